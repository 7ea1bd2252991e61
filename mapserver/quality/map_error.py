"""Errors of a map at its places, by the build's own evidence: marginals of its adjustment, scaled by how its passes disagree. Pure.

Marginals are those of images alone, after the best rigid alignment of all keyframes. What noise of pixels does not show, another pass
does: each keyframe is located by landmarks as other passes alone saw them. If they agree better than noise predicts, the marginals are
narrowed; what they disagree beyond is added to them. Errors that all passes share, such as a wrong baseline, do not show.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse, skew
from fleetmap.mapformat.map_errors import ErrorSigmas
from mapserver.survey.merge.merge import kept
from mapserver.survey.rig import Looks, projection_by_point
from mapserver.survey.survey_map import SurveyMap

_APART_M = 5.0  # path between two passes: the errors of a map are alike over that
_MOST_LOOKS, _MOST_PLACES, _LEAST_LOOKS, _LEAST_PLACES = 200, 64, 10, 3
_LEAST_MATCHES = 12
_MOST_OBSERVATIONS = 400_000  # of some landmarks, if there are more
_VAGUE_M = 0.3  # sigma of a point by one pass
_LEAST_SHARE = 0.5  # of the marginals' variances: few passes may agree by chance
_GROUPS = ([0, 1, 2], [3, 4], [5])  # of a pose's errors, as in `ErrorSigmas`

# Derivatives of M observations by the camera's pose (M, 3, 6) and by the point (M, 3, 3), and residuals (M, 3), in sigmas.
_Rows = tuple[Array, Array, Array]


def map_errors(survey: SurveyMap, tiles: Sequence[tuple[int, int]], size_m: float) -> dict[str, ErrorSigmas]:
    """Return by tile, as "x,y", the error of the map there. Empty without passes that can be compared, or without metres.

    Drives that were joined see no landmarks in common: the tiles that only others than the largest part saw have no error.
    """
    if not (survey.scale_known and len(tiles)):
        return {}
    thinned = 1 + len(survey.obs_landmark) // _MOST_OBSERVATIONS
    survey = kept(survey, _largest_part(survey) & (np.arange(len(survey.points_map)) % thinned == 0))
    map_from_cam = survey.map_from_body @ survey.body_from_cam
    rows = _linearised(survey, map_from_cam)
    off_m = np.linalg.norm((np.array(tiles)[:, None] + 0.5) * size_m - map_from_cam[:, :2, 3], axis=2)
    seen = off_m.min(axis=1) < size_m
    scales = _disagreement(survey, map_from_cam, rows) if seen.any() else None
    if scales is None:
        return {}
    off_m, nearest = off_m[seen], np.unique(off_m[seen].argmin(axis=1))
    nearest = nearest[np.unique(np.linspace(0, len(nearest) - 1, _MOST_PLACES).astype(int))]
    own = _marginals(survey, map_from_cam, rows, nearest)[off_m[:, nearest].argmin(axis=1)] / thinned
    of_groups = zip(_GROUPS, scales, strict=True)
    variances = [share * own[:, axes].mean(axis=1) + beyond for axes, (share, beyond) in of_groups]
    sigmas = np.round(np.clip(np.sqrt(np.stack(variances, axis=1)), 1e-5, 1.0), 6).tolist()
    return {f"{x},{y}": ErrorSigmas(*each) for (x, y), each in zip(np.array(tiles)[seen], sigmas, strict=True)}


def error_words(found: Mapping[str, Sequence[float]]) -> str:
    """Return the errors of a map's tiles as text."""
    if not found:
        return "own error unknown: no passes to compare"
    turn_rad, *sigmas_m = np.median(list(found.values()), axis=0)
    return f"own error {1e3 * np.max(sigmas_m):.1f} mm, {1e3 * turn_rad:.1f} mrad"


def _largest_part(survey: SurveyMap) -> NDArray[np.bool_]:
    """Return (N,) the landmarks of most keyframes that landmarks connect with each other."""
    keyframes, landmarks = len(survey.map_from_body), len(survey.points_map)
    seen = np.ones(len(survey.obs_landmark)), (survey.obs_keyframe, keyframes + survey.obs_landmark)
    graph = scipy.sparse.coo_array(seen, shape=(keyframes + landmarks, keyframes + landmarks))
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return np.asarray(part[keyframes:] == np.bincount(part[:keyframes]).argmax())


def _linearised(survey: SurveyMap, map_from_cam: Array) -> _Rows:
    cameras, points = map_from_cam[survey.obs_keyframe], survey.points_map
    looks = Looks(survey.camera, cameras, survey.obs_landmark, survey.obs_pixels, survey.obs_sigma_px)
    residuals, seen = looks.residuals(points)
    weights = np.where(np.isfinite(residuals), 1.0 / survey.obs_sigma_px[:, [0, 0, 1]], 0.0)
    by_point = (projection_by_point(survey.camera, seen) * weights[:, :, None]) @ se3_inverse(cameras)[:, :3, :3]
    by_turn = np.cross(by_point, (points[survey.obs_landmark] - cameras[:, :3, 3])[:, None])
    return np.concatenate([by_turn, -by_point], axis=2), by_point, np.nan_to_num(residuals) * weights


def _marginals(survey: SurveyMap, map_from_cam: Array, rows: _Rows, chosen: NDArray[np.int64]) -> Array:
    """Return (T, 6) variances of the errors of chosen keyframes (T,), of turn and position in map axes, by all observations."""
    by_camera, by_point, _ = rows
    keyframes, landmarks, starts = len(map_from_cam), len(survey.points_map), np.arange(len(by_point) + 1)
    of_cameras, of_points = (by_camera, survey.obs_keyframe, starts), (by_point, survey.obs_landmark, starts)
    cameras = scipy.sparse.bsr_array(of_cameras, shape=(3 * len(by_point), 6 * keyframes)).tocsr()
    points = scipy.sparse.bsr_array(of_points, shape=(3 * len(by_point), 3 * landmarks)).tocsr()
    blocks = np.tile(1e-6 * np.eye(3), (landmarks, 1, 1))
    np.add.at(blocks, survey.obs_landmark, by_point.transpose(0, 2, 1) @ by_point)
    covs = scipy.sparse.bsr_array((np.linalg.inv(blocks), np.arange(landmarks), np.arange(landmarks + 1))).tocsr()
    cross = cameras.T @ points
    # A radian and a metre for each keyframe: what no observation ties to the others stays finite.
    information = cameras.T @ cameras - cross @ covs @ cross.T + scipy.sparse.eye_array(6 * keyframes)
    solver = scipy.sparse.linalg.splu(information.tocsc(), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
    moved = np.tile(np.eye(6), (keyframes, 1, 1))  # of each keyframe by a motion of the whole map
    moved[:, 3:, :3] = [-skew(off_m) for off_m in map_from_cam[:, :3, 3] - map_from_cam[:, :3, 3].mean(axis=0)]
    aligned = np.linalg.pinv(moved.reshape(-1, 6))
    found = np.zeros((len(chosen), 6))
    for number, k in enumerate(chosen):
        left = -moved[k] @ aligned
        left[:, 6 * k : 6 * k + 6] += np.eye(6)
        found[number] = np.einsum("ij,ji->i", left, solver.solve(left.T))
    return found


def _disagreement(survey: SurveyMap, map_from_cam: Array, rows: _Rows) -> list[tuple[float, float]] | None:
    """Return for each of _GROUPS the share of the marginals' variances that the passes show, and a variance beyond; None without passes."""
    by_camera, by_point, residuals = rows
    steps_m = np.linalg.norm(np.diff(map_from_cam[:, :3, 3], axis=0, prepend=map_from_cam[:1, :3, 3]), axis=1)
    path_m, found = np.cumsum(steps_m), list[tuple[float, Array, Array]]()
    for k in np.unique(np.linspace(0, len(path_m) - 1, _MOST_LOOKS).astype(int)):
        mine = np.flatnonzero(survey.obs_keyframe == k)
        number = np.full(len(survey.points_map), -1)
        number[survey.obs_landmark[mine]] = np.arange(len(mine))
        is_apart = (np.abs(path_m - path_m[k]) > _APART_M)[survey.obs_keyframe]
        others = np.flatnonzero(is_apart & (number[survey.obs_landmark] >= 0))
        owners = number[survey.obs_landmark[others]]
        known, pull = np.zeros((len(mine), 3, 3)), np.zeros((len(mine), 3, 1))
        turned = by_point[others].transpose(0, 2, 1)
        np.add.at(known, owners, turned @ by_point[others])
        np.add.at(pull, owners, turned @ residuals[others, :, None])
        is_known = np.linalg.eigvalsh(known)[:, 0] > _VAGUE_M**-2
        if is_known.sum() < _LEAST_MATCHES:
            continue
        mine, cov_points = mine[is_known], np.linalg.inv(known[is_known])
        seen = residuals[mine, :, None] - by_point[mine] @ cov_points @ pull[is_known]
        weight = np.linalg.inv(np.eye(3) + by_point[mine] @ cov_points @ by_point[mine].transpose(0, 2, 1))
        jacobian = by_camera[mine].transpose(0, 2, 1) @ weight
        covariance = np.linalg.inv((jacobian @ by_camera[mine]).sum(axis=0) + 1e-6 * np.eye(6))
        found.append((path_m[k], (covariance @ (jacobian @ seen).sum(axis=0))[:, 0] ** 2, np.diag(covariance)))
    if len(found) < _LEAST_LOOKS or len({int(at_m / _APART_M) for at_m, *_ in found}) < _LEAST_PLACES:
        return None
    _, squared, predicted = map(np.array, zip(*found, strict=True))
    return [_scales(squared[:, axes], predicted[:, axes]) for axes in _GROUPS]


def _scales(squared: Array, predicted: Array) -> tuple[float, float]:
    """Return the share of predicted variances that squared errors show, and a variance beyond. Source: Paule and Mandel 1982.

    One beyond must make all looks together likelier, as errors of a Gaussian: a few at landmarks that another pass hardly placed
    predict decimetres, and are off by more, where many others show millimetres.
    """
    share = float(np.mean(squared / predicted))
    if share <= 1.0:
        return max(share, _LEAST_SHARE), 0.0

    def surprise(beyond: float) -> float:
        total = predicted + beyond
        return float(np.sum(squared / total + np.log(total)))

    beyond = float(scipy.optimize.brentq(lambda v: np.mean(squared / (predicted + v)) - 1.0, 0.0, squared.max()))
    return 1.0, beyond if surprise(beyond) < surprise(0.0) else 0.0
