"""Tells places that look alike apart by what stands in one of them and not in the others. Pure.

Totals do not: a sign at an aisle's end is ten landmarks among hundreds, and the map's budget takes other landmarks of each aisle.
So every place that is held remembers, landmark by landmark, how often it should have been seen and how often it was. Two places
are then laid over each other, as the robot's own way relates them. What looks the same in both says nothing and is left out, and so
is what any third place shares: a twin of an aisle that is not in the map itself would else be told from others by all that it shares
with that aisle. The rest is compared cell by cell: in almost all of them stands the same in both, of which the map holds other
corners, or it was taken away; where what the map holds of the one is found again and what it holds of the other never is, one of the
two is wrong. A cell of which only one place has landmarks says nothing: the budget may have chosen none, and a box may have been
moved. Nor do hundreds of cells that each say next to nothing: what the survey saw better in one aisle than in the other adds up as
well. A cell has to speak up, and no block of cells can decide alone, as all that a pallet carries can be carried from one aisle to
another.
"""

from dataclasses import dataclass, field
from math import lgamma

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import packed
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse, transform_points
from fleetmap.relocalization.map_view import CovisibleLandmarks
from locclient.localization import alias_disambiguation_kernels as kernels

Flags = NDArray[np.bool_]

_MOST_LOOKS, _ALL_LOOKS = 64, (1 << 64) - 1  # that are remembered: some 20 m of way
_MOST_LANDMARKS = 3000  # of a place: some 30 m of way
_STEP_M, _STEP_RAD = 0.2, 0.15  # between looks that count: two from the same spot fail for the same reasons
_REACH_M, _ALIKE_BITS = 0.15, 75  # of one thing's landmark, mapped in two aisles; others differ by 90 bits and more
# A plate, a poster, a pallet: some lattice has most of a sign in one cell, and little else with it.
_LATTICES = tuple((cell_m, shift) for cell_m in (0.35, 0.6, 0.9) for shift in (0.0, 0.5))
_BLOCK_M, _MOST_BLOCKS = 1.8, 256
_LEAST = 2.0  # landmarks whose absence says something: any single one may be one that is never found
# How often a landmark is found: where it stands about two looks in five, and one in eight never; where it does not, by chance.
_THERE, _NEVER_SHARE, _GONE = (2.0, 2.8), 0.12, (0.5, 10.0)
_TAKEN_SHARE = 0.05  # of the cells in which stock was moved since the survey
_DIFFERENT_SHARE = 0.15  # of the cells with something that looks the same nowhere in the other place
_ODD_SHARE = 0.01  # of those that mislead: stock moved to where it makes one place look like the other
_QUIET = 1.25  # a logarithm: cells say hardly more than this by chance, and that much is not heard
_MOST = 3.0  # from a block: no single thing that could have been carried here decides


@dataclass(slots=True)
class Spot:
    """From where the robot looked last, of the looks that count: two from the same spot fail for the same reasons."""

    odom_from_body: Array | None = None

    def is_new(self, odom_from_body: Array) -> bool:
        """Whether this look counts; it is the last one then."""
        if self.odom_from_body is not None:
            since = se3_inverse(self.odom_from_body) @ odom_from_body
            if np.linalg.norm(since[:3, 3]) < _STEP_M and rotation_angle_rad(since[:3, :3]) < _STEP_RAD:
                return False
        self.odom_from_body = odom_from_body
        return True

    def carry(self, new_odom_from_old_odom: Array) -> None:
        """The odometry began anew."""
        if self.odom_from_body is not None:
            self.odom_from_body = new_odom_from_old_odom @ self.odom_from_body


@dataclass(slots=True)
class Tally:
    """In which of the last looks each landmark of one place should have been seen, and in which it was; ids (L,) rise.

    Looks are bits, the newest the lowest. looks: those from this place; expected, found (L,): of each landmark. points_odom (L, 3):
    where the looks saw them, so that they are those of another place that has seen the same.
    """

    ids: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    points_odom: Array = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    expected: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    found: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    looks: int = 0

    def begin_look(self) -> None:
        """One more look, which says nothing of this place so far; what only the oldest knew is forgotten."""
        self.looks = self.looks << 1 & _ALL_LOOKS
        self.expected, self.found = self.expected << np.uint64(1), self.found << np.uint64(1)
        self._keep(np.flatnonzero(self.expected))

    def look(self, odom_from_map: Array, seen: CovisibleLandmarks) -> None:
        """What the look that began showed from here."""
        self.looks |= 1
        ids, inverse = np.unique(np.concatenate([self.ids, seen.ids]), return_inverse=True)
        old, new = inverse[: len(self.ids)], inverse[len(self.ids) :]
        points, (expected, found) = np.zeros((len(ids), 3)), np.zeros((2, len(ids)), np.uint64)
        descriptors, weights = np.zeros((len(ids), 32), np.uint8), np.zeros(len(ids))
        points[old], descriptors[old], expected[old], found[old] = (
            self.points_odom, self.descriptors, self.expected, self.found,
        )  # fmt: skip
        weights[old] = np.bitwise_count(self.expected)
        step = transform_points(odom_from_map, seen.points_map) - points[new]
        points[new] += step / (weights[new] + 1.0)[:, None]
        descriptors[new] = seen.descriptors
        expected[new] |= np.uint64(1)
        found[new] |= seen.is_found.astype(np.uint64)
        self.ids, self.points_odom, self.descriptors, self.expected, self.found = (
            ids,
            points,
            descriptors,
            expected,
            found,
        )
        newest = self.expected & (~self.expected + np.uint64(1))  # the lowest bit
        self._keep(np.sort(np.argsort(newest, kind="stable")[:_MOST_LANDMARKS]))

    def counts(self, looks: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """In how many of these looks (bits) each landmark was expected (L,) and found (L,)."""
        mask = np.uint64(looks)
        return np.bitwise_count(self.expected & mask), np.bitwise_count(self.found & mask)

    def carry(self, new_odom_from_old_odom: Array) -> None:
        """The odometry began anew."""
        self.points_odom = transform_points(new_odom_from_old_odom, self.points_odom)

    def _keep(self, rows: NDArray[np.int64]) -> None:
        self.ids, self.points_odom, self.descriptors = self.ids[rows], self.points_odom[rows], self.descriptors[rows]
        self.expected, self.found = self.expected[rows], self.found[rows]


def mark_shared(one: Tally, other: Tally, one_shared: Flags, other_shared: Flags) -> None:
    """Sets the flags of the landmarks (L,), (M,) that look the same at the same spot of the other place."""
    if len(one.ids) and len(other.ids):
        kernels.mark_alike(
            one.points_odom, packed(one.descriptors), other.points_odom, packed(other.descriptors), _REACH_M, _ALIKE_BITS,
            one_shared, other_shared,
        )  # fmt: skip


def evidence(one: Tally, other: Tally, one_shared: Flags, other_shared: Flags) -> float:
    """How much more likely what was seen is at the first place than at the second, a natural logarithm; 0 where nothing tells.

    By the looks from both: one that only one of them stands for was perhaps a bad one. one_shared, other_shared: landmarks that look
    the same at the same spot of any place that the robot may be at, of which none says which of them it is.
    """
    common = one.looks & other.looks
    if not common or not len(one.ids) or not len(other.ids):
        return 0.0
    counts = [tally.counts(common) for tally in (one, other)]
    scores = [_SCORES[expected, found] for expected, found in counts]
    alike, other_alike = (
        flags | (expected == 0) for flags, (expected, _) in zip((one_shared, other_shared), counts, strict=True)
    )
    slots = 1 << int(np.ceil(np.log2(2 * (len(alike) + len(other_alike)))))
    blocks, said, count = np.zeros(_MOST_BLOCKS, np.int64), np.zeros((_MOST_BLOCKS, len(_LATTICES))), 0
    for lattice, (cell_m, shift) in enumerate(_LATTICES):
        cells, middles, sums = np.zeros(slots, np.int64), np.zeros((slots, 3)), np.zeros((slots, 2, 3))
        for side, (tally, flags) in enumerate(((one, alike), (other, other_alike))):
            kernels.add_to_cells(tally.points_odom, scores[side], flags, side, cell_m, shift, cells, middles, sums)
        count = kernels.speak(
            sums,
            middles,
            lattice,
            _BLOCK_M,
            _LEAST,
            _TAKEN_SHARE,
            _DIFFERENT_SHARE,
            _ODD_SHARE,
            _QUIET,
            blocks,
            count,
            said,
        )
    most = np.maximum(said.max(axis=1), 0.0) - np.maximum(-said.min(axis=1), 0.0)
    return float(np.clip(most, -_MOST, _MOST).sum())


def log_found(expected: int, found: int, a: float, b: float) -> float:
    """The logarithm of the chance of one order of so many looks that found a landmark whose own share is Beta(a, b)."""
    return (
        lgamma(a + found)
        + lgamma(b + expected - found)
        - lgamma(a + b + expected)
        + lgamma(a + b)
        - lgamma(a)
        - lgamma(b)
    )


def _scores() -> Array:
    """(expected, found, 2): logarithms of the chance of these counts where the thing stands, and where it does not."""
    table = np.zeros((_MOST_LOOKS + 1, _MOST_LOOKS + 1, 2))
    for expected in range(_MOST_LOOKS + 1):
        for found in range(expected + 1):
            gone = log_found(expected, found, *_GONE)
            often = log_found(expected, found, *_THERE)
            table[expected, found] = np.logaddexp(np.log(_NEVER_SHARE) + gone, np.log1p(-_NEVER_SHARE) + often), gone
    return table


_SCORES = _scores()
