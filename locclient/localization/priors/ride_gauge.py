"""The vertical motion of a robot whose wheels rest, from its accelerometer. Pure.

At rest the length of the specific force is gravity plus the cabin's acceleration plus a bias, whatever the robot's tilt. A Kalman filter
follows height, vertical speed and that constant. Lifts stand when a ride begins and ends: then the speed is zero, which corrects
the height as well, by its covariance with the speed. Source: zero-velocity updates (Foxlin 2005).
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, WheelSample

_ROLLING_MPS, _ROLLING_RADPS = 0.01, 0.01
_GAP_NS, _SILENT_NS = 100_000_000, 400_000_000  # without inertial samples; without wheel samples
_STILL_S, _STEADY_S = 1.0, 0.5  # between two tests of a robot at rest; before each its speed does not change
_STILL_SIGMA_MPS = 0.01  # of a standing cabin, and of a robot that has just stopped, in which it pitches
_GATE = 3.0  # sigmas of a speed that may be zero
_MIN_MPS = 0.05  # of a ride: slower steps are vibrations of a floor
_SLOWED_SHARE = 0.3  # of the largest speed, below which a ride may have ended
_KNOWN_SHARE = 0.2  # of the largest speed: a speed with a larger sigma does not show the end of a ride
# Of a ride: a robot that must find its place before it may roll would wait for ever after a wrong one.
_LONGEST_S = 180.0
_BIAS_SIGMA_MPS2 = 0.3  # before the first rest
_SCALE_SIGMA = 0.02  # of an accelerometer, calibrated or not


class Ride(NamedTuple):
    """Rise since the last `reset` with its sigma, infinite if unknown; is_moving: the robot rides. rest_s: since its wheels rest.
    is_cut: until this frame, in which its wheels roll or are silent: the rest of the ride is not measured.
    """

    is_moving: bool
    rise_m: float
    sigma_m: float
    rest_s: float
    is_cut: bool = False


class RideGauge:
    """Follows inertial and wheel samples from frame to frame. Without either of them the rise is unknown."""

    def __init__(self, noise: ImuNoise | None) -> None:
        self._noise = noise
        self._state = np.array([0.0, 0.0, GRAVITY_MPS2])  # height, speed, specific force of a standing cabin
        self._cov = np.diag([0.0, _STILL_SIGMA_MPS**2, _BIAS_SIGMA_MPS2**2])
        self._imu: list[ImuSamples] = []
        self._last_ns: int | None = None  # of the inertial samples
        self._wheel: list[WheelSample] = []
        self._wheel_ns: int | None = None
        self._still_s = self._rest_s = 0.0
        self._speeds = deque[tuple[float, float]]()  # of the last half second at rest: time since the last test, speed
        self._fastest_mps = self._riding_s = 0.0  # of this ride; 0 before one
        self._is_known = noise is not None

    def handle_imu(self, samples: ImuSamples) -> None:
        if len(samples) and self._noise is not None:
            self._imu.append(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self._wheel.extend(samples)

    def reset(self) -> None:
        """Measure the rise from here."""
        self._state[0] = 0.0
        self._cov[0, :] = self._cov[:, 0] = 0.0
        self._is_known = self._noise is not None

    def doubt(self) -> None:
        """Hold the rise for unknown until the next `reset`."""
        self._is_known = False

    def advance(self, stamp_ns: int, dt_s: float) -> Ride:
        """Return the motion until a frame, dt_s after the one before; stamp_ns on the IMU's clock."""
        wheel, self._wheel = self._wheel, []
        self._wheel_ns = wheel[-1].stamp_ns if wheel else self._wheel_ns
        is_rolling = any(
            np.linalg.norm(sample.velocity_base_mps) > _ROLLING_MPS or abs(sample.yaw_rate_radps) > _ROLLING_RADPS
            for sample in wheel
        )
        has_wheels = self._wheel_ns is not None and stamp_ns - self._wheel_ns <= _SILENT_NS
        self._rest_s = 0.0 if is_rolling else self._rest_s + dt_s
        imu, self._imu = self._imu, []
        is_cut = (is_rolling or not has_wheels) and self._fastest_mps > 0.0 and not self._may_stand
        if not has_wheels:  # it may drive: its accelerations are no lift's
            self._stop()
            self._last_ns, self._is_known = None, False
            return Ride(False, 0.0, np.inf, self._rest_s, is_cut)
        if not imu and self._last_ns is not None and stamp_ns - self._last_ns > _GAP_NS:
            self._is_known = False
        for samples in imu:
            self._integrate(samples, is_rolling=is_rolling)
        if is_rolling:
            self._stop()
        else:
            self._speeds.append((self._still_s, float(self._state[1])))
            while self._still_s - self._speeds[0][0] > _STEADY_S:
                self._speeds.popleft()
            if self._still_s >= _STILL_S:
                self._test_rest()
        self._riding_s = self._riding_s + dt_s if self._fastest_mps else 0.0
        if self._riding_s > _LONGEST_S:
            self._stop()
            self._is_known, self._cov[2, 2] = False, _BIAS_SIGMA_MPS2**2
        if not is_rolling and not self._may_stand:
            self._fastest_mps = max(self._fastest_mps, abs(float(self._state[1])))
        rise_m = float(self._state[0])
        sigma_m = float(np.hypot(np.sqrt(self._cov[0, 0]), _SCALE_SIGMA * rise_m)) if self._is_known else np.inf
        return Ride(self._fastest_mps > 0.0, rise_m, sigma_m, self._rest_s, is_cut)

    @property
    def _may_stand(self) -> bool:
        """True if the speed may be zero."""
        return bool(abs(self._state[1]) <= _MIN_MPS + _GATE * np.sqrt(self._cov[1, 1]))

    def _integrate(self, samples: ImuSamples, *, is_rolling: bool) -> None:
        last_ns, self._last_ns = self._last_ns, int(samples.stamps_ns[-1])
        if last_ns is None or self._noise is None:
            return
        dt_s = (self._last_ns - last_ns) * 1e-9
        noise = self._noise
        self._cov[2, 2] += noise.accel_walk_mps3_rthz**2 * dt_s
        if is_rolling:
            return
        if samples.stamps_ns[0] - last_ns > _GAP_NS:
            self._is_known = False
        force_mps2 = np.linalg.norm(samples.accel_mps2, axis=1)
        step_mps = (float(force_mps2.mean()) - self._state[2]) * dt_s
        self._state[0] += (self._state[1] + 0.5 * step_mps) * dt_s
        self._state[1] += step_mps
        moved = np.array([[1.0, dt_s, -0.5 * dt_s**2], [0.0, 1.0, -dt_s], [0.0, 0.0, 1.0]])
        # A vibrating cabin is noisier than the sensor.
        variance = max(noise.accel_noise_mps2_rthz**2 * dt_s, float(force_mps2.var()) * dt_s**2 / len(samples))
        by_noise = np.array([0.5 * dt_s, 1.0, 0.0])
        self._cov = moved @ self._cov @ moved.T + variance * np.outer(by_noise, by_noise)
        self._still_s += dt_s

    def _test_rest(self) -> None:
        """Correct speed, height and bias by a cabin at rest, if the speed may be zero and does not change; that ends a ride."""
        speed_mps, sigma_mps = abs(self._state[1]), float(np.sqrt(self._cov[1, 1]))
        change_mps = np.ptp([speed for _, speed in self._speeds])
        bias_mps = float(np.sqrt(self._cov[2, 2])) * _STEADY_S
        if not self._may_stand or change_mps > _MIN_MPS + _GATE * bias_mps:
            return
        if self._fastest_mps:
            if speed_mps > _SLOWED_SHARE * self._fastest_mps:
                return
            self._is_known &= sigma_mps <= _KNOWN_SHARE * self._fastest_mps
        self._stand()

    def _stop(self) -> None:
        """The wheels roll: the cabin stands, and has stood for a while."""
        if self._fastest_mps or self._still_s:
            sigma_mps = float(np.sqrt(self._cov[1, 1]))
            self._is_known &= self._may_stand
            self._is_known &= not self._fastest_mps or sigma_mps <= _KNOWN_SHARE * self._fastest_mps
            self._stand()
        self._state[1] = 0.0
        self._cov[1, :] = self._cov[:, 1] = 0.0
        self._cov[1, 1] = _STILL_SIGMA_MPS**2

    def _stand(self) -> None:
        gain = self._cov[:, 1] / (self._cov[1, 1] + _STILL_SIGMA_MPS**2)
        self._state = self._state - gain * self._state[1]
        self._cov = self._cov - np.outer(gain, self._cov[1])
        self._fastest_mps = self._still_s = 0.0
        self._speeds.clear()
