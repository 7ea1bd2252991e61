"""Which features of two keyframes show the same thing: matched by descriptor, verified by one rigid motion, completed by projection."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching import match_by_projection, match_mutual
from fleetmap.geometry import Array, se3_inverse
from fleetmap.pnp.pnp import PnpResult, pnp_with_rotation, ransac_pnp, refine_pnp
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


def match_pair(
    i: int, j: int, keyframes: list[Keyframe], camera: StereoCamera, j_from_i: Array | None, rotation_sigma_rad: float | None,
    settings: PairSettings, *, is_known: bool = False,
) -> PairMatch | None:  # fmt: skip
    """The verified match of two keyframes, None where too little agrees.

    j_from_i: predicted camera motion, or None; rotation_sigma_rad: how well its rotation is known, None where it must not be used.
    is_known: the prediction is good to a few pixels (after bundle adjustment), so that projection alone finds the matches.
    """
    a, b = keyframes[i], keyframes[j]
    found = None
    if is_known and j_from_i is not None:
        found = _from_projection(a, b, camera, j_from_i, settings, settings.search_px)
    if found is None:
        found = _from_descriptors(a, b, camera, j_from_i, rotation_sigma_rad, settings)
    if found is None:
        return None
    return _complete(i, j, a, b, camera, found, settings)


def _measured(keyframe: Keyframe, index: Indices) -> Array:
    pixels = keyframe.features.pixels[index]
    measured = np.full(len(pixels), np.nan) if keyframe.from_views else keyframe.disparities[index, 0]
    return np.column_stack([pixels, pixels[:, 0] - measured])


def _sigmas(keyframe: Keyframe, index: Indices, settings: PairSettings) -> Array:
    scale = 1.2 ** np.minimum(keyframe.features.octaves[index], 4).astype(np.float64)
    return np.column_stack([settings.match_sigma_px * scale, np.maximum(settings.match_sigma_px, scale)])


def _from_descriptors(
    a: Keyframe,
    b: Keyframe,
    camera: StereoCamera,
    j_from_i: Array | None,
    rotation_sigma_rad: float | None,
    settings: PairSettings,
) -> PnpResult | None:
    known = np.flatnonzero(np.isfinite(a.disparities[:, 0]))
    pairs = match_mutual(a.features.descriptors[known], b.features.descriptors, settings.max_distance, settings.ratio)
    index_a, index_b = known[pairs[:, 0]], pairs[:, 1]
    points, measured, sigmas = a.points_cam[index_a], _measured(b, index_b), _sigmas(b, index_b, settings)
    if j_from_i is not None and rotation_sigma_rad is not None and not b.from_views:
        threshold = max(settings.search_px, 1.5 * rotation_sigma_rad * camera.focal_px)
        return pnp_with_rotation(
            camera, points, measured, sigmas, j_from_i[:3, :3], threshold_px=threshold, min_inliers=settings.min_inliers,
            rotation_sigma_rad=rotation_sigma_rad,
        )  # fmt: skip
    found = ransac_pnp(
        camera, points, measured, sigmas, threshold_px=4.0, min_inliers=settings.min_inliers, seed=len(pairs)
    )
    # without a known rotation a few matches agree with something by chance: ask for a share of them too
    return found if found is not None and found.inliers.sum() >= 0.2 * len(pairs) else None


def _project_match(
    a: Keyframe, b: Keyframe, camera: StereoCamera, b_from_a: Array, settings: PairSettings, radius_px: float
) -> Indices:
    """(P, 2) matches of a's features with depth into b by projection."""
    count = len(a.features)
    predicted, radius, span = np.empty((count, 2)), np.empty(count), np.zeros((count, 2), np.int64)
    predict_features(
        b_from_a,
        a.points_cam,
        a.disparities[:, 0],
        a.features.octaves,
        _lens(camera),
        radius_px,
        predicted,
        radius,
        span,
    )
    found, _ = match_by_projection(
        predicted, radius, a.features.descriptors, span, b.features.pixels, b.features.octaves, b.features.descriptors,
        settings.guided_distance, 0.95,
    )  # fmt: skip
    hit = np.flatnonzero(found >= 0)
    return np.column_stack([hit, found[hit]])


def _lens(camera: StereoCamera) -> Array:
    return np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px], np.float64)


def _from_projection(
    a: Keyframe, b: Keyframe, camera: StereoCamera, b_from_a: Array, settings: PairSettings, radius_px: float
) -> PnpResult | None:
    pairs = _project_match(a, b, camera, b_from_a, settings, radius_px)
    if len(pairs) < settings.min_inliers:
        return None
    found = refine_pnp(
        camera, a.points_cam[pairs[:, 0]], _measured(b, pairs[:, 1]), _sigmas(b, pairs[:, 1], settings), b_from_a
    )
    return found if found is not None and found.inliers.sum() >= max(settings.min_inliers, 0.4 * len(pairs)) else None


def _complete(
    i: int, j: int, a: Keyframe, b: Keyframe, camera: StereoCamera, found: PnpResult, settings: PairSettings
) -> PairMatch | None:
    """All matches that fit the motion, looked for in both directions, and the motion from all of them."""
    for _ in range(2):
        forward = _project_match(a, b, camera, found.cam_from_source, settings, settings.guided_radius_px)
        if len(forward) < settings.min_inliers:
            return None
        again = refine_pnp(
            camera,
            a.points_cam[forward[:, 0]],
            _measured(b, forward[:, 1]),
            _sigmas(b, forward[:, 1], settings),
            found.cam_from_source,
        )
        if again is None or again.inliers.sum() < settings.min_inliers:
            return None
        found = again
    forward = forward[found.inliers]
    backward = _project_match(b, a, camera, se3_inverse(found.cam_from_source), settings, settings.guided_radius_px)[
        :, ::-1
    ]
    fresh = ~np.isin(backward[:, 0], forward[:, 0]) & ~np.isin(backward[:, 1], forward[:, 1])
    features = np.vstack([forward, backward[fresh]]).astype(np.int32)  # a long survey has ten million
    return PairMatch(i, j, features, found.cam_from_source, found.cov_rot_trans)


def view_overlap(a: Keyframe, camera: StereoCamera, b_from_a: Array) -> float:
    """Share of a's points with depth that b would see, at a similar distance."""
    return share_in_view(b_from_a, a.points_cam, a.disparities[:, 0], _lens(camera))
