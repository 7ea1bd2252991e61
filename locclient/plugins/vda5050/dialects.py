"""Versions 2.0 and 2.1 of VDA 5050, as translations from and to 3.0, which the adapter speaks. Pure.

What 2.x cannot say becomes what is safe: a robot that is starting or was intervened is MANUAL, an error that stops an order is FATAL.
"""

from collections.abc import Mapping
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


class Dialect:
    """A version of the standard: 2.0.0, 2.1.0 or 3.0.0. major: level of the topics."""

    def __init__(self, version: str) -> None:
        self.version, self.is_old, self.has_maps = version, version != "3.0.0", version != "2.0.0"
        self.major = "v2" if self.is_old else "v3"

    def action_name(self, name: str) -> str:
        """Return the name of an instant action that the adapter knows by 3.0's."""
        return "initPosition" if self.is_old and name == _INITIALIZE else name

    def heard(self, payload: bytes) -> bytes:
        """Translate instant actions to 3.0; the adapter judges what is no message. The schema of 2.0 calls the type `actionName`."""
        if not self.is_old or len(payload) > MAX_PAYLOAD_BYTES:
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

    def said(self, topic: str, content: Message) -> Message:
        """Translate a message of a topic from 3.0."""
        if not self.is_old or topic == "factsheet":  # the manufacturer's file is of the robot's version
            return content
        if topic == "connection":
            return {"connectionState": content["connectionState"].replace("_", "")}
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
        found["actionStates"] = [self._action_state(state) for state in states]
        found["nodeStates"] = [_renamed(node) for node in found["nodeStates"]]
        for name in ("edgeStates", "information"):
            found |= {name: [_renamed(each) for each in found[name]]} if name in found else {}
        found["errors"] = [
            error | {"errorLevel": _LEVELS.get(error["errorLevel"], error["errorLevel"])} for error in found["errors"]
        ]
        return found if self.has_maps else _without_maps(found)

    def _action_state(self, state: Mapping[str, Any]) -> Message:
        found = _renamed(state) | {"actionStatus": _STATUSES.get(state["actionStatus"], state["actionStatus"])}
        return found | ({"actionType": self.action_name(found["actionType"])} if "actionType" in found else {})


def _renamed(content: Mapping[str, Any]) -> Message:
    return {_OLD.get(key, key): value for key, value in content.items()}


def _without_maps(state: Message) -> Message:
    """Translate a state of 2.1 to 2.0."""
    del state["maps"]
    battery = state["batteryState"]
    battery |= {key: round(battery[key]) for key in ("batteryHealth", "reach") if key in battery}
    for node in state["nodeStates"]:
        if "theta" not in node.get("nodePosition", {}):
            node.pop("nodePosition", None)  # which needs an angle there
    for error in state["errors"]:
        if hint := error.pop("errorHint", ""):
            error["errorDescription"] = "; ".join(filter(None, (error.get("errorDescription"), hint)))
    return state
