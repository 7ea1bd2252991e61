"""Bounded queue of sensor samples between the receiving threads and the localizing one.

Stereo frames may be dropped, the oldest first, and are counted; inertial samples never are.
"""

import threading
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.recordings import StoredFrame
from fleetmap.recordings.ordering import UNITS, wrong_unit
from fleetmap.sensors.samples import INTEGRATED_NS, PAUSE_NS, CameraFrame, ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.sensor_bundle import SensorBundle

_IMU_LEAD_NS = 10_000_000  # a frame is handled once IMU samples slightly past it have arrived
_ABSURD = 1e5
_SET_BACK_NS = 1_000_000_000  # a stamp older by more than this is not due to a late arrival
_STAYS_NS = 500_000_000  # duration of older stamps after which the clock counts as set back


@dataclass
class IntakeCounts:
    """Counts of received, dropped and refused samples. imu_late: frames handled without all of their IMU samples."""

    frames: int = 0
    frames_dropped: int = 0
    frames_disordered: int = 0
    imu_samples: int = 0
    imu_refused: int = 0
    imu_stale: int = 0
    imu_late: int = 0
    unreadable: int = 0


@dataclass
class _ImuQueue:
    stamps_ns: list[int] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def take_until(self, until_ns: int) -> ImuSamples:
        count = int(np.searchsorted(np.array(self.stamps_ns, np.int64), until_ns)) if self.stamps_ns else 0
        stamps, rows = np.array(self.stamps_ns[:count], np.int64), np.array(self.rows[:count], float).reshape(-1, 6)
        del self.stamps_ns[:count], self.rows[:count]
        return ImuSamples(stamps, np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:]))


class _Forward:
    """Accepts increasing stamps. After a pause the first one waits for confirmation by a second: a single wrong stamp is dropped alone."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._ahead_ns: int | None = None

    def takes(self, stamp_ns: int) -> bool:
        """True if the value with this stamp is accepted."""
        last_ns, ahead_ns, self._ahead_ns = self._last_ns, self._ahead_ns, None
        if last_ns is not None and stamp_ns <= last_ns:
            return False
        if last_ns is not None and stamp_ns - last_ns > PAUSE_NS:
            is_confirmed = ahead_ns is not None and 0 < stamp_ns - ahead_ns <= PAUSE_NS
            if not is_confirmed:
                self._ahead_ns = stamp_ns
                return False
        self._last_ns = stamp_ns
        return True


class Intake:
    """Queue with any number of producer threads and one consumer. unreadable_why: reason for the last unreadable message or image."""

    def __init__(self, *, frames: int, imu_minus_cam_s: float, has_imu: bool, imu_wait_s: float) -> None:
        """frames: capacity. imu_wait_s: longest wait of a frame for the inertial samples up to it."""
        self.counts = IntakeCounts()
        self.unreadable_why = ""
        self._frames: deque[CameraFrame | StoredFrame] = deque()
        self._limit = frames
        self._offset_ns = int(imu_minus_cam_s * 1e9)
        self._has_imu, self._imu_wait_s = has_imu, imu_wait_s
        self._changed = threading.Condition()
        self._imu, self._last_imu_ns, self._last_frame_ns = _ImuQueue(), -(2**62), -(2**62)
        self._frame_stamps, self._imu_stamps = _Forward(), _Forward()
        self._wheel: list[WheelSample] = []
        self._priors: list[PositionPrior] = []
        self._finished = self._forget = False
        self._older_since_ns: dict[str, int] = {}
        self._set_back = ""

    def put_frame(self, frame: CameraFrame | StoredFrame) -> None:
        """Put a frame, dropping the oldest if full. A frame not newer than all before, or alone far ahead, is refused and counted.

        RecordingError for a stamp in another unit than the IMU's.
        """
        with self._changed:
            _check_unit("images'", frame.stamp_ns, self._last_imu_ns)
            if _coarser_unit(self._last_imu_ns, frame.stamp_ns):
                self._imu, self._last_imu_ns, self._imu_stamps = _ImuQueue(), -(2**62), _Forward()
            if not self._frame_stamps.takes(frame.stamp_ns):
                self.counts.frames_disordered += 1
                if frame.stamp_ns <= self._last_frame_ns:
                    self._note_older("images", frame.stamp_ns, self._last_frame_ns)
                return
            self._older_since_ns.pop("images", None)
            self._last_frame_ns = frame.stamp_ns
            self.counts.frames += 1
            self._frames.append(frame)
            while len(self._frames) > self._limit:
                self._frames.popleft()
                self.counts.frames_dropped += 1
            self._changed.notify_all()

    def put_imu(self, samples: ImuSamples) -> None:
        """Put inertial samples; those that are not finite, implausible or not newer are refused and counted.

        RecordingError for stamps in another unit than the frames'.
        """
        with self._changed:
            if len(samples):
                _check_unit("imu", int(samples.stamps_ns[-1]), self._last_frame_ns)
            values = np.hstack([samples.gyro_radps, samples.accel_mps2])
            possible = np.asarray((np.abs(values) < _ABSURD).all(axis=1))
            for stamp_ns, row, good in zip(samples.stamps_ns.tolist(), values.tolist(), possible.tolist(), strict=True):
                if not good or not self._imu_stamps.takes(stamp_ns):
                    self.counts.imu_refused += 1
                    if good and stamp_ns <= self._last_imu_ns:
                        self._note_older("imu", stamp_ns, self._last_imu_ns)
                    continue
                self._older_since_ns.pop("imu", None)
                self._last_imu_ns = stamp_ns
                self.counts.imu_samples += 1
                self._imu.stamps_ns.append(stamp_ns)
                self._imu.rows.append(tuple(row))
            if not self._frames:
                self.counts.imu_stale += len(self._imu.take_until(self._last_imu_ns - INTEGRATED_NS))
            self._changed.notify_all()

    def put_wheel(self, sample: WheelSample) -> None:
        """Put wheel odometry; RecordingError for a stamp in another unit than the frames'."""
        with self._changed:
            _check_unit("wheel odometry", sample.stamp_ns, self._last_frame_ns)
            self._wheel.append(sample)
            del self._wheel[:-1000]

    def put_prior(self, prior: PositionPrior) -> None:
        """Put a coarse pose."""
        with self._changed:
            self._priors.append(prior)
            del self._priors[:-10]

    def put_forget(self) -> None:
        """Order the robot to forget its place and waiting priors, and to relocalize from the next frame on."""
        with self._changed:
            self._priors.clear()
            self._forget = True

    def count_unreadable(self, why: str) -> None:
        """Count an unreadable message or image; the last reason is kept."""
        with self._changed:
            self.counts.unreadable += 1
            self.unreadable_why = why

    def finish(self) -> None:
        """End the stream: no more samples will come."""
        with self._changed:
            self._finished = True
            self._changed.notify_all()

    @property
    def exhausted(self) -> bool:
        """True if the stream has ended and everything was taken."""
        with self._changed:
            return self._finished and not self._frames

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until a frame can be put without dropping another; False after timeout_s."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._frames) < self._limit, timeout_s)

    def take(self, timeout_s: float) -> SensorBundle:
        """Take the oldest frame with the samples before it, once its inertial samples have arrived or their wait is over.

        RecordingError once the stamps have permanently gone back: nothing would be accepted until they have caught up.
        """
        with self._changed:
            has_come = self._changed.wait_for(lambda: self._frames or self._finished or self._set_back, timeout_s)
            if self._set_back:
                raise RecordingError(self._set_back)
            if not has_come or not self._frames:
                return SensorBundle()
            if self._has_imu and not self._changed.wait_for(self._imu_is_there, self._imu_wait_s):
                self.counts.imu_late += 1
            frame = self._frames.popleft()
            body_ns = frame.stamp_ns + self._offset_ns
            imu = self._imu.take_until(body_ns + _IMU_LEAD_NS)
            wheel = [sample for sample in self._wheel if sample.stamp_ns <= body_ns]
            priors = [prior for prior in self._priors if prior.stamp_ns <= frame.stamp_ns]
            self._wheel = [sample for sample in self._wheel if sample.stamp_ns > body_ns]
            self._priors = [prior for prior in self._priors if prior.stamp_ns > frame.stamp_ns]
            forget, self._forget = self._forget, False
            self._changed.notify_all()
            return SensorBundle(frame, imu, wheel, priors, forget)

    def _note_older(self, what: str, stamp_ns: int, last_ns: int) -> None:
        """Detect stamps that continue from far before the last one. The caller holds the lock."""
        since_ns = self._older_since_ns.get(what)
        if last_ns - stamp_ns < _SET_BACK_NS:
            self._older_since_ns.pop(what, None)
        elif since_ns is None or stamp_ns < since_ns:
            self._older_since_ns[what] = stamp_ns
        elif stamp_ns - since_ns >= _STAYS_NS:
            self._set_back = (
                f"{what}: the stamps went back by {(last_ns - since_ns) * 1e-9:.1f} s, from {last_ns} to {since_ns}, and go on from "
                "there: the sensors' clock was set; start again, which begins a new run with the new clock"
            )
            self._changed.notify_all()

    def _imu_is_there(self) -> bool:
        """True if the IMU samples reach the oldest frame, which may have changed since the wait began."""
        return self._finished or self._last_imu_ns >= self._frames[0].stamp_ns + self._offset_ns


def _coarser_unit(stamp_ns: int, other_ns: int) -> int | None:
    """Nanoseconds per unit in which a stamp equals another sensor's, to 1 %; None for nanoseconds and if no unit fits."""
    return next((ns for ns in UNITS if stamp_ns > 0 and abs(stamp_ns * ns - other_ns) < 0.01 * other_ns), None)


def _check_unit(what: str, stamp_ns: int, other_ns: int) -> None:
    if ns := _coarser_unit(stamp_ns, other_ns):
        raise wrong_unit(what, UNITS[ns], f"{stamp_ns} beside {other_ns} of another sensor", f"multiply them by {ns}")
