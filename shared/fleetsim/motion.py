"""Motion of a robot: routes, timed within its limits and checked against solid things, and its body, which drives them along a quintic
spline in x, y, z, yaw, pitch, roll, so that rates and accelerations are exact.

Euler angles are safe here: a ground robot never pitches anywhere near 90 degrees.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, Indices
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


DEGREE = 5


def _segment_matrix() -> Array:
    """(6, 6) M: on one knot interval the spline is [1 u .. u^5] M c of its six control points, 0 <= u < 1.

    Built from the recursion of the cardinal B-spline (de Boor, A Practical Guide to Splines, chapter 10): a row is a
    piece of it, with the coefficients of its powers.
    """
    pieces = np.ones((1, 1))
    for degree in range(1, DEGREE + 1):
        number = np.arange(degree + 1)[:, None]
        rising, falling = np.pad(pieces, ((0, 1), (0, 0))), np.pad(pieces, ((1, 0), (0, 0)))
        pieces = np.pad(number * rising + (degree + 1 - number) * falling, ((0, 0), (0, 1)))
        pieces[:, 1:] += rising - falling
        pieces /= degree
    return np.ascontiguousarray(pieces[::-1].T)


_MATRIX = _segment_matrix()
GRAVITY_MPS2 = 9.80665
_KNOT_S = 0.1
_START_S = -6 * _KNOT_S  # of the first control point
_SQUAT_RAD_PER_MPS2, _LEAN_S = 0.006, 0.004


@dataclass(frozen=True, slots=True)
class Shake:
    """Floor ripple at full speed, rms."""

    tilt_rad: float = 0.0015
    heave_m: float = 0.0006


class RouteMotion:
    """A route as driven by a body at `height_m` above the ground."""

    def __init__(self, route: Route, limits: Limits, height_m: float, shake: Shake, rng: np.random.Generator) -> None:
        times_s, places_map = time_path(route, limits)
        self.duration_s = float(times_s[-1])  # from the first to the last moment of rest
        self._control = _control_points(times_s, places_map, height_m, shake, rng)

    def map_from_body(self, times_s: Array) -> Array:
        """(N, 4, 4)."""
        values = self._at(times_s)
        stacked = np.zeros((len(values), 4, 4))
        stacked[:, :3, :3] = rotation_from_yaw_pitch_roll(values[:, 3:])
        stacked[:, :3, 3] = values[:, :3]
        stacked[:, 3, 3] = 1.0
        return stacked

    def rates(self, times_s: Array) -> tuple[Array, Array]:
        """Angular rate rad/s and specific force m/s^2, both (N, 3) in body axes, in closed form. Source: ZYX Euler kinematics."""
        values, first, second = (self._at(times_s, order) for order in range(3))
        pitch, roll = values[:, 4], values[:, 5]
        d_yaw, d_pitch, d_roll = first[:, 3], first[:, 4], first[:, 5]
        gyro = np.stack(
            [
                d_roll - np.sin(pitch) * d_yaw,
                np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_yaw,
                np.cos(roll) * np.cos(pitch) * d_yaw - np.sin(roll) * d_pitch,
            ],
            axis=1,
        )
        rotation = rotation_from_yaw_pitch_roll(values[:, 3:])
        force_map = second[:, :3] + np.array([0.0, 0.0, GRAVITY_MPS2])
        return gyro, np.einsum("nji,nj->ni", rotation, force_map)

    def velocity_body(self, times_s: Array) -> Array:
        """(N, 3) m/s in body axes."""
        rotation = rotation_from_yaw_pitch_roll(self._at(times_s)[:, 3:])
        return np.asarray(np.einsum("nji,nj->ni", rotation, self._at(times_s, 1)[:, :3]))

    def _at(self, times_s: Array, derivative: int = 0) -> Array:
        """(N, 6) values of the approximating spline, or the given derivative per s^derivative, at times (N,), clamped to where all six
        control points exist. No overshoot, four continuous derivatives."""
        control, reach_s = self._control, (DEGREE - 1) / 2 * _KNOT_S
        last_s = _START_S + (len(control) - 1) * _KNOT_S - reach_s
        position = (np.clip(times_s, _START_S + reach_s, last_s) - _START_S) / _KNOT_S + (DEGREE + 1) / 2
        segment = np.clip(np.floor(position).astype(np.int64), DEGREE, len(control) - 1)
        u = position - segment
        powers = np.zeros((len(u), DEGREE + 1))
        for exponent in range(derivative, DEGREE + 1):
            factor = np.prod(np.arange(exponent - derivative + 1, exponent + 1)) if derivative else 1.0
            powers[:, exponent] = factor * u ** (exponent - derivative)
        weights = powers @ _MATRIX / _KNOT_S**derivative
        window = control[segment[:, None] - DEGREE + np.arange(DEGREE + 1)]
        return np.asarray(np.einsum("nk,nkd->nd", weights, window))


LIFT_M, LIFT_S = 0.5, 1.0
STOREY_M, STOREY_S = 4.0, 8.0


class CarriedMotion:
    """Several motions in sequence. Between two of them the robot is lifted by hand by LIFT_M within LIFT_S, and set down as fast at the
    start of the next: its sensors measure both, but nothing of the transport between. Or it rides a lift to the next storey, where heights
    begin at 0 again. Its wheels stand still."""

    def __init__(self, motions: Sequence[RouteMotion], *, rides: bool = False) -> None:
        self._motions = list(motions)
        last = len(motions) - 1
        self._up_m, self._up_s, self._down_s = (STOREY_M, STOREY_S, 0.0) if rides else (LIFT_M, LIFT_S, LIFT_S)
        lifts_s = [self._down_s * (n > 0) + self._up_s * (n < last) for n in range(len(motions))]
        self._ends_s = np.cumsum([m.duration_s + lift_s for m, lift_s in zip(motions, lifts_s, strict=True)])
        self.duration_s = float(self._ends_s[-1])
        self.rides_s = [(float(end_s) - STOREY_S, float(end_s)) for end_s in self._ends_s[:-1] if rides]

    def map_from_body(self, times_s: Array) -> Array:
        """(N, 4, 4); jumps where one piece ends."""
        placed = self._pick(times_s, lambda motion, local_s: motion.map_from_body(local_s))
        placed[:, 2, 3] += self._height(times_s, 0)
        return placed

    def rates(self, times_s: Array) -> tuple[Array, Array]:
        """As RouteMotion.rates of the piece in force."""
        gyro = self._pick(times_s, lambda motion, local_s: motion.rates(local_s)[0])
        force = self._pick(times_s, lambda motion, local_s: motion.rates(local_s)[1])
        return gyro, force + self._height(times_s, 2)[:, None] * self.map_from_body(times_s)[:, 2, :3]

    def velocity_body(self, times_s: Array) -> Array:
        """As RouteMotion.velocity_body of the piece in force, as measured by wheels, without the lift."""
        return self._pick(times_s, lambda motion, local_s: motion.velocity_body(local_s))

    def _local(self, times_s: Array) -> tuple[Indices, Array]:
        """(N,) the piece in force, and the time since the robot stood on the ground, which is negative before."""
        piece = np.minimum(np.searchsorted(self._ends_s, times_s, side="right"), len(self._motions) - 1)
        return piece, times_s - np.concatenate([[0.0], self._ends_s[:-1] + self._down_s])[piece]

    def _height(self, times_s: Array, derivative: int) -> Array:
        """(N,) above the ground, or a derivative; the fifth-order curve that begins and ends at rest."""
        piece, local_s = self._local(times_s)
        ends_s = np.array([motion.duration_s for motion in self._motions])[piece]
        before, after = -local_s / self._up_s, (local_s - ends_s) / self._up_s
        after = np.where(piece < len(self._motions) - 1, after, 0.0)
        share = np.clip(np.maximum(before, after), 0.0, 1.0)
        curve = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv(derivative)
        sign = np.where(before > after, -1.0, 1.0) ** derivative
        return np.asarray(self._up_m / self._up_s**derivative * sign * curve(share))

    def _pick(self, times_s: Array, ask: Callable[[RouteMotion, Array], Array]) -> Array:
        piece, local_s = self._local(times_s)
        answers = [
            ask(motion, np.clip(local_s[piece == number], 0.0, motion.duration_s))
            for number, motion in enumerate(self._motions)
        ]
        merged = np.zeros((len(times_s), *answers[0].shape[1:]))
        for number, answer in enumerate(answers):
            merged[piece == number] = answer
        return merged


Motion = RouteMotion | CarriedMotion
"""Exact pose, rates and forces of the body at times (N,) in seconds from the start, of `duration_s` in all."""


def _control_points(
    times_s: Array, places_map: Array, height_m: float, shake: Shake, rng: np.random.Generator
) -> Array:
    """(K, 6) each _KNOT_S from 6 knots before the start: the path, ground ripple with speed, squat, lean."""
    moments = np.arange(-6, int(np.ceil(times_s[-1] / _KNOT_S)) + 7) * _KNOT_S
    control = np.zeros((len(moments), 6))
    for column, values in zip((0, 1, 3), places_map.T, strict=True):
        control[:, column] = np.interp(moments, times_s, values)
    velocity = np.gradient(control[:, :2], _KNOT_S, axis=0)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    ripple = rng.standard_normal((len(moments), 3)) * np.clip(speed / 1.5, 0.0, 1.0)[:, None]
    accel = np.convolve(np.pad(np.gradient(speed, _KNOT_S), 2, "edge"), np.ones(5) / 5, "valid")
    control[:, 2] = height_m + shake.heave_m * ripple[:, 0]
    control[:, 4] = -_SQUAT_RAD_PER_MPS2 * accel + shake.tilt_rad * ripple[:, 1]
    control[:, 5] = _LEAN_S * speed * np.gradient(control[:, 3], _KNOT_S) + shake.tilt_rad * ripple[:, 2]
    return control


def rotation_from_yaw_pitch_roll(angles_rad: Array) -> Array:
    """(N, 3, 3) map_from_body rotations Rz(yaw) Ry(pitch) Rx(roll) of angles (N, 3)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles_rad).T, np.sin(angles_rad).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
