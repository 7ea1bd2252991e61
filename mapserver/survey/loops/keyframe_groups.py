"""Groups of keyframes in a survey that lost tracking, and the evidence needed to join two of them by revisits.

Within a group odometry gives the relative poses, and the gate of `LoopCloser` uses them. Between groups they are unknown:
one similar place would join them wrongly. So several revisits must agree, over some distance.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fleetmap.geometry import Indices, se3_inverse, so3_log
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge

_MIN_KEYFRAMES = 3  # that agree on the pose of their group
_MIN_WAY_M = 1.0  # between the outermost of them: TRACKING is reported after the same distance
_MOST_COMPETITORS = 1 / 3  # contradicting keyframes per agreeing one
_FLOOR_M, _FLOOR_RAD, _SIGMAS = 0.3, 0.15, 3.0


class KeyframeGroups:
    """Groups of connected keyframes (disjoint sets)."""

    def __init__(self, joins: Iterable[tuple[int, int]] = (), count: int = 0) -> None:
        self._parents = list(range(count))
        for a, b in joins:
            self.join(a, b)

    def __len__(self) -> int:
        return len(self._parents)

    def grow(self, count: int) -> None:
        """Add keyframes, each as its own group."""
        self._parents += range(len(self._parents), count)

    def join(self, a: int, b: int) -> None:
        """Join the groups of keyframes a and b; a group is named by its first keyframe."""
        first, second = sorted((self.of(a), self.of(b)))
        self._parents[second] = first

    def of(self, k: int) -> int:
        """Return the first keyframe of k's group."""
        while self._parents[k] != k:
            self._parents[k] = self._parents[self._parents[k]]
            k = self._parents[k]
        return k

    def labels(self) -> Indices:
        """Return (K,) the group of each keyframe, by its first keyframe."""
        return np.array([self.of(k) for k in range(len(self._parents))], np.int64)


@dataclass(frozen=True, slots=True)
class Revisit:
    """A verified match of a keyframe with one of another group: the edge from that (its j) to it (its i), the number of its record."""

    edge: PoseEdge
    record: int


@dataclass
class WaitingRevisits:
    """Revisits between groups that wait for others that agree with them."""

    _waiting: list[Revisit] = field(default_factory=list)

    def add(self, revisit: Revisit, groups: KeyframeGroups, marginals: GraphMarginals) -> list[Revisit]:
        """Add one; return all that join its two groups if it completes the evidence, else an empty list."""
        pair = _pair(revisit, groups)
        beside = [other for other in self._waiting if _pair(other, groups) == pair]
        self._waiting.append(revisit)
        agreeing = [revisit, *(other for other in beside if _agree(revisit, other, marginals))]
        competitors = {other.edge.i for other in beside if other not in agreeing}
        keyframes = sorted({other.edge.i for other in agreeing})
        places = marginals.map_from_body[keyframes, :3, 3]
        way_m = max(float(np.linalg.norm(a - b)) for a in places for b in places)
        is_short = len(keyframes) < _MIN_KEYFRAMES or way_m < _MIN_WAY_M
        if is_short or len(competitors) > _MOST_COMPETITORS * len(keyframes):
            return []
        self._waiting = [other for other in self._waiting if other not in agreeing]
        return sorted(agreeing, key=lambda each: each.record)


def _pair(revisit: Revisit, groups: KeyframeGroups) -> tuple[int, int]:
    return groups.of(revisit.edge.i), groups.of(revisit.edge.j)


def _agree(one: Revisit, other: Revisit, marginals: GraphMarginals) -> bool:
    """True if two revisits put the new group at the same pose, within the accuracy of odometry within the groups."""
    a, b, placed = one.edge, other.edge, marginals.map_from_body
    new_from_new, old_from_old = (se3_inverse(placed[q]) @ placed[p] for p, q in ((a.i, b.i), (b.j, a.j)))
    off = se3_inverse(b.i_from_j) @ new_from_new @ a.i_from_j @ old_from_old
    covs = (marginals.relative_cov(p, q) for p, q in ((a.i, b.i), (a.j, b.j)) if p != q)
    sigma_m = float(np.sqrt(sum(float(np.trace(cov[3:, 3:])) for cov in covs)))
    far = np.linalg.norm(off[:3, 3]) > _FLOOR_M + _SIGMAS * sigma_m
    return not far and bool(np.linalg.norm(so3_log(off[:3, :3])) < _FLOOR_RAD)
