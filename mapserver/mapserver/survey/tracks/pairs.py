"""Feature matching of two keyframes: by descriptor, verified by one rigid motion, completed by projection."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import Projected, match_by_projection, match_mutual
from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import Correspondences, PnpResult, pnp_with_rotation, ransac_pnp, refine_pnp
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.keyframes.keyframes import Keyframe
from mapserver.survey.settings import PairSettings
from mapserver.survey.tracks.pairs_kernels import predict_features, share_in_view

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PairMatch:
    """Keyframes i and j verified against each other: features (P, 2), camera j from camera i, its covariance (left, axes of j)."""

    i: int
    j: int
    features: NDArray[np.int32]
    j_from_i: Array
    cov_rot_trans: Array


@dataclass(frozen=True, slots=True)
class MatchInputs:
    """The keyframes of a survey, without their pictures, as matching reads them."""

    keyframes: list[Keyframe]
    camera: StereoCamera
    settings: PairSettings


class PredictedMotion(NamedTuple):
    """Camera motion j_from_i (4, 4) expected between two keyframes.

    rotation_sigma_rad: of its rotation, None where it must not be used. is_known: good to a few pixels (after bundle
    adjustment), so that projection alone finds the matches.
    """

    j_from_i: Array
    rotation_sigma_rad: float | None = None
    is_known: bool = False


def match_pair(i: int, j: int, inputs: MatchInputs, predicted: PredictedMotion | None = None) -> PairMatch | None:
    """The verified match of two keyframes, None where too little agrees."""
    found = None
    if predicted is not None and predicted.is_known:
        found = _from_projection(inputs.keyframes[i], inputs.keyframes[j], inputs, predicted.j_from_i)
    if found is None:
        found = _from_descriptors(inputs.keyframes[i], inputs.keyframes[j], inputs, predicted)
    return None if found is None else _complete(i, j, inputs, found)


def _measured(keyframe: Keyframe, index: Indices) -> Array:
    pixels = keyframe.features.pixels[index]
    measured = np.full(len(pixels), np.nan) if keyframe.from_views else keyframe.disparities[index, 0]
    return np.column_stack([pixels, pixels[:, 0] - measured])


def _sigmas(keyframe: Keyframe, index: Indices, settings: PairSettings) -> Array:
    scale = 1.2 ** np.minimum(keyframe.features.octaves[index], 4).astype(np.float64)
    return np.column_stack([settings.match_sigma_px * scale, np.maximum(settings.match_sigma_px, scale)])


def _correspondences(a: Keyframe, b: Keyframe, inputs: MatchInputs, pairs: Indices) -> Correspondences:
    """Points of a, which are features pairs[:, 0], as b sees them."""
    measured, sigmas = _measured(b, pairs[:, 1]), _sigmas(b, pairs[:, 1], inputs.settings)
    return Correspondences(inputs.camera, a.points_cam[pairs[:, 0]], measured, sigmas)


def _from_descriptors(
    a: Keyframe, b: Keyframe, inputs: MatchInputs, predicted: PredictedMotion | None
) -> PnpResult | None:
    camera, settings = inputs.camera, inputs.settings
    known = np.flatnonzero(np.isfinite(a.disparities[:, 0]))
    pairs = match_mutual(a.features.descriptors[known], b.features.descriptors, settings.max_distance, settings.ratio)
    index_a, index_b = known[pairs[:, 0]], pairs[:, 1]
    matches = _correspondences(a, b, inputs, np.column_stack([index_a, index_b]))
    least = settings.min_inliers
    if predicted is not None and predicted.rotation_sigma_rad is not None and not b.from_views:
        sigma_rad = predicted.rotation_sigma_rad
        threshold_px = max(settings.search_px, 1.5 * sigma_rad * camera.focal_px)
        rotation = predicted.j_from_i[:3, :3]
        return pnp_with_rotation(
            matches, rotation, threshold_px=threshold_px, min_inliers=least, rotation_sigma_rad=sigma_rad
        )
    found = ransac_pnp(matches, threshold_px=4.0, min_inliers=least, seed=len(pairs))
    # without a known rotation a few matches agree with something by chance: ask for a share of them too
    return found if found is not None and found.inliers.sum() >= 0.2 * len(pairs) else None


def _project_match(a: Keyframe, b: Keyframe, inputs: MatchInputs, b_from_a: Array, radius_px: float) -> Indices:
    """(P, 2) matches of a's features with depth into b by projection."""
    own, disparities = a.features, a.disparities[:, 0]
    predicted, radius, span = np.empty((len(own), 2)), np.empty(len(own)), np.zeros((len(own), 2), np.int64)
    lens, output = _lens(inputs.camera), (predicted, radius, span)
    predict_features(b_from_a, a.points_cam, disparities, own.octaves, lens, radius_px, *output)
    projected = Projected(predicted, radius, own.descriptors, span)
    found, _ = match_by_projection(projected, b.features, inputs.settings.guided_distance, 0.95)
    hit = np.flatnonzero(found >= 0)
    return np.column_stack([hit, found[hit]])


def _lens(camera: StereoCamera) -> Array:
    return np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px], np.float64)


def _from_projection(a: Keyframe, b: Keyframe, inputs: MatchInputs, b_from_a: Array) -> PnpResult | None:
    settings = inputs.settings
    pairs = _project_match(a, b, inputs, b_from_a, settings.search_px)
    if len(pairs) < settings.min_inliers:
        return None
    found = refine_pnp(_correspondences(a, b, inputs, pairs), b_from_a)
    return found if found is not None and found.inliers.sum() >= max(settings.min_inliers, 0.4 * len(pairs)) else None


def _complete(i: int, j: int, inputs: MatchInputs, found: PnpResult) -> PairMatch | None:
    """All matches that fit the motion, looked for in both directions, and the motion from all of them."""
    a, b, settings = inputs.keyframes[i], inputs.keyframes[j], inputs.settings
    for _ in range(2):
        forward = _project_match(a, b, inputs, found.cam_from_source, settings.guided_radius_px)
        if len(forward) < settings.min_inliers:
            return None
        again = refine_pnp(_correspondences(a, b, inputs, forward), found.cam_from_source)
        if again is None or again.inliers.sum() < settings.min_inliers:
            return None
        found = again
    forward = forward[found.inliers]
    j_from_i = found.cam_from_source
    backward = _project_match(b, a, inputs, se3_inverse(j_from_i), settings.guided_radius_px)[:, ::-1]
    fresh = ~np.isin(backward[:, 0], forward[:, 0]) & ~np.isin(backward[:, 1], forward[:, 1])
    features = np.vstack([forward, backward[fresh]]).astype(np.int32)  # a long survey has ten million
    return PairMatch(i, j, features, found.cam_from_source, found.cov_rot_trans)


def view_overlap(a: Keyframe, camera: StereoCamera, b_from_a: Array) -> float:
    """Share of a's points with depth that b would see, at a similar distance."""
    return share_in_view(b_from_a, a.points_cam, a.disparities[:, 0], _lens(camera))
