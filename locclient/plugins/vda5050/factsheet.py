"""Factsheet: the manufacturer's file, completed by the capabilities of the localization."""

from pathlib import Path
from typing import Annotated, Any

import msgspec

from fleetmap.errors import UsageError, disk_errors
from locclient.plugins.vda5050.actions import MAP_ACTIONS, PARAMETERS
from locclient.plugins.vda5050.dialects import Dialect
from locclient.plugins.vda5050.messages import MAX_PAYLOAD_BYTES

_HEADER = ("headerId", "timestamp", "version", "manufacturer", "serialNumber")
_LEAST = Annotated[float, msgspec.Meta(ge=0)]
_OBJECTS: dict[str, Any] = {"loadSpecification": dict[str, Any]}
_KINDS = {"seriesName": str, "localizationTypes": list[str], "navigationTypes": list[str]}
_NEW: dict[str, Any] = _OBJECTS | {
    "typeSpecification": _KINDS | {"mobileRobotKinematics": str, "mobileRobotClass": str, "maximumLoadMass": _LEAST},
    "physicalParameters": dict.fromkeys(("minimumSpeed", "maximumSpeed", "maximumAcceleration"), _LEAST)
    | dict.fromkeys(("maximumDeceleration", "minimumHeight", "maximumHeight", "width", "length"), float),
    "protocolLimits": dict.fromkeys(("maximumStringLengths", "maximumArrayLengths"), dict[str, Any])
    | {"timing": dict.fromkeys(("minimumOrderInterval", "minimumStateInterval"), _LEAST)},
    "protocolFeatures": {
        "optionalParameters": list[dict[str, Any]],
        "mobileRobotActions": [
            {"actionType": str, "actionScopes": list[str], "pauseAllowed": bool, "cancelAllowed": bool}
        ],
    },
    "mobileRobotGeometry": dict[str, Any],
}
_OLD: dict[str, Any] = _OBJECTS | {
    "typeSpecification": _KINDS | {"agvKinematic": str, "agvClass": str, "maxLoadMass": _LEAST},
    "physicalParameters": dict.fromkeys(
        ("speedMin", "speedMax", "accelerationMax", "decelerationMax", "heightMax", "width", "length"), float
    ),
    "protocolLimits": dict.fromkeys(("maxStringLens", "maxArrayLens"), dict[str, Any])
    | {"timing": dict.fromkeys(("minOrderInterval", "minStateInterval"), float)},
    "protocolFeatures": {
        "optionalParameters": list[dict[str, Any]],
        "agvActions": [{"actionType": str, "actionScopes": list[str]}],
    },
    "agvGeometry": dict[str, Any],
}
"""What the standard's upper levels require, by name: a type, the same of an object, or of each object in a list."""


def _type(shape: Any) -> Any:
    if isinstance(shape, list):
        return list[_type(shape[0])]  # type: ignore[misc]
    if not isinstance(shape, dict):
        return shape
    fields = [(f"field_{number}", _type(of)) for number, of in enumerate(shape.values())]
    names = dict(zip((name for name, _ in fields), shape, strict=True))
    return msgspec.defstruct("Object", fields, rename=names, kw_only=True)


def read_factsheet(path: Path, spoken: Dialect) -> dict[str, Any]:
    """Return the content of a factsheet in the spoken version without its header; its actions and localization types are kept beside ours.

    Raises UsageError if the file cannot be read, or lacks required objects of the standard at its upper levels.
    """
    with disk_errors(f"[vda5050] factsheet {path} cannot be read", "check the path", UsageError):
        data = path.read_bytes()[: MAX_PAYLOAD_BYTES + 1]
    try:
        if len(data) > MAX_PAYLOAD_BYTES:
            raise ValueError(f"more than {MAX_PAYLOAD_BYTES} bytes")
        msgspec.json.decode(data, type=_type(_OLD if spoken.is_old else _NEW))
        sheet: dict[str, Any] = msgspec.json.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UsageError(
            f"[vda5050] factsheet {path}: {error}; it must fit the factsheet.schema of VDA 5050 {spoken.version}"
        ) from error
    kinds, features = sheet["typeSpecification"]["localizationTypes"], sheet["protocolFeatures"]
    if "NATURAL" not in kinds:
        kinds.append("NATURAL")
    ours = [kind for kind in PARAMETERS if not spoken.is_old or kind != "clearInstantActions"]
    described = [_described(kind, spoken) for kind in ours if spoken.has_maps or kind not in MAP_ACTIONS]
    key, own = "agvActions" if spoken.is_old else "mobileRobotActions", {action["actionType"] for action in described}
    features[key] = [*(action for action in features[key] if action["actionType"] not in own), *described]
    return {key: value for key, value in sheet.items() if key not in _HEADER}


def _described(action_type: str, spoken: Dialect) -> dict[str, Any]:
    found: dict[str, Any] = {"actionType": spoken.action_name(action_type), "actionScopes": ["INSTANT"]}
    if not spoken.is_old:  # the schema of 2.1 allows no list of blockingTypes
        found |= {"blockingTypes": ["NONE"], "pauseAllowed": False, "cancelAllowed": False}
    listed = [
        {"key": key, "valueDataType": kind.rstrip("?"), "isOptional": kind.endswith("?")}
        for key, kind in PARAMETERS[action_type].items()
    ]
    return found | ({"actionParameters": listed} if listed else {})
