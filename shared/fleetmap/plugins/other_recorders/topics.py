"""Roles of the topics in a recording of messages: by the conventional name, else by type and name if the choice is unique."""

import re
from collections.abc import Iterable

from fleetmap.errors import RecordingError
from fleetmap.plugins.other_recorders.decoders import IMU_TYPES
from fleetmap.recordings.mcap.streams import Channel, Container
from fleetmap.recordings.ordering import ReadLog
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


def choose_topics(channels: Iterable[Channel], wanted: Topics, where: str, log: ReadLog) -> dict[str, list[Channel]]:
    """Choose the channels for each role; several if one topic was recorded on several channels.

    RecordingError if a topic requested by name is absent, or if the left image is ambiguous.
    """
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(channel.topic, []).append(channel)
    names = (f"{topic} ({', '.join(c.type_name for c in by_topic[topic])})" for topic in sorted(by_topic))
    there = ", ".join(names) or "no topic at all"

    def having(types: tuple[str, ...]) -> list[str]:
        return [topic for topic in sorted(by_topic) if any(c.type_name in types for c in by_topic[topic])]

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
        roles[role] = [channel for channel in by_topic[topic] if channel.type_name in types]
        if others := [channel.type_name for channel in by_topic[topic] if channel.type_name not in types]:
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
