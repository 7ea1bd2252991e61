"""Where things stand in a simulated warehouse, as a planner's grid, and how near an estimated grid comes to it."""

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from fleetmap.geometry import Array
from fleetmap.version_grid import CELL_M, FLOOR_M, FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from fleetsim.scene.faces import Faces
from fleetsim.scene.layout import Layout
from fleetsim.scene.world import World

_STEP_M = 0.01
_AROUND = np.ones((3, 3), bool)
Mask = NDArray[np.bool_]


def truth_mask(layout: Layout, seed: int, day: int, robot_height_m: float) -> Mask:
    """(rows, columns) of the hall's cells, row 0 at y = 0: whether a surface or a solid is there between floor and robot."""
    world = World(layout, seed=seed, day=day)
    columns, rows = layout.chunk_counts
    mask = np.zeros((round(layout.width_m / CELL_M) + 1, round(layout.length_m / CELL_M) + 1), bool)
    for column in range(columns):
        for row in range(rows):
            _mark(mask, world.detailed_faces(column, row), robot_height_m)
    return mask


def _mark(mask: Mask, faces: Faces, robot_height_m: float) -> None:
    origin, u, v = faces.quads[:, :3], faces.quads[:, 3:6], faces.quads[:, 6:]
    ends = np.stack([origin, origin + u, origin + v, origin + u + v])[..., 2]
    for i in np.flatnonzero((ends.max(0) > FLOOR_M) & (ends.min(0) < robot_height_m)):
        along, down = (
            np.arange(0.0, 1.0 + 1e-9, 1.0 / max(1, np.ceil(np.linalg.norm(e) / _STEP_M))) for e in (u[i], v[i])
        )
        # A wall of vertical lines is the same in plan all the way down.
        down = np.array([0.0]) if not np.abs(v[i, :2]).any() else down
        points = origin[i] + along[:, None, None] * u[i] + down[:, None] * v[i]
        _set(mask, points.reshape(-1, 3))
    for x, y, z, half_x, half_y, half_z, cosine, sine in faces.boxes[:, :8]:
        if z + half_z > FLOOR_M and z - half_z < robot_height_m:
            a, b = np.meshgrid(*(np.linspace(-half, half, int(2 * half / 0.02) + 2) for half in (half_x, half_y)))
            _set(mask, np.stack([x + cosine * a - sine * b, y + sine * a + cosine * b], axis=-1).reshape(-1, 2))


def _set(mask: Mask, points: Array) -> None:
    """What lies on the border of two cells, as the walls do, is in both."""
    for off in (-1e-6, 1e-6):
        cells = np.floor(points[:, 1::-1] / CELL_M + off).astype(int)
        inside = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
        mask[cells[inside, 0], cells[inside, 1]] = True


def in_hall(grid: OccupancyGrid, shape: tuple[int, ...]) -> NDArray[np.int8]:
    """The grid's cells in the hall's (rows, columns), unknown where it has none; those outside of the hall are left out."""
    column, row = np.rint(grid.map_from_grid[:2, 3] / CELL_M).astype(int)
    cells = np.full(shape, UNKNOWN, np.int8)
    known = np.argwhere(grid.cells != UNKNOWN)
    places = known + np.array([row, column])
    inside = ((places >= 0) & (places < shape)).all(axis=1)
    cells[tuple(places[inside].T)] = grid.cells[tuple(known[inside].T)]
    return cells


class GridFigures(NamedTuple):
    """Of an estimated grid against the truth.

    occupied_near: share of occupied cells within one cell of the truth. free_wrong: share of free cells that are occupied in truth.
    found: share of the truth's cells beside truly free ones that are known to be free which are occupied or have an occupied neighbour.
    known_inside: share of the known cells that lie where no camera can look, two cells and more inside of solid things or outside of
    the hall.
    """

    occupied_near: float
    free_wrong: float
    found: float
    known_inside: float
    free_m2: float
    occupied_m2: float


def compare(grid: OccupancyGrid, truth: Mask) -> GridFigures:
    """The figures of an estimated grid in the hall's frame."""
    cells = in_hall(grid, truth.shape)
    occupied, free = cells == OCCUPIED, cells == FREE
    edge = truth & binary_dilation(free & ~truth, _AROUND)
    hidden = ~binary_dilation(~truth, _AROUND, iterations=2)
    known = int((grid.cells != UNKNOWN).sum())
    out_of_hall = known - int((occupied | free).sum())
    return GridFigures(
        float((occupied & binary_dilation(truth, _AROUND)).sum() / max(1, occupied.sum())),
        float((free & truth).sum() / max(1, free.sum())),
        float((edge & binary_dilation(occupied, _AROUND)).sum() / max(1, edge.sum())),
        (int(((occupied | free) & hidden).sum()) + out_of_hall) / max(1, known),
        float(free.sum() * CELL_M**2),
        float(occupied.sum() * CELL_M**2),
    )


def passable(cells: NDArray[np.int8], radius_m: float) -> Mask:
    """Cells from which everything that is not free is further than a robot's radius."""
    reach = int(np.ceil(radius_m / CELL_M))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return ~binary_dilation(cells != FREE, (x * x + y * y) * CELL_M**2 <= radius_m**2)


def plan(
    cells: NDArray[np.int8], start: tuple[int, int], goal: tuple[int, int], radius_m: float
) -> list[tuple[int, int]]:
    """A* over free cells (row, column) from which everything else is further than the robot's radius; empty without a way.

    Source: Hart, Nilsson and Raphael 1968.
    """
    is_passable = passable(cells, radius_m)
    if not (is_passable[start] and is_passable[goal]):
        return []
    best, before = {start: 0.0}, {start: start}
    waiting = [(0.0, start)]
    while waiting:
        _, place = heapq.heappop(waiting)
        if place == goal:
            way = [place]
            while way[-1] != start:
                way.append(before[way[-1]])
            return way[::-1]
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            other = place[0] + dy, place[1] + dx
            cost = best[place] + float(np.hypot(dy, dx))
            if is_passable[other] and cost < best.get(other, np.inf):
                best[other], before[other] = cost, place
                heapq.heappush(waiting, (cost + float(np.hypot(other[0] - goal[0], other[1] - goal[1])), other))
    return []
