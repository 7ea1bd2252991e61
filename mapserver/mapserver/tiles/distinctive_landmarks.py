"""Distinctive landmarks of a survey, which look like nothing else in it: they tell an aisle from its aliases. Pure."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import packed
from fleetmap.geometry import Array
from mapserver.tiles import landmark_budget_kernels as kernels

# One thing differs from its twin by some 30 bits, two things by 128; twins stand equally high on the same floor.
_ALIKE_BITS, _HEIGHT_M = 60, 0.15
_OWN_M = 2.0  # within it the same thing may have been mapped twice
_REACH = 6  # among those that agree in two bytes
_MOST_COMPARED = 10_000  # what repeats not once among so many is as good as alone


def distinctive_landmarks(points_map: Array, descriptors: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(N,) which landmarks (N, 3) with descriptors (N, 32) have no twin: none equally high and further off that looks the same.

    Twins mostly agree in some two bytes, and are found side by side where all are sorted by those; the few without are then compared
    with all that stand equally high, in a large survey with a part of it, evenly chosen.
    """
    by_height = np.argsort(points_map[:, 2], kind="stable")  # the second search goes along it
    points, words = np.ascontiguousarray(points_map[by_height]), packed(descriptors[by_height])
    repeated = np.zeros(len(points), bool)
    for two_bytes in words.view(np.uint16).T:
        order = np.argsort(two_bytes, kind="stable")
        kernels.mark_repeated_near(words, points, order, _REACH, _ALIKE_BITS, _HEIGHT_M, _OWN_M, repeated)
    kernels.mark_repeated(words, points, _MOST_COMPARED, _ALIKE_BITS, _HEIGHT_M, _OWN_M, repeated)
    distinct = np.empty(len(points), bool)
    distinct[by_height] = ~repeated
    return distinct
