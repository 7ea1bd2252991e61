"""Guided matching of the map's landmarks in keyframes of a new survey, to a fraction of a pixel."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.features.patch_align import Patches, halvings, refine_matches
from fleetmap.geometry import Array, Mask, se3_inverse, transform_points
from fleetmap.relocalization.map_view import Rows
from fleetmap.relocalization.relocalizer import FrameFeatures, Relocalizer
from fleetmap.relocalization.settings import FixSettings, RelocalizerSettings
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe

_CORRELATION = 3.0  # as for loops: common errors of matched points make a fix's covariance too small


class Sighting(NamedTuple):
    """The map's landmarks in one image: rows (P,) as features (P,), pixels (P, 3), sigmas_px (P, 2)."""

    rows: Rows
    features: Rows
    pixels: Array
    sigmas_px: Array


_NOTHING = Sighting(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True)
class Sightings:
    """The sightings by all images (I,) of a survey, joined: the image (P,) of each; located (I,): images that have one, if only empty."""

    located: Mask
    image: Rows
    rows: Rows
    features: Rows
    pixels: Array
    sigmas_px: Array

    @classmethod
    def of(cls, images: Sequence[Sighting | None]) -> "Sightings":
        """Join those of each image."""
        image = np.repeat(np.arange(len(images)), [0 if seen is None else len(seen.rows) for seen in images])
        parts = zip(_NOTHING, *(seen for seen in images if seen is not None), strict=True)
        columns: list[Any] = [np.concatenate(part) for part in parts]
        return cls(np.array([seen is not None for seen in images]), image, *columns)

    def only(self, keep: Mask) -> "Sightings":
        """Return the chosen part (P,)."""
        return replace(self, **{name: getattr(self, name)[keep] for name in ("image", *Sighting._fields)})


def session_relocalization(settings: SurveySettings) -> RelocalizerSettings:
    """Return settings of the robots' relocalizer for sessions, over the whole map at the archive's precision.

    It differs from a robot's in two ways. The view has all landmarks of the archive, not the chosen ones rounded
    to a tile's grid: matches become observations of the adjustment. And inliers, windows and sigmas are the survey's: a
    wrong join damages a map permanently, whereas a robot's next fix corrects a wrong one.
    """
    sessions, pairs = settings.sessions, settings.pairs
    fix = FixSettings(
        min_inliers=sessions.min_inliers,
        min_cells=sessions.min_cells,
        top_places=sessions.top_places,
        max_distance=pairs.max_distance,
        ratio=pairs.ratio,
        guided_distance=pairs.guided_distance,
        guided_radius_px=sessions.search_px,
        feature_sigma_px=pairs.match_sigma_px,
        disparity_sigma_px=pairs.match_sigma_px,
        covariance_scale=_CORRELATION**2,
        floor_m=0.005,
        floor_rad=0.001,
        max_view_angle_deg=sessions.max_view_angle_deg,
    )
    return RelocalizerSettings(settings.seed, settings.stereo, settings.orb, fix)


def keyframe_features(keyframe: Keyframe) -> FrameFeatures:
    """Return a keyframe's features for the relocalizer."""
    pixels = keyframe.features.pixels
    return FrameFeatures(keyframe.features, np.column_stack([pixels, pixels[:, 0] - keyframe.disparities[:, 0]]))


def match_keyframe(
    base: BaseMap,
    relocalizer: Relocalizer,
    keyframe: Keyframe,
    map_from_cam: Array,
    radius_px: float,
    settings: SurveySettings,
) -> Sighting | None:
    """Return the landmarks seen by a keyframe near `map_from_cam`, at subpixel accuracy; None if too few agree.

    Coordinates are those from the landmarks' patches if these agree, else the corner's own with a wider sigma.
    """
    fix = relocalizer.by_projection(keyframe_features(keyframe), map_from_cam, radius_px)
    if fix is None or fix.matches is None:
        return None
    features, rows = np.ascontiguousarray(fix.matches.T)
    noise = settings.noise
    left = keyframe.features.pixels[features].copy()
    sigma = noise.descriptor_sigma_px * SCALE_FACTOR ** keyframe.features.octaves[features].astype(np.float64)
    aligned = _aligned(base, keyframe, rows, features, se3_inverse(fix.map_from_cam), settings)
    sure = np.isfinite(aligned[:, 0])
    left[sure] = aligned[sure, :2]
    sigma[sure] = np.hypot(noise.aligned_sigma_px, aligned[sure, 2])
    disparities, sigmas = keyframe.measured_at(features, left, settings.stereo).T
    sigma_depth = np.hypot(noise.disparity_sigma_px, np.nan_to_num(sigmas, nan=1.0))
    pixels = np.column_stack([left, left[:, 0] - disparities])
    return Sighting(rows, features, pixels, np.column_stack([sigma, sigma_depth]))


def _aligned(
    base: BaseMap, keyframe: Keyframe, rows: Rows, features: Rows, cam_from_map: Array, settings: SurveySettings
) -> Array:
    """Return (P, 3) as `refine_matches`, against the landmarks' patches instead of whole pictures."""
    references = base.references[rows]
    octaves, owners = base.map.obs_octave[references], base.map.obs_keyframe[references]
    sizes = 2.0 ** halvings(octaves)[:, None]
    exact = base.map.obs_pixels[references, :2] / sizes
    side = base.map.patches.shape[1]
    mosaic = np.ascontiguousarray(base.map.patches[rows].reshape(-1, side))
    centres = exact - np.rint(exact) + side // 2
    # Patches are stacked vertically: a window that leaves its patch sideways would also leave it up or down.
    centres[:, 1] += side * np.arange(len(rows))
    # Each patch was cut at its own level, which is the level of the mosaic. Without its angle only the motion can warp it.
    known = (mosaic, mosaic, mosaic), centres * sizes, octaves, np.full(len(rows), np.nan, np.float32)
    aligned = np.empty((len(rows), 3))
    for k in np.unique(owners):
        own, map_from_reference = np.flatnonzero(owners == k), base.map_from_cam[k]
        points = transform_points(se3_inverse(map_from_reference), base.points_map[rows[own]])
        seen = Patches.of(keyframe.pyramid, keyframe.features, features[own])
        aligned[own] = refine_matches(
            Patches(*known, own), seen, settings.align, points, cam_from_map @ map_from_reference
        )
    return aligned
