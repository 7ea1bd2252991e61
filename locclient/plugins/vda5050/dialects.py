"""Versions 2.0 and 2.1 of VDA 5050, as translations from and to 3.0, which the adapter speaks. Pure.

What 2.x cannot say becomes what is safe: a robot that is starting or was intervened is MANUAL, an error that stops an order is FATAL.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec

from fleetmap.encoding import to_json
from locclient.plugins.vda5050.messages import MAX_PAYLOAD_BYTES, without_nulls

Message = dict[str, Any]
_INITIALIZE = "initializePosition"
_MODES = {"STARTUP": "MANUAL", "INTERVENED": "MANUAL", "TEACH_IN": "TEACHIN"}
_LEVELS = {"URGENT": "WARNING", "CRITICAL": "FATAL"}
_STATUSES = {"PAUSED": "RUNNING", "RETRIABLE": "FAILED"}
_POWER = {"stateOfCharge": "batteryCharge", "batteryVoltage": "batteryVoltage", "batteryHealth": "batteryHealth"}
_POWER |= {"charging": "charging", "range": "reach"}
_OLD = {"nodeDescriptor": "nodeDescription", "edgeDescriptor": "edgeDescription", "infoDescriptor": "infoDescription"}
_OLD |= {
    "actionDescriptor": "actionDescription",
    "actionResult": "resultDescription",
    "localized": "positionInitialized",
}


@dataclass(frozen=True, slots=True)
class Dialect:
    """A version of the standard. major: level of the topics. action_name: of an instant action that the adapter knows by 3.0's.

    heard: translates instant actions to 3.0; said: translates a message of a topic from 3.0.
    """

    version: str
    major: str
    has_maps: bool
    action_name: Callable[[str], str]
    heard: Callable[[bytes], bytes]
    said: Callable[[str, Message], Message]


def dialect(version: str) -> Dialect:
    """Return the dialect of a version: 2.0.0, 2.1.0 or 3.0.0."""
    if version == "3.0.0":
        return Dialect(version, "v3", True, lambda name: name, lambda payload: payload, lambda _, content: content)
    return Dialect(version, "v2", version != "2.0.0", _old_action, _new_actions, partial(_old, version))


def _old_action(name: str) -> str:
    return "initPosition" if name == _INITIALIZE else name


def _new_actions(payload: bytes) -> bytes:
    """Translate instant actions to 3.0; the adapter judges what is no message. The schema of 2.0 calls the type `actionName`."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return payload
    try:
        message = without_nulls(msgspec.json.decode(payload, type=dict[str, Any]))
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return payload
    actions = message.get("actions", message.get("instantActions"))
    for action in actions if isinstance(actions, list) else []:
        if isinstance(action, dict):
            name = action.get("actionType", action.get("actionName"))
            action["actionType"] = _INITIALIZE if name == "initPosition" else name
            action["actionDescriptor"] = action.get("actionDescription", "")
    return to_json({"headerId": 0} | message | {"actions": actions})


def _old(version: str, topic: str, content: Message) -> Message:
    if topic == "connection":
        return {"connectionState": content["connectionState"].replace("_", "")}
    if topic == "factsheet":
        return content  # the manufacturer's file is of the robot's version
    found = dict(content)
    if (place := found.pop("mobileRobotPosition", None)) is not None:
        found["agvPosition"] = _renamed(place)
    if topic == "visualization":
        del found["referenceStateHeaderId"]
        return found
    power, safety = found.pop("powerSupply"), found.pop("safetyState")
    found["batteryState"] = {_POWER[key]: value for key, value in power.items() if key in _POWER}
    found["safetyState"] = {"eStop": safety["activeEmergencyStop"], "fieldViolation": safety["fieldViolation"]}
    found["operatingMode"] = _MODES.get(found["operatingMode"], found["operatingMode"])
    states = [*found["actionStates"], *found.pop("instantActionStates", [])]
    found["actionStates"] = [_action_state(state) for state in states]
    found["nodeStates"] = [_node(version, node) for node in found["nodeStates"]]
    for name in ("edgeStates", "information"):
        found |= {name: [_renamed(each) for each in found[name]]} if name in found else {}
    found["errors"] = [_error(version, error) for error in found["errors"]]
    if version == "2.0.0":
        del found["maps"]
        battery = found["batteryState"]
        battery |= {key: round(battery[key]) for key in ("batteryHealth", "reach") if key in battery}
    return found


def _renamed(content: Mapping[str, Any]) -> Message:
    return {_OLD.get(key, key): value for key, value in content.items()}


def _action_state(state: Mapping[str, Any]) -> Message:
    found = _renamed(state) | {"actionStatus": _STATUSES.get(state["actionStatus"], state["actionStatus"])}
    return found | ({"actionType": _old_action(found["actionType"])} if "actionType" in found else {})


def _node(version: str, node: Mapping[str, Any]) -> Message:
    found = _renamed(node)
    if version == "2.0.0" and "theta" not in found.get("nodePosition", {}):
        found.pop("nodePosition", None)  # which needs an angle there
    return found


def _error(version: str, error: Mapping[str, Any]) -> Message:
    found = dict(error) | {"errorLevel": _LEVELS.get(error["errorLevel"], error["errorLevel"])}
    if version == "2.0.0" and (hint := found.pop("errorHint", "")):
        found["errorDescription"] = "; ".join(filter(None, (found.get("errorDescription"), hint)))
    return found
