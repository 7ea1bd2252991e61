"""Calibration watch: independent looks collected while the robot drives, and a test of each parameter. Pure."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.features import stereo
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse, transport_cov
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.pnp.pnp import Correspondences
from fleetmap.sensors.rectification import MountedRig
from locclient.localization.calibration import mounting
from locclient.localization.calibration.camera_view import CameraView, camera_view, pair_offsets
from locclient.localization.calibration.mounting import BasePose, WheelTravel
from locclient.localization.calibration.parameters import (
    BIAS_LIMIT_M,
    COUNT,
    DRIFT_SIGMAS,
    HEADING,
    HEIGHT,
    IMAGE,
    NOT_JUDGED,
    PARAMETERS,
    TILT,
    TIME_OFFSET,
    CalibrationState,
    Drift,
)
from locclient.localization.map_query import FinishedQuery

_STEP_M, _FIRST_STEP_M, _STEP_RAD = 1.0, 0.5, 0.35  # between two looks, and between the first ones
_MIN_NEW_SHARE = 0.1  # weight of a look without landmarks new to the window
# Number of looks: of the window, and for a test. One is enough for a confirmed pose: a fix at a wrong place may show any parameter.
_WINDOW, _MIN_LOOKS, _MIN_CONFIRMED_LOOKS = 40, 2, 1
# Number of latest looks that show a sudden change, and of earlier ones to compare with.
_RECENT, _MIN_BEFORE = (4, 10), 6
_FEW = 10  # looks; until then they are taken more often
# A standstill: maximum speed and duration. Odometry initialized in motion may mistake it for a standstill, with a wrong gravity.
_STOOD_M, _STOOD_S = 0.03, 0.35
# Share of a parameter's least sigma: error common to neighbouring looks, which the scatter of a few looks does not show.
_LOCAL_FLOORS = 2.0
_MAP_TILT_SIGMA_RAD = 0.05  # of a map surveyed without IMU, which is levelled by its cameras
_GRAVITY_MPS2, _UNHELD_S = 9.81, 0.9  # age of a fix beyond which no pose is TRACKING
_KNOCKED_RAD = np.pi / 4  # no knock turns a camera further; which sensor is wrong then is decided by `WheelAgreement`
_PRIOR_SIGMA = 10.0  # of a parameter: practically none; keeps the equations regular for unobserved parameters
_JUDGED_SIGMA_SHARE = 0.5  # a parameter known no better than this share of the prior was not judged


class CalibrationWatch:
    """Compares observations with the map in which the robot is localized. Estimates do not change until a parameter has drifted.

    Each look is linearized about the calibration with its own pose, so that information adds up; its weight is the share of its
    landmarks that no other look of the window showed, because a landmark's error is the same in all looks. A parameter's sigma is the
    largest of three: by the information, by the scatter of the looks, and its least sigma. One look has no scatter.

    Sources: Triggs et al. 2000 (self-calibration in bundle adjustment), Huber 1967 (covariance from the scatter of scores).
    """

    def __init__(self, rig: MountedRig, stereo_settings: StereoSettings) -> None:
        self._rig, self._stereo = rig, stereo_settings
        self._cam_from_body = se3_inverse(rig.mounted[0].body_from_cam)
        self._looks: deque[CameraView] = deque(maxlen=_WINDOW)
        self.wheels = WheelTravel()
        self._last_map_from_cam: Array | None = None
        self._last_base: BasePose | None = None
        self._stood_from: tuple[int, Array] | None = None  # the oldest query from nearly the same place
        self._has_stood = False
        self.state = NOT_JUDGED
        self.has_confirmed = False  # a look of a confirmed pose was added

    def handle(self, query: FinishedQuery) -> None:
        """Add a map query if it is a new look."""
        fix, frame = query.fix, query.frame
        assert fix is not None
        matched = fix.matched
        stamp_ns, place_m = query.odometry.stamp_ns, fix.map_from_cam[:3, 3]
        if self._stood_from is None or np.linalg.norm(place_m - self._stood_from[1]) > _STOOD_M:
            self._stood_from = stamp_ns, place_m
        self._has_stood |= (stamp_ns - self._stood_from[0]) * 1e-9 >= _STOOD_S
        is_first = query.is_confirmed and not self.has_confirmed
        if matched is None or not (is_first or self._is_new(fix.map_from_cam)):
            return
        self.has_confirmed |= query.is_confirmed
        self._last_map_from_cam = fix.map_from_cam
        seen = None
        if frame.right is not None:
            offsets = pair_offsets(frame, matched, fix.map_from_cam)
            seen = camera_view(_with_depth(matched, offsets[:, 0]), fix.map_from_cam, offsets[:, 1])
        information, score = np.zeros((COUNT + 2, COUNT + 2)), np.zeros(COUNT + 2)
        rows = slice(0) if fix.matches is None else fix.matches[:, 1]
        ids = frozenset(query.relocalizer.view.landmark_ids[rows].tolist())
        if seen is not None:
            share = self._new_share(ids)
            information[:IMAGE, :IMAGE], score[:IMAGE] = share * seen.information, share * seen.score
        self._add_mounting(query, information, score)
        shift = np.zeros((6, IMAGE)) if seen is None else seen.pose_per_parameter
        self._looks.append(CameraView(information, score, shift, ids))
        state = self._judged(_MIN_CONFIRMED_LOOKS if query.is_confirmed else _MIN_LOOKS)
        self.state = state._replace(drifts=(*state.drifts, *self._time_offset(query.odometry)))

    def handle_unmatched(self, query: FinishedQuery) -> None:
        """As `handle`, for a frame that matches the map only without its depth: measure the depth of the matched features."""
        fix = query.fix
        assert fix is not None and fix.matched is not None
        matched = fix.matched
        found = stereo.disparities(query.frame, matched.camera, matched.pixels[:, :2], self._stereo)
        pixels = np.column_stack([matched.pixels[:, :2], matched.pixels[:, 0] - found[:, 0]])
        self.handle(replace(query, fix=replace(fix, matched=replace(matched, pixels=pixels))))

    # --- looks --------------------------------------------------------------------------------------------------------

    def _is_new(self, map_from_cam: Array) -> bool:
        last = self._last_map_from_cam
        if last is None:
            return True
        moved_m = float(np.linalg.norm(map_from_cam[:3, 3] - last[:3, 3]))
        step_m = _STEP_M if len(self._looks) >= _FEW else _FIRST_STEP_M
        return moved_m > step_m or rotation_angle_rad(last[:3, :3].T @ map_from_cam[:3, :3]) > _STEP_RAD

    def _new_share(self, ids: frozenset[int]) -> float:
        """Return the share of landmarks that no look of the window has shown."""
        known = frozenset[int]().union(*(ids & look.ids for look in self._looks))
        return max(1.0 - len(known) / len(ids), _MIN_NEW_SHARE) if ids else 1.0

    def _add_mounting(self, query: FinishedQuery, information: Array, score: Array) -> None:
        fix, odometry = query.fix, query.odometry
        assert fix is not None
        if odometry.inertial and self._has_stood:
            jacobian, measured = mounting.tilt(fix, self._cam_from_body, odometry)
            at = np.r_[TILT, COUNT : COUNT + 2]
            information[np.ix_(at, at)] += jacobian.T @ jacobian
            score[at] += jacobian.T @ measured
        if not self.wheels.is_heard:
            return
        map_from_base = fix.map_from_cam @ self._cam_from_body @ se3_inverse(self._rig.base_from_body)
        covariance = transport_cov(fix.cov_rot_trans, map_from_base[:3, 3] - fix.map_from_cam[:3, 3])
        base = BasePose(map_from_base, covariance, self.wheels.at(odometry.stamp_ns))
        turned = None if self._last_base is None else mounting.heading(self._last_base, base)
        if turned is not None and abs(turned[0]) > _KNOCKED_RAD:
            turned = None
        height = mounting.height(base, query.relocalizer.view.points_map)
        for at_one, measurement in ((HEADING, turned), (HEIGHT, height)):
            if measurement is not None:
                value, sigma = measurement
                information[at_one, at_one] += sigma**-2
                score[at_one] += value * sigma**-2
        self._last_base = base

    def _time_offset(self, odometry: OdometryEstimate) -> list[Drift]:
        sigma = float(np.hypot(odometry.imu_minus_cam_sigma_s, TIME_OFFSET.least_sigma))
        if not np.isfinite(sigma):
            return []
        value = odometry.imu_minus_cam_s - self._rig.imu_minus_cam_s
        return [Drift(TIME_OFFSET, value, sigma, 0.0, abs(value) > max(TIME_OFFSET.limit, DRIFT_SIGMAS * sigma))]

    # --- judgement ----------------------------------------------------------------------------------------------------

    def _judged(self, min_looks: int) -> CalibrationState:
        """Judge the window. Looks before a sudden change at its end are dropped, so that knocks and repairs show at once."""
        looks = list(self._looks)
        if len(looks) < min_looks:
            return NOT_JUDGED
        for recent in _RECENT:
            if len(looks) >= recent + _MIN_BEFORE:
                before, sigma_before = _estimate(looks[:-recent])
                now, sigma_now = _estimate(looks[-recent:])
                is_known = np.isfinite(sigma_before) & np.isfinite(sigma_now)
                change = np.abs(now - before)[is_known] / np.hypot(sigma_before, sigma_now)[is_known]
                if change.size and change.max() > DRIFT_SIGMAS:
                    looks = looks[-recent:]
                    self._looks = deque(looks, maxlen=_WINDOW)
                    break
        value, sigma = _estimate(looks)
        return _state(looks, value, sigma)


def _with_depth(matched: Correspondences, right_px: Array) -> Correspondences:
    """Add columns of the right image where stereo matching, which searches the row only, found none."""
    columns = np.where(np.isnan(matched.pixels[:, 2]), right_px, matched.pixels[:, 2])
    return replace(matched, pixels=np.column_stack([matched.pixels[:, :2], columns]))


def _estimate(looks: Sequence[CameraView]) -> tuple[Array, Array]:
    """Return values and sigmas (COUNT,) of PARAMETERS by looks, infinite if unobserved; one look determines those of the images alone."""
    prior = np.array([_PRIOR_SIGMA] * COUNT + [_MAP_TILT_SIGMA_RAD] * 2) ** -2.0
    information = np.array([look.information for look in looks])
    score = np.array([look.score for look in looks])
    covariance = np.linalg.inv(information.sum(axis=0) + np.diag(prior))
    value = covariance @ score.sum(axis=0)
    off = (score - information @ value) @ covariance
    scatter = np.sqrt((off**2).sum(axis=0) * len(looks) / max(len(looks) - 1, 1))
    sigma = np.maximum(np.sqrt(np.diag(covariance)), scatter)[:COUNT]
    least = np.array([parameter.least_sigma for parameter in PARAMETERS])
    common = least * np.sqrt(1.0 + _LOCAL_FLOORS**2 / len(looks))
    is_shown = sigma < _JUDGED_SIGMA_SHARE * _PRIOR_SIGMA
    is_shown[IMAGE:] &= len(looks) >= _MIN_LOOKS
    return value[:COUNT], np.where(is_shown, np.hypot(sigma, common), np.inf)


def _state(looks: Sequence[CameraView], value: Array, sigma: Array) -> CalibrationState:
    shifts = np.array([look.pose_per_parameter for look in looks])  # (V, 6, IMAGE)
    each = shifts * value[:IMAGE]
    bias_m = np.sqrt((each[:, 3:] ** 2).sum(axis=1).mean(axis=0))
    drifts = []
    for k, parameter in enumerate(PARAMETERS):
        if not np.isfinite(sigma[k]):
            continue
        costs_m = float(bias_m[k]) if k < IMAGE else 0.0
        is_large = costs_m > BIAS_LIMIT_M or abs(value[k]) > parameter.limit
        is_drifted = bool(is_large and abs(value[k]) > DRIFT_SIGMAS * sigma[k])
        drifts.append(Drift(parameter, float(value[k]), float(sigma[k]), costs_m, is_drifted))
    wrong = [drift for drift in drifts if drift.is_drifted]
    cov_bias = max((_cov_bias(shifts[at], value, sigma) for at in (slice(None), slice(-1, None))), key=_squared_m)
    if not wrong:
        cov_bias += np.diag([0.0] * 3 + [_in_bends_m(_tilt_in_doubt(looks, value, sigma)) ** 2] * 3)
        is_excluded = _squared_m(cov_bias) <= BIAS_LIMIT_M**2
        return CalibrationState(tuple(drifts), None if is_excluded else cov_bias)
    wrong.sort(key=lambda drift: (-drift.bias_m, -abs(drift.value) / drift.sigma))
    text = "; ".join(drift.text for drift in wrong)
    return CalibrationState(tuple(drifts), cov_bias + _cov_elsewhere(value, sigma), text)


def _tilt_in_doubt(looks: Sequence[CameraView], value: Array, sigma: Array) -> float:
    """Return the camera rotation about the body's x or y, rad, by gravity if the map is level; 0 if turns of the robot exclude it."""
    covariance = np.linalg.inv(sum((look.information[TILT, TILT] for look in looks), 1e-9 * np.eye(2)))
    in_level_map = np.abs(covariance @ sum(look.score[TILT] for look in looks))
    least, limit = np.array([(PARAMETERS[k].least_sigma, PARAMETERS[k].limit) for k in range(TILT.start, TILT.stop)]).T
    common = least * np.sqrt(1.0 + _LOCAL_FLOORS**2 / len(looks))
    is_odd = in_level_map > np.maximum(limit, DRIFT_SIGMAS * np.hypot(np.sqrt(np.diag(covariance)), common))
    is_open = np.abs(value[TILT]) + 2.0 * sigma[TILT] > limit
    return float(np.max(in_level_map, where=is_odd & is_open, initial=0.0))


def _in_bends_m(tilt_rad: float) -> float:
    """Return the odometry error since a fix, after a bend that separates gravity from the accelerometer bias that hid a tilt."""
    return 0.5 * _GRAVITY_MPS2 * tilt_rad * _UNHELD_S**2


def _squared_m(covariance: Array) -> float:
    """Return the mean square of a pose's position error."""
    return float(np.trace(covariance[3:, 3:]))


def _cov_bias(shifts: Array, value: Array, sigma: Array) -> Array:
    """Return (6, 6), the mean square of pose errors by values and uncertainty of all parameters; rotation first, camera axes."""
    total = shifts @ value[:IMAGE]
    known = np.where(np.isfinite(sigma[:IMAGE]), sigma[:IMAGE], 0.0)
    covariance = (total[:, :, None] * total[:, None, :]).mean(axis=0)
    return np.asarray(covariance + (shifts * known**2 @ shifts.transpose(0, 2, 1)).mean(axis=0))


def _cov_elsewhere(value: Array, sigma: Array) -> Array:
    """Return (6, 6), the error by drifted parameters outside the window's places: BIAS_LIMIT_M for each at its limit, isotropic."""
    share = value[:IMAGE] / np.array([parameter.limit for parameter in PARAMETERS[:IMAGE]])
    of_mount = np.where(np.isfinite(sigma[IMAGE:]), value[IMAGE:], 0.0)
    squared = [float((of_mount[:3] ** 2).sum())] * 3
    in_bends_m = _in_bends_m(float(np.linalg.norm(of_mount[:2])))
    squared += [float((share**2).sum()) * BIAS_LIMIT_M**2 + float(of_mount[3] ** 2) + in_bends_m**2] * 3
    return np.diag(squared)
