"""Bounded queue of sensor samples between the receiving threads and the localizing one.

Stereo frames may be dropped, the oldest first, and are counted; inertial samples never are.
"""

import threading
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.messages import Flag
from fleetmap.recordings import StoredFrame
from fleetmap.recordings.ordering import UNITS, wrong_unit
from fleetmap.sensors.samples import INTEGRATED_NS, PAUSE_NS, CameraFrame, ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.sensor_bundle import IMU_LEAD_NS, NEVER_NS, SensorBundle

_ABSURD = 1e5
_SET_BACK_NS = 1_000_000_000  # a stamp older by more than this is not due to a late arrival
_STAYS_NS = 500_000_000  # duration of older stamps after which the clock counts as set back
_LATEST_NS = 2**62  # in 2116; later stamps are no times
_STEP_NS = 100_000_000  # between values, until their own steps are known
_STEPS = 9  # whose median is the usual one
_IMU = "the IMU is left out"
V = TypeVar("V")
S = TypeVar("S", WheelSample, PositionPrior)


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
    wheel_refused: int = 0
    unreadable: int = 0


class _Stream(Generic[V]):
    """Values of one sensor in order of their stamps.

    The first one, and one that comes later than after a single lost one, may have a wrong stamp: it is held until the next value. A newer
    one confirms it, and an older one replaces it. Thus a wrong stamp ahead costs its own value, and one amid the lost at most two more.
    """

    def __init__(self, what: str) -> None:
        self.last_ns, self.refused, self.set_back = NEVER_NS, 0, ""
        self._what = what
        self._held: tuple[int, V] | None = None
        self._steps_ns = deque([_STEP_NS], _STEPS)
        self._older_since_ns: int | None = None

    @property
    def newest_ns(self) -> int:
        """Stamp of the last value, which may be held."""
        return self.last_ns if self._held is None else self._held[0]

    def put(self, stamp_ns: int, value: V) -> list[V]:
        """Return the values whose stamps are certain by this one, in order."""
        if not self.last_ns < stamp_ns < _LATEST_NS:
            self.refused += 1
            self._note_older(stamp_ns)
            return []
        certain = list[V]()
        if self._held is not None and 0 < stamp_ns - self._held[0] <= PAUSE_NS:
            certain = self.release()
        is_in_step = stamp_ns - self.last_ns <= 2.5 * sorted(self._steps_ns)[len(self._steps_ns) // 2]
        self.refused += self._held is not None
        self._held = stamp_ns, value
        return [*certain, *self.release()] if is_in_step else certain

    def release(self) -> list[V]:
        """Return the held value as certain."""
        if self._held is None:
            return []
        (stamp_ns, value), self._held = self._held, None
        if self.last_ns != NEVER_NS:
            self._steps_ns.append(stamp_ns - self.last_ns)
        self.last_ns, self._older_since_ns, self.set_back = stamp_ns, None, ""
        return [value]

    def _note_older(self, stamp_ns: int) -> None:
        """Detect stamps that continue from far before the last one."""
        since_ns = self._older_since_ns
        if self.last_ns - stamp_ns < _SET_BACK_NS:
            self._older_since_ns = None
        elif since_ns is None or stamp_ns < since_ns:
            self._older_since_ns = stamp_ns
        elif stamp_ns - since_ns >= _STAYS_NS:
            self.set_back = (
                f"{self._what}: the stamps went back by {(self.last_ns - since_ns) * 1e-9:.1f} s, from {self.last_ns} to {since_ns}, and "
                "go on from there: the clock was set"
            )


class Intake:
    """Queue of any producer threads and one consumer. unreadable_why: of the last message; source_faults: why sensors send nothing now."""

    def __init__(self, *, frames: int, imu_minus_cam_s: float, has_imu: bool, imu_wait_s: float) -> None:
        """frames: capacity. imu_wait_s: longest wait of a frame for the inertial samples up to it."""
        self.counts = IntakeCounts()
        self.unreadable_why, self.source_faults = "", list[str]()
        self._frames: deque[CameraFrame | StoredFrame] = deque()
        self._limit = frames
        self._offset_ns = int(imu_minus_cam_s * 1e9)
        self._has_imu, self._imu_wait_s = has_imu, imu_wait_s
        self._changed = threading.Condition()
        self._imu: list[tuple[int, list[float]]] = []
        self._frame_stream = _Stream[CameraFrame | StoredFrame]("images")
        self._imu_stream = _Stream[tuple[int, list[float]]](_IMU)
        self._wheel_stream = _Stream[WheelSample]("the wheels are left out")
        self._wheel: list[WheelSample] = []
        self._priors: list[PositionPrior] = []
        self._finished = self._forget = False
        self._dropped = 0  # since the frame that was taken last

    def put_frame(self, frame: CameraFrame | StoredFrame) -> None:
        """Put a frame, dropping the oldest if full. A frame not newer than all before, or alone ahead, is refused and counted.

        RecordingError for a stamp in another unit than the IMU's.
        """
        with self._changed:
            _check_unit("images'", frame.stamp_ns, self._imu_stream.newest_ns)
            if _coarser_unit(self._imu_stream.newest_ns, frame.stamp_ns):
                self._imu, self._imu_stream = [], _Stream(_IMU)
            self._queue(self._frame_stream.put(frame.stamp_ns, frame))

    def put_imu(self, samples: ImuSamples) -> None:
        """Put inertial samples; those that are not finite, implausible or not newer are refused and counted.

        RecordingError for stamps in another unit than the frames'.
        """
        with self._changed:
            stream = self._imu_stream
            for last_ns in samples.stamps_ns[-1:].tolist():
                _check_unit("imu", last_ns, self._frame_stream.newest_ns)
            values = np.hstack([samples.gyro_radps, samples.accel_mps2])
            possible = np.asarray((np.abs(values) < _ABSURD).all(axis=1))
            for stamp_ns, row, good in zip(samples.stamps_ns.tolist(), values.tolist(), possible.tolist(), strict=True):
                if not good:
                    stream.refused += 1
                    continue
                certain = stream.put(stamp_ns, (stamp_ns, row))
                self.counts.imu_samples += len(certain)
                self._imu += certain
            self.counts.imu_refused = stream.refused
            if not self._frames:
                self.counts.imu_stale += len(_take_until(self._imu, stream.last_ns - INTEGRATED_NS))
            self._changed.notify_all()

    def put_wheel(self, sample: WheelSample) -> None:
        """Put wheel odometry; as of images. RecordingError for a stamp in another unit than the frames'."""
        with self._changed:
            _check_unit("wheel odometry", sample.stamp_ns, self._frame_stream.newest_ns)
            self._wheel += self._wheel_stream.put(sample.stamp_ns, sample)
            self.counts.wheel_refused = self._wheel_stream.refused
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
            self._queue(self._frame_stream.release())

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

        RecordingError once the images' stamps have permanently gone back: none would be accepted until they have caught up. The clock of
        another sensor costs that sensor.
        """
        images = self._frame_stream
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._finished or images.set_back, timeout_s)
            if images.set_back:
                raise RecordingError(f"{images.set_back}; start again, which begins a new run with the new clock")
            if images.last_ns == NEVER_NS:  # a first frame that no second one has confirmed in time
                self._queue(images.release())
            if not self._frames:
                return SensorBundle()
            if self._has_imu and not self._changed.wait_for(self._imu_is_there, self._imu_wait_s):
                self.counts.imu_late += 1
            frame = self._frames.popleft()
            body_ns = frame.stamp_ns + self._offset_ns
            imu = _take_until(self._imu, body_ns + IMU_LEAD_NS)
            wheel, self._wheel = _split(self._wheel, body_ns)
            priors, self._priors = _split(self._priors, frame.stamp_ns)
            forget, self._forget = self._forget, False
            dropped, self._dropped = self._dropped, 0
            self._changed.notify_all()
            return SensorBundle(frame, imu, wheel, priors, forget, dropped, self._left_out())

    def _queue(self, certain: list[CameraFrame | StoredFrame]) -> None:
        """Queue frames. One that was held and the one that confirms it do not displace each other. The caller holds the lock."""
        self.counts.frames += len(certain)
        self.counts.frames_disordered = self._frame_stream.refused
        self._frames += certain
        while len(self._frames) > self._limit + (len(certain) > 1):
            self._frames.popleft()
            self.counts.frames_dropped += 1
            self._dropped += 1
        self._changed.notify_all()

    def _left_out(self) -> dict[Flag, str]:
        faults = {Flag.IMU_REFUSED: self._imu_stream.set_back, Flag.WHEELS_REFUSED: self._wheel_stream.set_back}
        return {flag: f"{words}; stamp all sensors by one clock" for flag, words in faults.items() if words}

    def _imu_is_there(self) -> bool:
        """True if the IMU samples reach the oldest frame, which may have changed since the wait began, or will not."""
        is_awaited = not (self._finished or self._imu_stream.set_back)
        return not is_awaited or self._imu_stream.last_ns >= self._frames[0].stamp_ns + self._offset_ns


def _split(samples: list[S], last_ns: int) -> tuple[list[S], list[S]]:
    """Samples up to a stamp, and later ones."""
    return [each for each in samples if each.stamp_ns <= last_ns], [each for each in samples if each.stamp_ns > last_ns]


def _take_until(imu: list[tuple[int, list[float]]], until_ns: int) -> ImuSamples:
    count = bisect_left(imu, until_ns, key=lambda sample: sample[0])
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in imu[:count]], np.int64)
    rows = np.array([row for _, row in imu[:count]], float).reshape(-1, 6)
    del imu[:count]
    return ImuSamples(stamps_ns, np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:]))


def _coarser_unit(stamp_ns: int, other_ns: int) -> int | None:
    """Nanoseconds per unit in which a stamp equals another sensor's, to 1 %; None for nanoseconds and if no unit fits."""
    return next((ns for ns in UNITS if stamp_ns > 0 and abs(stamp_ns * ns - other_ns) < 0.01 * other_ns), None)


def _check_unit(what: str, stamp_ns: int, other_ns: int) -> None:
    if ns := _coarser_unit(stamp_ns, other_ns):
        raise wrong_unit(what, UNITS[ns], f"{stamp_ns} beside {other_ns} of another sensor", f"multiply them by {ns}")
