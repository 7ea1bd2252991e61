"""Which descriptors of a map a picture shows: those with one of its own within some bits, looked for in the cells nearest to each."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.features.matching import Descriptors, packed
from fleetmap.relocalization import descriptor_index_kernels

_LEVEL = 2  # of the vocabulary's tree whose nodes are the cells
_CELLS = 4  # that are asked for each descriptor


class DescriptorIndex:
    """Descriptors (M, 32) by the cell of a vocabulary's tree that is nearest to them.

    A word is too small a cell: of two pictures of a corner, taken days apart, half lie in different words. Sources: Sivic and
    Zisserman 2003 on inverted files, Jegou, Douze and Schmid 2008 on asking several cells and comparing bits within them.
    """

    def __init__(self, descriptors: Descriptors, vocabulary: Vocabulary) -> None:
        self._centres = vocabulary.centres[_nodes_at(vocabulary, _LEVEL)]
        bits = packed(descriptors)
        cells = descriptor_index_kernels.nearest_cells(bits, self._centres, 1)[:, 0]
        self._order = np.argsort(cells, kind="stable")
        self._held = bits[self._order]
        self._starts = np.searchsorted(cells[self._order], np.arange(len(self._centres) + 1))

    def near(self, descriptors: Descriptors, max_bits: int) -> NDArray[np.bool_]:
        """(M,) which held descriptors are within max_bits of any of some others (N, 32)."""
        is_near = np.zeros(len(self._held), bool)
        asked = packed(descriptors)
        cells = descriptor_index_kernels.nearest_cells(asked, self._centres, _CELLS)
        descriptor_index_kernels.mark_near(asked, cells, self._held, self._starts, max_bits, is_near)
        found = np.zeros(len(is_near), bool)
        found[self._order] = is_near
        return found


def _nodes_at(vocabulary: Vocabulary, level: int) -> NDArray[np.int64]:
    """The nodes of a level of the tree and the leaves above it; the root where it has no children."""
    nodes, leaves = np.zeros(1, np.int64), np.zeros(0, np.int64)
    for _ in range(level):
        counts = vocabulary.child_count[nodes]
        leaves = np.concatenate([leaves, nodes[counts == 0]])
        inner = nodes[counts > 0]
        if not len(inner):
            break
        first = vocabulary.first_child[inner]
        nodes = np.concatenate([np.arange(a, a + n) for a, n in zip(first, vocabulary.child_count[inner], strict=True)])
    return np.unique(np.concatenate([leaves, nodes]))
