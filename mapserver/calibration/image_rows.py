"""Image rows of the adjustment: each observation against its landmark, as a function of the calibration.

Measured pixels are mapped back to the raw images once; their rectified positions follow from the lenses, so a changed calibration moves
the measurements and needs no new images. Rows are compared at the scale of the raw pixels, whose noise is known: at that of the rectified
image a longer focal length would shrink the errors, and so seem more likely than it is; the more so, the wider the lens.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, so3_exp
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import StereoCamera
from mapserver.calibration.motion_rows import CalibrationData, MotionState
from mapserver.calibration.parameters import (
    COLUMNS,
    DISTORTION,
    INDEX,
    UNKNOWNS,
    CalibrationParameter,
    RigAxes,
    corrected_rig,
    right_camera,
)
from mapserver.survey.bundle.problem import ImageRows

P = CalibrationParameter
_MIN_DEPTH_M = 0.05
_STEP_PX = 0.1  # of the numerical derivative of rectified by raw pixels
_BEHIND_SIGMAS = 1000.0  # residual of a landmark behind the camera: beyond every cutoff, with zero slope
# Columns that move what the left lens measures
_LEFT_LENS = {
    INDEX[P.FOCAL],
    INDEX[P.PRINCIPAL_X],
    INDEX[P.PRINCIPAL_Y],
    *range(len(COLUMNS), len(COLUMNS) + 2 * DISTORTION),
}
# Step sizes of the numerical derivatives of the measurements: lenses in shares and pixels, the pair's angles, distortion
_LENS_STEPS = dict.fromkeys((INDEX[P.FOCAL], INDEX[P.FOCAL_RATIO]), 1e-5)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PRINCIPAL_X], INDEX[P.PRINCIPAL_Y]), 0.01)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PAIR_PITCH], INDEX[P.PAIR_YAW], INDEX[P.PAIR_ROLL]), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(len(COLUMNS), len(COLUMNS) + 2 * DISTORTION), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(len(COLUMNS) + 2 * DISTORTION, UNKNOWNS), 0.01)
_PLACE = [INDEX[p] for p in (P.BASELINE, P.BASELINE_Y, P.BASELINE_Z)]
_TURN = slice(INDEX[P.CAMERA_IMU_X], INDEX[P.CAMERA_IMU_Z] + 1)
_SHIFT = slice(INDEX[P.CAMERA_POSITION_X], INDEX[P.CAMERA_POSITION_Z] + 1)


class Measured(NamedTuple):
    """Observations at a calibration, or their derivatives by it, with the columns last.

    rows (M, 4): left pixel, disparity, row difference in the image rectified by it. as_given (M, 2, 2): turns errors of pixels
    there into those in the image rectified by the given calibration, in which their sigmas are known.
    """

    rows: Array
    as_given: Array


class Fixed(NamedTuple):
    """Nearly constant values near a state: rates_map (K, 3), angular rate of the body, and `Observations.measured_slopes`."""

    rates_map: Array
    slopes: Measured


@dataclass(frozen=True)
class Observations:
    """Raw pixels (M, 2) in the left and the right image, and the sigmas of the rows (M, 4), infinite without an observation."""

    calibration: RigCalibration
    axes: RigAxes
    camera: StereoCamera
    left_px: Array
    right_px: Array
    row_sigmas: Array

    @classmethod
    def of(cls, data: CalibrationData) -> "Observations":
        """Return the observations of `data` in raw pixels."""
        rig, camera = data.calibration, data.rectifier.camera
        axes = RigAxes.of(rig, data.rectifier)
        pixels, sigma = data.obs_pixels, data.obs_sigma_px
        left = rig.cameras[0].pixel_from_ray(_rays(camera, pixels[:, :2]) @ axes.rect_from_cam[0])
        right = np.full_like(left, np.nan)
        if axes.baseline_m > 0:
            right = rig.cameras[1].pixel_from_ray(_rays(camera, pixels[:, 2:]) @ axes.rect_from_cam[1])
        sigmas = np.column_stack([sigma[:, 0], sigma[:, 0], sigma[:, 1], sigma[:, 2]])
        sigmas[~np.isfinite(left).all(axis=1)] = np.inf
        sigmas[~np.isfinite(right).all(axis=1), 2:] = np.inf
        return cls(rig, axes, camera, left, right, np.where(np.isfinite(sigmas), sigmas, np.inf))

    def measured(self, theta: Array, pair: tuple[StereoCamera, StereoCamera] | None = None) -> Measured:
        """Return what is seen in the image rectified by theta, at the scale of `pair`."""
        pair = pair or self.pair(theta)
        left = self._left_by_raw(theta, pair)
        return Measured(self._rows(theta, left, pair), self._as_given(left))

    def _rows(self, theta: Array, left: Array, pair: tuple[StereoCamera, StereoCamera]) -> Array:
        """Return (M, 4) rows from those of `_left_by_raw`."""
        if self.axes.baseline_m == 0:
            return np.column_stack([left[..., 0], np.zeros_like(left[..., 0])])
        rig, (rect_from_right, _) = corrected_rig(self.calibration, self.axes, theta), right_camera(self.axes, theta)
        right = _pixels(rig.cameras[1].ray_from_pixel(self.right_px) @ rect_from_right.T, pair[1])
        return np.column_stack([left[..., 0], left[..., 0] - right])

    def _left_by_raw(self, theta: Array, pair: tuple[StereoCamera, StereoCamera]) -> Array:
        """Return (M, 2, 3) the left image's rectified pixels, and their derivatives by the raw pixel's x and y."""
        camera = corrected_rig(self.calibration, self.axes, theta).cameras[0]
        steps = _STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        rays = [camera.ray_from_pixel(self.left_px + step) @ self.axes.rect_from_cam[0].T for step in steps]
        here, *beside = (_pixels(each, pair[0]) for each in rays)
        return np.stack([here, *((each - here) / _STEP_PX for each in beside)], axis=2)

    def _as_given(self, left: Array) -> Array:
        now, given = left[..., 1:], self._given_by_raw
        apart = now[:, 0, 0] * now[:, 1, 1] - now[:, 0, 1] * now[:, 1, 0]
        usable = np.isfinite(apart) & (apart != 0.0) & np.isfinite(given).all(axis=(1, 2))
        found = np.tile(np.eye(2), (len(now), 1, 1))
        found[usable] = given[usable] @ np.linalg.inv(now[usable])
        return found

    @cached_property
    def _given_by_raw(self) -> Array:
        none = np.zeros(UNKNOWNS)
        return self._left_by_raw(none, self.pair(none))[..., 1:]

    def pair(self, theta: Array) -> tuple[StereoCamera, StereoCamera]:
        """Return the left and right pinholes, each with the focal length of its lens."""
        left = self.camera.focal_px * (1.0 + float(theta[INDEX[P.FOCAL]]))
        right = left * (1.0 + float(theta[INDEX[P.FOCAL_RATIO]]))
        return replace(self.camera, focal_px=left), replace(self.camera, focal_px=right)

    def measured_slopes(self, theta: Array) -> Measured:
        """Return derivatives of `measured` by central differences at a fixed scale of the pinholes; zero if absent."""
        pair, count = self.pair(theta), len(self.left_px)
        slopes = Measured(np.zeros((count, 4, UNKNOWNS)), np.zeros((count, 2, 2, UNKNOWNS)))
        left = self._left_by_raw(theta, pair)
        for column, size in _LENS_STEPS.items():
            step = size * (np.arange(UNKNOWNS) == column)
            if column in _LEFT_LENS:
                more, less = self.measured(theta + step, pair), self.measured(theta - step, pair)
                change = more.rows - less.rows
                slopes.as_given[..., column] = (more.as_given - less.as_given) / (2.0 * size)
            else:
                change = self._rows(theta + step, left, pair) - self._rows(theta - step, left, pair)
            slopes.rows[..., column] = np.where(np.isfinite(change), change / (2.0 * size), 0.0)
        return slopes


def _pixels(rays: Array, view: StereoCamera) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(rays[:, :2] / rays[:, 2:] * view.focal_px + [view.cx_px, view.cy_px])


def _rays(camera: StereoCamera, pixels: Array) -> Array:
    return np.column_stack([(pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(len(pixels))])


def image_rows(
    seen: Observations,
    data: CalibrationData,
    state: MotionState,
    theta: Array,
    measured: Measured,
    scales: Array,
    fixed: Fixed | None,
) -> ImageRows:
    """Return whitened rows at a state, a theta and its `measured`, zero without an observation; with `fixed` also derivatives.

    A landmark behind the camera gets the largest residual.

    scales (4,): factors on the rows' sigmas.
    """
    pair, positions = seen.pair(theta), state.map_from_body[:, :3, 3]
    turned = seen.axes.body_from_rect @ so3_exp(theta[_TURN])
    place = seen.calibration.cameras[0].body_from_cam[:3, 3] + theta[_SHIFT]
    rect_from_map = (turned.T @ state.map_from_body[:, :3, :3].transpose(0, 2, 1))[data.obs_keyframe]
    # Landmarks from the bodies, in map axes, and in the left camera; place of the right one in that
    from_body = state.points_map[data.obs_landmark] - positions[data.obs_keyframe]
    in_left = np.einsum("mij,mj->mi", rect_from_map, from_body) - turned.T @ place
    right_m = right_camera(seen.axes, theta)[1] if seen.axes.baseline_m > 0 else np.zeros(3)
    is_ahead, is_seen = in_left[:, 2] > _MIN_DEPTH_M, np.isfinite(seen.row_sigmas)
    usable = is_ahead[:, None] & is_seen
    # of the pixel, of the pair's difference
    off = np.where(usable, measured.rows - _predicted(in_left, right_m, pair), 0.0).reshape(-1, 2, 2)
    back = measured.as_given
    errors = np.einsum("mij,mkj->mki", back, off).reshape(-1, 4)
    factor = np.where(usable, 1.0 / (seen.row_sigmas * scales), 0.0)
    residuals = np.where(is_ahead[:, None] | ~is_seen, errors * factor, _BEHIND_SIGMAS)
    if fixed is None:
        return ImageRows(residuals, np.zeros((0, 4, 3)), np.zeros((0, 4, UNKNOWNS)), positions)
    by_left = _projection_slopes(in_left, pair[0])
    by_cam = np.concatenate([by_left, np.zeros_like(by_left)], axis=1)
    by_calibration = fixed.slopes.rows.copy()
    if seen.axes.baseline_m > 0:
        by_right = _projection_slopes(in_left - right_m, pair[1])
        by_cam[:, 2:] = by_left - by_right
        steps = 1e-6 * np.eye(UNKNOWNS)[_PLACE]
        moved = [right_camera(seen.axes, theta + step)[1] - right_camera(seen.axes, theta - step)[1] for step in steps]
        by_calibration[:, 2:, _PLACE] -= np.einsum("mij,jk->mik", by_right, np.stack(moved, axis=1) / 2e-6)
    by_point = -np.einsum("mij,mjk->mik", by_cam, rect_from_map)
    # X <- Exp(-phi) X changes by X x phi
    by_calibration[:, :, _TURN] = -np.cross(by_cam, in_left[:, None, :])
    by_calibration[:, :, _SHIFT] = -np.einsum("mij,mjk->mik", by_point, state.map_from_body[data.obs_keyframe, :3, :3])
    flow = np.cross(from_body, fixed.rates_map[data.obs_keyframe]) - state.motions[data.obs_keyframe, :3]
    by_calibration[:, :, INDEX[P.TIME_OFFSET]] = np.einsum("mij,mj->mi", by_point, flow)
    by_calibration[:, 2:, INDEX[P.FOCAL_RATIO]] += (off[:, 1] - off[:, 0]) / (1.0 + theta[INDEX[P.FOCAL_RATIO]])
    by_point = (back[:, None] @ by_point.reshape(-1, 2, 2, 3)).reshape(-1, 4, 3) * factor[:, :, None]
    by_calibration = (back[:, None] @ by_calibration.reshape(-1, 2, 2, UNKNOWNS)).reshape(-1, 4, UNKNOWNS)
    by_calibration += np.einsum("mijc,mkj->mkic", fixed.slopes.as_given, off).reshape(-1, 4, UNKNOWNS)
    by_calibration *= factor[:, :, None]
    return ImageRows(residuals, by_point, by_calibration, positions)


def _predicted(in_left: Array, right_m: Array, pair: tuple[StereoCamera, StereoCamera]) -> Array:
    left = pair[0].pixel_from_point(in_left)[:, :2]
    if not right_m.any():
        return np.column_stack([left, np.zeros_like(left)])
    return np.column_stack([left, left - pair[1].pixel_from_point(in_left - right_m)[:, :2]])


def _projection_slopes(points: Array, camera: StereoCamera) -> Array:
    """Return (M, 2, 3) derivatives of pixels by points."""
    z = np.maximum(points[:, 2], _MIN_DEPTH_M)
    slopes = np.zeros((len(points), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = camera.focal_px / z
    slopes[:, 0, 2] = -camera.focal_px * points[:, 0] / z**2
    slopes[:, 1, 2] = -camera.focal_px * points[:, 1] / z**2
    return slopes
