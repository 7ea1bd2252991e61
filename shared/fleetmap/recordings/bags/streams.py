"""Building of a recording from the messages in a container: chooses topics, orders stamps, leaves images in the file."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.bags.calibration import (
    InfoCamera,
    calibration_of_messages,
    camera_poses,
    frames_not_optical,
    info_of_images,
    last_links,
    same_lens,
    setting_of,
)
from fleetmap.recordings.bags.container import CALIBRATION_ATTACHMENT, Channel, Container, Place
from fleetmap.recordings.bags.decoders import ENCODINGS, UNDECODABLE, decode, decode_imu, stamp_of
from fleetmap.recordings.bags.topics import (
    IMAGE_TYPES,
    INFO_TYPES,
    KNOWN_TYPES,
    TF_TYPES,
    choose_topics,
    info_topics,
    note_videos,
    transports,
)
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.files import hash_file
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize, image_parts
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, ViewSeries, pair_images, rig_images
from fleetmap.recordings.images import StoredImage, check_image
from fleetmap.recordings.ordering import (
    DEPTH_TOLERANCE_NS,
    ReadLog,
    as_logged,
    clean_imu,
    trajectory_of_rows,
    usual_size,
    values_forward,
)
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.ros2.messages import CameraInfo
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import ImuSamples, Stamps, Trajectory
from fleetmap.sensors.source_settings import CAMERA_ROLES, Topics

_LAST_NS = 2**63 - 1  # MCAP's times have a bit more
_SAME_LENS = 0.02  # of the focal length
_MOST_LENSES = 20  # of one camera in a recording
_HEADER_BYTES = (
    12  # CDR's head and a stamp, or ROS 1's sequence number and stamp: the difference between messages of equal content
)
_RECTIFIED = re.compile(r"(?<![a-z])(rect(?![a-z])|rectified)")  # image_rect, rect/image; not direct, image_unrect
_Source = tuple[Channel, Place]
_Images = ImageSeries[_Source]


@dataclass(eq=False)
class _Stream:
    """The messages of one channel with their log times: images by their place and size, everything else by its bytes.

    damaged: number of messages left out; why_damaged: the reason for the first image.
    """

    channel: Channel
    log_times_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    sizes_px: list[tuple[int, int]] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    lens: CameraInfo | None = None
    damaged: int = 0
    why_damaged: str = ""

    @property
    def is_of_images(self) -> bool:
        return self.channel.type_name in IMAGE_TYPES

    @cached_property
    def values(self) -> list[tuple[int, Any]]:
        """Log times and values of all messages that can be decoded; the others are counted."""
        found = []
        for log_time_ns, data in zip(self.log_times_ns, self.messages, strict=True):
            try:
                found.append((log_time_ns, decode(self.channel, data)))
            except UNDECODABLE:
                self.damaged += 1
        return found


@dataclass(frozen=True)
class _Lenses:
    """The distinct lenses of the CameraInfo messages, and the lens number of each image (N,)."""

    infos: list[CameraInfo]
    numbers: NDArray[np.int64]

    @property
    def usual(self) -> int:
        """Number of the lens of most images."""
        return int(np.bincount(self.numbers).argmax())


_Roles = Mapping[str, list[_Stream]]  # streams by the role that `choose_topics` assigns to their topic


def open_messages(path: Path, file_format: str, opener: Callable[[], Container], options: OpenOptions) -> Recording:
    """Open the recording at `path` through the container that `opener` opens; its issues list unreadable messages.

    opener: must be picklable, because other processes may read part of the frames.
    """
    log = ReadLog()
    given = calibration_of_options(options, log)
    container = opener()
    try:
        parts = _parts(container, opener, options, given, log)
        return finalize(replace(parts, path=path, format=file_format, name=parts.name or path.stem), log)
    except BaseException:
        container.close()
        raise


class MessageReader:
    """An ImageReader of the image messages of a container, which the first read opens if necessary.

    read_files: files covered by the content's hash, the recording first.
    """

    def __init__(
        self, opener: Callable[[], Container], container: Container | None, read_files: Sequence[Path]
    ) -> None:
        self._opener, self._container, self._read_files = opener, container, read_files
        self._is_closed = False

    def read(self, source: _Source, stamp_ns: int) -> StoredImage:
        channel, place = source
        where = f"{self._read_files[0]}: {channel.topic} at {stamp_ns}"
        if self._is_closed:
            raise RecordingError(
                f"{where} was asked for after the recording was closed; keep it open while frames are read"
            )
        try:
            if self._container is None:
                self._container = self._opener()
            image: StoredImage = decode(channel, self._container.read(place))
            return replace(image, where=where)
        except UNDECODABLE as error:
            raise RecordingError(
                f"{where}: {error}; the message is damaged, leave the frame out with --frames"
            ) from error
        except OSError as error:
            raise RecordingError(
                f"{where} cannot be read any more ({error.strerror}); was the recording moved?"
            ) from error

    def apart(self) -> "MessageReader":
        return MessageReader(self._opener, None, self._read_files)

    def hash_into(self, digest: "hashlib._Hash", images: list[_Source]) -> None:
        """Hash the bytes of the recording's files, then those of the calibration file if one was given."""
        for path in self._read_files:
            hash_file(path, digest)

    def close(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container, self._is_closed = None, True


def _parts(
    container: Container,
    opener: Callable[[], Container],
    options: OpenOptions,
    given: CalibrationFile | None,
    log: ReadLog,
) -> RecordingParts:
    streams, others = _collect(container, options.topics, log)
    log.issues += container.issues
    note_videos(others, log)
    log.files[:0] = container.files
    channels = [stream.channel for stream in streams if stream.messages or stream.is_of_images]
    if not channels:
        there = ", ".join(f"{c.topic} ({c.type_name} in {c.encoding or 'no encoding'})" for c in others[:8])
        known = f"; known encodings are {', '.join(ENCODINGS)}" if others else ""
        why = f"{log.told() or there or 'it is empty'}{known}"
        raise RecordingError(f"{container.path} holds no message that can be read ({why})")
    topics = _with_hints(options.topics, given, {channel.topic for channel in channels})
    chosen = choose_topics(channels, topics, str(container.path), log)
    by_id = {stream.channel.id: stream for stream in streams}
    roles = {role: [by_id[channel.id] for channel in chosen[role]] for role in chosen}
    imu, imu_frame = _imu(roles.get("imu", ()), log)
    lenses: dict[str, _Lenses] = {}
    if given is None and CALIBRATION_ATTACHMENT not in container.attachments:
        sides = [side for side in (CAMERA_ROLES[:2] if "depth" in roles else CAMERA_ROLES) if side in roles]
        lenses = {side: _lenses(roles[side], roles.get(f"{side}_info", ())) for side in sides}
        for side in [side for side in sides[1:] if not lenses[side].infos and side not in CAMERA_ROLES[:2]]:
            log.note(
                "camera without a lens",
                f"{side}: no CameraInfo beside {roles[side][0].channel.topic}; its images are not used",
            )
            del lenses[side]
    left = _images(roles["left"], "left images", log, lenses.get("left"))
    right = _images(roles["right"], "right images", log, lenses.get("right")) if "right" in roles else None
    depth = _images(roles["depth"], "depth images", log) if "depth" in roles else None
    if right is not None:
        depth = None
    elif depth is not None:
        left, depth = pair_images(left, depth, log, DEPTH_TOLERANCE_NS)
    described: tuple[str, ...] = CAMERA_ROLES
    if given:
        calibration = given.calibration
    else:
        calibration, described = _calibration(container, roles, lenses, imu_frame, log)
    views = tuple[ViewSeries[_Source], ...]()
    if depth is None and len(calibration.cameras) > 1:
        read = {"left": left, "right": right}
        cameras = {
            n: (
                f"{role} ({roles[role][0].channel.topic})",
                read.get(role) or _images(roles[role], f"{role} images", log, lenses.get(role)),
            )
            for n, role in enumerate(described[: len(calibration.cameras)])
            if role in roles
        }
        if not given and CALIBRATION_ATTACHMENT not in container.attachments:
            marked = zip(calibration.cameras, described, strict=False)
            marked_cameras = tuple(replace(camera, has_depth=f"{role}_depth" in roles) for camera, role in marked)
            calibration = replace(calibration, cameras=marked_cameras)
        depths = {
            n: _images(roles[f"{described[n]}_depth"], f"depth images of cam{n}", log)
            for n in cameras
            if calibration.cameras[n].has_depth and f"{described[n]}_depth" in roles
        }
        calibration, (left, right, _), views = rig_images(calibration, cameras, log, depths)
    elif right is not None:
        left, right = pair_images(left, right, log)
    if depth is not None:
        beside = [role for role in CAMERA_ROLES[2:] if role in roles]
        if beside:
            how = "let a stereo pair be left and right, and the depth camera cam2, with its depth on cam2_depth"
            log.note(
                "images not used", f"{', '.join(beside)}: beside a depth camera as first view no other is used; {how}"
            )
        _note_unregistered(streams, roles, calibration.cameras[0], log)
    wheel = _samples(roles.get("wheel", ()), "wheel odometry", log)
    priors = _samples(roles.get("prior", ()), "position priors", log)
    ground_truth = _ground_truth(roles.get("ground_truth", ()), log)
    for stream in streams:
        if stream.damaged and not stream.is_of_images:
            what = f"{stream.channel.topic}: damaged messages"
            log.note(what, f"{stream.damaged} left out, {len(stream.messages)} were found")
    frames = SeriesFrames(MessageReader(opener, container, log.files), left, right, depth, others=views)
    sensors = {"imu": imu, "wheel": wheel, "priors": priors, "ground_truth": ground_truth}
    return image_parts(container.path, "", calibration, frames, name=container.name, **sensors)


def _collect(container: Container, topics: Topics, log: ReadLog) -> tuple[list[_Stream], list[Channel]]:
    """Collect the streams of all channels that may be needed, and the other channels."""
    streams: dict[int, _Stream] = {}
    unused: dict[int, Channel] = {}
    for channel, logged_ns, place, data in container.messages():
        if channel.id in unused:
            continue
        stream = streams.get(channel.id)
        if stream is None:
            is_known = channel.encoding in ENCODINGS and channel.type_name in KNOWN_TYPES
            is_other_tf = channel.type_name in TF_TYPES and channel.topic != topics.tf_static
            if is_other_tf or not is_known:
                unused[channel.id] = channel
                continue
            stream = streams[channel.id] = _Stream(channel)
        if stream.is_of_images:
            if not _takes_image(stream, bytes(data), f"{container.path}: {channel.topic}", log):
                continue
            container.keep(0)
            stream.places.append(place)
        else:
            if channel.type_name in INFO_TYPES and not _takes_lens(stream, bytes(data)):
                continue
            container.keep(len(data))
            stream.messages.append(bytes(data))
        stream.log_times_ns.append(min(logged_ns, _LAST_NS))
    return list(streams.values()), list(unused.values())


def _takes_image(stream: _Stream, data: bytes, topic: str, log: ReadLog) -> bool:
    """Add an image with stamp and size to the stream if it is whole and return True; else keep the reason."""
    stamp_ns = None
    try:
        stamp_ns = stamp_of(stream.channel, data)
        image: StoredImage = decode(stream.channel, data)
        size_px = check_image(replace(image, where=f"{topic} at {stamp_ns}"))
    except (*UNDECODABLE, RecordingError) as error:
        stream.damaged += 1
        why = str(error) if isinstance(error, RecordingError) else f"{topic}: {error}; the message is damaged"
        stream.why_damaged = stream.why_damaged or why
        log.damaged_ns += [stamp_ns] if stamp_ns else []
        return False
    stream.stamps_ns.append(stamp_ns)
    stream.sizes_px.append(size_px)
    return True


def _takes_lens(stream: _Stream, data: bytes) -> bool:
    """Keep a CameraInfo and return True if it differs from the previous one; lenses repeat with every image.

    Before the first valid lens only the latest is kept: uncalibrated drivers send zeros, others do so at their start.
    """
    if stream.lens is not None and data[_HEADER_BYTES:] == stream.messages[-1][_HEADER_BYTES:]:
        return False
    try:
        info: CameraInfo = decode(stream.channel, data)
        lens = info if info.matrix[0, 0] > 0 else None
    except UNDECODABLE:
        lens = None
    if stream.lens is None:
        stream.messages, stream.log_times_ns = [], []
    elif lens is None or same_lens(lens, stream.lens):
        return False
    stream.lens = lens
    return True


def _with_hints(topics: Topics, given: CalibrationFile | None, present: set[str]) -> Topics:
    """The wanted topics, completed by those noted in a Kalibr file if they exist and the caller chose no other."""
    changes = {}
    for role, key in (*((role, f"cam{number}") for number, role in enumerate(CAMERA_ROLES)), ("imu", "imu0")):
        hint = given.topics.get(key, "") if given else ""
        bases = [hint, hint.removesuffix("/compressed"), f"{hint}/image_raw"] if hint else []
        named = next((base for base in bases if present.intersection(transports(base, role))), None)
        if named and getattr(topics, role) == getattr(Topics(), role):
            changes[role] = named
    return msgspec.structs.replace(topics, **changes)


def _lenses(images: Sequence[_Stream], streams: Sequence[_Stream]) -> _Lenses:
    """CalibrationError if the number of lenses keeps growing, as with autofocus."""
    told: list[tuple[int, CameraInfo]] = [
        (info.stamp_ns or log_time_ns, info)
        for stream in streams
        for log_time_ns, info in stream.values
        if info.matrix[0, 0] > 0
    ]
    told.sort(key=lambda each: each[0])
    infos: list[CameraInfo] = []
    numbers: list[int] = []
    for _, info in told:
        number = next((n for n, lens in enumerate(infos) if same_lens(lens, info)), len(infos))
        numbers.append(number)
        if number == len(infos):
            infos.append(info)
        if len(infos) > _MOST_LENSES:
            raise CalibrationError(
                f"{streams[0].channel.topic} describes more than {_MOST_LENSES} lenses, from {setting_of(infos[0])} to "
                f"{setting_of(info)}; a map needs one: switch off zoom and autofocus, or pass a calibration with --calibration FILE"
            )
    stamps_ns = [stamp_ns for stream in images for stamp_ns in stream.stamps_ns]
    if not numbers:
        return _Lenses(infos, np.zeros(len(stamps_ns), np.int64))
    rows = np.searchsorted([stamp_ns for stamp_ns, _ in told], stamps_ns, side="right") - 1
    return _Lenses(infos, np.array(numbers)[np.maximum(rows, 0)])


def _images(streams: Sequence[_Stream], what: str, log: ReadLog, lenses: _Lenses | None = None) -> _Images:
    damaged = sum(stream.damaged for stream in streams)
    sources = tuple((stream.channel, place) for stream in streams for place in stream.places)
    if damaged:
        why = next(stream.why_damaged for stream in streams if stream.why_damaged)
        if not sources:
            raise RecordingError(f"{why} (none of {damaged} {what} can be read)")
        log.note(f"{what} left out", f"{damaged} of {damaged + len(sources)}; the first: {why}")
    sent, logged = chain(*(s.stamps_ns for s in streams)), chain(*(s.log_times_ns for s in streams))
    stamps_ns, order = as_logged(list(sent), list(logged), what, log)
    kept = usual_size([size for stream in streams for size in stream.sizes_px], what, log)
    if lenses is not None and not (of_usual := np.asarray(lenses.numbers == lenses.usual)).all():
        kept &= of_usual
        log.note(
            f"{what}: the CameraInfo changes",
            f"{int((~of_usual).sum())} of {len(kept)} left out, which have {setting_of(lenses.infos[int(lenses.numbers[~of_usual][0])])}; "
            f"{setting_of(lenses.infos[lenses.usual])} is used: keep zoom, focus, binning and roi as they are while you record",
        )
    return ImageSeries(stamps_ns, sources).take(order[kept[order]]).forward(what, log)


def _samples(streams: Sequence[_Stream], what: str, log: ReadLog) -> tuple[Any, ...]:
    """The samples whose stamps increase as they arrived."""
    samples = [value for stream in streams for value in stream.values]
    stamps_ns, order = as_logged([sample.stamp_ns for _, sample in samples], [at for at, _ in samples], what, log)
    stamped = [replace(samples[k][1], stamp_ns=int(stamps_ns[k])) for k in order.tolist()]
    return values_forward(stamped, [sample.stamp_ns for sample in stamped], what, log)


def _imu(streams: Sequence[_Stream], log: ReadLog) -> tuple[ImuSamples, str | None]:
    parts: list[tuple[Stamps, Array, Array, str]] = []
    log_times_ns: list[int] = []
    for stream in streams:
        try:
            parts.append(decode_imu(stream.channel, stream.messages))
            log_times_ns += stream.log_times_ns
        except UNDECODABLE:  # one of them is damaged
            parts += [part for _, part in stream.values]
            log_times_ns += [at for at, _ in stream.values]
    if not parts:
        return ImuSamples.empty(), None
    stamps_ns, gyro, accel = (np.concatenate([part[i] for part in parts]) for i in range(3))
    stamps_ns, order = as_logged(stamps_ns, log_times_ns, "imu", log)
    return clean_imu(stamps_ns[order], gyro[order], accel[order], log), parts[0][3]


def _ground_truth(streams: Sequence[_Stream], log: ReadLog) -> Trajectory | None:
    values = [value for stream in streams for value in stream.values]
    if not values:
        return None
    rows = np.stack([row for _, (_, row) in values])
    stamps_ns, order = as_logged([ns for _, (ns, _) in values], [at for at, _ in values], "ground truth", log)
    return trajectory_of_rows(stamps_ns[order], rows[order], log)


def _note_unregistered(streams: Iterable[_Stream], roles: _Roles, camera: CameraCalibration, log: ReadLog) -> None:
    """Note a depth topic whose CameraInfo differs from the left camera's: its pixels do not correspond."""
    left, depth = (roles[role][0].channel.topic for role in ("left", "depth"))
    fx, _, cx, cy = camera.intrinsics_px
    beside = [stream for stream in streams if stream.channel.topic in info_topics(depth)]
    infos = [info for stream in beside for _, info in stream.values]
    if not infos or not infos[0].matrix.any():
        return
    own = np.array([infos[0].matrix[0, 0], infos[0].matrix[0, 2], infos[0].matrix[1, 2]])
    if np.abs(own - [fx, cx, cy]).max() > _SAME_LENS * fx:
        log.note(
            "depth not registered",
            f"{depth} has a lens of its own (fx cx cy {np.round(own, 1).tolist()}), not that of {left} ({fx:.1f}, {cx:.1f}, "
            f"{cy:.1f}): record depth that is aligned to {left}, or name it with --topic depth=/NAME",
        )


def _calibration(
    container: Container, roles: _Roles, lenses: Mapping[str, _Lenses], imu_frame: str | None, log: ReadLog
) -> tuple[RigCalibration, tuple[str, ...]]:
    """The calibration in the container, and the roles of its cameras."""
    attached = container.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is not None:
        where = f"{container.path}: attachment {CALIBRATION_ATTACHMENT}"
        return parse_calibration(attached.decode("utf-8", "replace"), where).calibration, CAMERA_ROLES
    cameras, sides = [], tuple(lenses)
    for side, told in lenses.items():
        image_topic = roles[side][0].channel.topic
        if not told.infos:
            has_messages = any(len(stream.messages) > stream.damaged for stream in roles.get(f"{side}_info", ()))
            fault = (
                f"every CameraInfo beside {image_topic} holds zeros, as drivers without a calibration send it; calibrate the camera, or"
                if has_messages
                else f"no CameraInfo beside {image_topic} describes its lens;"
            )
            raise CalibrationError(f"{container.path}: {fault} pass a calibration with --calibration FILE")
        sizes_px = [size for stream in roles[side] for size in stream.sizes_px]
        of_usual = [size for size, n in zip(sizes_px, told.numbers, strict=True) if n == told.usual]
        size_px = Counter(of_usual).most_common(1)[0][0]
        info = info_of_images(told.infos[told.usual], size_px, f"{container.path}: {image_topic}")
        if info.binning != (1, 1) or info.roi[:2] != (0, 0):
            setting = f"{setting_of(info)}, of images of just that size; the calibration is used as it is"
            log.note("binning or roi not used", f"the CameraInfo beside {image_topic} says {setting}")
        cameras.append(InfoCamera(info, bool(_RECTIFIED.search(image_topic.lower()))))
    said = [value for stream in roles.get("tf_static", ()) for value in stream.values]
    said.sort(key=lambda value: value[0])
    links, changes = last_links([link for _, found in said for link in found])
    for words in changes:
        log.note("transform said twice", f"{words}; the last one is used, as tf2 does")
    for issue in dict.fromkeys(link.issue for link in links if link.issue):
        log.note("transform not sound", issue)
    cam0_from_cams = camera_poses(cameras, links, str(container.path))
    for camera, side, cam0_from_cam in zip(cameras, sides, cam0_from_cams, strict=True):
        if cam0_from_cam is None:
            what = f"no transform connects {camera.frame} to {cameras[0].frame}"
            log.note("camera not mounted", f"{side}: {what}; its images are not used")
    for words in frames_not_optical(cameras, links):
        log.note("camera frame not optical", words)
    mounted = tuple(
        side for side, cam0_from_cam in zip(sides, cam0_from_cams, strict=True) if cam0_from_cam is not None
    )
    return calibration_of_messages(cameras, cam0_from_cams, links, imu_frame, str(container.path)), mounted
