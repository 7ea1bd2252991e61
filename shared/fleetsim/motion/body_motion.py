"""Motion of a robot's body: a quintic spline in x, y, z, yaw, pitch, roll, so that rates and accelerations are exact.

Euler angles are safe here: a ground robot never pitches anywhere near 90 degrees.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetsim.motion.routes import Limits, Route, time_path

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

    def _local(self, times_s: Array) -> tuple[NDArray[np.int64], Array]:
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
