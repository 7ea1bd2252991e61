"""Localization of a drive in a version that does not change: odometry between keyframes, fixes at them. Pure.

A keyframe's fix is what robots' fixes are (`fleetmap.relocalization`). A place is believed once three keyframes over a metre agree.
"""

from dataclasses import dataclass

import numpy as np

from fleetmap.bow import Vocabulary
from fleetmap.geometry import Array, se3, se3_inverse, se3_log, so3_exp, so3_log
from fleetmap.mapformat import Tile
from fleetmap.messages import Cause, Status
from fleetmap.numerics.time_sliced import finished
from fleetmap.relocalization.frame_features import FrameFeatures, features_with_depth
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import Fix, Relocalizer, is_reliable
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.survey.live.live_values import LiveEstimate, LiveLoops, LiveParts, LiveRig, NewKeyframe
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999
from mapserver.survey.pose_graph.pose_graph import adjoint

_ROBOTS = RelocalizerSettings()
_AGREE_M, _AGREE_RAD = 0.5, 0.1
_MIN_FIXES, _MIN_WAY_M = 3, 1.0  # before a place is believed
_KNOWN_M, _LOST_M = 0.15, 1.0  # sigma of the position: above, a pose is DEGRADED, and then LOST
_ALIAS_RATIO = 0.7  # another place with so much of the support may be the true one


@dataclass(frozen=True)
class FrozenVersion:
    """A version as it is localized in."""

    version: int
    tiles: tuple[Tile, ...]
    vocabulary: Vocabulary
    focal_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A fix of a keyframe before any place is believed, and what it says of the odometry's frame."""

    frame_from_body: Array
    map_from_frame: Array
    cov: Array


class FrozenMap:
    """Takes every keyframe in turn, as `LiveMap`; the version stays what it is."""

    def __init__(self, version: FrozenVersion, rig: LiveRig) -> None:
        self._rig = rig
        self._view = MapView(version.tiles, version.vocabulary, version.focal_px)
        self._relocalizer = Relocalizer(self._view, rig.camera, _ROBOTS)
        self._news: list[NewKeyframe] = []
        self._placed: list[Array] = []  # map_from_body, as believed when it was driven
        self._tracked: list[bool] = []
        self._map_from_frame: Array | None = None
        self._cov = np.zeros((6, 6))  # of map_from_body, map axes, rotation first
        self._candidates: list[_Candidate] = []
        self._status, self._cause = Status.INITIALISING, Cause.NONE
        self.fixes, self._refused = 0, dict[str, int]()

    def __len__(self) -> int:
        return len(self._placed)

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) in `map` once a place is believed, in the odometry's frame before."""
        return np.array(self._placed).reshape(-1, 4, 4)

    def points_map(self) -> Array:
        """(N, 3) the version's landmarks."""
        return np.asarray(self._view.points_map, np.float64)

    def loops(self) -> LiveLoops:
        """No revisits; how many keyframes had no fix, or one that was not believed."""
        return LiveLoops(np.zeros((0, 2), np.int64), dict(self._refused))

    def parts(self) -> LiveParts:
        """One part: keyframes that were localized; the others are in none."""
        return LiveParts(np.where(self._tracked, 0, -1).astype(np.int64).reshape(-1), [])

    def estimate(self) -> LiveEstimate | None:
        """Where the newest keyframe is."""
        if not self._news:
            return None
        if self._map_from_frame is None:
            return LiveEstimate(self._news[-1], self._status, self._cause, None, None)
        return LiveEstimate(self._news[-1], self._status, self._cause, self._placed[-1], self._cov)

    def add(self, frame: RectifiedFrame, new: NewKeyframe) -> None:
        """One more keyframe: predicted by odometry, placed by what it sees of the version."""
        self._predict(new)
        query = features_with_depth(frame, self._rig.camera, _ROBOTS.orb, _ROBOTS.stereo)
        if self._map_from_frame is not None:
            self._track(query, new)
        if self._map_from_frame is None:
            self._search(query, new)
        placed = np.eye(4) if self._map_from_frame is None else self._map_from_frame
        self._placed.append(placed @ new.frame_from_body)
        self._tracked.append(self._status is Status.TRACKING)

    def _predict(self, new: NewKeyframe) -> None:
        self._news.append(new)
        if new.step_cov is not None and self._map_from_frame is not None:
            before = self._map_from_frame @ self._news[-2].frame_from_body
            turn = np.kron(np.eye(2), before[:3, :3])
            step_m = (self._map_from_frame @ new.frame_from_body)[:3, 3] - before[:3, 3]
            carry = adjoint(se3(np.eye(3), -step_m))  # what turns the body before moves the one after
            self._cov = carry @ self._cov @ carry.T + turn @ new.step_cov @ turn.T

    def _track(self, query: FrameFeatures, new: NewKeyframe) -> None:
        """A fix near the prediction moves it; without one its covariance grows until the place is lost."""
        assert self._map_from_frame is not None
        body_from_cam, predicted = self._rig.body_from_cam, self._map_from_frame @ new.frame_from_body
        fix = self._relocalizer.near(query, predicted @ body_from_cam, self._cov)
        if fix is not None and is_reliable(fix, _ROBOTS.fix) and self._take(fix, predicted, new):
            self.fixes += 1
        else:
            self._refuse("no fix")
        sigma_m = float(np.sqrt(np.trace(self._cov[3:, 3:])))
        if sigma_m > _LOST_M:
            self._map_from_frame, self._candidates = None, []
            self._status, self._cause = Status.LOST, Cause.NO_MATCH
            return
        known = sigma_m <= _KNOWN_M
        self._status, self._cause = (Status.TRACKING, Cause.NONE) if known else (Status.DEGRADED, Cause.UNMATCHED)

    def _take(self, fix: Fix, predicted: Array, new: NewKeyframe) -> bool:
        """The prediction corrected by a fix (Kalman, on the left); False where they contradict each other."""
        seen = fix.map_from_cam @ se3_inverse(self._rig.body_from_cam)
        turn = so3_log(seen[:3, :3] @ predicted[:3, :3].T)
        off = np.concatenate([turn, seen[:3, 3] - predicted[:3, 3]])
        total = self._cov + fix.cov_rot_trans
        if off @ np.linalg.solve(total, off) > CHI2_6_0999:
            return False
        gain = np.linalg.solve(total, self._cov).T
        moved = gain @ off
        corrected = se3(so3_exp(moved[:3]) @ predicted[:3, :3], predicted[:3, 3] + moved[3:])
        self._map_from_frame = corrected @ se3_inverse(new.frame_from_body)
        self._cov = (np.eye(6) - gain) @ self._cov
        return True

    def _search(self, query: FrameFeatures, new: NewKeyframe) -> None:
        """Fixes anywhere; a place is believed once several agree through the odometry, and nowhere else agrees as much."""
        if self._status is not Status.LOST:
            self._status = Status.INITIALISING
        found = [fix for fix in finished(self._relocalizer.anywhere(query)) if is_reliable(fix, _ROBOTS.fix)]
        if not found:
            self._refuse("no fix")
            self._cause = Cause.NO_MATCH
            return
        if len(found) > 1 or found[0].alias_ratio >= _ALIAS_RATIO:
            self._refuse("ambiguous")
            self._status, self._cause = Status.AMBIGUOUS, Cause.AMBIGUOUS
        body_from_cam, frame_from_body = self._rig.body_from_cam, new.frame_from_body
        for fix in found:
            map_from_frame = fix.map_from_cam @ se3_inverse(frame_from_body @ body_from_cam)
            self._candidates.append(_Candidate(frame_from_body, map_from_frame, fix.cov_rot_trans))
        groups = [self._agreeing(one) for one in self._candidates]
        best = max(groups, key=len)
        competitor = max((len(group) for group in groups if group[0] not in best), default=0)
        places = np.array([each.frame_from_body[:3, 3] for each in best])
        way_m = float(np.linalg.norm(places - places[0], axis=1).max())
        if len(best) >= _MIN_FIXES and way_m >= _MIN_WAY_M and 2 * competitor < len(best):
            last = max(best, key=self._candidates.index)
            self._map_from_frame, self._cov, self._candidates = last.map_from_frame, last.cov, []
            self._status, self._cause = Status.TRACKING, Cause.NONE
            self.fixes += 1

    def _agreeing(self, one: _Candidate) -> list[_Candidate]:
        """The candidates that put the newest of them where this one does, this one first."""
        here = self._news[-1].frame_from_body
        mine, same = one.map_from_frame @ here, [one]
        for other in self._candidates:
            off = se3_log(se3_inverse(mine) @ other.map_from_frame @ here)
            if other is not one and np.linalg.norm(off[3:]) < _AGREE_M and np.linalg.norm(off[:3]) < _AGREE_RAD:
                same.append(other)
        return same

    def _refuse(self, verdict: str) -> None:
        self._refused[verdict] = self._refused.get(verdict, 0) + 1
