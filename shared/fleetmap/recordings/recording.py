"""A recording in memory, independent of its format, and a selection of its frames."""

import hashlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import Indices
from fleetmap.recordings.image_series import SeriesFrames
from fleetmap.recordings.images import StoredFrame, file_kind
from fleetmap.sensors import samples
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, DataIssue, ImuSamples, PositionPrior, SensorSet, Stamps, Trajectory
from fleetmap.sensors.source_settings import Topics


def named_topics(words: Sequence[str] | None, others: Topics | None = None) -> Topics:
    """Parse topics given as `left=/camera/left`, or `imu=` for none; the rest is as in `others`. UsageError for other text."""
    roles, found = Topics.__struct_fields__, {}
    for word in words or ():
        role, sign, name = word.partition("=")
        if role not in roles or not sign:
            form = "write ROLE=NAME, such as left=/camera/left"
            raise UsageError(f"--topic {word}: {form}; roles are {', '.join(roles)}")
        found[role] = name
    return msgspec.structs.replace(others or Topics(), **found)


@dataclass(frozen=True)
class OpenOptions:
    """Options of opening a recording. calibration_file takes precedence over a calibration inside the recording."""

    calibration_file: Path | None = None
    topics: Topics = field(default_factory=Topics)


class FrameSource(Protocol):
    """Access to the images of a recording: F frames, in any order."""

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` as stored, images still encoded; RecordingError if the bytes are gone."""

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded; RecordingError naming an image that cannot be decoded."""

    def part(self, indices: Indices) -> "FrameSource":
        """The frames at indices (K,), renumbered, read and closed independently of this source, also in other threads and processes."""

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """Feed the recording's content, including images, to `digest`, in a fixed order."""

    def close(self) -> None:
        """Close open files."""


@dataclass(frozen=True)
class WrappedFrames:
    """Base of a FrameSource over another one: the same stored frames and content, closed together with it."""

    source: FrameSource

    def stored(self, index: int) -> StoredFrame:
        return self.source.stored(index)

    def hash_into(self, digest: "hashlib._Hash") -> None:
        self.source.hash_into(digest)

    def close(self) -> None:
        self.source.close()


@dataclass(frozen=True)
class _SomeFrames(WrappedFrames):
    """The frames of a source at indices (K,), renumbered."""

    indices: Indices

    def stored(self, index: int) -> StoredFrame:
        return self.source.stored(int(self.indices[index]))

    def frame(self, index: int) -> CameraFrame:
        return self.source.frame(int(self.indices[index]))

    def part(self, indices: Indices) -> FrameSource:
        return self.source.part(self.indices[indices])


@dataclass(frozen=True)
class Recording(AbstractContextManager["Recording"]):
    """An open recording: everything but the images in memory, images read on demand.

    frame_stamps_ns (F,), strictly increasing: left frames that have their partner (right image or depth). imu: all
    samples, also those before the first frame; empty if the calibration lacks the mounting of the IMU (stated
    in issues). ground_truth: frame_from_body of the body (the IMU, or the frame that the calibration's body_from_cam
    refers to without one). issues: unreadable data. damaged_ns (D,): frames that
    opening, or `readable`, left out because one of their images cannot be decoded.
    """

    path: Path
    name: str
    format: str
    sensor_set: SensorSet
    calibration: RigCalibration
    frame_stamps_ns: Stamps
    imu: ImuSamples
    frames: FrameSource
    wheel: tuple[samples.WheelSample, ...] = ()
    priors: tuple[PositionPrior, ...] = ()
    ground_truth: Trajectory | None = None
    issues: tuple[DataIssue, ...] = ()
    damaged_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.frame_stamps_ns)

    def read_frame(self, index: int) -> CameraFrame:
        """Frame `index`, 0 <= index < F, decoded.

        RecordingError for damaged images and sizes other than the calibration's.
        """
        self._check_index(index)
        frame = self.frames.frame(index)
        for view, numbers in zip((frame, *frame.others), self.calibration.views, strict=False):
            for number, image in zip(numbers, (view.left, view.right) if view else (), strict=False):
                camera = self.calibration.cameras[number]
                if view and image is not None and image.shape != (camera.height_px, camera.width_px):
                    raise RecordingError(
                        f"{self.path}: the cam{number} image at {view.stamp_ns} is {_size(image)} px, the calibration says "
                        f"{camera.width_px}x{camera.height_px}; pass the matching one with --calibration FILE"
                    )
            if view and view.depth_m is not None and view.depth_m.shape != view.left.shape:
                raise RecordingError(
                    f"{self.path}: the depth image at {view.stamp_ns} is {_size(view.depth_m)} px, the colour image "
                    f"{_size(view.left)}; record depth registered to colour"
                )
        return frame

    def readable(self, indices: Indices) -> tuple["Recording", Indices]:
        """Return the recording without those frames at indices (K,) whose images are damaged, and the new indices of the others.

        They are noted in its issues. Only JPEG images are decoded for it: the checksums of PNG files were checked when the recording
        was opened. RecordingError if most are damaged.
        """
        faults: dict[int, str] = {}
        has_jpeg = False
        for index in indices.tolist():
            try:
                if not has_jpeg:
                    stored = self.stored_frame(index)
                    images = stored.left, stored.right, stored.depth
                    has_jpeg = any(image and file_kind(image.data) == "jpeg" for image in images)
                if has_jpeg:
                    self.read_frame(index)
            except RecordingError as error:
                faults[index] = str(error)
        if not faults:
            return self, indices
        first = next(iter(faults.values()))
        if 2 * len(faults) > len(indices):
            raise RecordingError(f"{len(faults)} of {len(indices)} frames cannot be read; the first: {first}")
        issue = DataIssue("images damaged", f"{len(faults)} of {len(indices)} frames left out; the first: {first}")
        kept = np.setdiff1d(np.arange(len(self)), list(faults))
        sound = replace(
            self,
            frame_stamps_ns=self.frame_stamps_ns[kept],
            frames=_SomeFrames(self.frames, kept),
            issues=(*self.issues, issue),
            damaged_ns=np.union1d(self.damaged_ns, self.frame_stamps_ns[list(faults)]),
        )
        return sound, np.searchsorted(kept, np.setdiff1d(indices, list(faults)))

    def stored_frame(self, index: int) -> StoredFrame:
        """Frame `index` with its images as stored, for lossless copying."""
        self._check_index(index)
        return self.frames.stored(index)

    def part(self, indices: Indices) -> "Recording":
        """The recording with only the frames at indices (K,), renumbered; see `FrameSource.part`."""
        return replace(self, frame_stamps_ns=self.frame_stamps_ns[indices], frames=self.frames.part(indices))

    def view(self, number: int) -> "Recording":
        """The recording of one of a rig's views alone, with its own stamps; the content's hash is that of all views for the first one."""
        views = self.calibration.views
        if len(views) == 1:
            return self
        calibration = replace(self.calibration, cameras=tuple(self.calibration.cameras[n] for n in views[number]))
        frames: Any = self.frames
        if number == 0:  # other views of wrapped frames find no camera in that calibration
            shown = frames.of_view(0) if isinstance(frames, SeriesFrames) else frames
            return replace(self, calibration=calibration, frames=shown)
        while not isinstance(frames, SeriesFrames):
            frames = frames.source  # of frames that are kept, or some of all
        frames, has_imu = frames.of_view(number), self.sensor_set.endswith("-inertial")
        sensor_set = sensors_of_view(len(views[number]) == 2, calibration.cameras[0].has_depth, has_imu)
        stamps_ns = frames.stamps_ns
        return replace(self, calibration=calibration, frames=frames, frame_stamps_ns=stamps_ns, sensor_set=sensor_set)

    def content_hash(self) -> str:
        """SHA-256 (hex) of the content, including images; the same on every machine."""
        digest = hashlib.sha256()
        self.frames.hash_into(digest)
        return digest.hexdigest()

    def close(self) -> None:
        """Close open files; the recording's arrays stay usable."""
        self.frames.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_index(self, index: int) -> None:
        if not 0 <= index < len(self):
            there = f"there are {len(self)} (0 to {len(self) - 1})"
            raise RecordingError(f"{self.path}: frame {index} was asked for, {there}")


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def sensors_of_view(has_right: bool, has_depth: bool, has_imu: bool) -> SensorSet:
    """The sensor set of a recording by its first view and its IMU, which a depth camera does not use."""
    if has_depth:
        return SensorSet.RGBD
    return SensorSet(("stereo" if has_right else "mono") + ("-inertial" if has_imu else ""))


@dataclass(frozen=True, slots=True)
class FrameSelection:
    """A slice of the frame indices with Python's meaning; the default takes all."""

    start: int | None = None
    stop: int | None = None
    step: int = 1

    @classmethod
    def parse(cls, text: str) -> "FrameSelection":
        """Parse a selection written `A:B:C`; each part may be omitted.

        UsageError for anything else and for steps below 1.
        """
        parts = text.strip().split(":")
        try:
            start, stop, step = (int(part) if part.strip() else None for part in (*parts, "", "")[:3])
        except ValueError:
            parts = []
        if not 2 <= len(parts) <= 3:
            form = "write A:B:C, for example 0:600:2, 100: or ::2"
            raise UsageError(f"--frames {text!r}: invalid slice of frame numbers; {form}")
        if step is not None and step < 1:
            backwards = "`locclient replay --reverse` plays backwards"
            raise UsageError(f"--frames {text!r}: the step {step} must be 1 or more; {backwards}")
        return cls(start, stop, step or 1)

    def apply(self, recording: Recording) -> Indices:
        """The selected frame indices (K,), increasing; UsageError if none is left."""
        indices = np.arange(len(recording), dtype=np.int64)[self.start : self.stop : self.step]
        if len(indices) == 0:
            raise UsageError(f"--frames {self} selects none of the {len(recording)} frames of {recording.path}")
        return indices

    def __str__(self) -> str:
        start, stop = ("" if v is None else str(v) for v in (self.start, self.stop))
        return f"{start}:{stop}:{self.step}"
