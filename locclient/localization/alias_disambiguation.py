"""Disambiguation of places that look alike, by landmarks that only one of them has. Pure.

Fix totals cannot do this: a sign at an aisle's end has ten landmarks among hundreds, and the map's budget selects different landmarks
of each aisle. So every hypothesis keeps a history: how often each landmark was expected, and how often it was observed. To compare
two hypotheses, their landmarks are superimposed in the odometry frame:

* Landmarks that look the same at the same position of both are excluded. Those of a third hypothesis do not support theirs: if the robot's
  own aisle is not mapped, its aliases would otherwise be distinguished by features that they share with it. If they are absent, they count
  against theirs: an object of one aisle alone mostly stands where all the others have the same one. If they are observed, they must not
  hide the absence of a sign in the same cell. So the comparison is made with and without them, and the stronger support counts.
* The others are compared cell by cell. In most cells both places contain the same object, mapped by different corners, or the
  object was removed. If the landmarks of one place are observed and those of the other never are, one of the two is wrong.
* A cell with landmarks of one place only is ignored: the budget may have dropped the other's, or a box may have been moved.
* Only cells beyond a threshold count, because the survey saw some aisles better than others and hundreds of weak cells would add up.
* The log odds of a block of cells are bounded, because a pallet can be moved from one aisle to another.

The result is a log Bayes factor (Kass and Raftery 1995); a landmark's observations follow a beta-binomial distribution.
"""

from dataclasses import dataclass, field
from math import lgamma

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.geometry import Array, Indices, rotation_angle_rad, se3_inverse, transform_points
from fleetmap.relocalization.map_view import CovisibleLandmarks

_MAX_LOOKS, _ALL_LOOKS = 64, (1 << 64) - 1  # in the history: about 20 m of travel
_MAX_LANDMARKS = 3000  # of a hypothesis: about 30 m of travel
_STEP_M, _STEP_RAD = 0.2, 0.15  # between counted looks: two looks from one viewpoint fail for the same reasons
_REACH_M, _ALIKE_BITS = 0.15, 75  # between landmarks of one object in two aisles; others differ by over 90 bits
# Sizes of a plate, a poster, a pallet: in one of the lattices, a single cell contains most of a sign and little else.
_LATTICES = np.array([(cell_m, shift) for cell_m in (0.35, 0.6, 0.9) for shift in (0.0, 0.5)])
_BLOCK_M, _MAX_BLOCKS = 1.8, 256
_MAX_BLOCK_LOG_ODDS = 3.0  # so that no single movable object decides
# Beta parameters of the share of looks in which a landmark is observed. If present: about two in five, and one in eight landmarks
# is never observed. If absent: by chance.
_PRESENT, _NEVER_SHARE, _ABSENT = (2.0, 2.8), 0.12, (0.5, 10.0)
Flags = NDArray[np.bool_]


# Prior probabilities of the content of a cell, as `core.block_log_odds` takes them.
_CELL_MODEL = (
    2.0,  # minimum number of absent landmarks: a single one may be one that is never observed
    0.05,  # share of cells whose stock was moved since the survey
    0.15,  # share of cells with an object without counterpart in the other place
    0.01,  # share of cells in which moved stock makes one place look like the other
    1.25,  # threshold, a logarithm: cells hardly reach this by chance
)


def is_other_viewpoint(since: Array) -> bool:
    """Return True if a motion (4, 4) leads to another viewpoint."""
    return bool(np.linalg.norm(since[:3, 3]) >= _STEP_M or rotation_angle_rad(since[:3, :3]) >= _STEP_RAD)


@dataclass(slots=True)
class ViewpointGate:
    """Admits a look only from another viewpoint than the last admitted one."""

    odom_from_body: Array | None = None

    def is_new(self, odom_from_body: Array) -> bool:
        """Return True if this look is admitted, and store it as the last one."""
        last = self.odom_from_body
        if last is not None and not is_other_viewpoint(se3_inverse(last) @ odom_from_body):
            return False
        self.odom_from_body = odom_from_body
        return True

    def redefine_odom(self, new_odom_from_old_odom: Array) -> None:
        if self.odom_from_body is not None:
            self.odom_from_body = new_odom_from_old_odom @ self.odom_from_body


@dataclass(slots=True)
class ObservationHistory:
    """Last looks of one hypothesis in which each landmark was expected, and in which it was found; ids (L,) ascending.

    Looks are bits, the newest is the lowest. looks: those with a fix at the hypothesis; expected, found (L,): per landmark.
    points_odom (L, 3): means over the looks. They coincide with those of another hypothesis that observed the same objects.
    """

    ids: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    points_odom: Array = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    expected: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    found: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    looks: int = 0

    def begin_look(self) -> None:
        """Begin a look without a fix at this hypothesis so far; drop landmarks that only the oldest look had."""
        self.looks = self.looks << 1 & _ALL_LOOKS
        self.expected, self.found = self.expected << np.uint64(1), self.found << np.uint64(1)
        self._keep(np.flatnonzero(self.expected))

    def add(self, odom_from_map: Array, observed: CovisibleLandmarks) -> None:
        self.looks |= 1
        ids, inverse = np.unique(np.concatenate([self.ids, observed.ids]), return_inverse=True)
        old, new = inverse[: len(self.ids)], inverse[len(self.ids) :]
        points, descriptors = np.zeros((len(ids), 3)), np.zeros((len(ids), 32), np.uint8)
        weights, (expected, found) = np.zeros(len(ids)), np.zeros((2, len(ids)), np.uint64)
        points[old], descriptors[old] = self.points_odom, self.descriptors
        expected[old], found[old], weights[old] = self.expected, self.found, np.bitwise_count(self.expected)
        step = transform_points(odom_from_map, observed.points_map) - points[new]
        points[new] += step / (weights[new] + 1.0)[:, None]
        descriptors[new] = observed.descriptors
        expected[new] |= np.uint64(1)
        found[new] |= observed.is_found.astype(np.uint64)
        self.ids, self.points_odom, self.descriptors = ids, points, descriptors
        self.expected, self.found = expected, found
        newest = expected & (~expected + np.uint64(1))  # the lowest bit
        self._keep(np.sort(np.argsort(newest, kind="stable")[:_MAX_LANDMARKS]))

    def counts(self, looks: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the number of these looks (bits) in which each landmark was expected (L,) and found (L,)."""
        mask = np.uint64(looks)
        return np.bitwise_count(self.expected & mask), np.bitwise_count(self.found & mask)

    def redefine_odom(self, new_odom_from_old_odom: Array) -> None:
        self.points_odom = transform_points(new_odom_from_old_odom, self.points_odom)

    def _keep(self, rows: Indices) -> None:
        self.ids, self.points_odom, self.descriptors = self.ids[rows], self.points_odom[rows], self.descriptors[rows]
        self.expected, self.found = self.expected[rows], self.found[rows]


def mark_shared(one: ObservationHistory, other: ObservationHistory, one_shared: Flags, other_shared: Flags) -> None:
    """Set the flags of the landmarks (L,), (M,) that look the same at the same position of the other place."""
    if len(one.ids) and len(other.ids):
        first = one.points_odom, packed(one.descriptors), one_shared
        core.mark_shared(first, (other.points_odom, packed(other.descriptors), other_shared), _REACH_M, _ALIKE_BITS)


def log_odds(one: ObservationHistory, other: ObservationHistory, one_shared: Flags, other_shared: Flags) -> float:
    """Return the log Bayes factor of the first hypothesis against the second, given the observations; 0 without evidence.

    Only looks with a fix at both count: a fix at a single hypothesis may be wrong. one_shared, other_shared: landmarks that look
    the same at the same position of any hypothesis, and so do not support theirs. Source: Kass and Raftery 1995 (Bayes factors).
    """
    common = one.looks & other.looks
    if not common or not len(one.ids) or not len(other.ids):
        return 0.0
    one_alike, other_alike = np.zeros(len(one.ids), bool), np.zeros(len(other.ids), bool)
    mark_shared(one, other, one_alike, other_alike)
    # The result is no larger than the better of the two comparisons: a wrong place needs one that is wrong by as much.
    against = max(_support(common, (other, other_shared), (one, flags)) for flags in (one_alike, one_shared))
    return max(_support(common, (one, one_shared), (other, flags)) for flags in (other_alike, other_shared)) - against


def _support(looks: int, one: tuple[ObservationHistory, Flags], other: tuple[ObservationHistory, Flags]) -> float:
    """Return the log odds of the blocks that support the first hypothesis in these looks; each with its excluded landmarks."""
    sides = []
    for history, excluded in (one, other):
        expected, found = history.counts(looks)
        sides.append((history.points_odom, _LOG_LIKELIHOODS[expected, found], excluded | (expected == 0)))
    strongest = core.block_log_odds(sides[0], sides[1], _LATTICES, _CELL_MODEL, _BLOCK_M, _MAX_BLOCKS)
    return float(np.clip(strongest, 0.0, _MAX_BLOCK_LOG_ODDS).sum())


def log_beta_binomial(expected: int, found: int, a: float, b: float) -> float:
    """Return the log probability of one sequence of `expected` looks, `found` of them positive, of a landmark with rate Beta(a, b)."""
    # log B(a + found, b + expected - found) - log B(a, b)
    seen, missed = a + found, b + expected - found
    return lgamma(seen) + lgamma(missed) - lgamma(a + b + expected) + lgamma(a + b) - lgamma(a) - lgamma(b)


def _log_likelihoods() -> Array:
    """Return (expected, found, 2): log likelihoods of these counts if the landmark is present, and if it is absent."""
    table = np.zeros((_MAX_LOOKS + 1, _MAX_LOOKS + 1, 2))
    for expected in range(_MAX_LOOKS + 1):
        for found in range(expected + 1):
            absent = log_beta_binomial(expected, found, *_ABSENT)
            present = log_beta_binomial(expected, found, *_PRESENT)
            never, often = np.log(_NEVER_SHARE) + absent, np.log1p(-_NEVER_SHARE) + present
            table[expected, found] = np.logaddexp(never, often), absent
    return table


_LOG_LIKELIHOODS = _log_likelihoods()
