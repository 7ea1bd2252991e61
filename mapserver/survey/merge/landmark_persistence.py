"""Persistence of landmarks through surveys: expected, seen, moved, faded."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import GATE_SQUARED
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.finish.map_assembly import point_information
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.confirmation import EDGE_PX, WIDER_VIEW_RAD, due
from mapserver.survey.merge.guided_matching import Sighting, keyframe_features
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe

PRIOR_COUNT = 4.0  # weight of the survey's overall rate, in observations, for a landmark without history
_AGAINST = 7.815  # 0.95 of chi-square with 3 degrees of freedom: an observation that contradicts a position
_DOUBTED, _SETTLED = 0.5, 0.8  # shares of sightings: against the old position, for the new one
_MIN_SIGHTINGS = 3  # below, a landmark's position is not judged


@dataclass(frozen=True, slots=True)
class LandmarkCounts:
    """Numbers of keyframes of this survey in which each of N landmarks was expected and seen."""

    expected: NDArray[np.int64]
    seen: NDArray[np.int64]

    @property
    def rate(self) -> float:
        """Share of the expected observations that were made, for landmarks still present."""
        there = self.seen > 0
        return float(self.seen[there].sum() / max(self.expected[there].sum(), 1))


def count_landmarks(
    base: BaseMap, keyframes: Sequence[Keyframe], map_from_cam: Array, sightings: Sequence[Sighting | None]
) -> LandmarkCounts:
    """Return counts over keyframes (K) at map_from_cam (K, 4, 4); those without a sighting do not count."""
    expected, seen = np.zeros(len(base.points_map), np.int64), np.zeros(len(base.points_map), np.int64)
    for keyframe, place, sighting in zip(keyframes, map_from_cam, sightings, strict=True):
        if sighting is None:
            continue
        visible = base.visible(place, -EDGE_PX, WIDER_VIEW_RAD)
        is_due = np.zeros(len(expected), bool)
        is_due[visible.rows[due(visible, keyframe_features(keyframe).pixels)]] = True
        is_due[sighting.rows] = True
        expected += is_due
        seen[sighting.rows] += 1
    return LandmarkCounts(expected, seen)


def missed_since(base: BaseMap, counts: LandmarkCounts) -> NDArray[np.int64]:
    """Return (N,) how often each landmark was expected since it was last seen."""
    before = base.history.landmark_missed.astype(np.int64)
    return np.where(counts.seen > 0, 0, before + counts.expected - counts.seen)


def faded(base: BaseMap, counts: LandmarkCounts, settings: SurveySettings) -> NDArray[np.bool_]:
    """Return (N,) landmarks that were missed more often than is likely if still present.

    The probability of detection is each landmark's own before the misses, shrunk towards the survey's if it was rarely
    expected. Observations within one survey are correlated, so each counts for less than one (`look_weight`).
    """
    history, missed = base.history, missed_since(base, counts)
    before = history.landmark_expected.astype(np.float64) - history.landmark_missed
    chance = (history.landmark_seen + PRIOR_COUNT * counts.rate) / (before + PRIOR_COUNT)
    chance = np.clip(chance, 0.0, 0.95)
    gone = missed * np.log1p(-settings.sessions.look_weight * chance) < np.log(settings.sessions.fade_probability)
    return np.asarray(gone & (missed > 1))


@dataclass(frozen=True, slots=True)
class Shift:
    """Landmarks of the map seen often enough to judge: rows (R,), their points (R, 3) by the new survey alone, whether those differ."""

    rows: Rows
    points_map: Array
    significant: NDArray[np.bool_]


def shifts(base: BaseMap, map_from_cam: Array, sightings: Sequence[Sighting | None], settings: SurveySettings) -> Shift:
    """Compare each landmark, triangulated by its sightings alone from cameras map_from_cam (K, 4, 4), with its position in the map.

    The difference is judged by both covariances, for fixed keyframes, and `still_m` for their omissions; also most
    sightings must individually contradict the old position (smaller differences do not affect robots) and nearly
    all must support the new one: occlusion corners have no fixed position.
    """
    seen = [(k, s) for k, s in enumerate(sightings) if s is not None]
    landmark = np.concatenate([s.rows for _, s in seen]) if seen else np.zeros(0, np.int64)
    rows, numbers, counts = np.unique(landmark, return_inverse=True, return_counts=True)
    enough = counts >= _MIN_SIGHTINGS
    keep = enough[numbers] if len(rows) else np.zeros(0, bool)
    renumbered = np.cumsum(enough) - 1
    rows, numbers = rows[enough], renumbered[numbers[keep]].astype(np.int32)
    if not len(rows):
        return Shift(rows, np.zeros((0, 3)), np.zeros(0, bool))
    cameras = np.repeat(map_from_cam[[k for k, _ in seen]], [len(s.rows) for _, s in seen], axis=0)[keep]
    pixels = np.concatenate([s.pixels for _, s in seen])[keep]
    sigmas = np.concatenate([s.sigmas_px for _, s in seen])[keep]
    points = base.points_map[rows].copy()
    new = _triangulated(base, points, cameras, numbers, pixels, sigmas)
    own = np.isin(base.map.obs_landmark, rows)
    old_numbers = np.searchsorted(rows, base.map.obs_landmark[own]).astype(np.int32)
    old_cameras, has_depth = base.map_from_cam[base.map.obs_keyframe[own]], np.isfinite(base.obs_pixels[own, 2])
    old = point_information(
        base.camera, old_cameras, base.points_map[rows], old_numbers, has_depth, base.obs_sigma_px[own]
    )
    info = point_information(base.camera, cameras, new, numbers, np.isfinite(pixels[:, 2]), sigmas)
    slack = 1e-6 * np.eye(3)
    spread = np.linalg.inv(old + slack) + np.linalg.inv(info + slack) + settings.sessions.still_m**2 * np.eye(3)
    off = new - base.points_map[rows]
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    counts = np.bincount(numbers, minlength=len(rows))
    old_squared, new_squared = (
        _squared(base, p, cameras, numbers, pixels, sigmas) for p in (base.points_map[rows], new)
    )
    doubted = np.bincount(numbers, old_squared > _AGAINST, len(rows)) > _DOUBTED * counts
    settled = np.bincount(numbers, new_squared < GATE_SQUARED, len(rows)) >= _SETTLED * counts
    return Shift(rows, new, doubted & settled & (squared > settings.sessions.significance))


def _squared(
    base: BaseMap, points_map: Array, map_from_cam: Array, landmark: NDArray[np.int32], pixels: Array, sigmas_px: Array
) -> Array:
    """Return (M,) squared residuals of observations in sigmas."""
    cam_from_map = se3_inverse(map_from_cam)
    seen = np.einsum("mij,mj->mi", cam_from_map[:, :3, :3], points_map[landmark]) + cam_from_map[:, :3, 3]
    residual = _residuals(base, seen, pixels) / sigmas_px[:, [0, 0, 1]]
    return np.asarray(np.square(np.nan_to_num(residual)).sum(axis=1))


def _residuals(base: BaseMap, points_cam: Array, pixels: Array) -> Array:
    """Return (M, 3) of u, v and disparity; NaN without a right match."""
    predicted = base.camera.pixel_from_point(np.column_stack([points_cam[:, :2], np.maximum(points_cam[:, 2], 0.05)]))
    return np.column_stack(
        [pixels[:, :2] - predicted[:, :2], pixels[:, 0] - pixels[:, 2] - predicted[:, 0] + predicted[:, 2]]
    )


def _triangulated(
    base: BaseMap, points_map: Array, map_from_cam: Array, landmark: NDArray[np.int32], pixels: Array, sigmas_px: Array
) -> Array:
    """Return points (R, 3) with the best fit to their observations (M) from known cameras: some steps of Gauss-Newton."""
    camera, points = base.camera, points_map.copy()
    cam_from_map = se3_inverse(map_from_cam)
    for _ in range(4):
        seen = np.einsum("mij,mj->mi", cam_from_map[:, :3, :3], points[landmark]) + cam_from_map[:, :3, 3]
        residual = _residuals(base, seen, pixels)
        z, f = np.maximum(seen[:, 2], 0.05), camera.focal_px
        rows = np.zeros((len(z), 3, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = f / z
        rows[:, 0, 2], rows[:, 1, 2] = -f * seen[:, 0] / z**2, -f * seen[:, 1] / z**2
        rows[:, 2, 2] = -f * camera.baseline_m / z**2
        sigma = np.column_stack([sigmas_px[:, 0], sigmas_px[:, 0], sigmas_px[:, 1]])
        weight = np.where(np.isfinite(residual), 1.0 / sigma, 0.0)
        jacobian = (rows * weight[:, :, None]) @ cam_from_map[:, :3, :3]
        hessian, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(hessian, landmark, jacobian.transpose(0, 2, 1) @ jacobian)
        np.add.at(pull, landmark, np.einsum("mij,mi->mj", jacobian, np.nan_to_num(residual) * weight))
        step = np.linalg.solve(hessian + 1e-6 * np.eye(3), pull[:, :, None])[:, :, 0]
        points += np.clip(step, -0.5, 0.5)
    return points
