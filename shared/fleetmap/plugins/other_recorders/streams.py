"""A recording from the messages of any recorder: chooses the topics of its sensors by their conventional names, else by type and name if
the choice is unique, and computes the calibration from CameraInfo and transforms.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Mask
from fleetmap.plugins.other_recorders import calibration as rig_messages
from fleetmap.plugins.other_recorders.calibration import setting_of
from fleetmap.plugins.other_recorders.decoders import ENCODINGS, IMU_TYPES, CameraInfo
from fleetmap.recordings.calibration_files import CalibrationFile
from fleetmap.recordings.mcap import streams as mcap_streams
from fleetmap.recordings.mcap.streams import Channel, Container, ImageStream, Place, Roles, Stream
from fleetmap.recordings.ordering import ReadLog
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.source_settings import CAMERA_ROLES, IMAGE_ROLES, PACKED, Topics, transports

INFO_TYPES = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
IMAGE_TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage")
TF_TYPES = ("tf2_msgs/TFMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms")
_TYPES = {
    **dict.fromkeys(IMAGE_ROLES, IMAGE_TYPES),
    "left_info": INFO_TYPES,
    "right_info": INFO_TYPES,
    "imu": IMU_TYPES,
    "wheel": ("nav_msgs/Odometry",),
    "prior": ("geometry_msgs/PoseWithCovarianceStamped",),
    "ground_truth": ("geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
    "tf_static": TF_TYPES,
}
_VIDEO_TYPES = (
    "foxglove.CompressedVideo",
    "foxglove_msgs/CompressedVideo",
    "ffmpeg_image_transport_msgs/FFMPEGPacket",
    "theora_image_transport/Packet",
)
KNOWN_TYPES = frozenset(name for names in _TYPES.values() for name in names)
_ALONE = ("imu", "wheel", "prior", "ground_truth")
_IMAGE_NAMES = ("image_raw", "image", "image_color", "image_mono", "image_rect", "image_rect_color", "image_rect_raw")
_HINTS = {"depth": ("depth",), "left": ("left", "cam0", "infra1"), "right": ("right", "cam1", "infra2"), "other": ("",)}


def note_videos(channels: Iterable[Channel], log: ReadLog | Container) -> None:
    """Note topics whose messages are parts of a video stream."""
    names = sorted(f"{c.topic} ({c.type_name})" for c in channels if c.type_name in _VIDEO_TYPES)
    if names:
        advice = "record JPEG or raw images, or write the video to an .mp4 file, which is read with --calibration FILE"
        log.note("video not read", f"{', '.join(names)}; {advice}")


def _choose_topics(streams: Iterable[Stream], wanted: Topics, where: str, log: ReadLog) -> Roles:
    """Choose the streams for each role; several if one topic was recorded on several channels.

    RecordingError if a topic requested by name is absent, or if the left image is ambiguous.
    """
    by_topic: dict[str, list[Stream]] = {}
    for stream in streams:
        by_topic.setdefault(stream.channel.topic, []).append(stream)
    types_of = {topic: [stream.channel.type_name for stream in by_topic[topic]] for topic in sorted(by_topic)}
    there = ", ".join(f"{topic} ({', '.join(names)})" for topic, names in types_of.items()) or "no topic at all"

    def having(types: tuple[str, ...]) -> list[str]:
        return [topic for topic, names in types_of.items() if any(name in types for name in names)]

    chosen: dict[str, str] = {}
    for role, types in _TYPES.items():
        name, candidates = getattr(wanted, role), having(types)
        found = next((topic for topic in transports(name, role) if topic in candidates), None)
        if found is not None:
            chosen[role] = found
        elif name and name != getattr(Topics(), role):
            kind = " or ".join(types)
            raise RecordingError(f"{where} has no topic {name} of type {kind} for --topic {role}; it has {there}")
        elif role in _ALONE and name and len(candidates) == 1:
            chosen[role] = candidates[0]
        elif role in _ALONE and name and candidates:
            log.note(f"{role} not chosen", f"{', '.join(candidates)} could be it; name one with --topic {role}=/NAME")
    images = having(IMAGE_TYPES)
    if "left" not in chosen:
        _choose_left(images, chosen)
    if "left" not in chosen:
        issues = "".join(f". {issue.what}: {issue.detail}" for issue in log.issues)
        raise RecordingError(
            f"{where}: no topic is clearly the left image; name it with --topic left=/NAME. There is {there}{issues}"
        )
    used = [chosen[role] for role in IMAGE_ROLES if role in chosen]
    if unused := [topic for topic in images if topic not in used]:
        detail = f"{', '.join(unused)}; {', '.join(used)} {'are' if len(used) > 1 else 'is'} used"
        log.note("images not used", f"{detail}. Choose with --topic left=/NAME, right=/NAME or depth=/NAME")
    infos = having(INFO_TYPES)
    for role in [role for role in CAMERA_ROLES if role in chosen]:
        if beside := [topic for topic in info_topics(chosen[role]) if topic in infos]:
            chosen.setdefault(f"{role}_info", beside[0])
    roles = {}
    for role, topic in chosen.items():
        types = _TYPES.get(role, INFO_TYPES)  # lenses of further cameras have the names that belong to their images
        roles[role] = [stream for stream in by_topic[topic] if stream.channel.type_name in types]
        if others := [name for name in types_of[topic] if name not in types]:
            read = f"{' or '.join(types)} is read as {role}"
            log.note("messages of another type", f"{topic}: {', '.join(others)} left out; {read}")
    return roles


def _choose_left(images: list[str], chosen: dict[str, str]) -> None:
    """Choose the left image, and right or depth, by words in the names, if they leave one camera for each."""
    kinds: dict[str, list[str]] = {kind: [] for kind in _HINTS}
    for topic in images:
        kinds[next(kind for kind, hints in _HINTS.items() if any(h in topic.lower() for h in hints))].append(topic)
    left = _of_one_camera(kinds["left"] or kinds["other"])
    if left is None:
        return
    chosen["left"] = left
    right, depth = _of_one_camera(kinds["right"]), _of_one_camera(kinds["depth"])
    if kinds["left"] and right:
        chosen.setdefault("right", right)
    if depth and "right" not in chosen:
        chosen.setdefault("depth", depth)


def _of_one_camera(topics: list[str]) -> str | None:
    """The topic to read of one camera's topics: raw before compressed, original before rectified; None for several cameras or none."""
    if len({_camera(topic) for topic in topics}) != 1:
        return None
    return min(topics, key=lambda topic: (topic.endswith(PACKED), "rect" in topic, topic))


def _unpacked(topic: str) -> str:
    return re.sub(rf"({'|'.join(PACKED)})$", "", topic)


def _camera(topic: str) -> str:
    """Common prefix of all topics with the images of one camera."""
    parent, _, last = _unpacked(topic).rpartition("/")
    return parent if last in _IMAGE_NAMES else _unpacked(topic)


def info_topics(image_topic: str) -> tuple[str, ...]:
    """Topics on which ROS and Foxglove publish the lens of the camera with this image topic."""
    parent = _unpacked(image_topic).rpartition("/")[0]
    return f"{parent}/calibration", f"{parent}/camera_info"


_SAME_LENS = 0.02  # of the focal length
_MOST_LENSES = 20  # of one camera in a recording
# CDR's head and a stamp, or ROS 1's sequence number and stamp: the difference between messages of equal content
_HEADER_BYTES = 12
_RECTIFIED = re.compile(r"(?<![a-z])(rect(?![a-z])|rectified)")  # image_rect, rect/image; not direct, image_unrect


@dataclass(eq=False)
class _InfoStream(Stream):
    """CameraInfo messages that differ from the previous one; lenses repeat with every image.

    Before the first valid lens only the latest is kept: uncalibrated drivers send zeros, others do so at their start.
    """

    lens: CameraInfo | None = None

    def take(self, data: bytes, place: Place, logged_ns: int, log: ReadLog) -> None:
        if self.lens is not None and data[_HEADER_BYTES:] == self.messages[-1][_HEADER_BYTES:]:
            return
        try:
            info: CameraInfo = self.container.decode(self.channel, data)
            lens = info if info.matrix[0, 0] > 0 else None
        except mcap_streams.UNDECODABLE:
            lens = None
        if self.lens is None:
            self.messages, self.log_times_ns = [], []
        elif lens is None or rig_messages.same_lens(lens, self.lens):
            return
        self.lens = lens
        super().take(data, place, logged_ns, log)


class _Lens(NamedTuple):
    """The lens of most of a camera's images, None if no CameraInfo describes one; and (N,) the images that were taken with it."""

    info: CameraInfo | None
    usable: Mask


def open_messages(path: Path, file_format: str, opener: Callable[[], Container], options: OpenOptions) -> Recording:
    """Open the recording at `path` through the container that `opener` opens; its issues list unreadable messages.

    opener: must be picklable, because other processes may read part of the frames.
    """
    with mcap_streams.opened(opener, options) as (container, given, log):
        streams, others = mcap_streams.collect(container, partial(_stream_of, container, options.topics), log)
        note_videos(others, log)
        used = [stream for stream in streams if stream.messages or isinstance(stream, ImageStream)]
        if not used:
            there = ", ".join(f"{c.topic} ({c.type_name} in {c.encoding or 'no encoding'})" for c in others[:8])
            known = f"; known encodings are {', '.join(ENCODINGS)}" if others else ""
            why = f"{log.told() or there or 'it is empty'}{known}"
            raise RecordingError(f"{container.path} holds no message that can be read ({why})")
        topics = _with_hints(options.topics, given, {stream.channel.topic for stream in used})
        roles = _choose_topics(used, topics, str(container.path), log)
        calibration = given.calibration if given else mcap_streams.attached_calibration(container)
        lenses = _lenses_of(roles, log) if calibration is None else {}

        def calibrate(imu_frame: str | None) -> tuple[RigCalibration, Sequence[str]]:
            found = calibration
            described: Sequence[str] = CAMERA_ROLES
            if found is None:
                found, described = _calibration(container, roles, lenses, imu_frame, log)
            if "depth" in roles and "right" not in roles:
                _note_unregistered(streams, roles, found.cameras[0], log)
            return found, described

        usable = {role: lens.usable for role, lens in lenses.items()}
        return mcap_streams.assemble(path, file_format, container, opener, streams, roles, calibrate, log, usable)


def _stream_of(container: Container, topics: Topics, channel: Channel) -> Stream | None:
    """An empty stream for a channel that may be needed."""
    is_known = channel.encoding in ENCODINGS and channel.type_name in KNOWN_TYPES
    if not is_known or (channel.type_name in TF_TYPES and channel.topic != topics.tf_static):
        return None
    if channel.type_name in INFO_TYPES:
        return _InfoStream(container, channel)
    return (ImageStream if channel.type_name in IMAGE_TYPES else Stream)(container, channel)


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


def _lenses_of(roles: Roles, log: ReadLog) -> dict[str, _Lens]:
    """The lenses of the cameras that can be used, by their roles."""
    lenses = {}
    for side in CAMERA_ROLES[:2] if "depth" in roles else CAMERA_ROLES:
        if side in roles:
            lens, topic = _lens(side, roles[side], roles.get(f"{side}_info", ()), log), roles[side][0].channel.topic
            if side in CAMERA_ROLES[:2] or (lens.info and len(lens.usable)):
                lenses[side] = lens
            elif lens.info:
                log.note("camera without an image", f"{side}: none of the images on {topic} can be read")
            else:
                log.note("camera without a lens", f"{side}: no CameraInfo beside {topic}; its images are not used")
    return lenses


def _lens(role: str, images: Sequence[ImageStream], streams: Sequence[Stream], log: ReadLog) -> _Lens:
    """Images of other lenses are noted; CalibrationError if the number of lenses keeps growing, as with autofocus."""
    values: list[tuple[int, CameraInfo]] = [value for stream in streams for value in stream.values]
    told = [(info.stamp_ns or log_time_ns, info) for log_time_ns, info in values if info.matrix[0, 0] > 0]
    told.sort(key=lambda each: each[0])
    stamps_ns = [stamp_ns for stream in images for stamp_ns, *_ in stream.images]
    if not told:
        return _Lens(None, np.ones(len(stamps_ns), np.bool_))
    infos, numbers = list[CameraInfo](), list[int]()
    for _, info in told:
        number = next((n for n, lens in enumerate(infos) if rig_messages.same_lens(lens, info)), len(infos))
        numbers.append(number)
        infos += [info] if number == len(infos) else []
        if len(infos) > _MOST_LENSES:
            raise CalibrationError(
                f"{streams[0].channel.topic} describes more than {_MOST_LENSES} lenses, from {setting_of(infos[0])} to "
                f"{setting_of(info)}; a map needs one: switch off zoom and autofocus, or pass a calibration with --calibration FILE"
            )
    rows = np.searchsorted([stamp_ns for stamp_ns, _ in told], stamps_ns, side="right") - 1
    of_images = np.array(numbers)[np.maximum(rows, 0)]
    usual = int(np.bincount(of_images, minlength=1).argmax())
    usable = np.asarray(of_images == usual)
    if not usable.all():
        setting, other = (setting_of(infos[n]) for n in (usual, int(of_images[~usable][0])))
        log.note(
            f"{role} images: the CameraInfo changes",
            f"{int((~usable).sum())} of {len(usable)} left out, which have {other}; "
            f"{setting} is used: keep zoom, focus, binning and roi as they are while you record",
        )
    return _Lens(infos[usual], usable)


def _note_unregistered(streams: Iterable[Stream], roles: Roles, camera: CameraCalibration, log: ReadLog) -> None:
    """Note a depth topic whose CameraInfo differs from the left camera's: its pixels do not correspond."""
    left, depth = (roles[role][0].channel.topic for role in ("left", "depth"))
    fx, _, cx, cy = camera.intrinsics_px
    beside = [stream for stream in streams if stream.channel.topic in info_topics(depth)]
    infos = [info for stream in beside for _, info in stream.values]
    if not infos or not infos[0].matrix.any():
        return
    own = infos[0].matrix[[0, 0, 1], [0, 2, 2]]
    if np.abs(own - [fx, cx, cy]).max() > _SAME_LENS * fx:
        log.note(
            "depth not registered",
            f"{depth} has a lens of its own (fx cx cy {np.round(own, 1).tolist()}), not that of {left} ({fx:.1f}, {cx:.1f}, "
            f"{cy:.1f}): record depth that is aligned to {left}, or name it with --topic depth=/NAME",
        )


def _calibration(
    container: Container, roles: Roles, lenses: Mapping[str, _Lens], imu_frame: str | None, log: ReadLog
) -> tuple[RigCalibration, tuple[str, ...]]:
    """The calibration by the messages in the container, and the roles of its cameras."""
    cameras, sides = [], tuple(lenses)
    for side, lens in lenses.items():
        image_topic = roles[side][0].channel.topic
        if lens.info is None:
            has_messages = any(len(stream.messages) > stream.damaged for stream in roles.get(f"{side}_info", ()))
            fault = f"no CameraInfo beside {image_topic} describes its lens;"
            if has_messages:
                zeros = "holds zeros, as drivers without a calibration send it; calibrate the camera, or"
                fault = f"every CameraInfo beside {image_topic} {zeros}"
            raise CalibrationError(f"{container.path}: {fault} pass a calibration with --calibration FILE")
        sizes_px = [size_px for stream in roles[side] for *_, size_px in stream.images]
        used = [size for size, is_usable in zip(sizes_px, lens.usable, strict=True) if is_usable]
        size_px = Counter(used).most_common(1)[0][0]
        info = rig_messages.info_of_images(lens.info, size_px, f"{container.path}: {image_topic}")
        if info.binning != (1, 1) or info.roi[:2] != (0, 0):
            setting = f"{setting_of(info)}, of images of just that size; the calibration is used as it is"
            log.note("binning or roi not used", f"the CameraInfo beside {image_topic} says {setting}")
        if _RECTIFIED.search(image_topic.lower()):
            turned = replace(info, matrix=info.projection[:, :3], rect_from_cam=np.eye(3))
            info = replace(turned, lens="", distortion=np.zeros(0))
        cameras.append(info)
    said = [value for stream in roles.get("tf_static", ()) for value in stream.values]
    said.sort(key=lambda value: value[0])
    links, changes = rig_messages.last_links([link for _, found in said for link in found])
    for words in changes:
        log.note("transform said twice", f"{words}; the last one is used, as tf2 does")
    for issue in dict.fromkeys(link.issue for link in links if link.issue):
        log.note("transform not sound", issue)
    cam0_from_cams = rig_messages.camera_poses(cameras, links, str(container.path))
    for camera, side, cam0_from_cam in zip(cameras, sides, cam0_from_cams, strict=True):
        if cam0_from_cam is None:
            what = f"no transform connects {camera.frame} to {cameras[0].frame}"
            log.note("camera not mounted", f"{side}: {what}; its images are not used")
    for words in rig_messages.frames_not_optical(cameras, links):
        log.note("camera frame not optical", words)
    mounted = tuple(side for side, mount in zip(sides, cam0_from_cams, strict=True) if mount is not None)
    calibration = rig_messages.calibration_of_messages(cameras, cam0_from_cams, links, imu_frame, str(container.path))
    if len(mounted) > 1:
        marked = zip(calibration.cameras, mounted, strict=True)
        placed = tuple(replace(camera, has_depth=f"{role}_depth" in roles) for camera, role in marked)
        calibration = replace(calibration, cameras=placed)
    return calibration, mounted
