"""Information of one frame on the camera parameters, with its pose marginalized. Pure."""

from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
from fleetmap.pnp.pnp import Correspondences
from fleetmap.sensors.rectification import RectifiedFrame
from locclient.localization.calibration.parameters import IMAGE

_POSE = 6
_CENTRE_SIGMA_PX = 1.0  # of the principal point, which is not distinguishable from a rotation of the rig
# Widths of the robust weight in sigmas, one for each iteration: a wrong calibration shifts all disparities at once.
_WIDTHS = (30.0, 6.0, 3.0)
_ROW_POINTS, _ROW_WINDOW_PX, _ROW_BACK_PX = 40, 11, 0.5
_MIN_POINTS = 15
_NEAREST_M = 0.3


class CameraView(NamedTuple):
    """information (6, 6) and score (6,) = information @ estimate of the first parameters of `PARAMETERS`.

    pose_per_parameter (6, 6): derivative of a fix's pose, a left perturbation of cam_from_map in camera axes, by each parameter.
    A look of the watch has information and score of all of `PARAMETERS` and the map's tilt; ids: of its landmarks.
    """

    information: Array
    score: Array
    pose_per_parameter: Array
    ids: frozenset[int] = frozenset()


def pair_offsets(frame: RectifiedFrame, matched: Correspondences, map_from_cam: Array) -> Array:
    """Return (N, 2) of points in the right image: column, and row minus the left row, px; NaN where not searched or not found.

    Searched around the map's prediction in both directions, so that a pitch error of the pair is still visible.
    """
    out = np.full((len(matched), 2), np.nan)
    if frame.right is None:
        return out
    points_cam = transform_points(se3_inverse(map_from_cam), matched.points_source)
    seen = np.flatnonzero(points_cam[:, 2] > _NEAREST_M)
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), _ROW_POINTS)).astype(int)] if len(seen) else seen
    left = np.ascontiguousarray(matched.pixels[seen, :2])
    predicted = left - np.column_stack([matched.camera.lens[3] / points_cam[seen, 2], np.zeros(len(seen))])
    limits = _ROW_WINDOW_PX // 2, 1, _ROW_BACK_PX, -np.inf
    places, good = core.follow_pixels(frame.left, frame.right, left, np.ascontiguousarray(predicted), *limits)
    out[seen[good]] = places[good] - left[good] * [0.0, 1.0]
    return out


def camera_view(matched: Correspondences, map_from_cam: Array, rows_px: Array) -> CameraView | None:
    """Return the view of a frame near map_from_cam, with all its matches before any gate; None if too few have depth.

    rows_px (N,): from `pair_offsets`. Source: Triggs et al. 2000, sections 6.1 (Schur complement) and 2.2 (self-calibration).
    """
    if np.isfinite(matched.pixels[:, 2]).sum() < _MIN_POINTS:
        return None
    cam_from_map, theta = se3_inverse(map_from_cam), np.zeros(IMAGE + 2)
    prior = np.zeros(_POSE + IMAGE + 2)
    prior[-2:] = _CENTRE_SIGMA_PX**-2
    hessian = np.zeros((len(prior), len(prior)))
    points, pixels = np.ascontiguousarray(matched.points_source), np.ascontiguousarray(matched.pixels)
    seen = points, pixels, np.ascontiguousarray(matched.sigmas_px), np.ascontiguousarray(rows_px), matched.camera.lens
    for width in _WIDTHS:
        hessian, gradient = core.camera_equations(*seen, np.ascontiguousarray(cam_from_map), theta, width)
        gradient[_POSE:] -= prior[_POSE:] * theta
        hessian[range(len(prior)), range(len(prior))] += prior
        try:
            step = np.asarray(np.linalg.solve(hessian + 1e-9 * np.diag(np.diag(hessian) + 1.0), gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        cam_from_map = se3(so3_exp(step[:3]), step[3:_POSE]) @ cam_from_map
        theta = theta + step[_POSE:]
    kept = slice(_POSE, _POSE + IMAGE)
    free = [*range(_POSE), *range(_POSE + IMAGE, len(prior))]
    cross = hessian[np.ix_(free, range(_POSE, _POSE + IMAGE))]
    regular = hessian[np.ix_(free, free)] + 1e-9 * np.eye(len(free))
    information = hessian[kept, kept] - cross.T @ np.linalg.solve(regular, cross)
    pose_hessian = hessian[:_POSE, :_POSE] + 1e-9 * np.eye(_POSE)
    shift = np.asarray(np.linalg.solve(pose_hessian, hessian[:_POSE, kept]), np.float64)
    if not (np.isfinite(theta).all() and np.isfinite(information).all()):
        return None
    return CameraView(information, information @ theta[:IMAGE], shift)
