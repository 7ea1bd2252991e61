"""Persistence of landmarks through surveys: expected, seen, moved, faded."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Indices, Mask
from fleetmap.pnp.pnp import GATE_SQUARED
from fleetmap.relocalization.map_view import Rows, visible_landmarks
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.confirmation import EDGE_PX, WIDER_VIEW_RAD, due
from mapserver.survey.merge.guided_matching import Sightings, keyframe_features
from mapserver.survey.rig import Looks
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
    base: BaseMap, keyframes: Sequence[Keyframe], map_from_cam: Array, sightings: Sightings
) -> LandmarkCounts:
    """Return counts over keyframes (K) at map_from_cam (K, 4, 4); those without a sighting do not count."""
    expected, seen = np.zeros((2, len(base.points_map)), np.int64)
    for k in np.flatnonzero(sightings.located).tolist():
        visible = visible_landmarks(base.cones, map_from_cam[k], base.camera, -EDGE_PX, WIDER_VIEW_RAD)
        is_due = np.zeros(len(expected), bool)
        is_due[visible.rows[due(visible, keyframe_features(keyframes[k]).pixels)]] = True
        own = sightings.rows[sightings.image == k]
        is_due[own] = True
        expected += is_due
        seen[own] += 1  # once, by however many features
    return LandmarkCounts(expected, seen)


def missed_since(base: BaseMap, counts: LandmarkCounts) -> Indices:
    """Return (N,) how often each landmark was expected since it was last seen."""
    before = base.history.landmark_missed.astype(np.int64)
    return np.where(counts.seen > 0, 0, before + counts.expected - counts.seen)


def faded(base: BaseMap, counts: LandmarkCounts, settings: SurveySettings) -> Mask:
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
    significant: Mask


def shifts(base: BaseMap, map_from_cam: Array, sightings: Sightings, settings: SurveySettings) -> Shift:
    """Compare each landmark, triangulated by its sightings alone from cameras map_from_cam (K, 4, 4), with its position in the map.

    The difference is judged by both covariances, for fixed keyframes, and `still_m` for their omissions; also most
    sightings must individually contradict the old position (smaller differences do not affect robots) and nearly
    all must support the new one: occlusion corners have no fixed position.
    """
    rows, which, counts = np.unique(sightings.rows, return_inverse=True, return_counts=True)
    enough = counts >= _MIN_SIGHTINGS
    rows, counts, seen = rows[enough], counts[enough], sightings.only(enough[which])
    numbers = (np.cumsum(enough) - 1)[which][enough[which]].astype(np.int32)
    before = base.points_map[rows]
    looks = Looks(base.camera, map_from_cam[seen.image], numbers, seen.pixels, seen.sigmas_px)
    now = looks.triangulated(before)
    own = np.isin(base.map.obs_landmark, rows)
    old_numbers = np.searchsorted(rows, base.map.obs_landmark[own]).astype(np.int32)
    old_cameras = base.map_from_cam[base.map.obs_keyframe[own]]
    known = Looks(base.camera, old_cameras, old_numbers, base.obs_pixels[own], base.obs_sigma_px[own])
    slack = 1e-6 * np.eye(3)
    spread = np.linalg.inv(known.information(before) + slack) + np.linalg.inv(looks.information(now) + slack)
    spread += settings.sessions.still_m**2 * np.eye(3)
    off = now - before
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    doubted = np.bincount(numbers, looks.squared(before) > _AGAINST, len(rows)) > _DOUBTED * counts
    settled = np.bincount(numbers, looks.squared(now) < GATE_SQUARED, len(rows)) >= _SETTLED * counts
    return Shift(rows, now, doubted & settled & (squared > settings.sessions.significance))
