"""Failures for other programs: JSON lines, and MCAP with Foxglove's schemas, as its documentation fixes them, and our own."""

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import NoneType
from typing import Any, BinaryIO, get_args, get_type_hints

from mcap.writer import CompressionType, Writer

from fleetmap.errors import disk_errors
from fleetmap.messages import FailureKind, report_dict
from mapserver.fleet.fleet import finite
from mapserver.store import FailureDetail, FailureFilter, FailureRow, MapStore

_PAGE = 200
_LOG_ERROR, _LOG_WARNING = 4, 3


def _object(title: str, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


_NUMBER, _INTEGER, _STRING = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_SECONDS, _NANOSECONDS = {"type": "integer", "minimum": 0}, {"type": "integer", "minimum": 0, "maximum": 999999999}
_TIME = _object("time", sec=_SECONDS, nsec=_NANOSECONDS)
_NAMES = {int: "integer", float: "number", str: "string", NoneType: "null"}


def _schema(hint: Any) -> dict[str, Any]:
    """Of a type, or of a type and None."""
    names = [_NAMES[kind] for kind in get_args(hint) or (hint,)]
    return {"type": names if len(names) > 1 else names[0]}


_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)

SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.Log": _object(
        "foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_STRING, name=_STRING, file=_STRING, line=_INTEGER
    ),
    "foxglove.PoseInFrame": _object(
        "foxglove.PoseInFrame",
        timestamp=_TIME,
        frame_id=_STRING,
        pose=_object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION),
    ),
    "foxglove.CompressedImage": _object(
        "foxglove.CompressedImage",
        timestamp=_TIME,
        frame_id=_STRING,
        data={"type": "string", "contentEncoding": "base64"},
        format=_STRING,
    ),
    "fleetmap.Failure": _object(
        "fleetmap.Failure",
        **{name: _schema(hint) for name, hint in get_type_hints(FailureRow).items()},
        report={"type": "object"},
        pictures={"type": "array", "items": {"type": "object"}},
    ),
}


def failures_oldest_first(store: MapStore, wanted: FailureFilter) -> Iterator[FailureDetail]:
    """Failures with their context, in the order in which they happened."""
    rows, before = [], None
    while page := store.fleet.failures(wanted, before=before, limit=_PAGE):
        rows += [(row.happened_ns, row.number) for row in page]
        before = page[-1].number
    for _, number in sorted(rows):
        yield store.fleet.failure(number)


def as_plain(found: FailureDetail) -> dict[str, Any]:
    """A failure as plain values; pictures by kind and place, without their bytes."""
    report = report_dict(found.report)
    report.pop("thumbnails")
    pictures = [asdict(picture) for picture in found.pictures]
    plain: dict[str, Any] = finite({**asdict(found.failure), "report": report, "pictures": pictures})
    return plain


def write_json_lines(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Writes one failure a line and returns their number; the file appears when it is whole."""
    count = 0
    with _appearing(path) as file:
        for found in failures_oldest_first(store, wanted):
            file.write(json.dumps(as_plain(found), sort_keys=True).encode() + b"\n")
            count += 1
    return count


def write_mcap(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Writes failures as a log, a place in `map`, pictures and the whole report; returns their number."""
    count = 0
    with _appearing(path) as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="", library="fleetmap")
        channels = {}
        for topic, name in _TOPICS.items():
            schema = writer.register_schema(name, "jsonschema", json.dumps(SCHEMAS[name]).encode())
            channels[topic] = writer.register_channel(topic, "json", schema)
        for found in failures_oldest_first(store, wanted):
            for topic, message in _messages(store, found):
                stamp_ns = max(0, found.failure.happened_ns)
                data = json.dumps(message).encode()
                writer.add_message(channels[topic], log_time=stamp_ns, data=data, publish_time=stamp_ns, sequence=count)
            count += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return count


_TOPICS = {
    "/failures/log": "foxglove.Log",
    "/failures/place": "foxglove.PoseInFrame",
    "/failures/frame": "foxglove.CompressedImage",
    "/failures/matches": "foxglove.CompressedImage",
    "/failures/report": "fleetmap.Failure",
}


def _messages(store: MapStore, found: FailureDetail) -> Iterator[tuple[str, dict[str, Any]]]:
    row, placed = found.failure, found.report.map_from_base
    stamp = {"sec": max(0, row.happened_ns) // 10**9, "nsec": max(0, row.happened_ns) % 10**9}
    words = f"{row.kind}: {row.cause}, {row.duration_s:.1f} s, version {row.version}, {row.where or 'outside'}"
    level = _LOG_WARNING if row.kind == FailureKind.SUSPECTED else _LOG_ERROR
    yield (
        "/failures/log",
        {"timestamp": stamp, "level": level, "message": words, "name": row.robot, "file": row.site, "line": row.number},
    )
    if placed is not None:
        (x, y, z), (qw, qx, qy, qz) = finite(list(placed.position_m)), finite(list(placed.quat_wxyz))
        if None not in {x, y, z, qw, qx, qy, qz}:
            place = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}
            yield "/failures/place", {"timestamp": stamp, "frame_id": "map", "pose": place}
    for picture in found.pictures:
        data = base64.b64encode(store.fleet.picture(row.number, picture.place)).decode()
        topic = "/failures/matches" if picture.kind == "matches" else "/failures/frame"
        yield topic, {"timestamp": stamp, "frame_id": "cam0", "format": "jpeg", "data": data}
    yield "/failures/report", as_plain(found)


@contextmanager
def _appearing(path: Path) -> Iterator[BinaryIO]:
    """The file at a path, which appears there when the block ends well. Raises StoreError where the disk refuses."""
    part = path.with_name(path.name + ".part")
    with disk_errors(f"{part} cannot be written", "choose another place"):
        file = part.open("wb")
    try:
        with file:
            yield file
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
