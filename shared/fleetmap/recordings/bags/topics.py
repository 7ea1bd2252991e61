"""Roles of the topics in an MCAP file: by the conventional name, else by type and name where one choice is left."""

from collections.abc import Iterable, Mapping

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.container import Channel
from fleetmap.recordings.ordering import ReadLog
from fleetmap.sensors.samples import DataIssue
from fleetmap.sensors.source_settings import Topics

IMAGE_TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage")
_TYPES = {
    "left": IMAGE_TYPES,
    "right": IMAGE_TYPES,
    "depth": IMAGE_TYPES,
    "left_info": ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration"),
    "right_info": ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration"),
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
_LEFT_HINTS, _RIGHT_HINTS, _DEPTH_HINTS = ("left", "cam0", "infra1"), ("right", "cam1", "infra2"), ("depth",)


def transports(topic: str, role: str) -> tuple[str, ...]:
    """The topics on which ROS's image_transport may send the images of `topic`; the topic alone for other roles."""
    if role not in ("left", "right", "depth") or not topic:
        return (topic,)
    return (topic, f"{topic}/compressed", *([f"{topic}/compressedDepth"] if role == "depth" else []))


def type_name(channel: Channel) -> str:
    """The message type without ROS 2's `/msg/`."""
    return channel.schema.name.replace("/msg/", "/")


def video_issues(channels: Iterable[Channel]) -> list[DataIssue]:
    """A note of the topics whose messages are pieces of a video; none without such topics."""
    names = sorted(
        f"{channel.topic} ({type_name(channel)})" for channel in channels if type_name(channel) in _VIDEO_TYPES
    )
    advice = "record JPEG or raw images, or write the video to an .mp4 file, which is read with --calibration FILE"
    return [DataIssue("video not read", f"{', '.join(names)}; {advice}")] if names else []


def choose_topics(channels: Iterable[Channel], wanted: Topics, where: str, log: ReadLog) -> dict[str, list[int]]:
    """The ids of the channels for each role; several where one topic was recorded on several channels.

    RecordingError where a topic that was asked for by name is not there, or where no left image can be told from the
    others.
    """
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(channel.topic, []).append(channel)
    chosen: dict[str, str] = {}
    for role, types in _TYPES.items():
        name = getattr(wanted, role)
        found = next((t for t in transports(name, role) if _type_of(by_topic, t) in types), None)
        candidates = sorted(topic for topic in by_topic if _type_of(by_topic, topic) in types)
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
    return {role: [channel.id for channel in by_topic[topic]] for role, topic in chosen.items()}


def _type_of(by_topic: Mapping[str, list[Channel]], topic: str) -> str:
    """The type of a topic's messages, empty where there is no such topic."""
    return type_name(by_topic[topic][0]) if topic in by_topic else ""


def _choose_images(by_topic: Mapping[str, list[Channel]], chosen: dict[str, str], where: str, log: ReadLog) -> None:
    if "left" in chosen:
        return
    images = sorted(topic for topic in by_topic if _type_of(by_topic, topic) in IMAGE_TYPES)
    depth = [topic for topic in images if _has(topic, _DEPTH_HINTS)]
    lefts = [topic for topic in images if topic not in depth and _has(topic, _LEFT_HINTS)]
    rights = [topic for topic in images if topic not in depth and _has(topic, _RIGHT_HINTS)]
    others = [topic for topic in images if topic not in (*depth, *lefts, *rights)]
    if len(lefts) == 1:
        chosen["left"] = lefts[0]
        if len(rights) == 1:
            chosen.setdefault("right", rights[0])
    elif not lefts and len(others) == 1:
        chosen["left"] = others[0]
    else:
        issues = "".join(f". {issue.what}: {issue.detail}" for issue in log.issues)
        raise RecordingError(
            f"{where}: no topic is clearly the left image; name it with --topic left=/NAME. There is {_listed(by_topic)}{issues}"
        )
    if len(depth) == 1 and "right" not in chosen:
        chosen.setdefault("depth", depth[0])


def _choose_infos(by_topic: Mapping[str, list[Channel]], chosen: dict[str, str]) -> None:
    for role in ("left", "right"):
        if role not in chosen or f"{role}_info" in chosen:
            continue
        parent = chosen[role].removesuffix("/compressed").rpartition("/")[0]
        for name in ("camera_info", "calibration"):
            if _type_of(by_topic, f"{parent}/{name}") in _TYPES["left_info"]:
                chosen[f"{role}_info"] = f"{parent}/{name}"


def _has(topic: str, hints: tuple[str, ...]) -> bool:
    return any(hint in topic.lower() for hint in hints)


def _listed(by_topic: Mapping[str, list[Channel]]) -> str:
    return ", ".join(f"{topic} ({_type_of(by_topic, topic)})" for topic in sorted(by_topic)) or "no topic at all"
