"""Update of the previous version's surfels by a build's recordings: their keyframes are matched densely at their final poses."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap import core
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.sensors.rectification import StereoCamera
from mapserver.grid.dense_stereo import nearest_around
from mapserver.grid.site_grid import AGAINST, HIT, OCCUPIED, REACH_PX
from mapserver.grid.survey_grid import DepthView, GridSession, measures_depth
from mapserver.surfels.exposure import Sample, estimate_exposure, squared_tangent
from mapserver.surfels.surfel_map import EDGE_M, EXPOSURE, LEVELS, MAX_RANGE_M, Surfels
from mapserver.survey.state import Keyframe

_SEEN, _SEEN_THROUGH = 1, 2
_KEPT_STEP_PX = 4  # pixel step of the depths kept per view, to test for free space
_BLOCK_M = 4.0  # surfels are judged by the views near their block
_OWN_LIGHT_M = 2.0
_DARK, _MIN_ALIKE = 5, 50  # grey levels; common voxels needed to compare the exposure of two drives
_SAMPLED, _SATURATED = 16, 250  # one surfel of this many is used for exposure; grey level of saturation
_MIN_FINER = 2  # voxels of the next finer level that replace a coarse one


class _Look(NamedTuple):
    """Data kept of a keyframe: disparities as of `nearest_around`, their standard deviation, its pose."""

    nearest_px: NDArray[np.float32]
    sigma_px: float
    cam_from_map: Array


class SurfelGrower:
    """The surfels of a site: a session removes those that it saw through, and its equally fine or finer ones replace old ones."""

    def __init__(self, before: Surfels) -> None:
        self.surfels = before

    def begin(self, session: GridSession) -> str | None:
        if not measures_depth(session.survey):
            return "one camera measures no depth; surfels need a stereo pair or a depth camera"
        self._session, self._table, self._looks = session, core.VoxelTable(), list[_Look]()
        return None

    def add(self, view: DepthView) -> None:
        disparity_px, images = view.disparity_px, view.keyframe.images
        lens = self._session.survey.state.camera.lens
        self._table.add(disparity_px, view.sigma_px, lens, np.ascontiguousarray(view.map_from_cam))
        kept = slice(None, None, _KEPT_STEP_PX), slice(None, None, _KEPT_STEP_PX)
        nearest = np.where(disparity_px[kept] > 0, nearest_around(disparity_px, REACH_PX)[kept], np.float32(0.0))
        self._looks.append(_Look(images.keep([nearest])[0], view.sigma_px, se3_inverse(view.map_from_cam)))

    def end(self) -> None:
        before, looks, camera = self.surfels, self._looks, self._session.survey.state.camera
        points_map, normals, levels, views = self._table.surfels()
        new = Surfels(points_map, normals, levels, np.zeros_like(levels))
        hits, passes = _judged(new, looks, camera)
        new = new[HIT * np.maximum(hits, views) - passes >= OCCUPIED]
        new = _coloured(
            new[~_known_finer(new, new, finer_by=1)], self._session.survey.odometry.keyframes, looks, camera
        )
        hits, passes = _judged(before, looks, camera)
        old = before[HIT * hits - passes > -AGAINST]
        new = _as_bright_as(old, new)
        if len(new.exposures) and len(
            old.exposures
        ):  # in the overlap of both drives, the last one defines the brightness
            gaps_m = cKDTree(new.exposures[:, :3]).query(old.exposures[:, :3])[0]
            old = replace(old, exposures=old.exposures[gaps_m > _OWN_LIGHT_M])
        self.surfels = Surfels.joined([old[~_known_finer(old, new, finer_by=0)], new])


def _as_bright_as(old: Surfels, new: Surfels) -> Surfels:
    """Scale the new surfels to the old ones' brightness, by the median over common voxels: each drive has its own mean."""
    (keys, first), (others, second) = (_of_voxels(surfels) for surfels in (old, new))
    _, mine, theirs = np.intersect1d(keys, others, assume_unique=True, return_indices=True)
    before, after = old.greys[first[mine]].astype(np.float64), new.greys[second[theirs]].astype(np.float64)
    sure = (before > _DARK) & (after > _DARK) & (before < _SATURATED) & (after < _SATURATED)
    if sure.sum() < _MIN_ALIKE:
        return new
    shift = float(np.median(np.log(before[sure] / after[sure])))
    greys = np.clip(np.round(new.greys * np.exp(shift)), 0, 255).astype(np.uint8)
    exposures = new.exposures - shift * (np.arange(EXPOSURE) == EXPOSURE - 1)
    return replace(new, greys=greys, exposures=exposures)


def _of_voxels(surfels: Surfels) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct voxels of surfels, and the first surfel of each."""
    found, first = np.unique(core.voxel_keys(surfels.points_map, surfels.levels), return_index=True)
    return found, first


def _judged(surfels: Surfels, looks: Sequence[_Look], camera: StereoCamera) -> tuple[Array, Array]:
    """Return (N,) numbers of views that see each surfel and that see through it, counted as in the planner grid."""
    hits, passes = np.zeros((2, len(surfels)))
    for number, rows in _near(surfels, looks, camera):
        marks, weights, _ = _look(surfels, rows, looks[number], camera)
        hits[rows] += marks == _SEEN
        passes[rows] += weights * (marks == _SEEN_THROUGH)
    return hits, passes


def _near(surfels: Surfels, looks: Sequence[_Look], camera: StereoCamera) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield every view with the surfels of blocks that it may see: near ones that reach into its pyramid."""
    places = np.floor(surfels.points_map[:, :2] / _BLOCK_M).astype(np.int64)
    keys, order = np.unique(places @ [1 << 32, 1], return_inverse=True)  # on integers, not on rows: thirty times faster
    x = (keys + (1 << 31)) >> 32
    blocks = np.stack([x, keys - (x << 32)], axis=-1)
    ends = np.cumsum(np.bincount(order, minlength=len(blocks)))
    parts = np.split(np.argsort(order, kind="stable"), ends[:-1])
    middles = (blocks + 0.5) * _BLOCK_M
    heights_m = (
        np.array([surfels.points_map[:, 2].min(), surfels.points_map[:, 2].max()]) if len(surfels) else np.zeros(2)
    )
    left, above = camera.cx_px + 1, camera.cy_px + 1
    right, below = camera.width_px - camera.cx_px, camera.height_px - camera.cy_px
    focal = camera.focal_px
    sides = np.array(
        [[focal, 0, left], [-focal, 0, right], [0, focal, above], [0, -focal, below]]
    )  # inwards, of the pyramid
    for number, look in enumerate(looks):
        place = -look.cam_from_map[:3, :3].T @ look.cam_from_map[:3, 3]
        normals = sides @ look.cam_from_map[:3, :3]
        farthest = (middles - place[:2]) @ normals[:, :2].T + _BLOCK_M * np.linalg.norm(normals[:, :2], axis=1)
        farthest += (np.multiply.outer(heights_m - place[2], normals[:, 2])).max(axis=0)
        is_near = np.linalg.norm(middles - place[:2], axis=1) < MAX_RANGE_M + _BLOCK_M
        near = np.flatnonzero(is_near & (farthest > 0).all(axis=1))
        if len(near):
            yield number, np.concatenate([parts[i] for i in near])


def _look(
    surfels: Surfels, rows: NDArray[np.int64], look: _Look, camera: StereoCamera
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Return marks, weights and pixels as of `core.look_at` of these surfels."""
    return core.look_at(
        surfels.points_map[rows], surfels.levels[rows], look.nearest_px, _KEPT_STEP_PX, look.sigma_px, camera.lens, look.cam_from_map,
        core.GRID_CLEAR_SIGMAS, CELL_M,
    )  # fmt: skip


def _coloured(surfels: Surfels, keyframes: Sequence[Keyframe], looks: Sequence[_Look], camera: StereoCamera) -> Surfels:
    """Return the surfels with colours from the views, near ones weighted most, corrected for exposure and vignetting."""
    samples = [
        Sample(rows[fit], np.full(int(fit.sum()), number), squared_tangent(pixels[fit], camera), np.log(greys[fit]))
        for number, rows, pixels, greys in _shown(surfels, keyframes, looks, camera, _SAMPLED)
        for fit in [(greys < _SATURATED) & (greys >= 1)]
    ]
    exposure = estimate_exposure(samples, len(looks))
    sums = np.zeros((2, len(surfels)))
    for number, rows, pixels, greys in _shown(surfels, keyframes, looks, camera, 1):
        cam_from_map = looks[number].cam_from_map
        distances_m = np.linalg.norm(surfels.points_map[rows] + cam_from_map[:3, :3].T @ cam_from_map[:3, 3], axis=1)
        sums[0, rows] += greys / exposure.factor(number, squared_tangent(pixels, camera)) / distances_m**4
        sums[1, rows] += 1.0 / distances_m**4
    known = sums[1] > 0
    greys = np.clip(np.round(sums[0, known] / sums[1, known]), 0, 255).astype(np.uint8)
    lights = [
        [*(-look.cam_from_map[:3, :3].T @ look.cam_from_map[:3, 3]), *look.cam_from_map[2, :3], log]
        for look, log in zip(looks, exposure.logs, strict=True)
    ]
    falloff = tuple(exposure.falloff.round(6).tolist())
    return replace(surfels[known], greys=greys, falloff=falloff, exposures=np.array(lights).reshape(-1, EXPOSURE))


def _shown(
    surfels: Surfels, keyframes: Sequence[Keyframe], looks: Sequence[_Look], camera: StereoCamera, every: int
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float32], Array]]:
    """Yield per view its number, a sample of its visible surfels (N,), their pixels (N, 2) and brightness (N,)."""
    for number, near in _near(surfels, looks, camera):
        rows = near[near % every == 0]
        marks, _, pixels = _look(surfels, rows, looks[number], camera)
        rows, pixels = rows[marks == _SEEN], pixels[marks == _SEEN]
        if not len(rows):
            continue
        size = (core.SURFEL_STRIDE_PX + 1,) * 2
        smooth = np.asarray(cv2.blur(keyframes[number].frame.left, size), np.uint8)
        yield number, rows, pixels, _bilinear(smooth, pixels)


def _bilinear(picture: NDArray[np.uint8], pixels: NDArray[np.float32]) -> Array:
    height, width = picture.shape
    u, v = np.clip(pixels[:, 0], 0, width - 1.001), np.clip(pixels[:, 1], 0, height - 1.001)
    column, row = u.astype(np.int64), v.astype(np.int64)
    right, down = u - column, v - row
    above = picture[row, column] * (1 - right) + picture[row, column + 1] * right
    below = picture[row + 1, column] * (1 - right) + picture[row + 1, column + 1] * right
    return np.asarray(above * (1 - down) + below * down, np.float64)


def _known_finer(surfels: Surfels, other: Surfels, *, finer_by: int) -> NDArray[np.bool_]:
    """Return (N,) True if `other` has the same place, or the one in front of or behind it, at least `finer_by` levels finer."""
    known = np.zeros(len(surfels), bool)
    for level in range(LEVELS):
        mine = np.flatnonzero(surfels.levels == level)
        finer = np.flatnonzero(other.levels >= 0) if not len(mine) else np.flatnonzero(other.levels + finer_by <= level)
        if not len(mine) or not len(finer):
            continue
        held, counts = np.unique(_keys(other.points_map[finer], level), return_counts=True)
        held = held[counts >= (_MIN_FINER if finer_by else 1)]
        edge_m = EDGE_M * (1 << level)
        for step in (-1.0, 0.0, 1.0):
            moved = surfels.points_map[mine] + np.float32(step * edge_m) * surfels.normals[mine]
            known[mine] |= np.isin(_keys(moved, level), held)
    return known


def _keys(points_map: NDArray[np.float32], level: int) -> NDArray[np.int64]:
    return core.voxel_keys(points_map, np.full(len(points_map), level, np.uint8))
