"""Image rows of the adjustment: each observation against its landmark, as a function of the calibration.

Measured pixels are mapped back to the raw images once; their rectified positions follow from the lenses, so a changed calibration moves
the measurements and needs no new images. Rows are compared at the scale of the raw pixels, whose noise is known: at that of the rectified
image a longer focal length would shrink the errors, and so seem more likely than it is; the more so, the wider the lens.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import StereoCamera
from mapserver.calibration import parameters
from mapserver.calibration.motion_rows import CalibrationData, MotionState
from mapserver.calibration.parameters import COLUMNS, DISTORTION, INDEX, UNKNOWNS, RigAxes, corrected_rig, right_camera
from mapserver.survey.bundle.problem import ImageRows

P = parameters.CalibrationParameter
_STEP_PX = 0.1  # of the numerical derivative of raw by rectified pixels
# Columns of the distortion of both lenses, and of their difference; those that move what the left lens measures
_BOTH = slice(len(COLUMNS), len(COLUMNS) + DISTORTION)
_DIFFERENCE = slice(_BOTH.stop, _BOTH.stop + DISTORTION)
_LEFT_LENS = {INDEX[P.FOCAL], INDEX[P.PRINCIPAL_X], INDEX[P.PRINCIPAL_Y], *range(_BOTH.start, _BOTH.stop)}
# Step sizes of the numerical derivatives of the measurements: lenses in shares and pixels, the pair's angles, distortion
_LENS_STEPS = dict.fromkeys((INDEX[P.FOCAL], INDEX[P.FOCAL_RATIO]), 1e-5)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PRINCIPAL_X], INDEX[P.PRINCIPAL_Y]), 0.01)
_LENS_STEPS |= dict.fromkeys((INDEX[P.PAIR_PITCH], INDEX[P.PAIR_YAW], INDEX[P.PAIR_ROLL]), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(_BOTH.start, _BOTH.stop), 1e-5)
_LENS_STEPS |= dict.fromkeys(range(_DIFFERENCE.stop, UNKNOWNS), 0.01)
_PLACE = [INDEX[p] for p in (P.BASELINE, P.BASELINE_Y, P.BASELINE_Z)]
_TURN = slice(INDEX[P.CAMERA_IMU_X], INDEX[P.CAMERA_IMU_Z] + 1)
_SHIFT = slice(INDEX[P.CAMERA_POSITION_X], INDEX[P.CAMERA_POSITION_Z] + 1)
_COLUMNS = np.array(
    [_TURN.start, _SHIFT.start, INDEX[P.TIME_OFFSET], INDEX[P.FOCAL_RATIO], *_PLACE]
)  # as the core takes them


class Measured(NamedTuple):
    """Observations at a calibration, or their derivatives by it, with the columns last.

    rows (M, 4): left pixel, disparity, row difference in the image rectified by it. as_given (M, 2, 2): turns errors of pixels
    there into those in the image rectified by the given calibration, in which their sigmas are known.
    """

    rows: Array
    as_given: Array


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
        left, right = self._rectified(theta, pair)
        return Measured(
            np.column_stack([left, left - right]), self._as_given(self._raw_by_rectified(left, theta, pair))
        )

    def _rectified(self, theta: Array, pair: tuple[StereoCamera, StereoCamera]) -> tuple[Array, Array]:
        """Return (M, 2) pixels in the rectified images of both cameras; of a single one twice."""
        cameras, turns = corrected_rig(self.calibration, self.axes, theta).cameras, self._rect_from_cams(theta)
        raw = self.left_px, self.right_px
        views = zip(cameras, raw, turns, pair, strict=False)
        found = [_pixels(camera.ray_from_pixel(pixels) @ turn.T, view) for camera, pixels, turn, view in views]
        return found[0], found[-1]

    def _rect_from_cams(self, theta: Array) -> list[Array]:
        right = [right_camera(self.axes, theta)[0]] if self.axes.baseline_m > 0 else []
        return [self.axes.rect_from_cam[0], *right]

    def _raw(self, number: int, rectified: Array, theta: Array, pair: tuple[StereoCamera, StereoCamera]) -> Array:
        """Return raw pixels (M, 2) of a camera: the inverse of `_rectified`."""
        camera = corrected_rig(self.calibration, self.axes, theta).cameras[number]
        return camera.pixel_from_ray(_rays(pair[number], rectified) @ self._rect_from_cams(theta)[number])

    def _raw_by_rectified(
        self, rectified: Array, theta: Array, pair: tuple[StereoCamera, StereoCamera], number: int = 0
    ) -> Array:
        """Return (M, 2, 2) derivatives of raw by rectified pixels."""
        steps = _STEP_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[:, None]
        ends = self._raw(number, (rectified + steps).reshape(-1, 2), theta, pair).reshape(4, -1, 2)
        return np.asarray((ends[::2] - ends[1::2]).transpose(1, 2, 0) / (2.0 * _STEP_PX))

    def _as_given(self, raw_by_now: Array) -> Array:
        """Return that of `Measured`; the identity where it is unknown."""
        found = _product(self._given_by_raw, raw_by_now)
        return np.ascontiguousarray(np.where(np.isfinite(found).all(axis=(1, 2), keepdims=True), found, np.eye(2)))

    @cached_property
    def _given_by_raw(self) -> Array:
        none = np.zeros(UNKNOWNS)
        pair = self.pair(none)
        return _inverse(self._raw_by_rectified(self._rectified(none, pair)[0], none, pair))

    def pair(self, theta: Array) -> tuple[StereoCamera, StereoCamera]:
        """Return the left and right pinholes, each with the focal length of its lens."""
        left = self.camera.focal_px * (1.0 + float(theta[INDEX[P.FOCAL]]))
        right = left * (1.0 + float(theta[INDEX[P.FOCAL_RATIO]]))
        return replace(self.camera, focal_px=left), replace(self.camera, focal_px=right)

    def measured_slopes(self, theta: Array) -> Measured:
        """Return derivatives of `measured` at a fixed scale of the pinholes; zero if absent.

        A ray whose raw pixel a change of the lens would move has to move back for the pixel to stay: no lens is inverted anew. Source: the
        theorem of implicit functions.
        """
        pair = self.pair(theta)
        places = self._rectified(theta, pair)[: len(self.axes.rect_from_cam)]
        raw = [self._raw(n, place, theta, pair) for n, place in enumerate(places)]
        by_rectified = [self._raw_by_rectified(place, theta, pair, n) for n, place in enumerate(places)]
        by_raw, as_given = [_inverse(each) for each in by_rectified], self._as_given(by_rectified[0])
        slopes = Measured(np.zeros((len(raw[0]), 4, UNKNOWNS)), np.zeros((len(raw[0]), 2, 2, UNKNOWNS)))
        for column, size in _LENS_STEPS.items():
            end = theta + size * (np.arange(UNKNOWNS) == column)
            moves = [
                _product(turn, (before - self._raw(n, place, end, pair))[:, :, None])[..., 0] / size
                for n, (place, before, turn) in enumerate(zip(places, raw, by_raw, strict=True))
            ]
            slopes.rows[..., column] = np.column_stack([moves[0], moves[0] - moves[-1]])
            if column in _LEFT_LENS:
                seen = self._raw_by_rectified(places[0] + size * moves[0], end, pair)
                slopes.as_given[..., column] = (self._as_given(seen) - as_given) / size
        # A difference of the two lenses is half a change of both, backwards on the left.
        left, apart = slopes.rows[:, :2, _BOTH], slopes.rows[:, 2:, _BOTH]
        slopes.rows[..., _DIFFERENCE] = np.concatenate([-0.5 * left, 0.5 * apart - left], axis=1)
        slopes.as_given[..., _DIFFERENCE] = -0.5 * slopes.as_given[..., _BOTH]
        slopes.rows[~np.isfinite(slopes.rows)] = 0.0
        return slopes


def _pixels(rays: Array, view: StereoCamera) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(rays[:, :2] / rays[:, 2:] * view.focal_px + [view.cx_px, view.cy_px])


def _rays(camera: StereoCamera, pixels: Array) -> Array:
    return np.column_stack([(pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(len(pixels))])


def _inverse(matrices: Array) -> Array:
    """Return the inverses of (M, 2, 2), NaN or infinite where there are none."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((np.array([[d, -b], [-c, a]]) / (a * d - b * c)).transpose(2, 0, 1))


def _product(left: Array, right: Array) -> Array:
    """Return (M, 2, k), the products of (M, 2, 2) and (M, 2, k)."""
    return np.asarray(left[:, :, :1] * right[:, :1] + left[:, :, 1:] * right[:, 1:])


def image_rows(
    seen: Observations,
    data: CalibrationData,
    state: MotionState,
    theta: Array,
    measured: Measured,
    scales: Array,
    rates_map: Array | None = None,
    by_lens: Measured | None = None,
) -> ImageRows:
    """Return whitened rows at a state, a theta and its `measured`, zero without an observation; with the slopes by_lens also derivatives.

    A landmark behind the camera gets the largest residual. scales (4,): factors on the rows' sigmas; rates_map (K, 3): of the body.
    """
    left, right = seen.pair(theta)
    turned = seen.axes.body_from_rect @ so3_exp(theta[_TURN])
    place = seen.calibration.cameras[0].body_from_cam[:3, 3] + theta[_SHIFT]
    right_m = right_camera(seen.axes, theta)[1] if seen.axes.baseline_m > 0 else np.zeros(3)
    slopes = None
    if by_lens is not None and rates_map is not None:
        steps = 1e-6 * np.eye(UNKNOWNS)[_PLACE]
        moved = [right_camera(seen.axes, theta + step)[1] - right_camera(seen.axes, theta - step)[1] for step in steps]
        zoom = float(1.0 + theta[INDEX[P.FOCAL_RATIO]])
        slopes = *by_lens, rates_map, state.motions, np.stack(moved, axis=1) / 2e-6, _COLUMNS, zoom
    residuals, by_point, by_calibration = core.image_rows(
        np.array([left.focal_px, right.focal_px, left.cx_px, left.cy_px]),
        se3_inverse(se3(turned, place)),
        right_m,
        state.map_from_body,
        state.points_map,
        data.obs_keyframe.astype(np.int32),
        data.obs_landmark.astype(np.int32),
        *measured,
        seen.row_sigmas * scales,
        slopes,
    )
    by_calibration = by_calibration.reshape(-1, 4, UNKNOWNS)  # also without any
    return ImageRows(residuals, by_point, by_calibration, state.map_from_body[:, :3, 3])
