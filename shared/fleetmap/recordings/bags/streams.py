"""A recording made of the messages in a container: topics chosen, stamps put in order, images left where they are."""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.bags.calibration import InfoCamera, calibration_of_messages
from fleetmap.recordings.bags.codecs import CODECS, Codec
from fleetmap.recordings.bags.container import CALIBRATION_ATTACHMENT, Channel, Container, Place
from fleetmap.recordings.bags.topics import IMAGE_TYPES, KNOWN_TYPES, choose_topics, type_name, video_issues
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import hash_file
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, pair_images
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ordering import DEPTH_TOLERANCE_NS, ReadLog, clean_imu, trajectory_of_rows, values_forward
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import ImuSamples, Stamps, Trajectory
from fleetmap.sensors.source_settings import Topics

V = TypeVar("V")
_RECTIFIED = re.compile(
    r"(?<![a-z])rect(?![a-z])|(?<![a-z])rectified"
)  # image_rect, rect/image; not direct, image_unrect


@dataclass
class _Stream:
    """The messages of one channel: images by their place, everything else by its bytes."""

    channel: Channel
    codec: Codec
    stamps_ns: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    damaged: int = 0

    def __len__(self) -> int:
        return len(self.places) + len(self.messages)

    def values(self, decode: Callable[[Channel, bytes], V]) -> list[V]:
        """All messages that can be decoded; the others are counted."""
        found = []
        for data in self.messages:
            try:
                found.append(decode(self.channel, data))
            except ValueError:
                self.damaged += 1
        return found


_Images = ImageSeries[tuple[_Stream, Place]]
_Roles = Mapping[str, list[_Stream]]  # the streams by the role that `choose_topics` gives their topic


def open_messages(path: Path, file_format: str, opener: Callable[[], Container], options: OpenOptions) -> Recording:
    """The recording at `path`, whose messages `opener` gives access to, as far as they are whole; its issues say what is not.

    opener: can be pickled; part of the frames may be read in another process.
    """
    given = calibration_of_options(options)
    container = opener()
    try:
        parts, log = _parts(container, opener, options, given)
        return finalize(replace(parts, path=path, format=file_format, name=parts.name or path.stem), log)
    except BaseException:
        container.close()
        raise


class MessageFrames(SeriesFrames[tuple[_Stream, Place]]):
    """A FrameSource over the image messages of an open container, or of one that the first read opens.

    `read_files`: the files that the content's hash covers, the recording first.
    """

    def __init__(
        self,
        opener: Callable[[], Container],
        container: Container | None,
        read_files: Sequence[Path],
        left: _Images,
        right: _Images | None = None,
        depth: _Images | None = None,
    ) -> None:
        super().__init__(self._image, left, right, depth)
        self._opener, self._container, self._read_files = opener, container, read_files
        self._is_closed = False

    def part(self, indices: NDArray[np.int64]) -> "MessageFrames":
        """See FrameSource."""
        return MessageFrames(self._opener, None, self._read_files, *self.taken(indices))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """The bytes of the recording's files, then those of the calibration file where one was given."""
        for path in self._read_files:
            hash_file(path, digest)

    def close(self) -> None:
        """Closes the container."""
        if self._container is not None:
            self._container.close()
        self._container, self._is_closed = None, True

    def _image(self, source: tuple[_Stream, Place], stamp_ns: int) -> StoredImage:
        stream, place = source
        where = f"{self._read_files[0]}: {stream.channel.topic} at {stamp_ns}"
        if self._is_closed:
            raise RecordingError(
                f"{where} was asked for after the recording was closed; keep it open while frames are read"
            )
        try:
            if self._container is None:
                self._container = self._opener()
            return stream.codec.image(stream.channel, self._container.read(place), where)
        except ValueError as error:
            raise RecordingError(
                f"{where}: {error}; the message is damaged, leave the frame out with --frames"
            ) from error
        except OSError as error:
            raise RecordingError(
                f"{where} cannot be read any more ({error.strerror}); was the recording moved?"
            ) from error


def _parts(
    container: Container, opener: Callable[[], Container], options: OpenOptions, given: CalibrationFile | None
) -> tuple[RecordingParts, ReadLog]:
    streams, others = _collect(container, options.topics)
    channels = [stream.channel for stream in streams.values() if len(stream)]
    log = ReadLog([*container.issues(), *video_issues(others)], list(container.files))
    if not channels:
        issues = "; ".join(f"{issue.what}: {issue.detail}" for issue in log.issues)
        damaged = sum(stream.damaged for stream in streams.values())
        issues = issues or (f"{damaged} damaged messages" if damaged else "")
        there = ", ".join(f"{c.topic} ({type_name(c)} in {c.message_encoding or 'no encoding'})" for c in others[:8])
        known = f"; known encodings are {', '.join(CODECS)}" if others else ""
        raise RecordingError(
            f"{container.path} holds no message that can be read ({issues or there or 'it is empty'}{known})"
        )
    topics = _with_hints(options.topics, given, {channel.topic for channel in channels})
    chosen = choose_topics(channels, topics, str(container.path), log)
    roles = {role: [streams[channel_id] for channel_id in ids] for role, ids in chosen.items()}
    imu, imu_frame = _imu(roles.get("imu", ()), log)
    left = _images(roles["left"], "left images", log)
    right = _images(roles["right"], "right images", log) if "right" in roles else None
    depth = _images(roles["depth"], "depth images", log) if "depth" in roles else None
    if right is not None:
        (left, right), depth = pair_images(left, right, log), None
    elif depth is not None:
        left, depth = pair_images(left, depth, log, DEPTH_TOLERANCE_NS)
    calibration = given.calibration if given else _calibration(container, roles, right is not None, imu_frame)
    wheel = [v for stream in roles.get("wheel", ()) for v in stream.values(stream.codec.wheel)]
    priors = [v for stream in roles.get("prior", ()) for v in stream.values(stream.codec.prior)]
    ground_truth = _ground_truth(roles.get("ground_truth", ()), log)
    for stream in streams.values():
        if stream.damaged:
            what = f"{stream.channel.topic}: damaged messages"
            log.note(what, f"{stream.damaged} left out, {len(stream)} were found")
    if options.calibration_file is not None:
        log.files.append(options.calibration_file)
    parts = RecordingParts(
        path=container.path,
        name=container.name,
        format="",
        calibration=calibration,
        frame_stamps_ns=left.stamps_ns,
        frames=MessageFrames(opener, container, log.files, left, right, depth),
        has_right=right is not None,
        has_depth=depth is not None,
        imu=imu,
        wheel=values_forward(wheel, [sample.stamp_ns for sample in wheel], "wheel odometry", log),
        priors=values_forward(priors, [prior.stamp_ns for prior in priors], "position priors", log),
        ground_truth=ground_truth,
    )
    return parts, log


def _collect(container: Container, topics: Topics) -> tuple[dict[int, _Stream], list[Channel]]:
    """The streams of all channels whose messages may be needed, and the other channels."""
    streams: dict[int, _Stream] = {}
    codecs: dict[str, Codec] = {}
    unused: dict[int, Channel] = {}
    for channel, log_time_ns, place, data in container.messages():
        stream = streams.get(channel.id)
        if stream is None:
            if channel.id in unused or not _may_be_needed(channel, topics):
                unused[channel.id] = channel
                continue
            encoding = channel.message_encoding
            codec = codecs.setdefault(encoding, CODECS[encoding]())
            stream = streams[channel.id] = _Stream(channel, codec)
        if type_name(channel) not in IMAGE_TYPES:
            # Lenses repeat with every image, one is enough
            if not (stream.messages and type_name(channel) in ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")):
                container.keep(len(data))
                stream.messages.append(bytes(data))
            continue
        try:
            stamp_ns = stream.codec.stamp_ns(channel, data) or log_time_ns
        except ValueError:
            stream.damaged += 1
            continue
        container.keep(0)
        stream.stamps_ns.append(stamp_ns)
        stream.places.append(place)
    return streams, list(unused.values())


def _may_be_needed(channel: Channel, topics: Topics) -> bool:
    if channel.message_encoding not in CODECS or type_name(channel) not in KNOWN_TYPES:
        return False
    return channel.topic == topics.tf_static or "Transform" not in type_name(channel).replace("TFMessage", "Transform")


def _with_hints(topics: Topics, given: CalibrationFile | None, present: set[str]) -> Topics:
    """The wanted topics, with those that a Kalibr file notes where they exist and the caller asked for no other."""
    if given is None:
        return topics
    defaults, changes = Topics(), {}
    for part, key in (("left", "cam0"), ("right", "cam1"), ("imu", "imu0")):
        hint = given.topics.get(key, "")
        is_asked_for = getattr(topics, part) != getattr(defaults, part)
        if hint in present and not is_asked_for:
            changes[part] = hint
    return msgspec.structs.replace(topics, **changes)


def _images(streams: Sequence[_Stream], what: str, log: ReadLog) -> _Images:
    stamps_ns = np.array([stamp for stream in streams for stamp in stream.stamps_ns], np.int64)
    sources = tuple(
        (bare, place)
        for stream in streams
        for bare in [_Stream(stream.channel, stream.codec)]
        for place in stream.places
    )
    return _Images(stamps_ns, sources).forward(what, log)


def _imu(streams: Sequence[_Stream], log: ReadLog) -> tuple[ImuSamples, str | None]:
    parts: list[tuple[Stamps, NDArray[np.float64], NDArray[np.float64], str]] = []
    for stream in streams:
        codec = stream.codec
        try:
            parts.append(codec.imu(stream.channel, stream.messages))
        except ValueError:
            parts += stream.values(lambda channel, data, codec=codec: codec.imu(channel, [data]))  # type: ignore[misc]
    if not parts:
        return ImuSamples.empty(), None
    stamps_ns, gyro, accel = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return clean_imu(stamps_ns.astype(np.int64), gyro, accel, log), parts[0][3]


def _ground_truth(streams: Sequence[_Stream], log: ReadLog) -> Trajectory | None:
    rows = [value for stream in streams for value in stream.values(stream.codec.pose)]
    if not rows:
        return None
    stamps_ns = np.array([stamp for stamp, _ in rows], np.int64)
    return trajectory_of_rows(stamps_ns, np.stack([row for _, row in rows]), log)


def _calibration(container: Container, roles: _Roles, has_right: bool, imu_frame: str | None) -> RigCalibration:
    attached = container.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is not None:
        where = f"{container.path}: attachment {CALIBRATION_ATTACHMENT}"
        return parse_calibration(attached.decode("utf-8", "replace"), where).calibration
    cameras = []
    for role in ("left", "right") if has_right else ("left",):
        streams, image_topic = roles.get(f"{role}_info", ()), roles[role][0].channel.topic
        infos = [info for stream in streams for info in stream.values(stream.codec.camera_info)]
        if not infos:
            raise CalibrationError(
                f"{container.path}: no CameraInfo beside {image_topic} says what its lens is; pass a calibration with "
                "--calibration FILE"
            )
        cameras.append(InfoCamera(infos[0], bool(_RECTIFIED.search(image_topic.lower()))))
    streams = roles.get("tf_static", ())
    links = [link for stream in streams for found in stream.values(stream.codec.links) for link in found]
    return calibration_of_messages(cameras, links, imu_frame, str(container.path))
