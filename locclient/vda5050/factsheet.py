"""Factsheet: the manufacturer's file, completed by the capabilities of the localization."""

from pathlib import Path
from typing import Annotated, Any

import msgspec

from fleetmap.errors import UsageError, disk_errors
from locclient.vda5050.actions import PARAMETERS
from locclient.vda5050.messages import MAX_PAYLOAD_BYTES

_HEADER = ("headerId", "timestamp", "version", "manufacturer", "serialNumber")
_Least = Annotated[float, msgspec.Meta(ge=0)]


class _Camel(msgspec.Struct, rename="camel", kw_only=True):
    pass


class _TypeSpecification(_Camel):
    series_name: str
    mobile_robot_kinematics: str
    mobile_robot_class: str
    maximum_load_mass: _Least
    localization_types: list[str]
    navigation_types: list[str]


class _PhysicalParameters(_Camel):
    minimum_speed: _Least
    maximum_speed: _Least
    maximum_acceleration: _Least
    maximum_deceleration: float
    minimum_height: float
    maximum_height: float
    width: float
    length: float


class _Timing(_Camel):
    minimum_order_interval: _Least
    minimum_state_interval: _Least


class _ProtocolLimits(_Camel):
    maximum_string_lengths: dict[str, Any]
    maximum_array_lengths: dict[str, Any]
    timing: _Timing


class _MobileRobotAction(_Camel):
    action_type: str
    action_scopes: list[str]
    pause_allowed: bool
    cancel_allowed: bool


class _ProtocolFeatures(_Camel):
    optional_parameters: list[dict[str, Any]]
    mobile_robot_actions: list[_MobileRobotAction]


class _Factsheet(_Camel):
    type_specification: _TypeSpecification
    physical_parameters: _PhysicalParameters
    protocol_limits: _ProtocolLimits
    protocol_features: _ProtocolFeatures
    mobile_robot_geometry: dict[str, Any]
    load_specification: dict[str, Any]


def read_factsheet(path: Path) -> dict[str, Any]:
    """Return the content of a factsheet without its header; the file's actions and localization types are kept beside ours.

    Raises UsageError if the file cannot be read, or lacks required objects of the standard at its upper levels.
    """
    with disk_errors(f"[vda5050] factsheet {path} cannot be read", "check the path", UsageError):
        data = path.read_bytes()[: MAX_PAYLOAD_BYTES + 1]
    try:
        if len(data) > MAX_PAYLOAD_BYTES:
            raise ValueError(f"more than {MAX_PAYLOAD_BYTES} bytes")
        msgspec.json.decode(data, type=_Factsheet)
        sheet: dict[str, Any] = msgspec.json.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UsageError(f"[vda5050] factsheet {path}: {error}; it must fit VDA 5050's factsheet.schema") from error
    kinds, features = sheet["typeSpecification"]["localizationTypes"], sheet["protocolFeatures"]
    if "NATURAL" not in kinds:
        kinds.append("NATURAL")
    others = [action for action in features["mobileRobotActions"] if action["actionType"] not in PARAMETERS]
    features["mobileRobotActions"] = [*others, *(_described(kind) for kind in PARAMETERS)]
    return {key: value for key, value in sheet.items() if key not in _HEADER}


def _described(action_type: str) -> dict[str, Any]:
    found: dict[str, Any] = {"actionType": action_type, "actionScopes": ["INSTANT"], "blockingTypes": ["NONE"]}
    found |= {"pauseAllowed": False, "cancelAllowed": False}
    listed = [
        {"key": key, "valueDataType": kind.rstrip("?"), "isOptional": kind.endswith("?")}
        for key, kind in PARAMETERS[action_type].items()
    ]
    return found | ({"actionParameters": listed} if listed else {})
