"""Changes between two versions of a site: surfels that only one of them has, at places seen by the other. Pure.

A surfel of one version has changed if images of the other saw through its place, by the rule of the planner grid. Without images of
the other version it counts as not seen, not as gone.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy

from fleetmap import core
from fleetmap.errors import UsageError
from fleetmap.geometry import Array, Array32, Indices, Mask, se3, se3_inverse
from fleetmap.sensors.calibration import CameraCalibration
from mapserver.plugins.dense_maps.expected_view import expected_depth
from mapserver.plugins.dense_maps.site_grid import AGAINST, HIT
from mapserver.plugins.dense_maps.surfel_map import EDGE_M, MAX_RANGE_M, MIN_RANGE_M, Surfels

CELL_M = 0.1
APPEARED, VANISHED = "appeared", "vanished"
_VOXEL_LEVEL = 3
_VOXEL_M = EDGE_M * 2**_VOXEL_LEVEL
_FINEST = 2  # coarser surfels come from distant images with inaccurate depth
_REACH_M = 0.15  # a surfel of the other version this near to a voxel's middle is the same surface
_LEAST_AREA_M2 = 0.05  # of surfels in a patch: a face of a small carton
_LEAST_SHARE = 0.3  # of a voxel's face that its surfels cover
_VIEW_PX = 96
_CLEAR_PER_M = 0.01  # times the squared depth: three standard deviations of a consistent depth
_MOST_CELLS = 1 << 24
_SHADES = {"same": (150, 150, 150), "not_seen": (218, 226, 232), VANISHED: (0, 94, 213), APPEARED: (178, 114, 0)}  # BGR


class SeenSite(NamedTuple):
    """The surfels of a version, and the tangent of the half angle of the cone that its cameras cover in any orientation."""

    surfels: Surfels
    tangent: float


@dataclass(frozen=True, slots=True)
class Patch:
    """Connected changed surfels: kind, corners (2, 3) of their box in `map`, metres, and their area."""

    kind: str
    box_map: Array
    area_m2: float


@dataclass(frozen=True, slots=True)
class Changes:
    """Patches, the largest first, and a plan (H, W) of cells by layer; row 0 has the lowest y, corner_m (2,) of the plan in `map`.

    Layers: same (both have surfels), not_seen (only one has, and the other had no view), appeared, vanished.
    """

    patches: tuple[Patch, ...]
    layers: dict[str, Mask]
    corner_m: Array

    def area_m2(self, kind: str) -> float:
        """Return the area of all patches of a kind."""
        return sum(patch.area_m2 for patch in self.patches if patch.kind == kind)


def changes_between(before: SeenSite, after: SeenSite) -> Changes:
    """Return the surfels of `before` that vanished and those that appeared in `after`. UsageError without surfels or for a large plan."""
    if not len(before.surfels) or not len(after.surfels):
        raise UsageError("a version without surfels cannot be compared; choose two versions with surfels")
    corner_m, shape = _plan(np.concatenate([before.surfels.points_map, after.surfels.points_map])[:, :2])
    patches, layers = list[Patch](), {name: np.zeros(shape, bool) for name in _SHADES}
    for kind, one, other in ((VANISHED, before, after), (APPEARED, after, before)):
        voxels_map, areas_m2 = _only_in(one.surfels, other.surfels)
        through, seen = _counts(voxels_map, other)
        changed = HIT * seen - through <= -AGAINST
        _fill(layers["not_seen"], voxels_map[~changed & (seen == 0)], corner_m)
        changed_map, areas_m2 = voxels_map[changed], areas_m2[changed]
        for rows in _joined(changed_map):
            if (area_m2 := float(areas_m2[rows].sum())) >= _LEAST_AREA_M2:
                points = changed_map[rows]
                box = np.stack([points.min(axis=0) - _VOXEL_M / 2, points.max(axis=0) + _VOXEL_M / 2])
                patches.append(Patch(kind, box, area_m2))
                _fill(layers[kind], points, corner_m)
    both = np.zeros((2, *shape), bool)
    for layer, one in zip(both, (before, after), strict=True):
        _fill(layer, one.surfels.points_map, corner_m)
    layers["same"] = both.all(axis=0) & ~layers["not_seen"]
    return Changes(tuple(sorted(patches, key=lambda patch: -patch.area_m2)), layers, corner_m)


def changes_png(changes: Changes) -> bytes:
    """Return the plan as PNG, y upwards, one pixel a cell: appeared blue, vanished orange, same grey, not seen by one pale."""
    height, width = changes.layers["same"].shape
    picture = np.zeros((height, width, 4), np.uint8)
    for name, shade in _SHADES.items():
        picture[changes.layers[name]] = (*shade, 255)
    done, data = cv2.imencode(".png", picture[::-1])
    assert done
    return data.tobytes()


def changes_geojson(changes: Changes) -> dict[str, Any]:
    """Return the patches as GeoJSON with metres in `map` instead of degrees."""
    features = []
    for patch in changes.patches:
        (x0, y0, z0), (x1, y1, z1) = patch.box_map.round(2).tolist()
        ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
        said = {"change": patch.kind, "lowest_m": z0, "highest_m": z1, "area_m2": round(patch.area_m2, 3)}
        features.append({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}, "properties": said})
    return {"type": "FeatureCollection", "frame": "map", "features": features}


def _plan(places_m: Array32) -> tuple[Array, tuple[int, int]]:
    """Return the corner of a plan that contains places (N, 2), and its rows and columns."""
    low, high = np.floor(np.stack([places_m.min(axis=0), places_m.max(axis=0)]) / CELL_M).astype(np.int64)
    columns, rows = (high - low + 1).tolist()
    if rows * columns > _MOST_CELLS:
        raise UsageError(f"a plan of {columns} x {rows} cells; the limit is {_MOST_CELLS}")
    return low * CELL_M, (rows, columns)


def _fill(layer: Mask, points_map: Array | Array32, corner_m: Array) -> None:
    columns, rows = np.floor((points_map[:, :2] - corner_m) / CELL_M + 1e-6).astype(np.int64).T
    layer[np.clip(rows, 0, layer.shape[0] - 1), np.clip(columns, 0, layer.shape[1] - 1)] = True


def _only_in(one: Surfels, other: Surfels) -> tuple[Array, Array]:
    """Return mean positions (M, 3) and areas (M,) of voxels of fine surfels of `one` without a near surfel of `other`."""
    fine = one[one.levels <= _FINEST]
    keys = core.voxel_keys(fine.points_map, np.full(len(fine), _VOXEL_LEVEL, np.uint8))
    _, first, of_voxel = np.unique(keys, return_index=True, return_inverse=True)
    voxels = np.floor(fine.points_map[first].astype(np.float64) / _VOXEL_M)
    gaps_m = scipy.spatial.cKDTree(other.points_map).query((voxels + 0.5) * _VOXEL_M, distance_upper_bound=_REACH_M)[0]
    rest = np.flatnonzero(np.isinf(gaps_m)[of_voxel])
    places, areas = fine.points_map[rest].astype(np.float64), fine.edges_m[rest].astype(np.float64) ** 2
    count, of_voxel = np.bincount(of_voxel[rest], minlength=len(voxels)), of_voxel[rest]
    means = np.stack([np.bincount(of_voxel, places[:, i], len(voxels)) for i in range(3)], axis=1)
    summed = np.bincount(of_voxel, areas, len(voxels))
    kept = summed >= _LEAST_SHARE * _VOXEL_M**2
    return means[kept] / np.maximum(count[kept], 1)[:, None], summed[kept]


def _counts(points_map: Array, other: SeenSite) -> Array:
    """Return (2, M) how many of the other version's images saw through the points, and a surface there."""
    through, seen = counts = np.zeros((2, len(points_map)))
    focal_px = 0.5 * _VIEW_PX / other.tangent
    centre_px = (_VIEW_PX - 1) / 2
    lens = np.array([focal_px, focal_px, centre_px, centre_px])
    camera = CameraCalibration("radial-tangential", _VIEW_PX, _VIEW_PX, lens, np.zeros(0), np.eye(4))
    for view in other.surfels.exposures:
        rows = _shown(points_map, view, other.tangent)
        if not len(rows):
            continue
        # A camera with the view's position and direction, as level as possible
        forward = view[3:6] / np.linalg.norm(view[3:6])
        right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        map_from_cam = se3(np.stack([right, np.cross(forward, right), forward], axis=1), view[:3])
        depth_m = expected_depth(other.surfels, camera, map_from_cam, MAX_RANGE_M + 1.0)
        is_known, around = np.isfinite(depth_m), np.ones((3, 3), np.uint8)
        nearest_m = np.asarray(cv2.erode(np.where(is_known, depth_m, np.float32(np.inf)), around))
        farthest_m = np.asarray(cv2.dilate(np.where(is_known, depth_m, np.float32(-np.inf)), around))
        points_cam = points_map[rows] @ se3_inverse(map_from_cam)[:3, :3].T + se3_inverse(map_from_cam)[:3, 3]
        columns, lines = np.round(camera.pixel_from_ray(points_cam)).astype(np.int64).clip(0, _VIEW_PX - 1).T
        distance_m, clear_m = np.linalg.norm(points_cam, axis=1), CELL_M + _CLEAR_PER_M * depth_m[lines, columns] ** 2
        near_m, far_m = nearest_m[lines, columns] - clear_m, farthest_m[lines, columns] + clear_m
        through[rows] += distance_m < near_m  # False for NaN, unknown pixels
        seen[rows] += (distance_m >= near_m) & (distance_m <= far_m)
    return counts


def _shown(points_map: Array, view: Array, tangent: float) -> Indices:
    """Return the points in the cone of a view, a row of Surfels.exposures."""
    off = points_map - view[:3]
    depth_m = off @ view[3:6]
    aside_m = np.sqrt(np.maximum((off**2).sum(axis=1) - depth_m**2, 0.0))
    return np.flatnonzero((depth_m > MIN_RANGE_M) & (depth_m < MAX_RANGE_M) & (aside_m < tangent * depth_m))


def _joined(points_map: Array) -> list[Indices]:
    """Return rows of points connected by steps of up to a voxel's diagonal."""
    if not len(points_map):
        return []
    tree = scipy.spatial.cKDTree(points_map)
    links = tree.sparse_distance_matrix(tree, 1.8 * _VOXEL_M, output_type="coo_matrix")
    count, labels = scipy.sparse.csgraph.connected_components(links, directed=False)
    return np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels, minlength=count))[:-1])
