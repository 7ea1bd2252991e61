"""What fleet managers of VDA 5050 2.0 and 2.1 hear fits their official schemas, and what they say is understood."""

import json
from pathlib import Path
from typing import Any

import pytest

from fleetmap.errors import LinkError, UsageError
from locclient.plugins.vda5050.dialects import Dialect
from locclient.plugins.vda5050.factsheet import read_factsheet
from locclient.plugins.vda5050.messages import MAX_PAYLOAD_BYTES, InstantActions, RobotPart, decode, timestamp
from support.fleet_manager.vda5050_master import validator

OLD = ("2.0.0", "2.1.0")
PLACE = {"x": 1.0, "y": 2.0, "theta": 0.5, "mapId": "hall", "localized": True, "deviationRange": 0.1}
# Every field that a robot's program may give, in the values that 2.x does not have.
STATE: dict[str, Any] = {
    "orderId": "o", "orderUpdateId": 1, "lastNodeId": "n", "lastNodeSequenceId": 2, "driving": True, "paused": False,
    "operatingMode": "TEACH_IN", "mobileRobotPosition": PLACE, "velocity": {"vx": 1.0}, "loads": [{"loadId": "l", "weight": 3.0}],
    "maps": [{"mapId": "hall", "mapVersion": "7", "mapStatus": "ENABLED"}],
    "nodeStates": [
        {"nodeId": "n", "sequenceId": 1, "released": True, "nodeDescriptor": "door", "nodePosition": {"x": 1.0, "y": 2.0, "mapId": "hall"}},
        {"nodeId": "m", "sequenceId": 3, "released": True, "nodePosition": {"x": 1.0, "y": 2.0, "theta": 0.1, "mapId": "hall"}},
    ],
    "edgeStates": [{"edgeId": "e", "sequenceId": 2, "released": False, "edgeDescriptor": "aisle"}],
    "actionStates": [{"actionId": "a", "actionStatus": "PAUSED", "actionResult": "half"}],
    "instantActionStates": [{"actionId": "b", "actionType": "initializePosition", "actionStatus": "RETRIABLE"}],
    "powerSupply": {"stateOfCharge": 50.0, "charging": False, "batteryCurrent": 1.5, "batteryHealth": 90.4, "range": 12.5},
    "safetyState": {"activeEmergencyStop": "MANUAL", "fieldViolation": True},
    "errors": [
        {"errorType": "LOCALIZATION_ERROR", "errorLevel": "CRITICAL", "errorDescription": "lost", "errorHint": "lights"},
        {"errorType": "X", "errorLevel": "URGENT"},
    ],
    "information": [{"infoType": "i", "infoLevel": "INFO", "infoDescriptor": "words"}],
}  # fmt: skip


def headed(version: str, content: dict[str, Any]) -> dict[str, Any]:
    head = {"headerId": 1, "timestamp": timestamp(10**18), "version": version}
    return head | {"manufacturer": "acme", "serialNumber": "1"} | content


@pytest.mark.parametrize("version", OLD)
def test_a_state_of_any_content_fits(version: str) -> None:
    said = Dialect(version).said("state", STATE)
    assert list(validator("state", version).iter_errors(headed(version, said))) == []
    assert said["agvPosition"]["positionInitialized"] is True
    assert said["operatingMode"] == "TEACHIN"
    assert said["safetyState"] == {"eStop": "MANUAL", "fieldViolation": True}
    assert [state["actionStatus"] for state in said["actionStates"]] == ["RUNNING", "FAILED"]
    assert said["actionStates"][1]["actionType"] == "initPosition"
    assert [error["errorLevel"] for error in said["errors"]] == ["FATAL", "WARNING"]
    assert "lights" in str(said["errors"][0])
    assert ("maps" in said) == (version == "2.1.0")
    assert said["batteryState"]["reach"] == (12 if version == "2.0.0" else 12.5)


@pytest.mark.parametrize(
    "mode", ["STARTUP", "AUTOMATIC", "SEMIAUTOMATIC", "INTERVENED", "MANUAL", "SERVICE", "TEACH_IN"]
)
@pytest.mark.parametrize("stop", ["MANUAL", "REMOTE", "NONE"])
def test_every_mode_of_a_robot_fits(mode: str, stop: str) -> None:
    content = STATE | {"operatingMode": mode, "safetyState": {"activeEmergencyStop": stop, "fieldViolation": False}}
    part = {key: content[key] for key in ("operatingMode", "safetyState", "powerSupply")}
    decode(json.dumps(part).encode(), RobotPart)
    for version in OLD:
        said = headed(version, Dialect(version).said("state", content))
        assert list(validator("state", version).iter_errors(said)) == []


@pytest.mark.parametrize("version", OLD)
@pytest.mark.parametrize("topic, content", [
    ("connection", {"connectionState": "CONNECTION_BROKEN"}),
    ("visualization", {"referenceStateHeaderId": 3, "mobileRobotPosition": PLACE, "velocity": {"vx": 1.0}}),
])  # fmt: skip
def test_other_topics_fit(version: str, topic: str, content: dict[str, Any]) -> None:
    said = Dialect(version).said(topic, content)
    assert list(validator(topic, version).iter_errors(headed(version, said))) == []
    assert "referenceStateHeaderId" not in said
    assert said.get("connectionState", "CONNECTIONBROKEN") == "CONNECTIONBROKEN"


def test_instant_actions_of_all_versions_are_understood() -> None:
    given = [{"key": "x", "value": 1.0}]
    action = {"actionId": "a", "blockingType": "NONE", "actionDescription": "words", "actionParameters": given}
    by_version = {"2.0.0": action | {"actionName": "initPosition"}, "2.1.0": action | {"actionType": "initPosition"}}
    for version, asked in by_version.items():
        message = headed(version, {"actions": [asked]})
        assert list(validator("instantActions", version).iter_errors(message)) == []
        (heard,) = decode(Dialect(version).heard(json.dumps(message).encode()), InstantActions).actions
        assert (heard.action_type, heard.action_id, heard.action_descriptor) == ("initializePosition", "a", "words")
        assert heard.action_parameters[0].key == "x"
        for optional in ("actionDescription", "actionParameters"):
            message = {"headerId": 1, "actions": [asked | {optional: None}]}
            (heard,) = decode(Dialect(version).heard(json.dumps(message).encode()), InstantActions).actions
            assert (heard.action_type, heard.action_id) == ("initializePosition", "a")


@pytest.mark.parametrize(
    "payload", [b"", b"[]", b"{", b"null", b"\xff", b"{}", b'{"actions": 3}', b'{"actions": [3]}', b"[" * 10_000]
)
def test_what_is_no_message_is_left_to_the_adapter(payload: bytes) -> None:
    with pytest.raises(LinkError):
        decode(Dialect("2.1.0").heard(payload), InstantActions)
    with pytest.raises(LinkError, match="limit"):
        decode(Dialect("2.1.0").heard(b" " * (MAX_PAYLOAD_BYTES + 1)), InstantActions)


@pytest.mark.parametrize("version", OLD)
def test_a_factsheet_of_an_older_version_is_completed(version: str, tmp_path: Path) -> None:
    path, spoken = tmp_path / "factsheet.json", Dialect(version)
    sheet = {
        "typeSpecification": {
            "seriesName": "T", "agvKinematic": "DIFF", "agvClass": "TUGGER", "maxLoadMass": 500, "localizationTypes": ["RFID"],
            "navigationTypes": ["AUTONOMOUS"],
        },
        "physicalParameters": {
            "speedMin": 0, "speedMax": 2, "accelerationMax": 1, "decelerationMax": 1, "heightMax": 1, "width": 1, "length": 2,
        },
        "protocolLimits": {"maxStringLens": {}, "maxArrayLens": {}, "timing": {"minOrderInterval": 1, "minStateInterval": 1}},
        "protocolFeatures": {"optionalParameters": [], "agvActions": [{"actionType": "pick", "actionScopes": ["NODE"]}]},
        "agvGeometry": {}, "loadSpecification": {},
    }  # fmt: skip
    path.write_text(json.dumps(sheet))
    said = headed(version, read_factsheet(path, spoken))
    assert list(validator("factsheet", version).iter_errors(said)) == []
    names = [action["actionType"] for action in said["protocolFeatures"]["agvActions"]]
    assert {"pick", "initPosition"} <= set(names)
    assert ("downloadMap" in names) == (version == "2.1.0")
    sheet.pop("agvGeometry")
    path.write_text(json.dumps(sheet))
    with pytest.raises(UsageError, match=version):
        read_factsheet(path, spoken)
