"""JSON schemas of what is exported: Foxglove's messages, field by field as its documentation fixes them, and our own."""

from typing import Any


def _object(title: str, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


_NUMBER, _INTEGER, _STRING = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_MAYBE_NUMBER = {"type": ["number", "null"]}
_MAYBE_STRING = {"type": ["string", "null"]}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999}},
    "required": ["sec", "nsec"],
}  # fmt: skip
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
        number=_INTEGER,
        site=_STRING,
        robot=_STRING,
        failure_id=_STRING,
        received_ns=_INTEGER,
        happened_ns=_INTEGER,
        duration_s=_NUMBER,
        kind=_STRING,
        cause=_STRING,
        status=_STRING,
        version={"type": ["integer", "null"]},
        tile=_MAYBE_STRING,
        x_map_m=_MAYBE_NUMBER,
        y_map_m=_MAYBE_NUMBER,
        report={"type": "object"},
        pictures={"type": "array", "items": {"type": "object"}},
    ),
}
