"""Landmarks from verified pairs: features joined across keyframes, one per keyframe, with sub-pixel coordinates."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import stereo
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.keyframes.keyframes import Keyframe, Pictures, with_pictures
from mapserver.survey.settings import NoiseSettings, SurveySettings
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks_kernels import align_observations
from mapserver.survey.tracks.tracks_kernels import join as join_kernel

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


def of_features(marks: Landmarks, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """What each observation's feature has: columns are one array for each keyframe, a row for each feature."""
    out = np.empty((len(marks.obs_keyframe), *columns[0].shape[1:]), columns[0].dtype)
    order = np.argsort(marks.obs_keyframe, kind="stable")
    ends = np.cumsum(np.bincount(marks.obs_keyframe, minlength=len(columns)))
    for column, rows in zip(columns, np.split(order, ends[:-1]), strict=True):
        out[rows] = column[marks.obs_feature[rows]]
    return out


def join_tracks(keyframes: list[Keyframe], pairs: list[PairMatch]) -> list[list[tuple[int, int]]]:
    """Groups of (keyframe, feature) that pairs connect, no keyframe twice in a group; strongest pairs are joined first."""
    groups = tracks_of(pairs)
    members = list(zip(groups.keyframes.tolist(), groups.features.tolist(), strict=True))
    edges = np.append(groups.starts, len(members)).tolist()
    return [members[start:end] for start, end in pairwise(edges)]


@dataclass(frozen=True, slots=True)
class Tracks:
    """What pairs connect: members (M,) of G tracks, one track after the other, by rising keyframe; starts (G,) of each."""

    keyframes: NDArray[np.int64]
    features: NDArray[np.int64]
    starts: NDArray[np.int64]


def tracks_of(pairs: list[PairMatch]) -> Tracks:
    """The tracks of all pairs, as `join_tracks` makes them."""
    ordered = sorted(pairs, key=lambda p: (-len(p.features), p.i, p.j))
    if not ordered:
        nothing = np.zeros(0, np.int64)
        return Tracks(nothing, nothing, nothing)
    # Keyframes have far fewer features than pairs have matches: any feature is a node, and links stay small.
    stride = 1 + max(int(p.features.max(initial=0)) for p in ordered)
    owners = np.arange(1 + max(p.j for p in ordered), dtype=np.int32).repeat(stride)
    first = np.concatenate([(p.i * stride + p.features[:, 0]).astype(np.int32) for p in ordered])
    second = np.concatenate([(p.j * stride + p.features[:, 1]).astype(np.int32) for p in ordered])
    roots = join_kernel(first, second, owners)
    shared = np.flatnonzero(np.bincount(roots, minlength=len(roots))[roots] > 1)
    nodes = shared[np.argsort(roots[shared], kind="stable")]
    starts = np.flatnonzero(np.diff(roots[nodes], prepend=-1))
    return Tracks(nodes // stride, nodes % stride, starts)


def build_landmarks(
    keyframes: list[Keyframe], pairs: list[PairMatch], map_from_body: Array, body_from_cam: Array, camera: StereoCamera,
    settings: SurveySettings, worker: Executor = SERIAL,
) -> Landmarks:  # fmt: skip
    """Tracks of the pairs with a stereo point to start from, each observation's coordinate refined against the reference patch."""
    none = np.zeros(len(keyframes), bool)
    return landmarks_of(keyframes, tracks_of(pairs), none, map_from_body, body_from_cam, camera, settings, worker)


def landmarks_of(
    keyframes: list[Keyframe], tracks: Tracks, spare: NDArray[np.bool_], map_from_body: Array, body_from_cam: Array,
    camera: StereoCamera, settings: SurveySettings, worker: Executor = SERIAL,
) -> Landmarks:  # fmt: skip
    """The same from tracks. Those that fewer than two keyframes see which are not spare (K,) give no landmark."""
    map_from_cam = map_from_body @ body_from_cam
    table, points_cam = _tracks_from_reference(keyframes, tracks, spare)
    if not len(table):
        nothing = np.zeros(0, np.int32)
        return Landmarks(np.zeros((0, 3)), nothing, nothing, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
    there = map_from_cam[table[_is_first(table), 0]]
    points_map = np.einsum("nij,nj->ni", there[:, :3, :3], points_cam) + there[:, :3, 3]
    pixels, sigmas = _observe(keyframes, table, points_map, map_from_cam, camera, settings, worker)
    return Landmarks(
        points_map, table[:, 0].astype(np.int32), table[:, 1].astype(np.int32), table[:, 2], pixels, sigmas
    )


def observed_again(
    marks: Landmarks, keyframes: list[Keyframe], map_from_body: Array, body_from_cam: Array, camera: StereoCamera,
    settings: SurveySettings, worker: Executor = SERIAL,
) -> Landmarks:  # fmt: skip
    """The same landmarks with their coordinates refined anew: from better places patches are warped better."""
    table = np.column_stack([marks.obs_keyframe, marks.obs_landmark, marks.obs_feature]).astype(np.int64)
    pixels, sigmas = _observe(
        keyframes, table, marks.points_map, map_from_body @ body_from_cam, camera, settings, worker
    )
    return replace(marks, obs_pixels=pixels, obs_sigma_px=sigmas)


def _is_first(table: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(M,) which observations are the first of their landmark."""
    return np.asarray(np.diff(table[:, 1], prepend=-1) != 0)


def _tracks_from_reference(
    keyframes: list[Keyframe], tracks: Tracks, spare: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Array]:
    """(M, 3) keyframe, landmark, feature of the tracks that know a depth, each one's reference first; its points_cam (N, 3).

    The reference defines the landmark's patch: with depth, not spare, finest octave, nearest.
    """
    if not len(tracks.keyframes):
        return np.zeros((0, 3), np.int64), np.zeros((0, 3))
    first_of = np.cumsum([0, *(len(k.features) for k in keyframes)])
    at = first_of[tracks.keyframes] + tracks.features
    octaves = np.concatenate([k.features.octaves for k in keyframes])[at]
    disparities = np.concatenate([k.disparities[:, 0] for k in keyframes])[at]
    members, is_spare = np.arange(len(at)), spare[tracks.keyframes]
    track = np.repeat(np.arange(len(tracks.starts)), np.diff(tracks.starts, append=len(at)))
    best = np.lexsort((members, -disparities, octaves, is_spare, ~np.isfinite(disparities), track))[tracks.starts]
    lasting = (
        np.isfinite(disparities[best]) & ~is_spare[best] & (np.bincount(track[~is_spare], minlength=len(best)) > 1)
    )
    is_reference = np.zeros(len(at), bool)
    is_reference[best] = True
    order = np.lexsort((members, ~is_reference, track))
    order = order[lasting[track[order]]]
    landmark = (np.cumsum(lasting) - 1)[track]
    table = np.column_stack([tracks.keyframes, landmark, tracks.features])[order]
    return table, np.concatenate([k.points_cam for k in keyframes])[at[best[lasting]]]


def _observe(
    keyframes: list[Keyframe],
    table: NDArray[np.int64],
    points_map: Array,
    map_from_cam: Array,
    camera: StereoCamera,
    settings: SurveySettings,
    worker: Executor,
) -> tuple[Array, Array]:
    """Pixels (M, 3) and sigmas (M, 2) of observations (keyframe, landmark, feature), references first in each landmark."""
    is_reference = _is_first(table)
    reference_row = np.maximum.accumulate(np.where(is_reference, np.arange(len(table)), 0))
    groups = in_batches(np.unique(table[:, 0]).tolist(), _BATCH)
    rows_of = [np.flatnonzero(np.isin(table[:, 0], group)) for group in groups]

    def batches() -> Iterator[_Looks]:
        for group, rows in zip(groups, rows_of, strict=True):
            references = table[reference_row[rows]]
            sources = np.unique(references[:, 0]).tolist()
            known = {k: with_pictures(keyframes[k], whole=k in group) for k in sorted({*group, *sources})}
            places = {k: map_from_cam[k] for k in known}
            yield _Looks(table[rows], references, is_reference[rows], points_map[table[rows, 1]], known, places)

    pixels, sigmas = np.empty((len(table), 3)), np.empty((len(table), 2))
    found = worker.map(_observe_batch, (camera, settings), batches())
    for rows, (batch_pixels, batch_sigmas) in zip(rows_of, found, strict=True):
        pixels[rows], sigmas[rows] = batch_pixels, batch_sigmas
    return pixels, sigmas


@dataclass(frozen=True, slots=True)
class _Looks:
    """Observations (M, 3) of some keyframes, their references (M, 3), which are references themselves, where their landmarks
    are, and all that these need."""

    table: NDArray[np.int64]
    references: NDArray[np.int64]
    is_reference: NDArray[np.bool_]
    points_map: Array
    keyframes: dict[int, Keyframe]
    map_from_cam: dict[int, Array]


def _observe_batch(shared: tuple[StereoCamera, SurveySettings], looks: _Looks) -> tuple[Array, Array]:
    """Pixels (M, 3) and sigmas (M, 2) of one batch."""
    camera, settings = shared
    noise, keyframes = settings.noise, looks.keyframes
    pixels, sigmas = np.empty((len(looks.table), 3)), np.empty((len(looks.table), 2))
    for k in np.unique(looks.table[:, 0]).tolist():
        rows = np.flatnonzero(looks.table[:, 0] == k)
        own, pictures = keyframes[k], keyframes[k].pictures
        features, references, is_reference = looks.table[rows, 2], looks.references[rows], looks.is_reference[rows]
        points_map = looks.points_map[rows]
        left, sigma = own.features.pixels[features].copy(), _descriptor_sigma(own, features, noise)
        sigma[is_reference] = noise.aligned_sigma_px
        cam_from_map = se3_inverse(looks.map_from_cam[k])
        others = np.flatnonzero(~is_reference)
        others = others[np.argsort(references[others, 0], kind="stable")]
        sources, starts = np.unique(references[others, 0], return_index=True)
        for source, inner in zip(sources.tolist(), np.split(others, starts[1:]), strict=True):
            refined = _align(
                keyframes[source], references[inner, 2], own, pictures, features[inner], looks.map_from_cam[source],
                cam_from_map, points_map[inner], settings,
            )  # fmt: skip
            sure = np.isfinite(refined[:, 0])
            left[inner[sure]] = refined[sure, :2]
            sigma[inner[sure]] = np.hypot(noise.aligned_sigma_px, refined[sure, 2])
        found = stereo.disparities(pictures.frame, camera, left, settings.stereo, own.disparities[features, 0])
        pixels[rows] = np.column_stack([left, left[:, 0] - found[:, 0]])
        sigmas[rows] = np.column_stack([sigma, np.hypot(noise.disparity_sigma_px, np.nan_to_num(found[:, 1], nan=1.0))])
    return pixels, sigmas


def _descriptor_sigma(keyframe: Keyframe, features: NDArray[np.int64], noise: NoiseSettings) -> Array:
    return np.asarray(noise.descriptor_sigma_px * 1.2 ** keyframe.features.octaves[features].astype(np.float64))


def _align(
    reference: Keyframe, theirs: NDArray[np.int64], own: Keyframe, pictures: Pictures, ours: NDArray[np.int64],
    map_from_reference: Array, cam_from_map: Array, points_map: Array, settings: SurveySettings,
) -> Array:  # fmt: skip
    """Refined pixels (N, 3) of `ours`, NaN where the patches do not agree."""
    refined, a, b, align = np.empty((len(ours), 3)), reference.features, own.features, settings.align
    whole, half, quarter = reference.pyramid
    own_whole, own_half, own_quarter = pictures.pyramid
    align_observations(
        whole, half, quarter, a.pixels, a.octaves, a.angles_deg, theirs,
        transform_points(se3_inverse(map_from_reference), points_map), own_whole, own_half, own_quarter, b.pixels, b.octaves,
        b.angles_deg, ours, cam_from_map @ map_from_reference, align.half_window_px, align.max_shift_px, align.min_correlation,
        refined,
    )  # fmt: skip
    return refined
