"""Landmarks of the map in keyframes of a new survey: looked for where they should be, placed to a fraction of a pixel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import patch_align, stereo
from fleetmap.features.matching import Projected, match_by_projection
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.features.patch_align_kernels import align_patches
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.pnp.pnp import Correspondences, PnpResult, refine_pnp
from mapserver.survey.keyframes.keyframes import Keyframe
from mapserver.survey.merge.base_map import BaseMap, Rows
from mapserver.survey.settings import SurveySettings


@dataclass(frozen=True, slots=True)
class Sighting:
    """What one keyframe sees of the map: landmarks rows (P,) as features (P,), pixels (P, 3), sigmas_px (P, 2)."""

    rows: Rows
    features: Rows
    pixels: Array
    sigmas_px: Array

    def only(self, keep: NDArray[np.bool_]) -> "Sighting":
        """Some of it."""
        return Sighting(self.rows[keep], self.features[keep], self.pixels[keep], self.sigmas_px[keep])


def locate(
    base: BaseMap, keyframe: Keyframe, map_from_cam: Array, radius_px: float, settings: SurveySettings
) -> tuple[Rows, Rows, PnpResult] | None:
    """Where a keyframe near `map_from_cam` is, by landmarks (P,) seen as features (P,); None where too few agree."""
    s = settings.sessions
    rows, features = _match(base, keyframe, map_from_cam, radius_px, settings)
    if len(rows) < s.min_inliers:
        return None
    pixels = keyframe.features.pixels[features]
    measured = np.column_stack([pixels, pixels[:, 0] - keyframe.disparities[features, 0]])
    scale = SCALE_FACTOR ** np.minimum(keyframe.features.octaves[features], 4).astype(np.float64)
    rough = settings.pairs.match_sigma_px * scale
    sigmas = np.column_stack([rough, np.maximum(rough, 1.0)])
    matches = Correspondences(base.camera, base.points_map[rows], measured, sigmas)
    solved = refine_pnp(matches, se3_inverse(map_from_cam))
    if solved is None or solved.inliers.sum() < s.min_inliers or solved.inliers.mean() < 0.35:
        return None
    rows, features = rows[solved.inliers], features[solved.inliers]
    return (rows, features, solved) if _cells(base, keyframe, features) >= s.min_cells else None


def sight(
    base: BaseMap, keyframe: Keyframe, map_from_cam: Array, radius_px: float, settings: SurveySettings
) -> Sighting | None:
    """The landmarks that a keyframe near `map_from_cam` sees, to a fraction of a pixel; None where too few agree."""
    found = locate(base, keyframe, map_from_cam, radius_px, settings)
    return None if found is None else _refined(base, keyframe, found[0], found[1], found[2].cam_from_source, settings)


def _match(
    base: BaseMap, keyframe: Keyframe, map_from_cam: Array, radius_px: float, settings: SurveySettings
) -> tuple[Rows, Rows]:
    rows, predicted, octaves = base.visible(
        map_from_cam, radius_px, float(np.radians(settings.sessions.max_view_angle_deg))
    )
    span = np.column_stack([np.floor(octaves) - 2, np.ceil(octaves) + 2]).astype(np.int64)
    window = radius_px * SCALE_FACTOR ** np.clip(octaves, 0, 3)
    projected = Projected(predicted[:, :2], window, base.descriptors[rows], span)
    hit, _ = match_by_projection(projected, keyframe.features, settings.pairs.guided_distance, 0.95)
    kept = np.flatnonzero(hit >= 0)
    return rows[kept], hit[kept].astype(np.int64)


def _cells(base: BaseMap, keyframe: Keyframe, features: Rows) -> int:
    cells = image_cells(keyframe.features.pixels[features], base)
    return len(np.unique(cells))


def image_cells(pixels: Array, base: BaseMap) -> Rows:
    """(P,) which of 8 x 6 parts of the picture each pixel (P, 2) lies in."""
    column = np.clip(pixels[:, 0] / base.camera.width_px * 8, 0, 7).astype(np.int64)
    row = np.clip(pixels[:, 1] / base.camera.height_px * 6, 0, 5).astype(np.int64)
    return np.asarray(column * 6 + row)


def _refined(
    base: BaseMap, keyframe: Keyframe, rows: Rows, features: Rows, cam_from_map: Array, settings: SurveySettings
) -> Sighting:
    """Coordinates from the landmarks' patches where those agree, else the corner's own with a wider sigma."""
    noise = settings.noise
    left = keyframe.features.pixels[features].copy()
    sigma = noise.descriptor_sigma_px * SCALE_FACTOR ** keyframe.features.octaves[features].astype(np.float64)
    aligned = _aligned(base, keyframe, rows, features, cam_from_map, settings)
    sure = np.isfinite(aligned[:, 0])
    left[sure] = aligned[sure, :2]
    sigma[sure] = np.hypot(noise.aligned_sigma_px, aligned[sure, 2])
    depth = stereo.disparities(keyframe.frame, base.camera, left, settings.stereo, keyframe.disparities[features, 0])
    sigma_depth = np.hypot(noise.disparity_sigma_px, np.nan_to_num(depth[:, 1], nan=1.0))
    pixels = np.column_stack([left, left[:, 0] - depth[:, 0]])
    return Sighting(rows, features, pixels, np.column_stack([sigma, sigma_depth]))


def _aligned(
    base: BaseMap, keyframe: Keyframe, rows: Rows, features: Rows, cam_from_map: Array, settings: SurveySettings
) -> Array:
    """(P, 3) as patch_align.refine_matches, against the landmarks' patches instead of whole pictures."""
    references = base.references[rows]
    levels = patch_align.halvings(base.map.obs_octave[references])
    exact = base.map.obs_pixels[references, :2] / 2.0 ** levels[:, None]
    side = base.map.patches.shape[1]
    mosaic = np.ascontiguousarray(base.map.patches[rows].reshape(-1, side))
    centres = exact - np.rint(exact) + side // 2
    centres[:, 1] += side * np.arange(
        len(rows)
    )  # a window that leaves its patch sideways would leave it up or down too
    warps = _warps(base, rows, cam_from_map)
    out = np.full((len(rows), 3), np.nan)
    current_levels = patch_align.halvings(keyframe.features.octaves[features])
    pyramid = keyframe.pyramid
    for level in np.unique(current_levels):
        index = np.flatnonzero((current_levels == level) & np.isfinite(warps).all(axis=(1, 2)))
        found = np.empty((len(index), 4))
        align_patches(
            mosaic, pyramid[level], np.ascontiguousarray(centres[index]),
            np.ascontiguousarray(keyframe.features.pixels[features[index]] / 2.0**level),
            warps[index] * 2.0 ** (level - levels[index])[:, None, None], settings.align.half_window_px,
            settings.align.max_shift_px, found,
        )  # fmt: skip
        found[~(found[:, 3] >= settings.align.min_correlation)] = np.nan
        out[index] = found[:, :3] * 2.0**level
    return out


def _warps(base: BaseMap, rows: Rows, cam_from_map: Array) -> Array:
    """(P, 2, 2) reference_from_current for pixel offsets; NaN where degenerate."""
    cameras = base.reference_cameras(rows)
    warps = np.empty((len(rows), 2, 2))
    order = base.map.obs_keyframe[base.references[rows]]
    for k in np.unique(order):
        own = np.flatnonzero(order == k)
        reference_from_map = se3_inverse(cameras[own[0]])
        points = transform_points(reference_from_map, base.points_map[rows[own]])
        warps[own] = patch_align.similarity_from_motion(base.camera, points, cam_from_map @ cameras[own[0]])
    return warps
