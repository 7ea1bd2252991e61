"""Check of the accelerometer against the images while a robot drives: signs and order of its axes, and its unit.

Positions of the body at times t0, t1 and t2 give a change of velocity, (p2 - p1) / (t2 - t1) - (p1 - p0) / (t1 - t0). It is the integral of
the acceleration with a weight that rises from 0 at t0 to 1 at t1 and falls to 0 at t2, for any velocity; and equals the same integral
of the specific force, rotated by the images' rotations, less gravity and the accelerometer's bias.
"""

from collections.abc import Sequence

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, length, so3_log
from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.sensors.axes import SIGNED_AXES, axes_in_words
from fleetmap.sensors.samples import ImuSamples

_HALF_NS, _LONGEST_NS = 200_000_000, 350_000_000  # half a window, and the longest between two frames
LONGEST_STEP_NS = 50_000_000  # between two samples, at most
_CHANGE_SIGMA_MPS, _BIAS_SIGMA_MPS2 = 0.05, 0.3
_KEPT = 0.97  # of earlier evidence, with each window: turns accumulate errors of the images
_MIN_WINDOWS, _SIZE_WINDOWS, _MANY_WINDOWS = 4, 10, 20
# By how much other axes must fit better than the given ones to rule these out: in variances of a window, and as a factor
_SURE_SQUARES, _SURE_RATIO = 60.0, 4.0
_NAMED_SQUARES = 12.0  # worse than the best fit by less than this: candidates as well
_REACH_SIGMAS = 4.0
_GRAVITY_OFF_MPS2 = 2.0  # biases and errors of the images cause less
_NO_GRAVITY_MPS2 = 4.0  # gravity that motion seems to show if there is none
_AXES = np.array([[*each.ravel(), -1.0] for each in SIGNED_AXES])
_GIVEN, _REVERSED = (int((_AXES[:, [0, 4, 8]].sum(axis=1) == trace).argmax()) for trace in (3.0, -3.0))
_KNOWN = np.r_[:9, 15]  # of the normal equations
_UPRIGHT = 0.7  # cosine of the angle between the base's up and the accelerometer's: ramps are far within


Posed = tuple[int, Array, Array, Array]
"""Stamp on the IMU's clock, place and rotation of a body, in the axes of the first one of its run, and its turn since the one before."""


def change_of_velocity(run: Sequence[Posed], middle: int, imu: ImuSamples) -> Array | None:
    """Return rows (3, 16) of the body's change of velocity about run[middle]; None with gaps in the samples.

    Their product with body_from_sensor (9), the bias (3), up in the run's axes times gravity (3), and minus the metres in one of the places
    is zero.
    """
    start_ns, end_ns = run[0][0], run[-1][0]
    samples = imu.between(start_ns, end_ns)
    if len(samples) < 8 or core.longest_gap_ns(samples.stamps_ns, start_ns, end_ns) > LONGEST_STEP_NS:
        return None
    frames_ns, places, rotations, turns = (np.array(each) for each in zip(*run, strict=True))
    of_frames = frames_ns, rotations, turns, places, middle
    return core.velocity_change_rows(samples.stamps_ns, samples.accel_mps2, *of_frames)


class AccelerometerCheck:
    """Follows images and samples frame by frame.

    fault: text why the accelerometer cannot be used, naming its axes or unit; empty without evidence.
    """

    def __init__(self, base_from_body: Array) -> None:
        self._base_from_body = base_from_body
        self.fault = ""
        self._run: list[Posed] = []
        self._normal = np.zeros((16, 16))  # equations of `change_of_velocity`
        self._windows = 0.0
        # The squares' matrix for axes (9) and -1, those of the given axes and of the best fit, and the variance
        self._judged: tuple[Array, float, float, float] | None = None

    def favours(self, seen_from_true: Array) -> bool | None:
        """Return whether it says that the images' motion is rotated by (3, 3), in body axes; None without evidence."""
        if self._judged is None:
            return None
        left, given, best, variance = self._judged
        squares = float(np.append(seen_from_true, -1.0) @ left @ np.append(seen_from_true, -1.0))
        if self.fault:
            return squares < best + _NAMED_SQUARES * variance
        return False if squares > max(given + _SURE_SQUARES * variance, _SURE_RATIO * given) else None

    def handle(self, stamp_ns: int, earlier_from_body: Array | None, imu: ImuSamples, *, on_wheels: bool) -> None:
        """Process a frame on the IMU's clock; earlier_from_body (4, 4): by images, since the frame before, None if unknown.

        on_wheels: True if the base stands upright.
        """
        if self.fault:
            return
        if earlier_from_body is None or not self._run or stamp_ns - self._run[-1][0] > _LONGEST_NS:
            # Evidence on axes and bias stays; the up direction in the axes of this frame is unknown.
            self._run = [(stamp_ns, np.zeros(3), np.eye(3), np.zeros(3))]
            up, others = self._normal[12:15], np.linalg.pinv(self._normal[12:15, 12:15], hermitian=True)
            self._normal = self._normal - up.T @ others @ up
            self._normal[12:15], self._normal[:, 12:15] = 0.0, 0.0
            return
        _, place, rotation, _ = self._run[-1]
        moved = place + rotation @ earlier_from_body[:3, 3], rotation @ earlier_from_body[:3, :3]
        self._run.append((stamp_ns, *moved, so3_log(earlier_from_body[:3, :3])))
        stamps_ns = [each[0] for each in self._run]
        middle = next((k for k, stamp in enumerate(stamps_ns) if stamp - stamps_ns[0] >= _HALF_NS), None)
        if middle is None or stamp_ns - stamps_ns[middle] < _HALF_NS:
            return
        rows = change_of_velocity(self._run, middle, imu)
        if rows is not None:
            self._normal = _KEPT * self._normal + rows.T @ rows / _CHANGE_SIGMA_MPS**2
            self._windows = _KEPT * self._windows + 1.0
        del self._run[:middle]
        self._judge(imu, on_wheels)

    def _judge(self, imu: ImuSamples, on_wheels: bool) -> None:
        if self._windows < _MIN_WINDOWS:
            return
        normal = self._normal.copy()
        normal[range(9, 12), range(9, 12)] += _BIAS_SIGMA_MPS2**-2
        normal[range(12, 15), range(12, 15)] += 1e-3  # unknown where images were interrupted
        crossed = normal[9:15][:, _KNOWN]
        solved = np.linalg.solve(normal[9:15, 9:15], crossed)
        left = normal[_KNOWN][:, _KNOWN] - crossed.T @ solved
        squares = (_AXES @ left * _AXES).sum(axis=1)
        ups = -(_AXES @ solved.T)[:, 3:]
        size = length(ups[_GIVEN])
        best = float(squares.min())
        variance = max(1.0, best / max(3.0 * self._windows - 6.0, 1.0))
        self._judged = left, float(squares[_GIVEN]), best, variance
        sigma_mps2 = float(np.sqrt(variance * np.trace(np.linalg.inv(normal[9:15, 9:15])[3:, 3:])))
        if abs(size - GRAVITY_MPS2) > _GRAVITY_OFF_MPS2 + _REACH_SIGMAS * sigma_mps2:
            if self._windows >= _SIZE_WINDOWS:
                self.fault = _size_in_words(size, float(np.median(np.linalg.norm(imu.accel_mps2, axis=1))))
            return
        ups_base = ups @ (self._base_from_body[:3, :3] @ self._run[0][2].T).T / max(size, 1e-9)
        is_up = ups_base[:, 2] > _UPRIGHT
        is_possible = squares < best + _NAMED_SQUARES * variance
        is_contradicted = squares[_GIVEN] > max(best + _SURE_SQUARES * variance, _SURE_RATIO * best)
        # Upside down: once it shows whether all axes are reversed, or one.
        is_told = not is_possible[_REVERSED] or self._windows > _MANY_WINDOWS
        is_reversed = on_wheels and ups_base[_GIVEN, 2] < -_UPRIGHT and is_told
        if not is_contradicted and not is_reversed:
            return
        if abs(ups_base[_GIVEN, 2]) > _UPRIGHT and (is_possible & is_up).any():  # a rig that stands as its base does
            is_possible &= is_up
        # All axes reversed is a single fault, of a driver that reports gravity; it precedes other faults that fit equally well.
        possible = [each for k, each in enumerate(SIGNED_AXES) if is_possible[k]]
        likely = max(possible, key=lambda each: 4.0 if (each == -np.eye(3)).all() else float(np.trace(each)))
        self.fault = f"it {axes_in_words(likely)}"


def _size_in_words(size_mps2: float, median_mps2: float) -> str:
    words = f"it shows gravity as {size_mps2:.2g} m/s^2 in place of 9.8"
    if size_mps2 > _NO_GRAVITY_MPS2:
        return f"{words}: check its unit and range"
    return f"{words}: it is in g" if 0.8 < median_mps2 < 1.25 else f"{words}: gravity was taken out of it"
