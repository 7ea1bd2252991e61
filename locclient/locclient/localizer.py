"""The localizer: samples and tiles in, one honest estimate for each frame out. Never touches a file, a socket or a clock."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.calibration import RigCalibration
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.mapformat import Tile
from fleetmap.odometry import Odometry, OdometryEstimate
from fleetmap.rectification import RectifiedFrame, StereoCamera
from fleetmap.samples import ImuSamples, PositionPrior, WheelSample
from locclient.map_view import MapView
from locclient.relocalizer import Fix, Relocalizer, Seen
from locclient.settings import LocalizerSettings

_RADIUS_95 = 2.796  # of a three-dimensional normal distribution, in sigmas


class Status(StrEnum):
    """What an estimate is worth."""

    INITIALISING = "INITIALISING"
    TRACKING = "TRACKING"
    DEGRADED = "DEGRADED"
    AMBIGUOUS = "AMBIGUOUS"
    LOST = "LOST"


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A place where the robot may be: map_from_body (4, 4) and how many fixes spoke for it."""

    map_from_body: Array
    support: int


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the body is.

    map_from_body (4, 4) and cov_rot_trans (6, 6) (map axes, rotation first) are None until there is anything to say. fix: this
    frame's own, None without one; refused: why a fix was not used. hypotheses: what speaks for which place while AMBIGUOUS.
    stage_s: seconds by the clock that was passed in, for odometry and for looking at the map.
    """

    stamp_ns: int
    status: Status
    map_from_body: Array | None
    cov_rot_trans: Array | None
    map_version: int | None
    fix: Fix | None
    refused: str
    innovation: float | None
    hypotheses: tuple[Hypothesis, ...]
    odometry: OdometryEstimate
    stage_s: dict[str, float]


@dataclass
class _Anchor:
    """Where the body was in `map` at one frame of the odometry, and everything that speaks for it.

    map_from_body and cov_rot_trans: at that frame. now_map_from_body, now_cov: the same carried to the present.
    """

    frame_index: int
    stamp_ns: int
    map_from_body: Array
    cov_rot_trans: Array
    now_map_from_body: Array
    now_cov: Array
    support: int = 1
    misses: int = 0
    travelled_m: float = 0.0
    strangers: list["_Anchor"] = field(default_factory=list)


class Localizer:
    """Localises one robot in one map version; a new version is taken over without losing the place."""

    def __init__(
        self, calibration: RigCalibration, camera: StereoCamera, body_from_cam: Array, imu_minus_cam_s: float, settings: LocalizerSettings,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:  # fmt: skip
        """`clock` (seconds) measures the stages; the default measures nothing."""
        self._clock = clock
        self._stage_s: dict[str, float] = {}
        self._settings = settings
        self._camera, self._body_from_cam = camera, body_from_cam
        self._cam_from_body = se3_inverse(body_from_cam)
        self._base_from_body = calibration.base_from_body
        self._odometry = Odometry(
            calibration, camera, body_from_cam, imu_minus_cam_s, settings.odometry, settings.stereo
        )
        self._relocalizer: Relocalizer | None = None
        self._map_version: int | None = None
        self._prior: PositionPrior | None = None
        self._way_since_prior_m = 0.0
        self._anchor: _Anchor | None = None  # the confirmed place
        self._candidates: list[_Anchor] = []  # unconfirmed ones
        self._last_odom: Array | None = None
        self._last_look_ns: int | None = None
        self._ever_tracked = False

    def handle_imu(self, samples: ImuSamples) -> None:
        """IMU samples newer than any before."""
        self._odometry.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Wheel odometry newer than any before."""
        self._odometry.handle_wheel(samples)

    def handle_prior(self, prior: PositionPrior) -> None:
        """A coarse place at this moment; used for the search until a fix has been confirmed, widened by the way since."""
        self._prior, self._way_since_prior_m = prior, 0.0

    def handle_version(
        self, version: int, tiles: Iterable[Tile], vocabulary: Vocabulary, survey_focal_px: float
    ) -> None:
        """The tiles around, of one version; takes the place of what was held."""
        self._relocalizer = Relocalizer(MapView(tiles, vocabulary, survey_focal_px), self._camera, self._settings)
        self._map_version = version

    def handle_stereo(self, frame: RectifiedFrame) -> Estimate:
        """The estimate at `frame`, newer than any before."""
        begun = self._clock()
        odometry = self._odometry.handle_stereo(frame)
        tracked = self._clock()
        self._follow(odometry)
        fix, refused, innovation = None, "", None
        if self._relocalizer is not None and self._is_due(frame.stamp_ns, odometry):
            fix, refused, innovation = self._look(frame, odometry)
        self._stage_s = {"odometry": tracked - begun, "map": self._clock() - tracked}
        return self._estimate(odometry, fix, refused, innovation)

    # --- odometry in, drift out ------------------------------------------------------------------------------------------

    def _follow(self, odometry: OdometryEstimate) -> None:
        """Carries every anchor to the present frame and counts the way."""
        change = odometry.new_odom_from_old_odom
        last = None if self._last_odom is None else self._last_odom if change is None else change @ self._last_odom
        step = np.eye(4) if last is None else se3_inverse(last) @ odometry.odom_from_body
        self._way_since_prior_m += float(np.linalg.norm(step[:3, 3]))
        anchors = [*([self._anchor, *self._anchor.strangers] if self._anchor else []), *self._candidates]
        for anchor in anchors:
            anchor.travelled_m += float(np.linalg.norm(step[:3, 3]))
            self._carry(anchor, odometry, step)
        self._last_odom = odometry.odom_from_body

    def _carry(self, anchor: _Anchor, odometry: OdometryEstimate, step: Array) -> None:
        """From the anchor's frame while the odometry holds it (exact), else on from the last frame; re-anchors before it is forgotten."""
        settings = self._settings.track
        motion = self._odometry.motion_since(anchor.frame_index)
        if motion is None:  # the odometry began anew since: one step on its estimates alone
            loose = np.diag([0.02**2] * 3 + [(0.05 + 0.1 * float(np.linalg.norm(step[:3, 3]))) ** 2] * 3)
            anchor.now_map_from_body, anchor.now_cov = _compose(anchor.now_map_from_body, anchor.now_cov, step, loose)
        else:
            distance = float(np.linalg.norm(motion[0][:3, 3]))
            floor = np.diag([0.0] * 3 + [(settings.drift_floor_m + settings.drift_share * distance) ** 2] * 3)
            anchor.now_map_from_body, anchor.now_cov = _compose(
                anchor.map_from_body, anchor.cov_rot_trans, motion[0], motion[1] + floor
            )
        if motion is None or anchor.frame_index == self._odometry.oldest_frame_index:
            anchor.frame_index = odometry.frame_index
            anchor.map_from_body, anchor.cov_rot_trans = anchor.now_map_from_body, anchor.now_cov

    def _is_due(self, stamp_ns: int, odometry: OdometryEstimate) -> bool:
        last = self._last_look_ns
        return (
            last is None
            or odometry.after_gap
            or (stamp_ns - last) * 1e-9 >= 0.999 * self._settings.track.fix_interval_s
        )

    # --- looking at the map ----------------------------------------------------------------------------------------------

    def _look(self, frame: RectifiedFrame, odometry: OdometryEstimate) -> tuple[Fix | None, str, float | None]:
        assert self._relocalizer is not None
        self._last_look_ns = frame.stamp_ns
        seen = self._relocalizer.look(frame)
        if self._anchor is not None:
            map_from_body, covariance = self._anchor.now_map_from_body, self._anchor.now_cov
            map_from_cam = map_from_body @ self._body_from_cam
            fix = self._relocalizer.near(seen, map_from_cam, self._at_camera(map_from_body, covariance))
            if fix is None:
                fixes = self._relocalizer.anywhere(seen, None, map_from_cam[:3, :3])
                fix = fixes[0] if fixes and fixes[0].inliers >= self._settings.fix.min_inliers else None
            if fix is None:
                return None, "nothing in the map agrees with this frame", None
            return self._correct(fix, map_from_body, covariance, odometry)
        fixes = self._search(seen)
        return self._weigh(fixes, odometry)

    def _search(self, seen: Seen) -> list[Fix]:
        """Fixes anywhere, around the candidates first; inside the prior where there is one."""
        assert self._relocalizer is not None
        relocalizer = self._relocalizer
        fixes: list[Fix] = []
        for candidate in self._candidates:
            map_from_body, covariance = candidate.now_map_from_body, candidate.now_cov
            fix = relocalizer.near(
                seen, map_from_body @ self._body_from_cam, self._at_camera(map_from_body, covariance)
            )
            if fix is not None:
                fixes.append(fix)
        known = None
        if len(self._candidates) == 1:
            known = (self._candidates[0].now_map_from_body @ self._body_from_cam)[:3, :3]
        fixes += relocalizer.anywhere(seen, self._places_in_prior(), known)
        return [f for f in fixes if f.inliers >= self._settings.fix.min_inliers and self._in_prior(f)]

    def _prior_cov_m2(self) -> Array:
        """(2, 2) of the prior's horizontal position now: the way since may have led anywhere."""
        assert self._prior is not None
        return np.asarray(self._prior.cov_rot_trans[3:5, 3:5] + (0.05**2 + self._way_since_prior_m**2) * np.eye(2))

    def _places_in_prior(self) -> NDArray[np.bool_] | None:
        if self._prior is None or self._relocalizer is None:
            return None
        off = self._relocalizer.view.map_from_cam[:, :2, 3] - self._prior.map_from_base[:2, 3]
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._prior_cov_m2())[-1]))
        return np.asarray(np.linalg.norm(off, axis=1) < 3.7 * sigma + 10.0)

    def _in_prior(self, fix: Fix) -> bool:
        """Whether a fix lies within the 0.999 bound of the prior's position."""
        if self._prior is None:
            return True
        map_from_base = fix.map_from_cam @ self._cam_from_body @ se3_inverse(self._base_from_body)
        off = map_from_base[:2, 3] - self._prior.map_from_base[:2, 3]
        return bool(off @ np.linalg.solve(self._prior_cov_m2(), off) < 13.816)

    # --- tracking --------------------------------------------------------------------------------------------------------

    def _correct(
        self, fix: Fix, map_from_body: Array, covariance: Array, odometry: OdometryEstimate
    ) -> tuple[Fix | None, str, float | None]:
        """Kalman update of the confirmed place; a fix outside its gate is refused, unless such fixes agree among themselves."""
        assert self._anchor is not None
        measured, measured_cov = self._at_body(fix)
        error = _difference(measured, map_from_body)
        spread = covariance + measured_cov
        innovation = float(error @ np.linalg.solve(spread, error))
        if innovation > self._settings.track.innovation_limit:
            self._consider_kidnapping(fix, odometry)
            return (
                None,
                f"the fix is {np.linalg.norm(error[3:]):.2f} m off, more than its covariance admits",
                innovation,
            )
        gain = np.linalg.solve(spread, covariance).T
        corrected = _apply(gain @ error, map_from_body)
        rest = np.eye(6) - gain
        updated = rest @ covariance @ rest.T + gain @ measured_cov @ gain.T
        anchor = self._new_anchor(corrected, updated, odometry)
        anchor.support = self._anchor.support + 1
        self._anchor = anchor
        return fix, "", innovation

    def _consider_kidnapping(self, fix: Fix, odometry: OdometryEstimate) -> None:
        """Refused fixes that agree with each other, frame after frame, end the belief in the old place; they must be confirmed anew."""
        assert self._anchor is not None
        settings = self._settings.track
        self._candidates = self._anchor.strangers
        for candidate in self._candidates:
            candidate.misses += 1
        self._weigh_one(fix, odometry)
        self._anchor.strangers = [c for c in self._candidates if c.misses < settings.max_misses]
        self._candidates = []
        if max(c.support for c in self._anchor.strangers) >= settings.kidnap_fixes:
            self._candidates, self._anchor = self._anchor.strangers, None

    # --- confirmation ----------------------------------------------------------------------------------------------------

    def _weigh(self, fixes: list[Fix], odometry: OdometryEstimate) -> tuple[Fix | None, str, float | None]:
        """Every fix speaks for a candidate or begins one; confirmed is the one that is left with enough behind it."""
        for candidate in self._candidates:
            candidate.misses += 1
        for fix in fixes:
            self._weigh_one(fix, odometry)
        self._candidates = [c for c in self._candidates if c.misses < self._settings.track.max_misses]
        if not fixes:
            return None, "nothing in the map agrees with this frame", None
        best = max(self._candidates, key=lambda c: c.support)
        rivals = [
            c
            for c in self._candidates
            if c is not best and c.support >= self._settings.track.rival_share * best.support
        ]
        if not rivals and self._is_confirmed(best):
            self._anchor, self._candidates, self._prior = best, [], None
            self._ever_tracked = True
        if rivals:
            return None, f"{len(rivals) + 1} places agree with what was seen", None
        own = [f for f in fixes if np.linalg.norm(self._at_body(f)[0][:3, 3] - best.now_map_from_body[:3, 3]) < 0.3]
        return (own[0], "", None) if own else (None, "the fix does not agree with those before", None)

    def _weigh_one(self, fix: Fix, odometry: OdometryEstimate) -> None:
        settings = self._settings.track
        measured, measured_cov = self._at_body(fix)
        for candidate in self._candidates:
            predicted, covariance = candidate.now_map_from_body, candidate.now_cov
            error = _difference(measured, predicted)
            close = np.linalg.norm(error[3:]) < settings.hypothesis_distance_m + 3 * np.sqrt(
                np.trace(covariance[3:, 3:])
            )
            if close and np.linalg.norm(error[:3]) < np.radians(settings.hypothesis_angle_deg) + 3 * np.sqrt(
                np.trace(covariance[:3, :3])
            ):
                if candidate.misses:  # at most one vote a frame
                    candidate.support, candidate.misses = candidate.support + 1, 0
                candidate.frame_index, candidate.stamp_ns = odometry.frame_index, odometry.stamp_ns
                candidate.map_from_body, candidate.cov_rot_trans = measured, measured_cov
                candidate.now_map_from_body, candidate.now_cov = measured, measured_cov
                return
        self._candidates.append(self._new_anchor(measured, measured_cov, odometry))

    def _is_confirmed(self, candidate: _Anchor) -> bool:
        settings = self._settings.track
        tight = (
            self._prior is not None
            and np.sqrt(np.linalg.eigvalsh(self._prior_cov_m2())[-1]) <= settings.tight_prior_sigma_m
        )
        enough = (
            candidate.support >= settings.confirming_fixes and candidate.travelled_m >= settings.confirming_distance_m
        )
        return bool(tight or enough)

    def _new_anchor(self, map_from_body: Array, covariance: Array, odometry: OdometryEstimate) -> _Anchor:
        return _Anchor(odometry.frame_index, odometry.stamp_ns, map_from_body, covariance, map_from_body, covariance)

    # --- output ----------------------------------------------------------------------------------------------------------

    def _estimate(
        self, odometry: OdometryEstimate, fix: Fix | None, refused: str, innovation: float | None
    ) -> Estimate:
        settings = self._settings.track
        if self._anchor is not None:
            map_from_body, covariance = self._anchor.now_map_from_body, self._anchor.now_cov
            radius = _RADIUS_95 * float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
            age_s = (odometry.stamp_ns - self._anchor.stamp_ns) * 1e-9
            if radius > settings.lost_radius_m:
                status = Status.LOST
            elif radius > settings.degraded_radius_m or age_s > settings.degraded_after_s:
                status = Status.DEGRADED
            else:
                status = Status.TRACKING
            return Estimate(
                odometry.stamp_ns, status, map_from_body, self._published(covariance), self._map_version, fix, refused, innovation, (),
                odometry, self._stage_s,
            )  # fmt: skip
        ranked = sorted(self._candidates, key=lambda c: -c.support)
        hypotheses = tuple(Hypothesis(c.now_map_from_body, c.support) for c in ranked)
        rivals = [c for c in ranked[1:] if c.support >= settings.rival_share * ranked[0].support]
        status = Status.AMBIGUOUS if rivals else Status.LOST if self._ever_tracked else Status.INITIALISING
        best = ranked[0] if ranked and not rivals else None
        return Estimate(
            odometry.stamp_ns, status, None if best is None else best.now_map_from_body,
            None if best is None else self._published(best.now_cov), self._map_version, fix, refused,
            innovation, hypotheses, odometry, self._stage_s,
        )  # fmt: skip

    def _published(self, covariance: Array) -> Array:
        """With the map's own uncertainty, which is common to all fixes: no number of them averages it away."""
        settings = self._settings.track
        return covariance + np.diag([settings.map_sigma_rad**2] * 3 + [settings.map_sigma_m**2] * 3)

    def _at_body(self, fix: Fix) -> tuple[Array, Array]:
        """A fix as map_from_body with its covariance (map axes, about the body)."""
        map_from_body = fix.map_from_cam @ self._cam_from_body
        return map_from_body, _moved(fix.cov_rot_trans, map_from_body[:3, 3] - fix.map_from_cam[:3, 3])

    def _at_camera(self, map_from_body: Array, covariance: Array) -> Array:
        return _moved(covariance, (map_from_body @ self._body_from_cam)[:3, 3] - map_from_body[:3, 3])


def _moved(cov_rot_trans: Array, lever_m: Array) -> Array:
    """The covariance of a point at `lever_m` from the one it was given for, on the same rigid thing; map axes."""
    carry = np.eye(6)
    carry[3:, :3] = -np.array(
        [[0, -lever_m[2], lever_m[1]], [lever_m[2], 0, -lever_m[0]], [-lever_m[1], lever_m[0], 0]]
    )
    return np.asarray(carry @ cov_rot_trans @ carry.T)


def _compose(map_from_body: Array, covariance: Array, body_from_next: Array, cov_step: Array) -> tuple[Array, Array]:
    """map_from_next and its covariance (map axes): a place moved on by a step whose covariance is left, in the body's axes."""
    rotation = map_from_body[:3, :3]
    lever = rotation @ body_from_next[:3, 3]
    turn = np.kron(np.eye(2), rotation)
    return map_from_body @ body_from_next, _moved(covariance + turn @ cov_step @ turn.T, lever)


def _difference(measured: Array, predicted: Array) -> Array:
    """(6,) rotation and position of measured against predicted, map axes."""
    return np.concatenate([so3_log(measured[:3, :3] @ predicted[:3, :3].T), measured[:3, 3] - predicted[:3, 3]])


def _apply(error: Array, map_from_body: Array) -> Array:
    return se3(so3_exp(error[:3]) @ map_from_body[:3, :3], map_from_body[:3, 3] + error[3:])
