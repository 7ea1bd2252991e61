"""Recordings from the messages in a file: the common interface of MCAP and of bags, and the recording made through it, which orders
stamps and leaves images in the file.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, Mask
from fleetmap.recordings import limits, ordering
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.finalize import RecordingParts, finalize, logged_calibration
from fleetmap.recordings.image_series import ImageReader, ImageSeries, SeriesFrames, ViewImages, paired, rig_views
from fleetmap.recordings.images import StoredImage, check_image
from fleetmap.recordings.ordering import LAST_NS, ReadLog, as_logged, clean_imu, forward_only, usual_size
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.ros2 import messages as ros
from fleetmap.recordings.ros2.cdr import unpack
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import DataIssue, ImuSamples, Stamps, Trajectory
from fleetmap.sensors.source_settings import CAMERA_ROLES, IMAGE_ROLES, Topics, transports

CALIBRATION_ATTACHMENT = "calibration.yaml"
_MOST_ISSUES = 20
UNDECODABLE = (ValueError, AttributeError)  # the second: a field that a schema in the file lacks
Place = tuple[int, ...]  # position of a message in its file, as numbered by its container


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic's channel. type_name: without ROS 2's `/msg/`, such as sensor_msgs/Imu; schema: as in the file."""

    id: int
    topic: str
    encoding: str
    type_name: str
    schema: bytes = b""


Message = tuple[Channel, int, Place, memoryview]


class Container:
    """Base of the open files of a recording of messages. files: covered by its hash; name: its own name, or empty.

    Counts what is unpacked and read of them, and the memory kept for them.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.path, self.size = files[0], sum(file.stat().st_size for file in files)
        self._kept = self._passed = self._unpacked = 0
        self.files, self.name = files, ""
        self.attachments: dict[str, bytes] = {}
        self.issues: list[DataIssue] = []

    def messages(self) -> Iterator[Message]:
        """Yield channel, log time in ns, place and bytes of every complete message, in the order of writing.

        After that, name, attachments and issues (unreadable parts) are complete.
        """
        raise NotImplementedError

    def read(self, place: Place) -> bytes:
        """Read one message again; ValueError if it is damaged, RecordingError if the file has changed."""
        raise NotImplementedError

    def decode(self, channel: Channel, data: bytes) -> Any:
        """The value of a message by its type, as `DECODERS`; UNDECODABLE for invalid ones, RecordingError if a library is missing."""
        return ros.DECODERS[channel.type_name](data)

    def decode_imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Stamps (N,), gyro (N, 3), accelerometer (N, 3), frame of the sensor. Errors as of `decode`, for any of the messages."""
        return ros.decode_imu(messages)

    def stamp_of(self, channel: Channel, data: bytes) -> int:
        """Stamp of a message with a header, 0 where the sender set none; UNDECODABLE without one."""
        seconds, nanoseconds = unpack("builtin_interfaces/Time", data)
        return int(seconds * 1_000_000_000 + nanoseconds)

    def close(self) -> None:
        """Close the files."""

    def unpack(self, compression: str, packed: bytes | memoryview, most_bytes: int = limits.MAX_MESSAGE_BYTES) -> bytes:
        """See `limits.unpack`; RecordingError beyond what a real recording unpacks to. Damaged bytes count as `most_bytes`."""
        self._limit(self._unpacked, limits.UNPACKED_BYTES + limits.UNPACKED_PER_FILE_BYTE * self.size, "bytes;")
        self._unpacked += most_bytes
        unpacked = limits.unpack(compression, packed, most_bytes)
        self._unpacked -= most_bytes - len(unpacked)
        return unpacked

    def pass_record(self) -> None:
        """Count a record that is read, kept or not; RecordingError if the file unpacks to more than a real recording can."""
        self._passed += 1
        self._limit(self._passed, limits.PASSED_RECORDS + self.size // limits.LEAST_RECORD_BYTES, "records;")

    def keep(self, size: int) -> None:
        """Count a record of `size` bytes kept in memory; RecordingError if the file unpacks to more than a real recording can."""
        self._kept += size + limits.KEPT_RECORD_BYTES
        most = limits.KEPT_BYTES + limits.KEPT_PER_FILE_BYTE * self.size
        self._limit(self._kept, most, "bytes beside the images; no recorder writes that,")

    def _limit(self, count: int, most: int, words: str) -> None:
        if count > most:
            raise RecordingError(
                f"{self.path}: {self.size} bytes unpack to more than {most} {words} leave the file out"
            )

    def note(self, what: str, detail: str) -> None:
        """Note an unreadable part, unless there are very many."""
        if len(self.issues) < _MOST_ISSUES:
            self.issues.append(DataIssue(what, detail))


_FIRST_ROLES = ("left", "right", "depth")  # those of a recording with one view
_TYPES = {
    **dict.fromkeys(IMAGE_ROLES, ("sensor_msgs/Image", "sensor_msgs/CompressedImage")),
    "imu": ("sensor_msgs/Imu",),
    "wheel": ("nav_msgs/Odometry",),
    "prior": ("geometry_msgs/PoseWithCovarianceStamped",),
    "ground_truth": ("geometry_msgs/PoseStamped",),
}
Source = tuple[Channel, Place]


@dataclass(eq=False)
class Stream:
    """The messages of one channel with their log times. damaged: number of messages left out."""

    container: Container
    channel: Channel
    log_times_ns: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    damaged: int = 0

    def take(self, data: bytes, place: Place, logged_ns: int, log: ReadLog) -> None:
        """Add a message."""
        self.container.keep(len(data))
        self.messages.append(data)
        self.log_times_ns.append(logged_ns)

    @cached_property
    def values(self) -> list[tuple[int, Any]]:
        """Log times and values of all messages that can be decoded; the others are counted."""
        found = []
        for log_time_ns, data in zip(self.log_times_ns, self.messages, strict=True):
            try:
                found.append((log_time_ns, self.container.decode(self.channel, data)))
            except UNDECODABLE:
                self.damaged += 1
        return found


@dataclass(eq=False)
class ImageStream(Stream):
    """Images: stamp, log time, place and size of each. why_damaged: the reason for the first one that was left out."""

    images: list[tuple[int, int, Place, tuple[int, int]]] = field(default_factory=list)
    why_damaged: str = ""

    def take(self, data: bytes, place: Place, logged_ns: int, log: ReadLog) -> None:
        """Add an image if it is whole, else keep the reason."""
        stamp_ns, topic = None, f"{self.container.path}: {self.channel.topic}"
        try:
            stamp_ns = self.container.stamp_of(self.channel, data)
            image: StoredImage = self.container.decode(self.channel, data)
            size_px = check_image(replace(image, where=f"{topic} at {stamp_ns}"))
        except (*UNDECODABLE, RecordingError) as error:
            self.damaged += 1
            why = str(error) if isinstance(error, RecordingError) else f"{topic}: {error}; the message is damaged"
            self.why_damaged = self.why_damaged or why
            log.damaged_ns += [stamp_ns] if stamp_ns else []
            return
        self.container.keep(0)
        self.images.append((stamp_ns, logged_ns, place, size_px))


Roles = Mapping[str, Sequence[Any]]
"""Streams by their role, ImageStreams for roles of images."""


@contextmanager
def opened(
    opener: Callable[[], Container], options: OpenOptions
) -> Iterator[tuple[Container, CalibrationFile | None, ReadLog]]:
    """Open a container, beside the calibration that the caller chose, if any; closed if the block fails."""
    log = ReadLog()
    given = None if options.calibration_file is None else logged_calibration(options.calibration_file, log)
    container = opener()
    try:
        yield container, given, log
    except BaseException:
        container.close()
        raise


def open_written(path: Path, opener: Callable[[], Container], options: OpenOptions) -> Recording:
    """Open a file that this project wrote: topics by their names, the calibration as attached.

    opener: must be picklable, because other processes may read part of the frames. CalibrationError without a calibration, RecordingError
    without the left image, and without a topic that the caller named.
    """
    with opened(opener, options) as (container, given, log):
        streams, others = collect(container, lambda channel: _stream_of(container, channel), log)
        there = ", ".join(f"{c.topic} ({c.type_name})" for c in (*(s.channel for s in streams), *others)) or "none"
        found = "; ".join(filter(None, (f"there is {there}", log.told())))
        roles = dict[str, list[Stream]]()
        for role, types in _TYPES.items():
            name = getattr(options.topics, role)
            named = {stream.channel.topic: stream for stream in streams if stream.channel.type_name in types}
            if stream := next((named[sent] for sent in transports(name, role) if sent in named), None):
                roles[role] = [stream]
            elif role == "left" or (name and name != getattr(Topics(), role)):
                lack = f"has no topic {name} of type {' or '.join(types)} for --topic {role}"
                raise RecordingError(f"{container.path} {lack}; {found}")

        def calibrate(_: str | None) -> tuple[RigCalibration, Sequence[str]]:
            calibration = given.calibration if given else attached_calibration(container)
            if calibration is None:
                how = "pass a calibration with --calibration FILE"
                raise CalibrationError(f"{container.path} has no attachment {CALIBRATION_ATTACHMENT}; {how}")
            return calibration, CAMERA_ROLES

        return assemble(path, "mcap", container, opener, streams, roles, calibrate, log)


def _stream_of(container: Container, channel: Channel) -> Stream | None:
    """An empty stream for a channel, None for messages that no recording uses."""
    if channel.encoding != "cdr" or channel.type_name not in {name for names in _TYPES.values() for name in names}:
        return None
    return (ImageStream if channel.type_name in _TYPES["left"] else Stream)(container, channel)


def attached_calibration(container: Container) -> RigCalibration | None:
    """The calibration that this project attached to the file."""
    attached = container.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is None:
        return None
    where = f"{container.path}: attachment {CALIBRATION_ATTACHMENT}"
    return parse_calibration(attached.decode("utf-8", "replace"), where).calibration


def collect(
    container: Container, stream_of: Callable[[Channel], Stream | None], log: ReadLog
) -> tuple[list[Stream], list[Channel]]:
    """Read the messages of all channels for which there is a stream; also return the other channels."""
    found: dict[int, tuple[Channel, Stream | None]] = {}
    for channel, logged_ns, place, data in container.messages():
        if channel.id not in found:
            found[channel.id] = channel, stream_of(channel)
        if stream := found[channel.id][1]:
            stream.take(bytes(data), place, min(logged_ns, LAST_NS), log)  # MCAP's times have a bit more
    log.issues += container.issues
    log.files[:0] = container.files
    return [s for _, s in found.values() if s], [channel for channel, s in found.values() if s is None]


def assemble(
    path: Path,
    file_format: str,
    container: Container,
    opener: Callable[[], Container],
    streams: Sequence[Stream],
    roles: Roles,
    calibrate: Callable[[str | None], tuple[RigCalibration, Sequence[str]]],
    log: ReadLog,
    usable: Mapping[str, Mask] = MappingProxyType({}),
) -> Recording:
    """Build a recording from the streams by their roles; its issues list unreadable messages.

    calibrate: by the frame of the IMU's messages, the calibration and the roles of its cameras. usable: (N,) by role, images to take.
    """
    imu, imu_frame = _imu(roles.get("imu", ()), log)
    images = {
        role: _images(roles[role], f"{role} images", log, usable.get(role)) for role in _FIRST_ROLES if role in roles
    }
    calibration, described = calibrate(imu_frame)
    if "depth" in images and "right" not in images:
        views: tuple[ViewImages, ...] = (paired(images["left"], {"depth": images["depth"]}, log),)
        if beside := [role for role in CAMERA_ROLES[2:] if role in roles]:
            how = "let a stereo pair be left and right, and the depth camera cam2, with its depth on cam2_depth"
            what = f"{', '.join(beside)}: beside a depth camera as first view no other is used"
            log.note("images not used", f"{what}; {how}")
    elif len(calibration.cameras) > 1:
        cameras, depths = {}, {}
        for n, role in enumerate(described[: len(calibration.cameras)]):
            if role in roles:
                series = images.get(role) or _images(roles[role], f"{role} images", log, usable.get(role))
                cameras[n] = f"{role} ({roles[role][0].channel.topic})", series
                if calibration.cameras[n].has_depth and f"{role}_depth" in roles:
                    depths[n] = _images(roles[f"{role}_depth"], f"depth images of cam{n}", log)
        calibration, views = rig_views(calibration, cameras, log, depths)
    else:
        views = (paired(images["left"], {role: images[role] for role in images if role == "right"}, log),)
    sensors: dict[str, Any] = {
        "imu": imu,
        "wheel": _samples(roles.get("wheel", ()), "wheel odometry", log),
        "priors": _samples(roles.get("prior", ()), "position priors", log),
        "ground_truth": _ground_truth(roles.get("ground_truth", ()), log),
    }
    for stream in streams:
        if stream.damaged and not isinstance(stream, ImageStream):
            what = f"{stream.channel.topic}: damaged messages"
            log.note(what, f"{stream.damaged} left out, {len(stream.messages)} were found")
    frames = SeriesFrames(MessageReader(opener, container, log.files), views)
    name = container.name or path.stem
    return finalize(RecordingParts(path, file_format, calibration, frames, name=name, **sensors), log)


def _images(streams: Sequence[ImageStream], what: str, log: ReadLog, usable: Mask | None = None) -> ImageSeries:
    images = [(stream.channel, *image) for stream in streams for image in stream.images]
    if damaged := sum(stream.damaged for stream in streams):
        why = next(stream.why_damaged for stream in streams if stream.why_damaged)
        if not images:
            raise RecordingError(f"{why} (none of {damaged} {what} can be read)")
        log.note(f"{what} left out", f"{damaged} of {damaged + len(images)}; the first: {why}")
    stamps_ns, order = as_logged([image[1] for image in images], [image[2] for image in images], what, log)
    kept = usual_size([size_px for *_, size_px in images], what, log)
    if usable is not None:
        kept &= usable
    sources = tuple((channel, place) for channel, _, _, place, _ in images)
    return ImageSeries(stamps_ns, sources).take(order[kept[order]]).forward(what, log)


def _samples(streams: Sequence[Stream], what: str, log: ReadLog) -> tuple[Any, ...]:
    """The samples whose stamps increase as they arrived."""
    samples = [value for stream in streams for value in stream.values]
    stamps_ns, order = as_logged([sample.stamp_ns for _, sample in samples], [at for at, _ in samples], what, log)
    kept = order[forward_only(stamps_ns[order], what, log)].tolist()
    return tuple(replace(samples[k][1], stamp_ns=int(stamps_ns[k])) for k in kept)


def _imu(streams: Sequence[Stream], log: ReadLog) -> tuple[ImuSamples, str | None]:
    parts: list[tuple[Stamps, Array, Array, str]] = []
    log_times_ns: list[int] = []
    for stream in streams:
        try:
            parts.append(stream.container.decode_imu(stream.channel, stream.messages))
            log_times_ns += stream.log_times_ns
        except UNDECODABLE:  # one of them is damaged
            parts += [part for _, part in stream.values]
            log_times_ns += [at for at, _ in stream.values]
    if not parts:
        return ImuSamples.empty(), None
    stamps_ns, gyro, accel = (np.concatenate([part[i] for part in parts]) for i in range(3))
    stamps_ns, order = as_logged(stamps_ns, log_times_ns, "imu", log)
    return clean_imu(stamps_ns[order], gyro[order], accel[order], log), parts[0][3]


def _ground_truth(streams: Sequence[Stream], log: ReadLog) -> Trajectory | None:
    values = [value for stream in streams for value in stream.values]
    if not values:
        return None
    rows = np.stack([row for _, (_, row) in values])
    stamps_ns, order = as_logged([ns for _, (ns, _) in values], [at for at, _ in values], "ground truth", log)
    return ordering.trajectory_of_rows(stamps_ns[order], rows[order], log)


class MessageReader(ImageReader):
    """Reads the image messages of a container, which the first read opens if necessary."""

    def __init__(
        self, opener: Callable[[], Container], container: Container | None, read_files: Sequence[Path]
    ) -> None:
        super().__init__(read_files)
        self._opener, self._container = opener, container

    def read(self, source: Source, stamp_ns: int) -> StoredImage:
        channel, place = source
        where = f"{self.read_files[0]}: {channel.topic} at {stamp_ns}"
        self.check_open(where)
        try:
            if self._container is None:
                self._container = self._opener()
            image: StoredImage = self._container.decode(channel, self._container.read(place))
            return replace(image, where=where)
        except UNDECODABLE as error:
            how = "the message is damaged, leave the frame out with --frames"
            raise RecordingError(f"{where}: {error}; {how}") from error
        except OSError as error:
            fault = f"cannot be read any more ({error.strerror})"
            raise RecordingError(f"{where} {fault}; was the recording moved?") from error

    def apart(self) -> "MessageReader":
        return MessageReader(self._opener, None, self.read_files)

    def close(self) -> None:
        super().close()
        if self._container is not None:
            self._container.close()
        self._container = None
