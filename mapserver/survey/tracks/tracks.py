"""Landmarks from verified pairs: feature tracks across keyframes, one feature per image, with sub-pixel coordinates."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleetmap import core
from fleetmap.features.patch_align import Patches, refine_matches
from fleetmap.geometry import Array, Indices, Mask, se3_inverse, transform_points
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe, Landmarks, RigImages, of_features
from mapserver.survey.tracks.pairs import PairMatch

_SAME_WARP = 0.01  # isotropic change of a patch's shape that moves its rim by less than 0.05 px
_ROWS = 2**18  # observations per comparison of warps
_BATCH = 16  # images: their sources overlap, so that few pictures are sent twice


@dataclass(frozen=True, slots=True)
class Tracks:
    """Features connected by pairs: members (M,) of G concatenated tracks, by ascending image; starts (G,) of each."""

    images: Indices
    features: Indices
    starts: Indices

    @classmethod
    def of(cls, marks: Landmarks, numbers: Indices) -> "Tracks":
        """Return the observations of landmarks, each one's reference first; numbers (K, V) of the images."""
        starts = np.flatnonzero(np.diff(marks.obs_landmark, prepend=-1))
        return cls(numbers[marks.obs_keyframe, marks.obs_camera], marks.obs_feature.astype(np.int64), starts)


def tracks_of(pairs: list[PairMatch], known: Tracks | None = None) -> Tracks:
    """Group features connected by pairs, no image twice in a group; pairs with the most matches are joined first.

    known: groups joined before any pair.
    Source: union-find, Tarjan 1975; tracks over unordered pairs, Moulon and Monasse 2012.
    """
    ordered = sorted(pairs, key=lambda p: (-len(p.features), p.i, p.j))
    known = known or Tracks(*np.zeros((3, 0), np.int64))
    if not ordered and not len(known.starts):
        return known
    # Images have far fewer features than pairs have matches: each feature is a node, and links stay small.
    stride = 1 + max([int(known.features.max(initial=0)), *(int(p.features.max(initial=0)) for p in ordered)])
    count = 1 + max([int(known.images.max(initial=0)), *(p.j for p in ordered)])
    linked = (known.images * stride + known.features).astype(np.int32)
    follows = np.setdiff1d(np.arange(len(linked)), known.starts, assume_unique=True)
    first = [linked[follows - 1], *((p.i * stride + p.features[:, 0]).astype(np.int32) for p in ordered)]
    second = [linked[follows], *((p.j * stride + p.features[:, 1]).astype(np.int32) for p in ordered)]
    owners = np.arange(count, dtype=np.int32).repeat(stride)
    roots = core.join_tracks(np.concatenate(first), np.concatenate(second), owners)
    shared = np.flatnonzero(np.bincount(roots, minlength=len(roots))[roots] > 1)
    nodes = shared[np.argsort(roots[shared], kind="stable")]
    starts = np.flatnonzero(np.diff(roots[nodes], prepend=-1))
    return Tracks(nodes // stride, nodes % stride, starts)


def build_landmarks(
    posed: RigImages,
    tracks: Tracks,
    settings: SurveySettings,
    executor: Executor = SERIAL,
    redundant: Mask | None = None,
) -> Landmarks:
    """Return landmarks of tracks with a stereo point, each observation's coordinate refined against the reference patch.

    Tracks in fewer than two images of keyframes that are not redundant (K,) give no landmark.
    """
    is_redundant = np.zeros(len(tracks.images), bool) if redundant is None else redundant[posed.keyframe][tracks.images]
    table, points_cam = _tracks_from_reference(posed.images, tracks, is_redundant)
    if not len(table):
        return Landmarks.empty()
    reference = posed.map_from_cam[table[np.unique(_reference_rows(table)), 0]]
    points_map = np.einsum("nij,nj->ni", reference[:, :3, :3], points_cam) + reference[:, :3, 3]
    pixels, sigmas = _observe(posed, table, points_map, settings, executor)
    columns = posed.keyframe[table[:, 0]], posed.camera[table[:, 0]], table[:, 1], table[:, 2]
    keyframes, cameras, landmarks, features = (column.astype(np.int32) for column in columns)
    return Landmarks(points_map, keyframes, cameras, landmarks, features, pixels, sigmas)


def refine_observations(
    posed: RigImages, marks: Landmarks, settings: SurveySettings, executor: Executor, before: Array
) -> Landmarks:
    """Return the same landmarks with coordinates refined again where better poses improve the warp of patches.

    before: map_from_cam (P, 4, 4) at which they were observed.
    """
    images, map_from_cam = posed.numbers[marks.obs_keyframe, marks.obs_camera], posed.map_from_cam
    table = np.column_stack([images, marks.obs_landmark, marks.obs_feature])
    anew = np.zeros(len(marks.points_map), bool)
    reference = table[_reference_rows(table), 0]
    for start in range(0, len(table), _ROWS):  # rotations of a site's observations would be gigabytes
        part = slice(start, start + _ROWS)
        points, seen = marks.points_map[table[part, 1]], (table[part, 0], reference[part])
        now, then = _warps(seen, points, map_from_cam), _warps(seen, points, before)
        changed = np.abs(now[0] - then[0]).max(axis=(1, 2)) + np.abs(now[1] - then[1]) > _SAME_WARP
        anew[table[part, 1][changed]] = True
    rows = np.flatnonzero(anew[table[:, 1]])
    pixels, sigmas = marks.obs_pixels.copy(), marks.obs_sigma_px.copy()
    if len(rows):
        pixels[rows], sigmas[rows] = _observe(posed, table[rows], marks.points_map, settings, executor)
    return replace(marks, obs_pixels=pixels, obs_sigma_px=sigmas)


def _warps(seen: tuple[Indices, Indices], points_map: Array, map_from_cam: Array) -> tuple[Array, Array]:
    """Return rotation (M, 3, 3) from each observation's reference, and the logarithm (M,) of the ratio of their distances.

    seen: the image (M,) of each observation and that of its reference. points_map (M, 3) of their landmarks.
    """
    own, reference = seen
    cam_from_map = se3_inverse(map_from_cam)
    depths = [np.einsum("mi,mi->m", cam_from_map[k, 2, :3], points_map) + cam_from_map[k, 2, 3] for k in seen]
    scale = np.log(np.maximum(depths[0], 1e-6) / np.maximum(depths[1], 1e-6))
    return np.asarray(cam_from_map[own, :3, :3] @ map_from_cam[reference, :3, :3]), np.asarray(scale)


def _reference_rows(table: Indices) -> Indices:
    """Return (M,) the row of each observation's reference, the first one of its landmark."""
    is_first = np.diff(table[:, 1], prepend=-1) != 0
    return np.maximum.accumulate(np.where(is_first, np.arange(len(table)), 0))


def _tracks_from_reference(images: list[Keyframe], tracks: Tracks, is_redundant: Mask) -> tuple[Indices, Array]:
    """Return (M, 3) image, landmark, feature of the tracks with depth, each one's reference first; its points_cam (N, 3).

    The reference defines the landmark's patch: with depth, not redundant (M,), finest octave, nearest.
    """
    if not len(tracks.images):
        return np.zeros((0, 3), np.int64), np.zeros((0, 3))
    owners, features = tracks.images, tracks.features
    octaves = of_features(owners, features, [k.features.octaves for k in images])
    disparities = of_features(owners, features, [k.disparities[:, 0] for k in images])
    members = np.arange(len(owners))
    track = np.repeat(np.arange(len(tracks.starts)), np.diff(tracks.starts, append=len(owners)))
    best = np.lexsort((members, -disparities, octaves, is_redundant, ~np.isfinite(disparities), track))[tracks.starts]
    lasting = (
        np.isfinite(disparities[best])
        & ~is_redundant[best]
        & (np.bincount(track[~is_redundant], minlength=len(best)) > 1)
    )
    is_reference = np.zeros(len(owners), bool)
    is_reference[best] = True
    order = np.lexsort((members, ~is_reference, track))
    order = order[lasting[track[order]]]
    landmark = (np.cumsum(lasting) - 1)[track]
    table, best = np.column_stack([owners, landmark, features])[order], best[lasting]
    return table, of_features(owners[best], features[best], [k.points_cam for k in images])


def _observe(
    posed: RigImages, table: Indices, points_map: Array, settings: SurveySettings, executor: Executor
) -> tuple[Array, Array]:
    """Return pixels (M, 3) and sigmas (M, 2) of observations (image, landmark, feature), references first in each landmark."""
    images, map_from_cam, reference_rows = posed.images, posed.map_from_cam, _reference_rows(table)
    groups = in_batches(np.unique(table[:, 0]).tolist(), _BATCH)
    by_image = np.argsort(table[:, 0], kind="stable")
    firsts = np.searchsorted(table[by_image, 0], [group[0] for group in groups])
    rows_of = [np.sort(rows) for rows in np.split(by_image, firsts[1:])]

    def batches() -> Iterator[_ObservationBatch]:
        for group, rows in zip(groups, rows_of, strict=True):
            references = table[reference_rows[rows]]
            known = sorted({*group, *references[:, 0].tolist()})
            posed_images = {k: (images[k].with_pyramid(), map_from_cam[k]) for k in known}
            yield _ObservationBatch(table[rows], references, points_map[table[rows, 1]], posed_images)

    pixels, sigmas = np.empty((len(table), 3)), np.empty((len(table), 2))
    found = executor.map(_observe_batch, settings, batches())
    for rows, (batch_pixels, batch_sigmas) in zip(rows_of, found, strict=True):
        pixels[rows], sigmas[rows] = batch_pixels, batch_sigmas
    return pixels, sigmas


@dataclass(frozen=True, slots=True)
class _ObservationBatch:
    """Observations (M, 3) in some images, their references (M, 3), their landmarks (M, 3), and the required images with map_from_cam."""

    table: Indices
    references: Indices
    points_map: Array
    images: dict[int, tuple[Keyframe, Array]]


def _observe_batch(settings: SurveySettings, batch: _ObservationBatch) -> tuple[Array, Array]:
    """Return pixels (M, 3) and sigmas (M, 2) of one batch."""
    noise, align = settings.noise, settings.align
    pixels, sigmas = np.empty((len(batch.table), 3)), np.empty((len(batch.table), 2))
    for k in np.unique(batch.table[:, 0]).tolist():
        rows = np.flatnonzero(batch.table[:, 0] == k)
        own, map_from_cam = batch.images[k]
        features, references, points_map = batch.table[rows, 2], batch.references[rows], batch.points_map[rows]
        left = own.features.pixels[features].copy()
        sigma = noise.descriptor_sigma_px * 1.2 ** own.features.octaves[features].astype(np.float64)
        for source in np.unique(references[:, 0]).tolist():
            inner = np.flatnonzero(references[:, 0] == source)
            if source == k:
                sigma[inner] = noise.aligned_sigma_px
                continue
            other, map_from_source = batch.images[source]
            points_source = transform_points(se3_inverse(map_from_source), points_map[inner])
            theirs = Patches.of(other.pyramid, other.features, references[inner, 2])
            ours = Patches.of(own.pyramid, own.features, features[inner])
            cam_from_source = se3_inverse(map_from_cam) @ map_from_source
            refined = refine_matches(theirs, ours, align, points_source, cam_from_source)
            sure = np.isfinite(refined[:, 0])
            left[inner[sure]] = refined[sure, :2]
            sigma[inner[sure]] = np.hypot(noise.aligned_sigma_px, refined[sure, 2])
        disparities, its_sigmas = own.measured_at(features, left, settings.stereo).T
        pixels[rows] = np.column_stack([left, left[:, 0] - disparities])
        sigmas[rows] = np.column_stack([sigma, np.hypot(noise.disparity_sigma_px, np.nan_to_num(its_sigmas, nan=1.0))])
    return pixels, sigmas
