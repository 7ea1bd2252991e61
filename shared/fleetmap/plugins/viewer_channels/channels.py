"""Channels of maps, robots, fixes, images and failures: the same for viewers and in MCAP files.

Messages are protobuf in Foxglove's own schemas; a failure's full report is JSON, for lack of a schema. Stamps are nanoseconds.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from foxglove import Schema
from foxglove import messages as fox
from mcap.writer import CompressionType, Writer

from fleetmap.encoding import to_json, to_plain
from fleetmap.geometry import Array, quat_wxyz_from_rotation
from fleetmap.messages import FailureKind, FailureReport, Status
from fleetmap.recordings.images import jpeg_image
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Image

MAP, ODOM, BASE, CAMERA, SURVEY = "map", "odom", "base_link", "camera", "survey"
MAX_POINTS = 1_000_000  # points of a map in one message of 12 MB; larger maps are thinned to every n-th
_MAX_PATH = 2000
_QUALITY = 80
_LAST_S = (1 << 32) - 1
REPORT = Schema(name="fleetmap.FailureReport", encoding="jsonschema", data=b"")
_KINDS: dict[str, Any] = {
    "/map": fox.PointCloud,
    "/path": fox.PosesInFrame,
    "/tf": fox.FrameTransforms,
    "/robots": fox.SceneUpdate,
    "/fixes": fox.PoseInFrame,
    "/camera": fox.CompressedImage,
    "/camera/calibration": fox.CameraCalibration,
    "/camera/matches": fox.ImageAnnotations,
    "/log": fox.Log,
    "/survey/landmarks": fox.PointCloud,
    "/survey/path": fox.PosesInFrame,
    "/survey/revisits": fox.SceneUpdate,
    "/survey/robot": fox.SceneUpdate,
    "/failures/log": fox.Log,
    "/failures/place": fox.PoseInFrame,
    "/failures/frame": fox.CompressedImage,
    "/failures/matches": fox.CompressedImage,
}
CHANNELS: dict[str, Schema] = {topic: kind.get_schema() for topic, kind in _KINDS.items()} | {
    "/failures/report": REPORT
}

_GOOD, _WARN = fox.Color(r=0.15, g=0.65, b=0.35, a=1.0), fox.Color(r=0.95, g=0.65, b=0.1, a=1.0)
_BAD, _QUIET = fox.Color(r=0.85, g=0.2, b=0.2, a=1.0), fox.Color(r=0.55, g=0.55, b=0.55, a=1.0)
_COLOURS: dict[str, fox.Color] = {
    Status.TRACKING: _GOOD,
    Status.DEGRADED: _WARN,
    Status.AMBIGUOUS: _BAD,
    Status.LOST: _BAD,
}
_LEVELS: dict[str, fox.LogLevel] = {
    Status.TRACKING: fox.LogLevel.Info,
    Status.INITIALISING: fox.LogLevel.Info,
    Status.DEGRADED: fox.LogLevel.Warning,
}


class ChannelMessage(NamedTuple):
    """A message of a topic of CHANNELS, encoded."""

    topic: str
    stamp_ns: int
    data: bytes


class Shown(NamedTuple):
    """A message that is encoded only if a viewer subscribes."""

    topic: str
    stamp_ns: int
    make: Callable[[], ChannelMessage]

    @classmethod
    def now(cls, message: ChannelMessage) -> "Shown":
        """Wrap a finished message."""
        return cls(message.topic, message.stamp_ns, lambda: message)


class RobotMark(NamedTuple):
    """A robot, or one of its possible places: map_from_base (4, 4), a Status by name."""

    name: str
    map_from_base: Array
    status: str


def encoding_of(schema: Schema) -> str:
    """Encoding of the messages of a schema."""
    return "json" if schema.encoding == "jsonschema" else "protobuf"


class ChannelWriter:
    """Writes an MCAP file; equal messages give equal bytes. A channel is added with its first message."""

    def __init__(self, file: BinaryIO) -> None:
        self._writer = Writer(file, compression=CompressionType.NONE)
        self._schemas, self._channels, self._count = dict[str, int](), dict[str, int](), 0

    def __enter__(self) -> Self:
        self._writer.start(profile="", library="fleetmap")
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def write(self, message: ChannelMessage) -> None:
        """Add a message, in any order of stamps."""
        topic, schema = message.topic, CHANNELS[message.topic]
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        if topic not in self._channels:
            schema_id = self._schemas[schema.name]
            self._channels[topic] = self._writer.register_channel(topic, encoding_of(schema), schema_id)
        stamp_ns = max(0, message.stamp_ns)
        self._writer.add_message(self._channels[topic], stamp_ns, message.data, stamp_ns, self._count)
        self._count += 1


def points(stamp_ns: int, points_map: Array, topic: str = "/map", frame: str = MAP) -> ChannelMessage:
    """Landmarks (N, 3), thinned evenly if there are too many."""
    kept = points_map[:: max(1, math.ceil(len(points_map) / MAX_POINTS))]
    kind = fox.PackedElementFieldNumericType.Float32
    fields = [fox.PackedElementField(name=name, offset=4 * n, type=kind) for n, name in enumerate("xyz")]
    data = np.ascontiguousarray(kept, "<f4").tobytes()
    placed = {"frame_id": frame, "pose": _located(np.eye(4))}
    return _stamped(topic, stamp_ns, **placed, point_stride=12, fields=fields, data=data)


def path(stamp_ns: int, positions_m: Array, topic: str = "/path", frame: str = MAP) -> ChannelMessage:
    """Positions (N, 3) of a path, thinned evenly; the last one is among them."""
    step = max(1, math.ceil(len(positions_m) / _MAX_PATH))
    level = fox.Quaternion(w=1.0)
    kept = positions_m[::-1][::step][::-1].tolist()
    placed = [fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=level) for x, y, z in kept]
    return _stamped(topic, stamp_ns, frame_id=frame, poses=placed)


def links(stamp_ns: int, given: Iterable[tuple[str, str, Array]]) -> ChannelMessage:
    """Links between frames: parent, child, parent_from_child (4, 4)."""
    found = []
    for parent, child, parent_from_child in given:
        translation, rotation = _parts(parent_from_child)
        frames: dict[str, Any] = {"timestamp": _stamp(stamp_ns), "parent_frame_id": parent, "child_frame_id": child}
        found.append(fox.FrameTransform(**frames, translation=translation, rotation=rotation))
    return ChannelMessage("/tf", stamp_ns, fox.FrameTransforms(transforms=found).encode())


def robots(stamp_ns: int, marks: Sequence[RobotMark], topic: str = "/robots", frame: str = MAP) -> ChannelMessage:
    """All robots as arrows with labels; replaces those shown before."""
    entities = []
    for mark in marks:
        colour, above = _COLOURS.get(mark.status, _QUIET), mark.map_from_base.copy()
        above[2, 3] += 0.6
        sizes = {"shaft_length": 0.5, "shaft_diameter": 0.15, "head_length": 0.3, "head_diameter": 0.35}
        arrow = fox.ArrowPrimitive(pose=_located(mark.map_from_base), color=colour, **sizes)
        shown: dict[str, Any] = {"text": f"{mark.name}: {mark.status}", "font_size": 14, "color": colour}
        text = fox.TextPrimitive(pose=_located(above), billboard=True, scale_invariant=True, **shown)
        entities.append(_entity(stamp_ns, frame, mark.name, arrows=[arrow], texts=[text]))
    return _scene(topic, stamp_ns, entities)


def place(topic: str, stamp_ns: int, map_from_base: Array) -> ChannelMessage:
    """A place (4, 4) in `map`: a fix, or the start of a failure."""
    return _stamped(topic, stamp_ns, frame_id=MAP, pose=_located(map_from_base))


def picture(stamp_ns: int, left: Image) -> ChannelMessage:
    """An image of the left camera, rectified to `lens`."""
    return jpeg("/camera", stamp_ns, jpeg_image(left, _QUALITY).data)


def jpeg(topic: str, stamp_ns: int, data: bytes) -> ChannelMessage:
    """A JPEG of the left camera."""
    return _stamped(topic, stamp_ns, frame_id=CAMERA, data=data, format="jpeg")


def lens(stamp_ns: int, camera: StereoCamera) -> ChannelMessage:
    """The rectified left camera, with which a viewer projects the map into its images."""
    matrices = {"K": camera.matrix, "R": np.eye(3), "P": np.pad(camera.matrix, ((0, 0), (0, 1)))}
    rows = {name: matrix.ravel().tolist() for name, matrix in matrices.items()}
    size = {"width": camera.width_px, "height": camera.height_px}
    undistorted = {"distortion_model": "plumb_bob", "D": [0.0] * 5}
    return _stamped("/camera/calibration", stamp_ns, frame_id=CAMERA, **size, **undistorted, **rows)


def matches(stamp_ns: int, pixels: Array, expected: Array | None = None) -> ChannelMessage:
    """Observed pixels (N, 2) of landmarks; expected (N, 2): pixels predicted by the map, joined by lines."""
    drawn = [_annotation(stamp_ns, pixels, fox.PointsAnnotationType.Points, _GOOD)]
    if expected is not None:
        ends = np.column_stack([pixels, expected]).reshape(-1, 2)
        drawn.append(_annotation(stamp_ns, ends, fox.PointsAnnotationType.LineList, _WARN))
    return _stamped("/camera/matches", stamp_ns, points=drawn)


def status_log(stamp_ns: int, robot: str, status: str, cause: str) -> ChannelMessage:
    """A log line with a robot's status."""
    words = f"{status}: {cause}" if cause else status
    return _stamped("/log", stamp_ns, level=_LEVELS.get(status, fox.LogLevel.Error), message=words, name=robot)


def lines(stamp_ns: int, ends_m: Array, topic: str, frame: str) -> ChannelMessage:
    """Lines between two places (L, 2, 2) on the ground of a frame."""
    corners = [fox.Point3(x=x, y=y) for x, y in ends_m.reshape(-1, 2).tolist()]
    line = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineList,
        pose=_located(np.eye(4)),
        thickness=2.0,
        scale_invariant=True,
        points=corners,
        color=_WARN,
    )
    return _scene(topic, stamp_ns, [_entity(stamp_ns, frame, topic, lines=[line])])


def failure(
    stamp_ns: int, report: FailureReport, pictures: Iterable[tuple[str, bytes]], where: str | None = None
) -> list[ChannelMessage]:
    """A failure: log line, place, images and report. pictures: kind (`frame`, `matches`) and JPEG; where: place name, else the tile."""
    if where is None:
        where = "nowhere" if report.tile is None else "tile {},{}".format(*report.tile)
    words = f"{report.kind}: {report.cause}, {report.duration_s:.1f} s, version {report.version}, {where}"
    level = fox.LogLevel.Warning if report.kind == FailureKind.SUSPECTED else fox.LogLevel.Error
    found = [_stamped("/failures/log", stamp_ns, level=level, message=words, name=report.robot)]
    if report.map_from_base is not None:
        placed = report.map_from_base
        if np.isfinite([*placed.position_m, *placed.quat_wxyz]).all():
            found.append(place("/failures/place", stamp_ns, placed.target_from_source))
    for kind, data in pictures:
        found.append(jpeg("/failures/matches" if kind == "matches" else "/failures/frame", stamp_ns, data))
    plain = to_plain(report)
    plain.pop("thumbnails")
    found.append(ChannelMessage("/failures/report", stamp_ns, to_json(plain, order="sorted")))
    return found


def _stamped(topic: str, stamp_ns: int, **fields: Any) -> ChannelMessage:
    return ChannelMessage(topic, stamp_ns, _KINDS[topic](timestamp=_stamp(stamp_ns), **fields).encode())


def _scene(topic: str, stamp_ns: int, entities: list[fox.SceneEntity]) -> ChannelMessage:
    gone = fox.SceneEntityDeletion(timestamp=_stamp(stamp_ns), type=fox.SceneEntityDeletionType.All)
    return ChannelMessage(topic, stamp_ns, fox.SceneUpdate(deletions=[gone], entities=entities).encode())


def _entity(stamp_ns: int, frame: str, name: str, **drawn: Any) -> fox.SceneEntity:
    return fox.SceneEntity(timestamp=_stamp(stamp_ns), frame_id=frame, id=name, frame_locked=True, **drawn)


def _annotation(
    stamp_ns: int, pixels: Array, kind: fox.PointsAnnotationType, colour: fox.Color
) -> fox.PointsAnnotation:
    corners = [fox.Point2(x=u, y=v) for u, v in pixels.tolist()]
    return fox.PointsAnnotation(
        timestamp=_stamp(stamp_ns), type=kind, points=corners, outline_color=colour, fill_color=colour, thickness=2.0
    )


def _stamp(stamp_ns: int) -> fox.Timestamp:
    """Clamp a time to 1970 to 2106."""
    return fox.Timestamp(sec=min(max(0, stamp_ns) // 10**9, _LAST_S), nsec=max(0, stamp_ns) % 10**9)


def _parts(target_from_source: Array) -> tuple[fox.Vector3, fox.Quaternion]:
    x, y, z = target_from_source[:3, 3].tolist()
    qw, qx, qy, qz = quat_wxyz_from_rotation(target_from_source[:3, :3]).tolist()
    return fox.Vector3(x=x, y=y, z=z), fox.Quaternion(x=qx, y=qy, z=qz, w=qw)


def _located(target_from_source: Array) -> fox.Pose:
    position, orientation = _parts(target_from_source)
    return fox.Pose(position=position, orientation=orientation)
