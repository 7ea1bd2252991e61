"""Roles of the topics in an MCAP file: by the conventional name, else by type and name if the choice is unique."""

from collections.abc import Iterable, Mapping

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.container import Channel
from fleetmap.recordings.ordering import ReadLog
from fleetmap.sensors.samples import DataIssue
from fleetmap.sensors.source_settings import CAMERA_ROLES, DEPTH_ROLES, Topics

INFO_TYPES = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
IMAGE_TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage")
_TYPES = {
    "left": IMAGE_TYPES,
    "right": IMAGE_TYPES,
    **dict.fromkeys(CAMERA_ROLES[2:], IMAGE_TYPES),
    **dict.fromkeys(DEPTH_ROLES, IMAGE_TYPES),
    "left_info": INFO_TYPES,
    "right_info": INFO_TYPES,
    "imu": ("sensor_msgs/Imu", "foxglove.Imu", "foxglove.IMU", "fleetmap.Imu"),
    "wheel": ("nav_msgs/Odometry",),
    "prior": ("geometry_msgs/PoseWithCovarianceStamped",),
    "ground_truth": ("geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
    "tf_static": ("tf2_msgs/TFMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms"),
}
_VIDEO_TYPES = (
    "foxglove.CompressedVideo",
    "foxglove_msgs/CompressedVideo",
    "ffmpeg_image_transport_msgs/FFMPEGPacket",
    "theora_image_transport/Packet",
)
KNOWN_TYPES = frozenset(name for names in _TYPES.values() for name in names)
_ALONE = ("imu", "wheel", "prior", "ground_truth")
_PACKED = ("/compressed", "/compressedDepth")
_IMAGE_NAMES = ("image_raw", "image", "image_color", "image_mono", "image_rect", "image_rect_color", "image_rect_raw")
_LEFT_HINTS, _RIGHT_HINTS, _DEPTH_HINTS = ("left", "cam0", "infra1"), ("right", "cam1", "infra2"), ("depth",)


def transports(topic: str, role: str) -> tuple[str, ...]:
    """Topics on which ROS's image_transport may send the images of `topic`; only `topic` for other roles."""
    if role not in (*CAMERA_ROLES, *DEPTH_ROLES) or not topic:
        return (topic,)
    return (topic, *(topic + packed for packed in _PACKED[: 2 if role in DEPTH_ROLES else 1]))


def video_issues(channels: Iterable[Channel]) -> list[DataIssue]:
    """Issue about topics whose messages are parts of a video stream; none without such topics."""
    names = sorted(
        f"{channel.topic} ({channel.type_name})" for channel in channels if channel.type_name in _VIDEO_TYPES
    )
    advice = "record JPEG or raw images, or write the video to an .mp4 file, which is read with --calibration FILE"
    return [DataIssue("video not read", f"{', '.join(names)}; {advice}")] if names else []


def choose_topics(channels: Iterable[Channel], wanted: Topics, where: str, log: ReadLog) -> dict[str, list[int]]:
    """Choose the channel ids for each role; several if one topic was recorded on several channels.

    RecordingError if a topic requested by name is absent, or if the left image is
    ambiguous.
    """
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(channel.topic, []).append(channel)
    chosen: dict[str, str] = {}
    for role, types in _TYPES.items():
        name = getattr(wanted, role)
        found = next((t for t in transports(name, role) if _has_type(by_topic, t, types)), None)
        candidates = sorted(topic for topic in by_topic if _has_type(by_topic, topic, types))
        if found is not None:
            chosen[role] = found
        elif name and name != getattr(Topics(), role):
            raise RecordingError(
                f"{where} has no topic {name} of type {' or '.join(types)} for --topic {role}; it has {_listed(by_topic)}"
            )
        elif role in _ALONE and name and len(candidates) == 1:
            chosen[role] = candidates[0]
        elif role in _ALONE and name and candidates:
            log.note(f"{role} not chosen", f"{', '.join(candidates)} could be it; name one with --topic {role}=/NAME")
    _choose_images(by_topic, chosen, where, log)
    _choose_infos(by_topic, chosen)
    for role, topic in chosen.items():
        others = [channel for channel in by_topic[topic] if channel.type_name not in _types(role)]
        if others:
            names = ", ".join(channel.type_name for channel in others)
            log.note(
                "messages of another type", f"{topic}: {names} left out; {' or '.join(_types(role))} is read as {role}"
            )
    return {
        role: [channel.id for channel in by_topic[topic] if channel.type_name in _types(role)]
        for role, topic in chosen.items()
    }


def _types(role: str) -> tuple[str, ...]:
    return _TYPES.get(role, INFO_TYPES)  # lenses of further cameras have the names that belong to their images


def _has_type(by_topic: Mapping[str, list[Channel]], topic: str, types: tuple[str, ...]) -> bool:
    return any(channel.type_name in types for channel in by_topic.get(topic, ()))


def _choose_images(by_topic: Mapping[str, list[Channel]], chosen: dict[str, str], where: str, log: ReadLog) -> None:
    images = sorted(topic for topic in by_topic if _has_type(by_topic, topic, IMAGE_TYPES))
    depths = [topic for topic in images if _has(topic, _DEPTH_HINTS)]
    lefts = [topic for topic in images if topic not in depths and _has(topic, _LEFT_HINTS)]
    rights = [topic for topic in images if topic not in depths and _has(topic, _RIGHT_HINTS)]
    others = [topic for topic in images if topic not in (*depths, *lefts, *rights)]
    if "left" not in chosen:
        left, right = _of_one_camera(lefts), _of_one_camera(rights)
        only = None if lefts else _of_one_camera(others)
        if left or only:
            chosen["left"] = left or only or ""
            if left and right:
                chosen.setdefault("right", right)
        else:
            issues = "".join(f". {issue.what}: {issue.detail}" for issue in log.issues)
            raise RecordingError(
                f"{where}: no topic is clearly the left image; name it with --topic left=/NAME. There is {_listed(by_topic)}{issues}"
            )
        depth = _of_one_camera(depths)
        if depth and "right" not in chosen:
            chosen.setdefault("depth", depth)
    used = [chosen[role] for role in (*CAMERA_ROLES, *DEPTH_ROLES) if role in chosen]
    unused = [topic for topic in images if topic not in used]
    if unused:
        detail = f"{', '.join(unused)}; {', '.join(used)} {'are' if len(used) > 1 else 'is'} used"
        log.note("images not used", f"{detail}. Choose with --topic left=/NAME, right=/NAME or depth=/NAME")


def _of_one_camera(topics: list[str]) -> str | None:
    """The topic to read of one camera's topics: raw before compressed, original before rectified; None for several cameras or none."""
    cameras = {_camera(topic) for topic in topics}
    return (
        min(topics, key=lambda topic: (topic.endswith(_PACKED), "rect" in topic, topic)) if len(cameras) == 1 else None
    )


def _camera(topic: str) -> str:
    """Common prefix of all topics with the images of one camera."""
    for suffix in _PACKED:
        topic = topic.removesuffix(suffix)
    parent, _, last = topic.rpartition("/")
    return parent if last in _IMAGE_NAMES else topic


def _choose_infos(by_topic: Mapping[str, list[Channel]], chosen: dict[str, str]) -> None:
    for role in CAMERA_ROLES:
        if role not in chosen or f"{role}_info" in chosen:
            continue
        info = next(
            (name for name in info_topics(chosen[role]) if _has_type(by_topic, name, _TYPES["left_info"])), None
        )
        if info is not None:
            chosen[f"{role}_info"] = info


def info_topics(image_topic: str) -> tuple[str, ...]:
    """Topics on which ROS and Foxglove publish the lens of the camera with this image topic."""
    for suffix in _PACKED:
        image_topic = image_topic.removesuffix(suffix)
    parent = image_topic.rpartition("/")[0]
    return f"{parent}/calibration", f"{parent}/camera_info"


def _has(topic: str, hints: tuple[str, ...]) -> bool:
    return any(hint in topic.lower() for hint in hints)


def _listed(by_topic: Mapping[str, list[Channel]]) -> str:
    names = (f"{topic} ({', '.join(channel.type_name for channel in by_topic[topic])})" for topic in sorted(by_topic))
    return ", ".join(names) or "no topic at all"
