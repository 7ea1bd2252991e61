"""Columns of integers as bytes: byte planes, and increasing ids as differences."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.mapformat.tile import Ids, check_increasing


def differences(ids: Ids) -> Ids:
    """Each id less the one before it, the first as it is."""
    return np.diff(ids, prepend=np.uint32(0)) if len(ids) else ids


def planes(values: Ids, width: int) -> bytes:
    """The low `width` bytes of each value, as byte planes: all low bytes, then all next ones."""
    return values.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :width].T.tobytes()


class Columns:
    """Reads a payload column by column; the caller has checked that it is long enough. `what` names it in messages."""

    def __init__(self, payload: bytes, offset: int, what: str) -> None:
        self._data = np.frombuffer(payload, np.uint8)
        self._offset = offset
        self._what = what

    def bytes(self, count: int) -> NDArray[np.uint8]:
        """The next `count` bytes."""
        self._offset += count
        return self._data[self._offset - count : self._offset]

    def planes(self, count: int, width: int) -> Ids:
        """The next `count` values of `width` byte planes."""
        rows = np.zeros((count, 4), np.uint8)
        rows[:, :width] = self.bytes(count * width).reshape(width, count).T
        return rows.view("<u4").reshape(count).astype(np.uint32)

    def increasing(self, count: int) -> Ids:
        """The next `count` ids; raises MapFormatError unless they are strictly increasing."""
        return self._sums(self.planes(count, 4))

    def increasing_lists(self, counts: NDArray[np.int64]) -> tuple[Ids, ...]:
        """The next lists of ids, of so many each; errors as of `increasing`."""
        values = self.planes(int(counts.sum()), 4)
        return tuple(self._sums(part) for part in np.split(values, np.cumsum(counts)[:-1])) if len(counts) else ()

    def _sums(self, steps: Ids) -> Ids:
        sums = np.cumsum(steps.astype(np.uint64))
        if len(sums) and sums[-1] >= 1 << 32:
            raise MapFormatError(
                f"{self._what}: an id adds up to {sums[-1]}, more than 32 bits hold; the bytes are damaged"
            )
        ids = sums.astype(np.uint32)
        check_increasing(ids, f"{self._what}: ids")
        return ids
