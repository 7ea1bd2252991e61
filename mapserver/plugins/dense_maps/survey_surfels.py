"""Update of the previous version's surfels by a build's recordings: their keyframes are matched densely at their final poses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array, Array32, Indices, Mask, se3_inverse
from fleetmap.mapformat.tile import off_tile_m
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.version_grid import CELL_M
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps import surfel_map
from mapserver.plugins.dense_maps.dense_stereo import STEP_PX
from mapserver.plugins.dense_maps.exposure import Exposure, Sample, estimate_exposure, squared_tangent
from mapserver.plugins.dense_maps.site_grid import AGAINST, HIT, OCCUPIED
from mapserver.plugins.dense_maps.surfel_map import EDGE_M, MAX_RANGE_M, NO_FALLOFF, TILE_SIZE_M, Surfels, SurfelTiles
from mapserver.plugins.dense_maps.survey_grid import DepthView
from mapserver.survey.state import ImageStore

_SEEN = 1
_KEPT_STEP_PX = 4  # pixel step of the depths kept per view, to test for free space
_BLOCK_M = 4.0  # surfels are judged by the images near their block
_HALO_M = 0.32  # around a tile, where finer surfels may replace its coarse ones: two of the coarsest voxels
_OWN_LIGHT_M = 2.0
_DARK, _MIN_ALIKE = 5, 50  # grey levels; common voxels needed to compare the exposure of two drives
_SATURATED = 250  # grey level
_SAMPLE_STEP, _MOST_SAMPLED = 24, 10_000  # every so many kept disparities a point is used for exposure
_LOGS_STEP = 16  # one common voxel of this many is used to compare drives
_MIN_FINER = 2  # voxels of the next finer level that replace a coarse one
_Place = tuple[int, int]


class _Look(NamedTuple):
    """A keyframe: disparities of every `surfel_stride_px`-th pixel, NaN unknown; disparities as of `nearest_around`, 0 unknown; their
    standard deviation; the smoothed picture; its pose.
    """

    disparity_px: Array32
    nearest_px: Array32
    picture: NDArray[np.uint8]
    sigma_px: float
    map_from_cam: Array
    cam_from_map: Array


class SurfelGrower:
    """The surfels of a site: a session removes those that it saw through, and its equally fine or finer ones replace old ones.

    Memory holds one tile at a time; what is kept of the images lies in the image store.
    """

    def __init__(self, before: SurfelTiles) -> None:
        self.surfels = before

    def begin(self, session: MappedSession, some: Sequence[DepthView]) -> str | None:
        self._camera, self._looks = session.survey.state.rig.camera, list[_Look]()
        self._seen: dict[_Place, list[int]] = {}  # by tile, the images that measured something in it or its halo
        self._images: ImageStore = session.survey.odometry.keyframes[0].images
        self._images.release()
        return None

    def add(self, view: DepthView) -> None:
        disparity_px, stride = view.disparity_px, core.surfel_stride_px(self._camera.focal_px)
        kept = slice(None, None, _KEPT_STEP_PX // STEP_PX)
        nearest = np.where(disparity_px[kept, kept] > 0, view.nearest_px[kept, kept], np.float32(0.0))
        smooth = np.asarray(cv2.blur(view.keyframe.frame.left, (stride + 1, stride + 1)), np.uint8)
        sparse = np.ascontiguousarray(disparity_px[:: stride // STEP_PX, :: stride // STEP_PX])
        arrays: list[Any] = self._images.keep([sparse, nearest, smooth])
        map_from_cam = np.ascontiguousarray(view.map_from_cam)
        look = _Look(arrays[0], arrays[1], arrays[2], view.sigma_px, map_from_cam, se3_inverse(map_from_cam))
        flat = _points(look, self._camera, _KEPT_STEP_PX)[:, :2]
        shifts = np.array([(x, y) for x in (-_HALO_M, _HALO_M) for y in (-_HALO_M, _HALO_M)])
        places = np.floor((flat[:, None] + shifts) / TILE_SIZE_M).astype(np.int32).reshape(-1, 2)
        for place in np.unique(places.view(np.int64)).view(np.int32).reshape(-1, 2).tolist():
            self._seen.setdefault((place[0], place[1]), []).append(len(self._looks))
        self._looks.append(look)

    def end(self) -> None:
        before, images = self.surfels, _Images(self._looks, self._camera)
        exposure = self._exposure(images)
        grown = {place: self._grown(place, images, exposure) for place in sorted(self._seen)}
        near = [p for p in before.tiles if (off_tile_m(np.array(p), TILE_SIZE_M, images.places) < MAX_RANGE_M).any()]
        old = {place: self._left(place, images) for place in near}
        shift = self._brightness_shift([(old[place], grown[place]) for place in sorted(old.keys() & grown.keys())])
        tiles = dict(before.tiles)
        for place in sorted({*old, *grown}):
            new = grown.get(place, Surfels.joined([]))
            new = replace(new, greys=np.clip(np.round(new.greys * np.exp(shift)), 0, 255).astype(np.uint8))
            left = old.get(place, Surfels.joined([]))
            inside = np.floor(new.points_map[:, :2] / TILE_SIZE_M).astype(np.int64) == place
            found = Surfels.joined([left[~_known_finer(left, new, finer_by=0)], new[inside.all(axis=1)]])
            tiles.pop(place, None)
            if len(found):
                tiles[place] = surfel_map.encode_tile(place, found)
            self._images.release()
        self.surfels = SurfelTiles(tiles, *self._light(before, exposure, shift))

    def _exposure(self, images: "_Images") -> Exposure:
        """Estimate the brightness of the images, by a raster of points of each that others see, of a long drive by fewer of each."""
        raster = [_points(look, self._camera, _SAMPLE_STEP).astype(np.float32) for look in self._looks]
        points_map = np.concatenate(raster)
        points_map = points_map[:: max(1, math.ceil(len(points_map) / _MOST_SAMPLED))]
        order, blocks = _blocks(points_map)
        points_map, levels, samples = points_map[order], np.zeros(len(order), np.uint8), []
        last = np.array([self._camera.width_px, self._camera.height_px]) - 1
        for rows in blocks:
            for number in images.seeing(points_map[rows]):
                marks, pixels = core.look_at(points_map[rows], levels[rows], images.depths(number))
                seen = np.flatnonzero(marks == _SEEN)
                column, row = np.clip(pixels[seen].round().astype(np.int64), 0, last).T
                greys = self._looks[number].picture[row, column].astype(np.float64)
                fit = (greys < _SATURATED) & (greys >= 1)
                seen, greys = seen[fit], greys[fit]
                tangents = squared_tangent(pixels[seen], self._camera)
                samples.append(Sample(rows.start + seen, np.full(len(seen), number), tangents, np.log(greys)))
            self._images.release()
        return estimate_exposure(samples, len(self._looks))

    def _grown(self, place: _Place, images: "_Images", exposure: Exposure) -> Surfels:
        """Return the new surfels of a tile and its halo, with colours that near images dominate, corrected for exposure and vignetting."""
        low = np.array(place) * TILE_SIZE_M
        box, table = np.array([low - _HALO_M, low + TILE_SIZE_M + _HALO_M]), core.VoxelTable()
        for number in self._seen[place]:
            look = self._looks[number]
            table.add(look.disparity_px, look.sigma_px, self._camera.lens, look.map_from_cam, box)
        points_map, normals, levels, seen = table.surfels()
        del table
        order, blocks = _blocks(points_map)
        new = Surfels(points_map, normals, levels, np.zeros_like(levels))[order]
        sums = self._weighed(new, blocks, images, exposure)
        is_sure = HIT * np.maximum(sums[:, 0], seen[order]) - sums[:, 1] >= OCCUPIED
        new, sums = new[is_sure], sums[is_sure]
        finest = ~_known_finer(new, new, finer_by=1) & (sums[:, 3] > 0)
        new, sums = new[finest], sums[finest]
        greys = np.clip(np.round(sums[:, 2] / sums[:, 3]), 0, 255).astype(np.uint8)
        kept: list[Any] = self._images.keep([new.points_map, new.normals, new.levels, greys])
        self._images.release()
        return Surfels(*kept)

    def _left(self, place: _Place, images: "_Images") -> Surfels:
        """Return the earlier surfels of a tile but those that the session saw through."""
        old = self.surfels.surfels(place)
        order, blocks = _blocks(old.points_map)
        old = old[order]
        sums = self._weighed(old, blocks, images, Exposure(np.zeros(len(self._looks)), np.zeros(len(NO_FALLOFF))))
        old = old[HIT * sums[:, 0] - sums[:, 1] > -AGAINST]
        kept: list[Any] = self._images.keep([old.points_map, old.normals, old.levels, old.greys])
        self._images.release()
        return Surfels(*kept)

    def _weighed(self, surfels: Surfels, blocks: Sequence[slice], images: "_Images", exposure: Exposure) -> Array:
        """Return (N, 4) the sums of `core.weigh` over all images; hits and passes are counted as in the planner grid."""
        sums = np.zeros((len(surfels), 4))
        for rows in blocks:
            points_map, levels = surfels.points_map[rows], surfels.levels[rows]
            for number in images.seeing(points_map):
                light = self._looks[number].picture, exposure.falloff, float(exposure.logs[number])
                core.weigh(points_map, levels, images.depths(number), *light, sums[rows])
        return sums

    def _brightness_shift(self, tiles: Sequence[tuple[Surfels, Surfels]]) -> float:
        """Return the logarithm by which the new surfels of tiles are darker than the old ones, as the median over common voxels.

        Each drive has its own mean brightness; 0 if too few voxels are common.
        """
        shifts = [np.zeros(0)]
        for old, new in tiles:
            keys, others = (core.voxel_keys(surfels.points_map, surfels.levels) for surfels in (old, new))
            _, mine, theirs = np.intersect1d(keys, others, return_indices=True)
            before, after = old.greys[mine].astype(np.float64), new.greys[theirs].astype(np.float64)
            sure = (before > _DARK) & (after > _DARK) & (before < _SATURATED) & (after < _SATURATED)
            shifts.append(np.log(before[sure] / after[sure])[::_LOGS_STEP])
            self._images.release()
        every = np.concatenate(shifts)
        return float(np.median(every)) if len(every) * _LOGS_STEP >= _MIN_ALIKE else 0.0

    def _light(self, before: SurfelTiles, exposure: Exposure, shift: float) -> tuple[tuple[float, ...], Array]:
        """Return lens and exposures: where both drives overlap, the last one defines the brightness."""
        lights = [
            [*look.map_from_cam[:3, 3], *look.cam_from_map[2, :3], log - shift]
            for look, log in zip(self._looks, exposure.logs, strict=True)
        ]
        new, old = np.array(lights).reshape(-1, surfel_map.EXPOSURE), before.exposures
        if len(new) and len(old):
            old = old[scipy.spatial.cKDTree(new[:, :3]).query(old[:, :3])[0] > _OWN_LIGHT_M]
        return tuple(exposure.falloff.round(6).tolist()), np.concatenate([new, old])


class _Images:
    """Poses of the images, to find those that may see a block: near ones into whose pyramid it reaches."""

    def __init__(self, looks: Sequence[_Look], camera: StereoCamera) -> None:
        self._looks, self._lens = looks, camera.lens
        left, above = camera.cx_px + 1, camera.cy_px + 1
        right, below, focal = camera.width_px - camera.cx_px, camera.height_px - camera.cy_px, camera.focal_px
        sides = np.array([[focal, 0, left], [-focal, 0, right], [0, focal, above], [0, -focal, below]])  # inwards
        self._normals = np.array([sides @ look.cam_from_map[:3, :3] for look in looks]).reshape(-1, 4, 3)
        self.places = np.array([look.map_from_cam[:3, 3] for look in looks]).reshape(-1, 3)

    def seeing(self, points_map: Array32) -> list[int]:
        """Return the numbers of the images that may see some of these points (N, 3)."""
        low, high = points_map.min(axis=0).astype(np.float64), points_map.max(axis=0).astype(np.float64)
        middle, half = (low + high) / 2 - self.places, (high - low) / 2
        is_near = np.linalg.norm(np.maximum(np.abs(middle) - half, 0.0), axis=1) < MAX_RANGE_M
        farthest = (self._normals @ middle[:, :, None])[..., 0] + np.abs(self._normals) @ half
        return np.flatnonzero(is_near & (farthest > 0).all(axis=1)).tolist()

    def depths(self, number: int) -> tuple[Any, ...]:
        """Return a view's depths as `core.look_at` takes them."""
        look = self._looks[number]
        seen = look.nearest_px, _KEPT_STEP_PX, look.sigma_px, self._lens, look.cam_from_map
        return (*seen, core.GRID_CLEAR_SIGMAS, CELL_M)


def _points(look: _Look, camera: StereoCamera, step: int) -> Array:
    """Return (N, 3) points in map of every step-th of a view's disparities, of those in range."""
    some = look.disparity_px[::step, ::step]
    row, column = np.nonzero(some > camera.focal_px * camera.baseline_m / MAX_RANGE_M)
    pixels = np.column_stack([column, row]).astype(np.float64) * (step * core.surfel_stride_px(camera.focal_px))
    points = camera.point_from_pixel(pixels, some[row, column].astype(np.float64))
    return np.asarray(points @ look.map_from_cam[:3, :3].T + look.map_from_cam[:3, 3])


def _blocks(points_map: Array32) -> tuple[Indices, list[slice]]:
    """Return an order of points in which those of a block follow each other, and the rows of each block."""
    places = np.floor(points_map / _BLOCK_M).astype(np.int64) + (1 << 19)
    keys = places @ [1 << 40, 1 << 20, 1]  # on integers, not on rows: thirty times faster
    order = np.argsort(keys, kind="stable")
    ends = [*(np.flatnonzero(np.diff(keys[order])) + 1).tolist(), len(order)]
    return order, [slice(first, last) for first, last in zip([0, *ends], ends, strict=False) if last > first]


def _known_finer(surfels: Surfels, other: Surfels, *, finer_by: int) -> Mask:
    """Return (N,) True if `other` has the same place, or the one in front of or behind it, at least `finer_by` levels finer."""
    known = np.zeros(len(surfels), bool)
    for level in range(surfel_map.LEVELS):
        mine, finer = np.flatnonzero(surfels.levels == level), other.levels + finer_by <= level
        held, counts = np.unique(_keys(other.points_map[finer], level), return_counts=True)
        held = held[counts >= (_MIN_FINER if finer_by else 1)]
        if not len(held):
            continue
        edge_m = EDGE_M * (1 << level)
        for step in (-1.0, 0.0, 1.0):
            moved = surfels.points_map[mine] + np.float32(step * edge_m) * surfels.normals[mine]
            keys = _keys(moved, level)
            known[mine] |= held.take(np.searchsorted(held, keys), mode="clip") == keys
    return known


def _keys(points_map: Array32, level: int) -> Indices:
    return core.voxel_keys(points_map, np.full(len(points_map), level, np.uint8))
