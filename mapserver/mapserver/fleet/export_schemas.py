"""JSON schemas of exports: Foxglove's messages, as its documentation fixes them, and our own."""

from types import NoneType
from typing import Any, get_args, get_type_hints

from mapserver.store import FailureRow


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
