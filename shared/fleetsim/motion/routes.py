"""Routes over the ground: way points rounded, timed within a robot's limits, checked against solid things."""

import math
from dataclasses import dataclass

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import Array
from fleetsim.scene.layout import Layout

STEP_M = 0.01
_CREEP_MPS = 0.02  # speed at which a standing start begins
_STRETCH = 256  # points of a path that are checked together


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a robot's drive, and the radius of its corners."""

    speed_mps: float = 1.5
    accel_mps2: float = 0.8
    yaw_rate_radps: float = 1.0
    corner_radius_m: float = 0.8


@dataclass(frozen=True, slots=True)
class Route:
    """Way points in map (x, y).

    stops: number of a way point, seconds of standing near it; rest_s: standing at both ends.
    """

    way_points_map: tuple[tuple[float, float], ...]
    stops: tuple[tuple[int, float], ...] = ()
    rest_s: float = 1.5


def _corner_arc(before: Array, corner: Array, after: Array, radius_m: float) -> Array:
    """(K, 2) points of the arc that replaces a corner; (1, 2) the corner itself where the way goes straight on."""
    back, ahead = before - corner, after - corner
    back_m, ahead_m = float(np.linalg.norm(back)), float(np.linalg.norm(ahead))
    back, ahead = back / back_m, ahead / ahead_m
    angle = float(np.arccos(np.clip(back @ ahead, -1.0, 1.0)))
    if angle > np.pi - 1e-3:
        return corner[None]
    if angle < 1e-2:
        raise UsageError(f"the route doubles back on itself at {corner.round(2).tolist()}; give it a loop to turn in")
    reach = min(radius_m / np.tan(angle / 2), 0.49 * back_m, 0.49 * ahead_m)
    radius = reach * np.tan(angle / 2)
    centre = corner + ((back + ahead) / np.linalg.norm(back + ahead)) * np.hypot(reach, radius)
    start, end = corner + back * reach - centre, corner + ahead * reach - centre
    sweep = float(np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end))
    angles = np.linspace(0.0, sweep, max(4, int(abs(sweep) * radius / STEP_M)))
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.asarray(
        centre + np.stack([cosine * start[0] - sine * start[1], sine * start[0] + cosine * start[1]], axis=1)
    )


def time_path(route: Route, limits: Limits) -> tuple[Array, Array]:
    """The route within the limits: rest, drive, stops, rest; times (N,) from 0, and x, y and unwrapped yaw in map (N, 3) at each.

    Speeds by a forward and a backward sweep over the path.
    """
    way_points = np.array(route.way_points_map, np.float64)
    pieces = [way_points[:1]]
    for before, corner, after in zip(way_points[:-2], way_points[1:-1], way_points[2:], strict=True):
        pieces.append(_corner_arc(before, corner, after, limits.corner_radius_m))
    rounded = np.concatenate([*pieces, way_points[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rounded, axis=0), axis=1))])
    even = np.arange(0.0, along[-1], STEP_M)
    points = np.stack([np.interp(even, along, rounded[:, axis]) for axis in range(2)], axis=1)
    tangents = np.gradient(points, STEP_M, axis=0)
    yaw = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    curvature = np.convolve(np.pad(np.abs(np.gradient(yaw, STEP_M)), 15, "edge"), np.ones(31) / 31, "valid")
    speed = np.minimum(limits.speed_mps, limits.yaw_rate_radps / np.maximum(curvature, 1e-6))
    speed[[0, -1]] = _CREEP_MPS
    stops = {
        int(np.argmin(np.linalg.norm(points - way_points[number], axis=1))): wait_s for number, wait_s in route.stops
    }
    for index in stops:
        speed[index] = _CREEP_MPS
    gain, swept = 2 * limits.accel_mps2 * STEP_M, speed.tolist()
    for _ in range(2):  # forward, then backward
        for index in range(1, len(swept)):
            swept[index] = min(swept[index], math.sqrt(swept[index - 1] ** 2 + gain))
        swept.reverse()
    speed = np.array(swept)
    durations = np.concatenate([[route.rest_s], STEP_M / (0.5 * (speed[1:] + speed[:-1]))])
    for index, wait_s in stops.items():
        durations[index] += wait_s
    # A wait would lengthen the step before it, which would be driven slowly: a second sample holds the position.
    times = np.cumsum(durations)
    held = np.array(sorted(stops), np.int64)
    times_held = np.insert(times, held, times[held] - np.array([stops[int(index)] for index in held], np.float64))
    places = np.column_stack([points, yaw])
    places = np.pad(np.insert(places, held, places[held], axis=0), ((1, 1), (0, 0)), "edge")
    return np.concatenate([[0.0], times_held, [times_held[-1] + route.rest_s]]), places


def check_clear(points_map: Array, layout: Layout, clearance_m: float) -> None:
    """Raise UsageError if a path (N, 2) comes nearer than clearance_m to an obstacle or a wall."""
    x, y = points_map[:, 0], points_map[:, 1]
    walls = np.minimum(np.minimum(x, layout.length_m - x), np.minimum(y, layout.width_m - y))
    gap, blocker = float(walls.min()), "a wall"
    worst = int(np.argmin(walls))
    solids = np.array(layout.solid_rectangles()).reshape(-1, 4)
    for first in range(0, len(points_map), _STRETCH):
        stretch = points_map[first : first + _STRETCH]
        low, high = stretch.min(axis=0) - clearance_m, stretch.max(axis=0) + clearance_m
        for solid in solids[((solids[:, :2] < high) & (solids[:, 2:] > low)).all(axis=1)]:
            outside = np.maximum(np.maximum(solid[:2] - stretch, stretch - solid[2:]), 0.0)
            distance = np.hypot(outside[:, 0], outside[:, 1])
            if distance.min() < gap:
                gap, worst = float(distance.min()), first + int(np.argmin(distance))
                blocker = "the solid at x {0:.1f}..{2:.1f}, y {1:.1f}..{3:.1f} m".format(*solid)
    if gap < clearance_m:
        raise UsageError(
            f"the route passes {gap:.2f} m from {blocker} at ({x[worst]:.2f}, {y[worst]:.2f}) m, "
            f"the robot needs {clearance_m:.2f} m; move the way points"
        )
