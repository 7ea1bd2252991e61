"""Landmarks from verified pairs: features joined across keyframes, one per keyframe, with sub-pixel coordinates."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import patch_align, stereo
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.rectification import StereoCamera
from mapserver.survey.keyframes import Keyframe, with_pictures
from mapserver.survey.pairs import PairMatch
from mapserver.survey.settings import NoiseSettings, SurveySettings
from mapserver.survey.tracks_kernels import join as join_kernel
from mapserver.survey.work import ALONE, Worker, in_batches

_BATCH = 16  # keyframes: their sources overlap, so that few pictures travel twice


@dataclass
class Landmarks:
    """N landmarks and their M observations, sorted by landmark; the first observation of each is its reference.

    obs_keyframe, obs_landmark, obs_feature (M,); obs_pixels (M, 3) u_left v u_right; obs_sigma_px (M, 2) of pixel and disparity.
    """

    points_map: Array
    obs_keyframe: NDArray[np.int32]
    obs_landmark: NDArray[np.int32]
    obs_feature: NDArray[np.int64]
    obs_pixels: Array
    obs_sigma_px: Array

    def keep_observations(self, keep: NDArray[np.bool_], min_observations: int) -> "Landmarks":
        """Without the other observations, and without landmarks that are then seen too rarely."""
        counts = np.bincount(self.obs_landmark[keep], minlength=len(self.points_map))
        lasting = counts >= min_observations
        keep = keep & lasting[self.obs_landmark]
        number = np.cumsum(lasting) - 1
        return Landmarks(
            self.points_map[lasting], self.obs_keyframe[keep], number[self.obs_landmark[keep]].astype(np.int32),
            self.obs_feature[keep], self.obs_pixels[keep], self.obs_sigma_px[keep],
        )  # fmt: skip


def join_tracks(keyframes: list[Keyframe], pairs: list[PairMatch]) -> list[list[tuple[int, int]]]:
    """Groups of (keyframe, feature) that pairs connect, no keyframe twice in a group; strongest pairs are joined first."""
    ordered = sorted(pairs, key=lambda p: (-len(p.features), p.i, p.j))
    if not ordered:
        return []
    sides = [np.concatenate([p.features[:, side] for p in ordered]).astype(np.int64) for side in range(2)]
    counts = [len(p.features) for p in ordered]
    owners = [np.repeat(np.array([p.i for p in ordered]), counts), np.repeat(np.array([p.j for p in ordered]), counts)]
    stride = int(max(sides[0].max(initial=0), sides[1].max(initial=0))) + 1
    codes = [owner * stride + feature for owner, feature in zip(owners, sides, strict=True)]
    nodes, links = np.unique(np.concatenate(codes), return_inverse=True)
    roots = join_kernel(links[: len(codes[0])], links[len(codes[0]) :], nodes // stride)
    order = np.lexsort((nodes, roots))
    _, starts, sizes = np.unique(roots[order], return_index=True, return_counts=True)
    found = nodes[order]
    members = list(zip((found // stride).tolist(), (found % stride).tolist(), strict=True))
    return [members[start : start + size] for start, size in zip(starts, sizes, strict=True) if size > 1]


def build_landmarks(
    keyframes: list[Keyframe], pairs: list[PairMatch], map_from_body: Array, body_from_cam: Array, camera: StereoCamera,
    settings: SurveySettings, worker: Worker = ALONE,
) -> Landmarks:  # fmt: skip
    """Tracks of the pairs with a stereo point to start from, each observation's coordinate refined against the reference patch."""
    rows: list[tuple[int, int, int]] = []
    points: list[Array] = []
    map_from_cam = map_from_body @ body_from_cam
    for group in join_tracks(keyframes, pairs):
        reference = _reference(keyframes, group)
        if reference is None:
            continue
        keyframe, feature = reference
        points.append(transform_points(map_from_cam[keyframe], keyframes[keyframe].points_cam[feature][None])[0])
        ordered = [reference, *(node for node in group if node != reference)]
        rows.extend((k, len(points) - 1, f) for k, f in ordered)
    if not rows:
        nothing = np.zeros(0, np.int32)
        return Landmarks(np.zeros((0, 3)), nothing, nothing, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
    table = np.array(rows, np.int64)
    pixels, sigmas = _observe(keyframes, table, map_from_cam, camera, settings, worker)
    return Landmarks(
        np.array(points), table[:, 0].astype(np.int32), table[:, 1].astype(np.int32), table[:, 2], pixels, sigmas
    )


def _reference(keyframes: list[Keyframe], group: list[tuple[int, int]]) -> tuple[int, int] | None:
    """The observation that defines the landmark's patch: with depth, finest octave, nearest."""
    usable = [(k, f) for k, f in group if np.isfinite(keyframes[k].disparities[f, 0])]
    if not usable:
        return None
    return min(
        usable,
        key=lambda node: (keyframes[node[0]].features.octaves[node[1]], -keyframes[node[0]].disparities[node[1], 0]),
    )


def _observe(
    keyframes: list[Keyframe],
    table: NDArray[np.int64],
    map_from_cam: Array,
    camera: StereoCamera,
    settings: SurveySettings,
    worker: Worker,
) -> tuple[Array, Array]:
    """Pixels (M, 3) and sigmas (M, 2) of observations (keyframe, landmark, feature), references first in each landmark."""
    is_reference = np.r_[True, table[1:, 1] != table[:-1, 1]]
    reference_row = np.maximum.accumulate(np.where(is_reference, np.arange(len(table)), 0))
    groups = in_batches(np.unique(table[:, 0]).tolist(), _BATCH)
    rows_of = [np.flatnonzero(np.isin(table[:, 0], group)) for group in groups]

    def batches() -> Iterator[_Looks]:
        for group, rows in zip(groups, rows_of, strict=True):
            references = table[reference_row[rows]]
            sources = np.unique(references[:, 0]).tolist()
            known = {k: with_pictures(keyframes[k], whole=k in group) for k in sorted({*group, *sources})}
            places = {k: map_from_cam[k] for k in known}
            yield _Looks(table[rows], references, is_reference[rows], known, places)

    pixels, sigmas = np.empty((len(table), 3)), np.empty((len(table), 2))
    found = worker.map(_observe_batch, (camera, settings), batches())
    for rows, (batch_pixels, batch_sigmas) in zip(rows_of, found, strict=True):
        pixels[rows], sigmas[rows] = batch_pixels, batch_sigmas
    return pixels, sigmas


@dataclass(frozen=True, slots=True)
class _Looks:
    """Observations (M, 3) of some keyframes, their references (M, 3), which are references themselves, and all that these need."""

    table: NDArray[np.int64]
    references: NDArray[np.int64]
    is_reference: NDArray[np.bool_]
    keyframes: dict[int, Keyframe]
    map_from_cam: dict[int, Array]


def _observe_batch(shared: tuple[StereoCamera, SurveySettings], looks: _Looks) -> tuple[Array, Array]:
    """Pixels (M, 3) and sigmas (M, 2) of one batch."""
    camera, settings = shared
    noise, keyframes = settings.noise, looks.keyframes
    pixels, sigmas = np.empty((len(looks.table), 3)), np.empty((len(looks.table), 2))
    for k in np.unique(looks.table[:, 0]).tolist():
        rows = np.flatnonzero(looks.table[:, 0] == k)
        own, frame = keyframes[k], keyframes[k].frame
        features, references, is_reference = looks.table[rows, 2], looks.references[rows], looks.is_reference[rows]
        left, sigma = own.features.pixels[features].copy(), _descriptor_sigma(own, features, noise)
        sigma[is_reference] = noise.aligned_sigma_px
        for source in np.unique(references[:, 0]).tolist():
            inner = np.flatnonzero((references[:, 0] == source) & ~is_reference)
            if not len(inner):
                continue
            own_from_source = se3_inverse(looks.map_from_cam[k]) @ looks.map_from_cam[source]
            theirs = references[inner, 2]
            refined = _align(keyframes[source], theirs, own, features[inner], own_from_source, camera, settings)
            sure = np.isfinite(refined[:, 0])
            left[inner[sure]] = refined[sure, :2]
            sigma[inner[sure]] = np.hypot(noise.aligned_sigma_px, refined[sure, 2])
        found = stereo.disparities(frame, camera, left, settings.stereo, own.disparities[features, 0])
        pixels[rows] = np.column_stack([left, left[:, 0] - found[:, 0]])
        sigmas[rows] = np.column_stack([sigma, np.hypot(noise.disparity_sigma_px, np.nan_to_num(found[:, 1], nan=1.0))])
    return pixels, sigmas


def _descriptor_sigma(keyframe: Keyframe, features: NDArray[np.int64], noise: NoiseSettings) -> Array:
    return np.asarray(noise.descriptor_sigma_px * 1.2 ** keyframe.features.octaves[features].astype(np.float64))


def _align(
    reference: Keyframe, theirs: NDArray[np.int64], own: Keyframe, ours: NDArray[np.int64], own_from_reference: Array,
    camera: StereoCamera, settings: SurveySettings,
) -> Array:  # fmt: skip
    """Refined pixels (N, 3) of `ours`; the warp comes from the motion, which is finer than the octaves and angles of features."""
    a, b = reference.features.take(theirs), own.features.take(ours)
    warp = patch_align.similarity_from_motion(camera, reference.points_cam[theirs], own_from_reference)
    rough = patch_align.similarity_from_features(
        a.octaves, a.angles_deg.astype(np.float64), b.octaves, b.angles_deg.astype(np.float64)
    )
    unknown = ~np.isfinite(warp).all(axis=(1, 2))
    warp[unknown] = rough[unknown]
    return patch_align.refine_matches(
        reference.pyramid, own.pyramid, a.pixels, a.octaves, b.pixels, b.octaves, warp, settings.align
    )
