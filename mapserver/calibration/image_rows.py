"""Image rows of the adjustment: each observation against its landmark, as a function of the calibration.

Measured pixels are mapped back to the raw images once; their rectified positions follow from the lenses, so a changed calibration moves
the measurements and needs no new images. Rows are compared at the scale of the raw pixels, whose noise is known: at a fixed
scale a longer focal length would shrink the errors, and so seem more likely than it is.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, so3_exp
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import StereoCamera
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
from mapserver.calibration.problem import CalibrationData, MotionState
from mapserver.survey.bundle.problem import ImageRows

P = CalibrationParameter
_MIN_DEPTH_M = 0.05
_BEHIND_SIGMAS = 1000.0  # residual of a landmark behind the camera: beyond every cutoff, with zero slope
# Step sizes of the numerical derivatives of the measurements: lenses in shares and pixels, the pair's angles, distortion
_LENS_STEPS = dict.fromkeys((INDEX[P.FOCAL], INDEX[P.FOCAL_RATIO]), 1e-5)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PRINCIPAL_X], INDEX[P.PRINCIPAL_Y]), 0.01)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PAIR_PITCH], INDEX[P.PAIR_YAW], INDEX[P.PAIR_ROLL]), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(len(COLUMNS), len(COLUMNS) + 2 * DISTORTION), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(len(COLUMNS) + 2 * DISTORTION, UNKNOWNS), 0.01)
_PLACE = [INDEX[p] for p in (P.BASELINE, P.BASELINE_Y, P.BASELINE_Z)]
_TURN = slice(INDEX[P.CAMERA_IMU_X], INDEX[P.CAMERA_IMU_Z] + 1)
_SHIFT = slice(INDEX[P.CAMERA_POSITION_X], INDEX[P.CAMERA_POSITION_Z] + 1)


class Fixed(NamedTuple):
    """Nearly constant values near a state: rates_map (K, 3), angular rate of the body, and `Observations.measured_slopes` (M, 4, C)."""

    rates_map: Array
    slopes: Array


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

    def measured(self, theta: Array, views: tuple[StereoCamera, StereoCamera] | None = None) -> Array:
        """Return (M, 4) rows: left pixel, disparity, row difference in the image rectified by theta, at the scale of `views`."""
        rig = corrected_rig(self.calibration, self.axes, theta)
        views = views or self.views(theta)
        left = _pixels(rig.cameras[0].ray_from_pixel(self.left_px) @ self.axes.rect_from_cam[0].T, views[0])
        if self.axes.baseline_m == 0:
            return np.column_stack([left, np.zeros_like(left)])
        rect_from_right, _ = right_camera(self.axes, theta)
        right = _pixels(rig.cameras[1].ray_from_pixel(self.right_px) @ rect_from_right.T, views[1])
        return np.column_stack([left, left - right])

    def views(self, theta: Array) -> tuple[StereoCamera, StereoCamera]:
        """Return the left and right pinholes, each with the focal length of its lens."""
        left = self.camera.focal_px * (1.0 + float(theta[INDEX[P.FOCAL]]))
        right = left * (1.0 + float(theta[INDEX[P.FOCAL_RATIO]]))
        return replace(self.camera, focal_px=left), replace(self.camera, focal_px=right)

    def measured_slopes(self, theta: Array) -> Array:
        """Return (M, 4, C) derivatives of `measured` by central differences at a fixed scale of the pinholes; zero if absent."""
        views, slopes = self.views(theta), np.zeros((len(self.left_px), 4, UNKNOWNS))
        for column, size in _LENS_STEPS.items():
            step = size * (np.arange(UNKNOWNS) == column)
            change = self.measured(theta + step, views) - self.measured(theta - step, views)
            slopes[:, :, column] = np.where(np.isfinite(change), change / (2.0 * size), 0.0)
        return slopes


def _pixels(rays: Array, view: StereoCamera) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(rays[:, :2] / rays[:, 2:] * view.focal_px + [view.cx_px, view.cy_px])


def _rays(camera: StereoCamera, pixels: Array) -> Array:
    return np.column_stack([(pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(len(pixels))])


@dataclass(frozen=True)
class _View:
    """Landmarks from the keyframes: in the left camera (M, 3), and relative to the body (M, 3), map axes."""

    in_left: Array
    from_body: Array
    rect_from_map: Array
    right_m: Array


def _view(seen: Observations, data: CalibrationData, state: MotionState, theta: Array) -> _View:
    turned = seen.axes.body_from_rect @ so3_exp(theta[_TURN])
    place = seen.calibration.cameras[0].body_from_cam[:3, 3] + theta[_SHIFT]
    body_from_map = state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    rect_from_map = (turned.T @ body_from_map)[data.obs_keyframe]
    from_body = state.points_map[data.obs_landmark] - state.map_from_body[data.obs_keyframe, :3, 3]
    in_left = np.einsum("mij,mj->mi", rect_from_map, from_body) - turned.T @ place
    apart = right_camera(seen.axes, theta)[1] if seen.axes.baseline_m > 0 else np.zeros(3)
    return _View(in_left, from_body, rect_from_map, apart)


def image_rows(
    seen: Observations,
    data: CalibrationData,
    state: MotionState,
    theta: Array,
    measured: Array,
    scales: Array,
    fixed: Fixed | None,
) -> ImageRows:
    """Return whitened rows at a state, a theta and its `measured`, zero without an observation; with `fixed` also derivatives.

    A landmark behind the camera gets the largest residual.

    scales (4,): factors on the rows' sigmas.
    """
    view, views, positions = _view(seen, data, state, theta), seen.views(theta), state.map_from_body[:, :3, 3]
    is_ahead, is_seen = view.in_left[:, 2] > _MIN_DEPTH_M, np.isfinite(seen.row_sigmas)
    usable = is_ahead[:, None] & is_seen
    off = np.where(usable, measured - _predicted(view, views), 0.0)
    factor = np.where(usable, 1.0 / (seen.row_sigmas * scales), 0.0)
    residuals = np.where(is_ahead[:, None] | ~is_seen, off * factor, _BEHIND_SIGMAS)
    if fixed is None:
        return ImageRows(residuals, np.zeros((0, 4, 3)), np.zeros((0, 4, UNKNOWNS)), positions)
    by_left = _projection_slopes(view.in_left, views[0])
    by_cam = np.concatenate([by_left, np.zeros_like(by_left)], axis=1)
    by_calibration = fixed.slopes.copy()
    if seen.axes.baseline_m > 0:
        by_right = _projection_slopes(view.in_left - view.right_m, views[1])
        by_cam[:, 2:] = by_left - by_right
        by_calibration[:, 2:, _PLACE] -= np.einsum("mij,jk->mik", by_right, _right_place_slopes(seen.axes, theta))
    by_point = -np.einsum("mij,mjk->mik", by_cam, view.rect_from_map)
    # X <- Exp(-phi) X changes by X x phi
    by_calibration[:, :, _TURN] = -np.cross(by_cam, view.in_left[:, None, :])
    by_calibration[:, :, _SHIFT] = -np.einsum("mij,mjk->mik", by_point, state.map_from_body[data.obs_keyframe, :3, :3])
    flow = np.cross(view.from_body, fixed.rates_map[data.obs_keyframe]) - state.motions[data.obs_keyframe, :3]
    by_calibration[:, :, INDEX[P.TIME_OFFSET]] = np.einsum("mij,mj->mi", by_point, flow)
    by_calibration[:, :, INDEX[P.FOCAL]] += off / (1.0 + theta[INDEX[P.FOCAL]])
    by_calibration[:, 2:, INDEX[P.FOCAL_RATIO]] += (off[:, 2:] - off[:, :2]) / (1.0 + theta[INDEX[P.FOCAL_RATIO]])
    by_point *= factor[:, :, None]
    by_calibration *= factor[:, :, None]
    return ImageRows(residuals, by_point, by_calibration, positions)


def _right_place_slopes(axes: RigAxes, theta: Array) -> Array:
    """Return (3, 3) derivatives of the right camera's position by baseline and its direction."""
    steps = 1e-6 * np.eye(UNKNOWNS)[_PLACE]
    moved = [right_camera(axes, theta + step)[1] - right_camera(axes, theta - step)[1] for step in steps]
    return np.stack(moved, axis=1) / 2e-6


def _predicted(view: _View, views: tuple[StereoCamera, StereoCamera]) -> Array:
    left = views[0].pixel_from_point(view.in_left)[:, :2]
    if not view.right_m.any():
        return np.column_stack([left, np.zeros_like(left)])
    right = views[1].pixel_from_point(view.in_left - view.right_m)[:, :2]
    return np.column_stack([left, left - right])


def _projection_slopes(points: Array, camera: StereoCamera) -> Array:
    """Return (M, 2, 3) derivatives of pixels by points."""
    z = np.maximum(points[:, 2], _MIN_DEPTH_M)
    slopes = np.zeros((len(points), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = camera.focal_px / z
    slopes[:, 0, 2] = -camera.focal_px * points[:, 0] / z**2
    slopes[:, 1, 2] = -camera.focal_px * points[:, 1] / z**2
    return slopes
