"""A recording made of the messages in a container: topics chosen, stamps put in order, images left where they are."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.bags.calibration import (
    InfoCamera,
    calibration_of_messages,
    frames_not_optical,
    info_of_images,
    same_lens,
    setting_of,
)
from fleetmap.recordings.bags.codecs import CODECS, Codec
from fleetmap.recordings.bags.container import CALIBRATION_ATTACHMENT, Channel, Container, Place
from fleetmap.recordings.bags.topics import (
    IMAGE_TYPES,
    KNOWN_TYPES,
    choose_topics,
    info_topics,
    type_name,
    video_issues,
)
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import hash_file
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, pair_images
from fleetmap.recordings.images import StoredImage, check_image
from fleetmap.recordings.ordering import (
    DEPTH_TOLERANCE_NS,
    ReadLog,
    clean_imu,
    trajectory_of_rows,
    usual_size,
    values_forward,
    with_log_times,
)
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.ros2.messages import CameraInfo
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import ImuSamples, PositionPrior, Stamps, Trajectory, WheelSample
from fleetmap.sensors.source_settings import Topics

_LAST_NS = 2**63 - 1  # MCAP's times have a bit more
_SAME_LENS = 0.02  # of the focal length
_HEADER_BYTES = (
    12  # CDR's head and a stamp, or ROS 1's sequence number and stamp: what differs in messages that say the same
)
V = TypeVar("V")
_RECTIFIED = re.compile(
    r"(?<![a-z])rect(?![a-z])|(?<![a-z])rectified"
)  # image_rect, rect/image; not direct, image_unrect
Sample = TypeVar("Sample", WheelSample, PositionPrior)


@dataclass
class _Stream:
    """The messages of one channel with their log times: images by their place and size, everything else by its bytes.

    bad_images: how many are left out; why_bad: the reason of the first.
    """

    channel: Channel
    codec: Codec
    log_times_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    sizes_px: list[tuple[int, int]] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    lens: CameraInfo | None = None
    damaged: int = 0
    bad_images: int = 0
    why_bad: str = ""

    def __len__(self) -> int:
        return len(self.places) + self.bad_images + len(self.messages)

    def values(self, decode: Callable[[Channel, bytes], V]) -> list[tuple[int, V]]:
        """Log times and values of all messages that can be decoded; the others are counted."""
        found = []
        for log_time_ns, data in zip(self.log_times_ns, self.messages, strict=True):
            try:
                found.append((log_time_ns, decode(self.channel, data)))
            except (ValueError, AttributeError):  # a field that a schema in the file lacks
                self.damaged += 1
        return found


_Images = ImageSeries[tuple[_Stream, Place]]
_Lenses = tuple[list[CameraInfo], NDArray[np.int64]]
_MOST_LENSES = 20  # of one camera in a recording
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
        return self.like(MessageFrames(self._opener, None, self._read_files, *self.taken(indices)))

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
        except (ValueError, AttributeError) as error:
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
    lenses: dict[str, _Lenses] = {}
    if given is None and CALIBRATION_ATTACHMENT not in container.attachments:
        sides = [side for side in ("left", "right") if side in roles]
        lenses = {side: _lenses(roles[side], roles.get(f"{side}_info", ())) for side in sides}
    left = _images(roles["left"], "left images", log, lenses.get("left"))
    right = _images(roles["right"], "right images", log, lenses.get("right")) if "right" in roles else None
    depth = _images(roles["depth"], "depth images", log) if "depth" in roles else None
    if right is not None:
        (left, right), depth = pair_images(left, right, log), None
    elif depth is not None:
        left, depth = pair_images(left, depth, log, DEPTH_TOLERANCE_NS)
    calibration = given.calibration if given else _calibration(container, roles, lenses, imu_frame, log)
    if depth is not None:
        _note_unregistered(streams.values(), roles, calibration.cameras[0], log)
    wheel = _samples([v for s in roles.get("wheel", ()) for v in s.values(s.codec.wheel)], "wheel odometry", log)
    priors = _samples([v for s in roles.get("prior", ()) for v in s.values(s.codec.prior)], "position priors", log)
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
        wheel=wheel,
        priors=priors,
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
        if type_name(channel) in IMAGE_TYPES:
            if _takes_image(stream, data, f"{container.path}: {channel.topic}"):
                container.keep(0)
                stream.log_times_ns.append(min(log_time_ns, _LAST_NS))
                stream.places.append(place)
            continue
        if type_name(channel) in ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration"):
            # Lenses repeat with every image: one that says something is kept, and what differs from it
            if stream.lens is not None and data[_HEADER_BYTES:] == stream.messages[-1][_HEADER_BYTES:]:
                continue
            lens, last = _lens(stream, bytes(data)), stream.lens
            if last is not None and (lens is None or same_lens(lens, last)):
                continue
            if last is None:
                stream.messages, stream.log_times_ns = [], []
            stream.lens = lens
        container.keep(len(data))
        stream.log_times_ns.append(min(log_time_ns, _LAST_NS))
        stream.messages.append(bytes(data))
    return streams, list(unused.values())


def _takes_image(stream: _Stream, data: memoryview, topic: str) -> bool:
    """Whether a message is a whole image, whose stamp and size the stream then has; else it keeps the reason."""
    try:
        stamp_ns = stream.codec.stamp_ns(stream.channel, data)
        size_px = check_image(stream.codec.image(stream.channel, bytes(data), f"{topic} at {stamp_ns}"))
    except (ValueError, AttributeError, RecordingError) as error:
        stream.bad_images += 1
        stream.why_bad = stream.why_bad or (
            str(error) if isinstance(error, RecordingError) else f"{topic}: {error}; the message is damaged"
        )
        return False
    stream.stamps_ns.append(stamp_ns)
    stream.sizes_px.append(size_px)
    return True


def _lens(stream: _Stream, data: bytes) -> CameraInfo | None:
    """The lens of a CameraInfo; None where it says nothing: uncalibrated drivers send zeros, others at their start."""
    try:
        info = stream.codec.camera_info(stream.channel, data)
    except (ValueError, AttributeError):
        return None
    return info if info.matrix[0, 0] > 0 else None


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


def _lenses(images: Sequence[_Stream], streams: Sequence[_Stream]) -> _Lenses:
    """All lenses that CameraInfo tells, each once, and the number of the one that each image (N,) was taken with.

    CalibrationError where they never end, as of a lens that focuses by itself.
    """
    told = [
        (stream.codec.stamp_ns(stream.channel, memoryview(stream.messages[row])) or log_time_ns, info)
        for stream in streams
        for row, (log_time_ns, info) in enumerate(stream.values(stream.codec.camera_info))
    ]
    told = sorted((each for each in told if each[1].matrix[0, 0] > 0), key=lambda each: each[0])
    lenses: list[CameraInfo] = []
    numbers: list[int] = []
    for _, info in told:
        number = next((n for n, lens in enumerate(lenses) if same_lens(lens, info)), len(lenses))
        numbers.append(number)
        lenses += [info] if number == len(lenses) else []
        if len(lenses) > _MOST_LENSES:
            raise CalibrationError(
                f"{streams[0].channel.topic} tells more than {_MOST_LENSES} lenses, from {setting_of(lenses[0])} to "
                f"{setting_of(info)}; a map needs one: switch off zoom and autofocus, or pass a calibration with --calibration FILE"
            )
    stamps_ns = [stamp_ns for stream in images for stamp_ns in stream.stamps_ns]
    if not numbers:
        return lenses, np.zeros(len(stamps_ns), np.int64)
    rows = np.searchsorted([stamp_ns for stamp_ns, _ in told], stamps_ns, side="right") - 1
    return lenses, np.array(numbers)[np.maximum(rows, 0)]


def _usual_lens(lenses: _Lenses) -> int:
    """The number of the lens of most images."""
    return int(np.bincount(lenses[1]).argmax())


def _of_usual_lens(lenses: _Lenses, what: str, log: ReadLog) -> NDArray[np.bool_]:
    """(N,) mask of the images with the lens of most; the others are noted in `log`."""
    infos, numbers = lenses
    kept = np.asarray(numbers == _usual_lens(lenses))
    if not kept.all():
        other = infos[int(numbers[~kept][0])]
        log.note(
            f"{what}: the CameraInfo changes",
            f"{int((~kept).sum())} of {len(kept)} left out, which have {setting_of(other)}; {setting_of(infos[_usual_lens(lenses)])} is "
            "used: keep zoom, focus, binning and roi as they are while you record",
        )
    return kept


def _images(streams: Sequence[_Stream], what: str, log: ReadLog, lenses: _Lenses | None = None) -> _Images:
    bad, why = sum(stream.bad_images for stream in streams), next((s.why_bad for s in streams if s.why_bad), "")
    stamps_ns = np.array([stamp for stream in streams for stamp in stream.stamps_ns], np.int64)
    log_times_ns = np.array([stamp for stream in streams for stamp in stream.log_times_ns], np.int64)
    if bad and not len(stamps_ns):
        raise RecordingError(f"{why} (none of {bad} {what} can be read)")
    if bad:
        log.note(f"{what} left out", f"{bad} of {bad + len(stamps_ns)}; the first: {why}")
    sources = tuple(
        (bare, place)
        for stream in streams
        for bare in [_Stream(stream.channel, stream.codec)]
        for place in stream.places
    )
    images = _Images(with_log_times(stamps_ns, log_times_ns, what, log), sources)
    usual = usual_size([size for stream in streams for size in stream.sizes_px], what, log)
    if lenses is not None:
        usual &= _of_usual_lens(lenses, what, log)
    return images.take(np.flatnonzero(usual)).forward(what, log)


def _samples(samples: Sequence[tuple[int, Sample]], what: str, log: ReadLog) -> tuple[Sample, ...]:
    """The samples, with their log times, whose stamps increase."""
    stamps_ns = np.array([sample.stamp_ns for _, sample in samples], np.int64)
    stamps_ns = with_log_times(stamps_ns, np.array([at for at, _ in samples], np.int64), what, log)
    stamped = [replace(sample, stamp_ns=int(s)) for (_, sample), s in zip(samples, stamps_ns, strict=True)]
    return values_forward(stamped, stamps_ns.tolist(), what, log)


def _imu(streams: Sequence[_Stream], log: ReadLog) -> tuple[ImuSamples, str | None]:
    parts: list[tuple[Stamps, NDArray[np.float64], NDArray[np.float64], str]] = []
    log_times_ns: list[int] = []
    for stream in streams:
        codec = stream.codec
        try:
            parts.append(codec.imu(stream.channel, stream.messages))
            log_times_ns += stream.log_times_ns
        except ValueError:
            singly = stream.values(lambda channel, data, codec=codec: codec.imu(channel, [data]))  # type: ignore[misc]
            parts += [part for _, part in singly]
            log_times_ns += [at for at, _ in singly]
    if not parts:
        return ImuSamples.empty(), None
    stamps_ns, gyro, accel = (np.concatenate([part[i] for part in parts]) for i in range(3))
    stamps_ns = with_log_times(stamps_ns.astype(np.int64), np.array(log_times_ns, np.int64), "imu", log)
    return clean_imu(stamps_ns, gyro, accel, log), parts[0][3]


def _ground_truth(streams: Sequence[_Stream], log: ReadLog) -> Trajectory | None:
    rows = [value for stream in streams for value in stream.values(stream.codec.pose)]
    if not rows:
        return None
    stamps_ns, log_times_ns = (
        np.array(column, np.int64) for column in zip(*((s, at) for at, (s, _) in rows), strict=True)
    )
    stamps_ns = with_log_times(stamps_ns, log_times_ns, "ground truth", log)
    return trajectory_of_rows(stamps_ns, np.stack([row for _, (_, row) in rows]), log)


def _note_unregistered(streams: Iterable[_Stream], roles: _Roles, camera: CameraCalibration, log: ReadLog) -> None:
    """Notes a depth topic with a CameraInfo of its own that is not the left camera's: its pixels are others."""
    left, depth = (roles[role][0].channel.topic for role in ("left", "depth"))
    beside = [stream for stream in streams if stream.channel.topic in info_topics(depth)]
    fx, _, cx, cy = camera.intrinsics_px
    for info in [info for stream in beside for _, info in stream.values(stream.codec.camera_info)][:1]:
        own = np.array([info.matrix[0, 0], info.matrix[0, 2], info.matrix[1, 2]])
        if info.matrix.any() and np.abs(own - [fx, cx, cy]).max() > _SAME_LENS * fx:
            log.note(
                "depth not registered",
                f"{depth} has a lens of its own (fx cx cy {np.round(own, 1).tolist()}), not that of {left} ({fx:.1f}, {cx:.1f}, "
                f"{cy:.1f}): record depth that is aligned to {left}, or name it with --topic depth=/NAME",
            )


def _calibration(
    container: Container, roles: _Roles, lenses: Mapping[str, _Lenses], imu_frame: str | None, log: ReadLog
) -> RigCalibration:
    attached = container.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is not None:
        where = f"{container.path}: attachment {CALIBRATION_ATTACHMENT}"
        return parse_calibration(attached.decode("utf-8", "replace"), where).calibration
    cameras = []
    for side, (infos, numbers) in lenses.items():
        image_topic = roles[side][0].channel.topic
        if not infos and not any(len(stream) > stream.damaged for stream in roles.get(f"{side}_info", ())):
            raise CalibrationError(
                f"{container.path}: no CameraInfo beside {image_topic} says what its lens is; pass a calibration with "
                "--calibration FILE"
            )
        if not infos:
            raise CalibrationError(
                f"{container.path}: every CameraInfo beside {image_topic} holds zeros, as drivers without a calibration send it; "
                "calibrate the camera, or pass a calibration with --calibration FILE"
            )
        usual = _usual_lens((infos, numbers))
        sizes_px = [size for stream in roles[side] for size in stream.sizes_px]
        size_px = Counter(size for size, n in zip(sizes_px, numbers, strict=True) if n == usual).most_common(1)[0][0]
        info = info_of_images(infos[usual], size_px, f"{container.path}: {image_topic}")
        if info.binning != (1, 1) or info.roi[:2] != (0, 0):
            told = f"{setting_of(info)}, of images of just that size; the calibration is used as it is"
            log.note("binning or roi not used", f"the CameraInfo beside {image_topic} says {told}")
        cameras.append(InfoCamera(info, bool(_RECTIFIED.search(image_topic.lower()))))
    streams = roles.get("tf_static", ())
    links = [link for stream in streams for _, found in stream.values(stream.codec.links) for link in found]
    for issue in dict.fromkeys(link_issue for link in links if (link_issue := link.issue)):
        log.note("transform not sound", issue)
    for words in frames_not_optical(cameras, links):
        log.note("camera frame not optical", words)
    return calibration_of_messages(cameras, links, imu_frame, str(container.path))
