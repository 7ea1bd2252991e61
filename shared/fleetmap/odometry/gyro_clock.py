"""Check of the gyro's clock against the images, by correlation of their rotations.

For each of many shifts of the gyro's stamps the images' rotations are fitted by the gyro's, times a matrix near identity (its scale
and mounting may be off by a few percent) and with a bias; the squared residuals rate the shift. Source: Mair et al. 2011.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from fleetmap.core import longest_gap_ns
from fleetmap.geometry import AnyArray, Array, so3_log
from fleetmap.odometry.sensor_buffer import IMU_GAP_NS
from fleetmap.sensors.samples import ImuSamples

_STEP_S, _STEPS = 0.01, 30
_SHIFTS_S = _STEP_S * np.arange(-_STEPS, _STEPS + 1)
_REACH_NS = int(_SHIFTS_S[-1] * 1e9)
_LONGEST_NS = 350_000_000  # between two frames
_TURN_SIGMA_RAD = 0.001  # of the images' turn between two frames, at least
_MATRIX_SIGMA, _BIAS_SIGMA_RADPS = 0.1, 0.05
_KEPT = 0.975  # of earlier evidence, with each batch: clocks drift
_BATCH = 5  # frames taken together
_MOST_WAITING = 100  # frames that wait for samples
_MIN_FRAMES = 20  # for a result
_SURE_SQUARES = 25.0  # in variances, by which another shift must fit better: five sigmas

_PRIOR = np.zeros((7, 7))
_PRIOR[:3, :3] = _PRIOR[:3, 4:] = _PRIOR[4:, :3] = (_TURN_SIGMA_RAD / _MATRIX_SIGMA) ** 2 * np.eye(3)
_PRIOR[4:, 4:] = _PRIOR[:3, :3]
_PRIOR[3, 3] = (_TURN_SIGMA_RAD / _BIAS_SIGMA_RADPS) ** 2


def turned_between(times_s: AnyArray, rates_radps: Array, between_s: AnyArray) -> Array:
    """Return (..., 3) rotations by a gyro's samples, rates (n, 3) at times (n,), between pairs of times (..., 2)."""
    steps = np.diff(times_s)[:, None] * 0.5 * (rates_radps[1:] + rates_radps[:-1])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([np.diff(np.interp(between_s, times_s, column))[..., 0] for column in turned.T], axis=-1)


class GyroClock:
    """Follows turns of the images and samples of the gyro frame by frame.

    off_s: delay of the gyro's stamps relative to the calibration; None until it is certain.
    """

    def __init__(self, limit_s: float) -> None:
        """limit_s: largest offset that the filter estimates by itself."""
        self._limit_s = limit_s
        self.off_s: float | None = None
        self._last_ns: int | None = None
        # Stamps of two frames and the turn between them, until samples have come for all shifts.
        self._waiting: deque[tuple[int, int, Array]] = deque(maxlen=_MOST_WAITING)
        self._grams = np.zeros((len(_SHIFTS_S), 7, 7))  # of the gyro's turn (3), the duration, the images' turn (3)
        self._frames = 0.0

    def handle(self, stamp_ns: int, earlier_from_body: Array | None, imu: ImuSamples) -> None:
        """Process a frame on the calibrated IMU clock; earlier_from_body (4, 4): by images, since the frame before, None if unknown."""
        if self.off_s is not None or not len(imu):
            return
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if earlier_from_body is not None and last_ns is not None and stamp_ns - last_ns <= _LONGEST_NS:
            self._waiting.append((last_ns, stamp_ns, so3_log(earlier_from_body[:3, :3])))
        last_imu_ns = int(imu.stamps_ns[-1])
        if len(self._waiting) < _BATCH or self._waiting[_BATCH - 1][1] + _REACH_NS > last_imu_ns:
            return
        self._add([self._waiting.popleft() for _ in range(_BATCH)], imu)
        if self._frames >= _MIN_FRAMES:
            # If stamps are late, the samples of a frame's own time have not arrived yet: a larger delay causes a gap at each frame.
            self._judge((last_imu_ns - stamp_ns + IMU_GAP_NS) * 1e-9)

    def _add(self, batch: Sequence[tuple[int, int, Array]], imu: ImuSamples) -> None:
        begin_ns, until_ns = batch[0][0] - _REACH_NS, batch[-1][1] + _REACH_NS
        first, end = np.searchsorted(imu.stamps_ns, [begin_ns, until_ns])
        if first == 0 or longest_gap_ns(imu.stamps_ns, begin_ns, until_ns) > IMU_GAP_NS:
            return
        stamps, rates = imu.stamps_ns[first - 1 : end + 1], imu.gyro_radps[first - 1 : end + 1]
        times_s = (stamps - begin_ns) * 1e-9
        between_s = np.array([(start_ns - begin_ns, end_ns - begin_ns) for start_ns, end_ns, _ in batch]) * 1e-9
        at_s = _SHIFTS_S[:, None, None] + between_s  # (shifts, batch, 2)
        rows = np.empty((*at_s.shape[:2], 7))
        rows[:, :, :3] = turned_between(times_s, rates, at_s)
        rows[:, :, 3] = np.diff(between_s, axis=1)[:, 0]
        rows[:, :, 4:] = [turn for *_, turn in batch]
        self._grams = _KEPT * self._grams + rows.transpose(0, 2, 1) @ rows
        self._frames = _KEPT * self._frames + len(batch)

    def _judge(self, latest_s: float) -> None:
        grams = self._grams + _PRIOR
        known, crossed = grams[:, :4, :4], grams[:, :4, 4:]
        explained = (crossed * np.linalg.solve(known, crossed)).sum(axis=(1, 2))
        left = np.trace(grams[:, 4:, 4:], axis1=1, axis2=2) - explained
        variance = max(_TURN_SIGMA_RAD**2, left.min() / max(3.0 * self._frames - 12.0, 1.0))
        squares = left / variance  # residuals of each shift
        # Shift 0 is always included: the filter of a rig with exact clocks finds no offset.
        first_s = min(0.5 * _STEP_S - self._limit_s, 0.0)
        last_s = max(min(self._limit_s, latest_s) - 0.5 * _STEP_S, 0.0)
        may_be_found = (first_s <= _SHIFTS_S) & (last_s >= _SHIFTS_S)
        best = int(squares.argmin())
        is_off = squares[may_be_found].min() - squares[best] > _SURE_SQUARES
        if is_off and 0 < best < len(squares) - 1:
            before, here, after = squares[best - 1 : best + 2]
            self.off_s = float(_SHIFTS_S[best] + 0.5 * _STEP_S * (before - after) / (before - 2.0 * here + after))
