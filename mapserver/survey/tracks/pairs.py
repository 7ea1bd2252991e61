"""Feature matching of two keyframes: by descriptor, verified by one rigid motion, completed by projection."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import match_mutual, packed
from fleetmap.geometry import Array
from fleetmap.pnp.pnp import REFINEMENT, Correspondences, PnpResult, pnp_with_rotation, ransac_pnp
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.settings import PairSettings
from mapserver.survey.state import Keyframe

_SCALES = 1.2 ** np.minimum(np.arange(128), 4).astype(np.float64)  # pixel scale of an octave
_PROJECTED_SHARE = 0.4  # of the matches near their prediction: fewer, and the prediction was wrong


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
    """Keyframes by their numbers, without their pictures, for matching: of a survey, or of a few pairs."""

    keyframes: list[Keyframe] | dict[int, Keyframe]
    camera: StereoCamera
    settings: PairSettings


class PairTask(NamedTuple):
    """Work for a process: pairs (i, j, predicted motion), and their keyframes only, not those of the whole survey."""

    pairs: "list[tuple[int, int, PredictedMotion]]"
    keyframes: dict[int, Keyframe]

    @classmethod
    def of(cls, pairs: "list[tuple[int, int, PredictedMotion]]", inputs: MatchInputs) -> "PairTask":
        """Return the task of some of a survey's pairs."""
        numbers = sorted({k for i, j, _ in pairs for k in (i, j)})
        return cls(pairs, {k: inputs.keyframes[k] for k in numbers})


class PredictedMotion(NamedTuple):
    """Camera motion j_from_i (4, 4) expected between two keyframes.

    rotation_sigma_rad: of its rotation, None if it must not be used. is_known: accurate to a few pixels (after bundle
    adjustment), so that projection alone finds the matches.
    """

    j_from_i: Array
    rotation_sigma_rad: float | None = None
    is_known: bool = False


def match_task(shared: MatchInputs, task: PairTask) -> list[PairMatch | None]:
    """Return the verified match of each pair of a task; `shared` needs no keyframes."""
    inputs = replace(shared, keyframes=task.keyframes)
    return [match_pair(i, j, inputs, predicted) for i, j, predicted in task.pairs]


def match_pair(i: int, j: int, inputs: MatchInputs, predicted: PredictedMotion | None = None) -> PairMatch | None:
    """Return the verified match of two keyframes, None if too little agrees."""
    a, b, settings = inputs.keyframes[i], inputs.keyframes[j], inputs.settings
    match, radii_px = None, [settings.search_px, settings.guided_radius_px, settings.guided_radius_px]
    if predicted is not None and predicted.is_known:
        match = _match_guided(a, b, inputs, predicted.j_from_i, radii_px, _PROJECTED_SHARE)
    if match is None or match[0] == 0:
        found = _from_descriptors(a, b, inputs, predicted)
        if found is None:
            return None
        radii_px = radii_px[1:]
        match = _match_guided(a, b, inputs, found.cam_from_source, radii_px, 0.0)
    done, features, motion, hessian = match
    if done < len(radii_px):
        return None
    return PairMatch(i, j, features, motion, np.asarray(np.linalg.inv(hessian + 1e-9 * np.eye(6))))


def _match_guided(
    a: Keyframe, b: Keyframe, inputs: MatchInputs, b_from_a: Array, radii_px: list[float], least_share: float
) -> tuple[int, NDArray[np.int32], Array, Array]:
    """Return how often matches near a motion gave the motion, the final matches, the motion and its information."""
    settings, camera = inputs.settings, inputs.camera
    motion, size_px = np.ascontiguousarray(b_from_a, np.float64), (camera.width_px, camera.height_px)
    limits = camera.lens, size_px, settings.match_sigma_px, REFINEMENT, settings.guided_distance
    wanted = np.array(radii_px, np.float64), settings.min_inliers, least_share
    return core.match_guided(_features(a), _features(b), motion, *limits, *wanted)


def _features(keyframe: Keyframe) -> tuple[Array, NDArray[np.int8], NDArray[np.uint64], Array, Array, bool]:
    own = keyframe.features
    pixels, octaves = np.ascontiguousarray(own.pixels, np.float64), np.ascontiguousarray(own.octaves, np.int8)
    places = np.ascontiguousarray(keyframe.disparities), np.ascontiguousarray(keyframe.points_cam)
    return pixels, octaves, packed(own.descriptors), *places, not keyframe.from_views


def _from_descriptors(
    a: Keyframe, b: Keyframe, inputs: MatchInputs, predicted: PredictedMotion | None
) -> PnpResult | None:
    camera, settings = inputs.camera, inputs.settings
    known = np.flatnonzero(np.isfinite(a.disparities[:, 0]))
    nodes = None if a.nodes is None or b.nodes is None else (a.nodes[known], b.nodes[:, 0])
    descriptors = a.features.descriptors[known], b.features.descriptors
    pairs = match_mutual(*descriptors, settings.max_distance, settings.ratio, nodes)
    index_a, index_b = known[pairs[:, 0]], pairs[:, 1]
    pixels, scale = b.features.pixels[index_b], _SCALES[b.features.octaves[index_b]]
    measured = np.column_stack([pixels, pixels[:, 0] - b.measured(index_b)[:, 0]])
    sigmas = np.column_stack([settings.match_sigma_px * scale, np.maximum(settings.match_sigma_px, scale)])
    matches = Correspondences(camera, a.points_cam[index_a], measured, sigmas)
    least = settings.min_inliers
    if predicted is not None and predicted.rotation_sigma_rad is not None and not b.from_views:
        sigma_rad = predicted.rotation_sigma_rad
        threshold_px = max(settings.search_px, 1.5 * sigma_rad * camera.focal_px)
        rotation = predicted.j_from_i[:3, :3]
        return pnp_with_rotation(
            matches, rotation, threshold_px=threshold_px, min_inliers=least, rotation_sigma_rad=sigma_rad
        )
    found = ransac_pnp(matches, threshold_px=4.0, min_inliers=least, seed=len(pairs))
    # without a known rotation a few matches agree by chance: also require a share of them
    return found if found is not None and found.inliers.sum() >= 0.2 * len(pairs) else None


def view_overlap(a: Keyframe, camera: StereoCamera, b_from_a: Array) -> float:
    """Return the share of a's points with depth that b would see, at a similar distance."""
    motion, size_px = np.ascontiguousarray(b_from_a, np.float64), (camera.width_px, camera.height_px)
    places = np.ascontiguousarray(a.points_cam), np.ascontiguousarray(a.disparities)
    return core.share_in_view(motion, *places, camera.lens, size_px)
