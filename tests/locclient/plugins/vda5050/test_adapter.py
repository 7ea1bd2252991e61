"""What the adapter says is what the official schemas allow, whatever came; each wrong input gets an error of its own."""

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import ValidationError, convert

from fleetmap.errors import UsageError
from fleetmap.geometry import se3, so3_exp
from fleetmap.mapformat.building import BuildingFrame, Floor, FloorEntry
from fleetmap.messages import Cause, Status, WantedVersion
from locclient import hooks
from locclient.hooks import LinkedRobot
from locclient.plugins.vda5050.adapter import FleetAdapter
from locclient.plugins.vda5050.dialects import Dialect
from locclient.plugins.vda5050.factsheet import read_factsheet
from locclient.plugins.vda5050.localization import Localization, Position
from locclient.plugins.vda5050.messages import MAX_PAYLOAD_BYTES, timestamp
from locclient.plugins.vda5050.settings import Vda5050Section, check_section
from locclient.robot.continuous_odom import PublishedPose
from locclient.robot.version_trial import Change, VersionChange
from support.fleet.estimates import estimate
from support.fleet_manager.vda5050_master import validator

HEADER = {
    "headerId": 1, "timestamp": timestamp(1_767_323_045_123_456_789), "version": "3.0.0", "manufacturer": "acme", "serialNumber": "1",
}  # fmt: skip
PART = {
    "operatingMode": "AUTOMATIC",
    "powerSupply": {"stateOfCharge": 50, "charging": True, "range": 12.5},
    "safetyState": {"activeEmergencyStop": "NONE", "fieldViolation": False},
}
PLACED = b"""{"headerId": 1, "actions": [{"actionId": "p", "actionType": "initializePosition", "blockingType": "NONE",
    "actionParameters": [{"key": "x", "value": %s}]}]}"""
PLACE = Position(1.0, 2.0, 3.14159265358979, 0.12)


def seen(
    status: Status = Status.TRACKING, cause: Cause = Cause.NONE, *, version: int | None = 1, position: Position | None = PLACE
) -> Localization:  # fmt: skip
    last = replace(estimate(1e-8, status, version=version), cause=cause)
    is_localized = status is Status.TRACKING and position is not None
    return Localization(last, position, is_localized, is_silent=False)


def frame(
    placed: PublishedPose, status: Status = Status.TRACKING, cause: Cause = Cause.NONE, *, sigma_m: float = 0.01,
    version: int = 1, floor: str = "", protection_m: float = 0.1,
) -> Any:  # fmt: skip
    """What the robot makes of a frame."""
    estimate = SimpleNamespace(
        status=status, cause=cause, stamp_ns=7, cov_rot_trans=np.eye(6) * sigma_m**2, map_version=version, floor=floor,
        protection_m=protection_m,
    )  # fmt: skip
    return SimpleNamespace(estimate=estimate, published=placed, speed_mps=0.0)


class FakeMaps:
    """Versions without bytes."""

    def __init__(self) -> None:
        self.held = [(1, True), (2, False)]

    def versions(self) -> list[tuple[int, bool]]:
        return self.held

    def wanted(self, version: int) -> WantedVersion:
        return WantedVersion(site="hall", version=version, manifest_sha256=f"{version:064x}")

    def delete(self, version: int, in_use: set[int]) -> None:
        self.held = [entry for entry in self.held if entry[0] != version]


class Adapter(FleetAdapter):
    """With a clock to turn, and everything that it asks for kept."""

    def __init__(self, **settings: Any) -> None:
        self.now_s, self.offers, self.priors = 100.0, [], []
        self.schema = validator("state")
        self.older = [(Dialect(version), validator("state", version)) for version in ("2.0.0", "2.1.0")]
        client: Any = SimpleNamespace(site="hall", active=lambda: None)
        robot = LinkedRobot(client, False, 3.0, self.offers.append, self.priors.append)
        super().__init__(Vda5050Section(**settings), FakeMaps(), robot, lambda: self.now_s)  # type: ignore[arg-type]
        self.work()
        self._see(seen())

    def said(self) -> dict[str, Any]:
        """The state as it leaves."""
        state = json.loads(msgspec.json.encode({**HEADER, **self.state()}))
        assert list(self.schema.iter_errors(state)) == []
        for spoken, schema in self.older:
            told = {**HEADER, **spoken.said("state", state)}
            assert list(schema.iter_errors(told)) == []
            assert not told.keys() & {"mobileRobotPosition", "powerSupply", "instantActionStates"}
        return state

    def ask(self, kind: str = "enableMap", name: str = "a", **parameters: Any) -> dict[str, Any]:
        listed = [{"key": key, "value": value} for key, value in parameters.items()]
        action = {"actionId": name, "actionType": kind, "blockingType": "NONE", "actionParameters": listed}
        self.instant_actions(json.dumps({**HEADER, "actions": [action]}).encode())
        self.work()
        return next(state for state in self.said()["instantActionStates"] if state["actionId"] == name)

    def error_types(self) -> list[str]:
        return [error["errorType"] for error in self.said()["errors"]]


def test_a_position_is_said_as_sure_as_it_is() -> None:
    adapter = Adapter()
    adapter.robot_part(json.dumps(PART).encode())
    place = adapter.said()["mobileRobotPosition"]
    assert (place["x"], place["y"], place["mapId"], place["localized"]) == (1.0, 2.0, "hall", True)
    assert place["deviationRange"] == 0.12
    assert place["localizationScore"] == pytest.approx(0.96)
    assert adapter.error_types() == []
    assert adapter.said()["powerSupply"] == PART["powerSupply"]


@pytest.mark.parametrize(("level_m", "is_localized"), [(0.2, True), (0.31, False), (np.inf, False)])
def test_a_robot_stops_above_its_alert_limit(level_m: float, is_localized: bool) -> None:
    placed = PublishedPose(np.eye(4), np.eye(4))
    localization = Localization().after(frame(placed, protection_m=level_m), 3.0, np.eye(4), stop_above_m=0.3)
    position = localization.mobile_robot_position("hall", 3.0)
    assert position["localized"] is is_localized
    assert (localization.error() is None) is is_localized
    assert position["localizationScore"] == pytest.approx(1 - level_m / 3 if is_localized else 0.0)


@pytest.mark.parametrize("status", [Status.LOST, Status.AMBIGUOUS, Status.INITIALISING])
@pytest.mark.parametrize("cause", Cause)
def test_a_robot_that_is_not_localized_says_why(status: Status, cause: Cause) -> None:
    adapter = Adapter()
    adapter._see(seen(status, cause))
    state = adapter.said()
    assert state["mobileRobotPosition"]["localized"] is False
    assert "deviationRange" not in state["mobileRobotPosition"]
    (error,) = (error for error in state["errors"] if error["errorType"] == "LOCALIZATION_ERROR")
    assert error["errorLevel"] == "FATAL"
    assert len(error["errorHint"]) > 10


@pytest.mark.parametrize(("sigma_m", "is_localized"), [(0.1, True), (2.0, False)])
def test_a_position_beyond_the_lost_radius_is_none(sigma_m: float, is_localized: bool) -> None:
    """The check of the calibration widens covariances of estimates that keep their status."""
    placed, adapter = PublishedPose(np.eye(4), np.eye(4)), Adapter()
    adapter.after_frame(frame(placed, Status.DEGRADED, Cause.CALIBRATION, sigma_m=sigma_m), frozenset({1}), {}, {})
    assert adapter.said()["mobileRobotPosition"]["localized"] is is_localized
    assert ("LOCALIZATION_ERROR" in adapter.error_types()) is not is_localized


def test_each_floor_has_its_map_id() -> None:
    """The site's name; in the building's frame positions of a floor are by its own alignment."""
    adapter, floors = Adapter(frame="building"), {}
    for number, site in enumerate(("", "hall-2")):
        entry = FloorEntry(site=site or "hall", level=f"L{number}", height_m=4.0 * number)
        floors[site] = Floor(entry, BuildingFrame(x_m=10.0 * number, y_m=0.0, yaw_rad=0.0))
    placed = PublishedPose(np.eye(4), np.eye(4), floors["hall-2"].building_from_map)
    adapter.after_frame(frame(placed, version=5, floor="hall-2"), frozenset({1}), floors, {"hall-2": 5})
    state = adapter.said()
    assert (state["mobileRobotPosition"]["mapId"], state["mobileRobotPosition"]["x"]) == ("hall-2", 10.0)
    assert {"mapId": "hall-2", "mapVersion": "5", "mapStatus": "ENABLED"} in state["maps"]
    adapter.order(_order("hall-2"))
    assert "UNKNOWN_MAP_ID" not in adapter.error_types()
    adapter.after_frame(frame(placed, Status.LOST, version=5, floor="hall-2"), frozenset({1}), floors, {"hall-2": 5})
    given = {"x": 12.0, "y": 1.0, "theta": 0.0, "lastNodeId": "n"}
    assert adapter.ask("initializePosition", "a", mapId="hall-2", **given)["actionStatus"] == "RUNNING"
    (prior,) = adapter.priors
    assert prior.floor == "hall-2"
    np.testing.assert_allclose(prior.map_from_base[:2, 3], [2.0, 1.0])
    assert adapter.ask("initializePosition", "b", mapId="hall-3", **given)["actionStatus"] == "FAILED"
    here, other = Position(1.0, 2.0, 0.0), Position(1.0, 2.0, 0.0, site="hall-2")
    assert here.away_from(other)[0] == np.inf
    adapter.map_id = "hall-2"  # as configured for the own site: it names one map
    assert "mobileRobotPosition" not in adapter.said()
    assert adapter.ask("initializePosition", "c", mapId="hall-2", **given)["actionStatus"] == "RUNNING"
    assert adapter.priors[-1].floor == ""


def test_positions_are_in_the_building_where_that_is_asked_for() -> None:
    adapter = Adapter(frame="building")
    building_from_map = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([10.0, -20.0, 0.0]))
    map_from_odom = se3(np.eye(3), np.array([3.0, 1.0, 0.0]))
    given = {"x": 9.0, "y": -17.0, "theta": np.pi / 2, "mapId": "hall", "lastNodeId": "n"}

    def drive(known: np.ndarray | None, status: Status = Status.TRACKING) -> dict[str, Any]:
        adapter.after_frame(frame(PublishedPose(np.eye(4), map_from_odom, known), status), frozenset({1}), {}, {})
        return adapter.said()

    unknown = drive(None)
    assert "mobileRobotPosition" not in unknown
    (lost,) = (error for error in unknown["errors"] if error["errorType"] == "LOCALIZATION_ERROR")
    assert "its pose in the building" in lost["errorHint"]
    assert adapter.ask("initializePosition", "a", **given)["actionStatus"] == "FAILED"
    place = drive(building_from_map)["mobileRobotPosition"]
    assert (place["x"], place["y"], place["theta"]) == pytest.approx((9.0, -17.0, np.pi / 2))
    assert place["localized"] is True
    drive(building_from_map, Status.DEGRADED)
    adapter.ask("initializePosition", "b", **given)
    np.testing.assert_allclose(adapter.priors[-1].map_from_base, map_from_odom, atol=1e-12)


def test_a_loss_between_two_states_is_told() -> None:
    adapter = Adapter()
    adapter.said()
    adapter._see(seen(Status.LOST))
    adapter._see(seen())
    adapter.changed.clear()
    assert adapter.said()["errors"][0]["errorType"] == "LOCALIZATION_ERROR"
    assert adapter.changed.is_set(), "and what is true now follows at once"
    assert adapter.said()["mobileRobotPosition"]["localized"] is True


def test_without_images_or_a_map_it_is_not_localized() -> None:
    adapter = Adapter()
    adapter.silence()
    assert "no images" in adapter.said()["errors"][0]["errorHint"]
    assert adapter.said()["mobileRobotPosition"]["localized"] is False
    adapter._see(seen(version=None, position=None))
    assert "no map" in adapter.said()["errors"][0]["errorHint"]
    assert "mobileRobotPosition" not in adapter.said()


def test_the_robots_own_part_is_missed_and_checked() -> None:
    adapter = Adapter()
    assert adapter.said()["operatingMode"] == "STARTUP"
    assert adapter.said()["safetyState"]["fieldViolation"] is True, "nothing is said that looks safe"
    assert adapter.error_types() == ["ROBOT_PART_MISSING"]
    adapter.robot_part(json.dumps(PART).encode())
    assert adapter.said()["operatingMode"] == "AUTOMATIC"
    for wrong in (
        {"operatingMode": "FLYING"}, {"powerSupply": {"stateOfCharge": 101, "charging": True}}, {"maps": []},
        {"errors": [{"errorType": "X", "errorLevel": "MILD"}]}, {"nodeStates": [{"nodeId": "n"}]}, {"velocity": {"vx": "fast"}},
    ):  # fmt: skip
        adapter.robot_part(json.dumps({**PART, **wrong}).encode())
        assert adapter.error_types() == ["ROBOT_PART_INVALID"], wrong
        assert adapter.said()["operatingMode"] == "AUTOMATIC", "the last one stands"
    bent = {"errorType": "FORK_BENT", "errorLevel": "URGENT", "errorHint": None}
    optional = dict.fromkeys(
        ["nodeStates", "actionStates", "orderId", "lastNodeId", "velocity", "loads", "information"]
    )
    adapter.robot_part(json.dumps({**PART, **optional, "errors": [bent]}).encode())
    assert adapter.error_types() == ["FORK_BENT"]
    adapter.now_s += 11.0
    assert adapter.error_types() == ["ROBOT_PART_MISSING"]


MALFORMED = {
    "empty": b"",
    "cut": b"{",
    "no text": b"\xff\xfe",
    "list": b"[]",
    "half": b'{"headerId": 1}',
    "deep": b"[" * 200_000,
    "huge": b'{"headerId":1,"actions":' + b" " * MAX_PAYLOAD_BYTES + b"[]}",
    "400 digits": PLACED % (b"1" * 400),
    "5000 digits": PLACED % (b"1" * 5000),
    "1e400": PLACED % b"1e400",
    "NaN": PLACED % b"NaN",
    "nested": PLACED % (b"[" * 2000 + b"]" * 2000),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_messages_are_said_and_change_nothing(name: str) -> None:
    adapter, payload = Adapter(), MALFORMED[name]
    for take in (adapter.instant_actions, adapter.order):
        take(payload)
        adapter.instant_actions(Dialect("2.1.0").heard(payload))
    assert adapter.error_types() == [*["VALIDATION_FAILURE"] * 3, "ROBOT_PART_MISSING"]
    assert adapter.said()["instantActionStates"] == []
    assert adapter.ask("stateRequest")["actionStatus"] == "FINISHED"
    assert adapter.error_types() == ["ROBOT_PART_MISSING"], "it ends when another action is accepted"


@pytest.mark.parametrize(
    ("kind", "parameters", "error_type", "words"),
    [
        ("makeCoffee", {}, "INVALID_INSTANT_ACTION", "unknown here; known are downloadMap"),
        ("enableMap", {"mapId": "hall"}, "INVALID_INSTANT_ACTION", "needs the parameter mapVersion"),
        ("enableMap", {"mapId": "hall", "mapVersion": 2}, "INVALID_INSTANT_ACTION", "must be a string"),
        ("enableMap", {"mapId": "hall", "mapVersion": "2", "x": 1}, "INVALID_INSTANT_ACTION", "no parameter 'x'"),
        ("enableMap", {"mapId": "yard", "mapVersion": "2"}, "UNKNOWN_MAP_ID", "'yard'"),
        ("enableMap", {"mapId": "hall", "mapVersion": "2.1"}, "UNKNOWN_MAP_ID", "'2.1'"),
        ("initializePosition", {"x": True, "y": 0, "theta": 0, "mapId": "hall", "lastNodeId": "n"}, "INVALID_INSTANT_ACTION", "number"),
        ("initializePosition", {"x": 1, "y": 2, "theta": 9, "mapId": "hall", "lastNodeId": "n"}, "INITIALIZE_POSITION_FAILED", "theta"),
        ("initializePosition", {"x": 1, "y": 2, "theta": 0, "mapId": "yard", "lastNodeId": "n"}, "INITIALIZE_POSITION_FAILED", "'yard'"),
        ("initializePosition", {"x": 99, "y": 2, "theta": 3, "mapId": "hall", "lastNodeId": "n"}, "INITIALIZE_POSITION_FAILED", "98.00 m"),
        ("factsheetRequest", {}, "FACTSHEET_MISSING", "factsheet"),
    ],
)  # fmt: skip
def test_actions_that_cannot_be_done_fail(kind: str, parameters: dict[str, Any], error_type: str, words: str) -> None:
    adapter = Adapter()
    state = adapter.ask(kind, **parameters)
    assert state["actionStatus"] == "FAILED"
    assert words in state["actionResult"]
    (error,) = (error for error in adapter.said()["errors"] if error["errorType"] == error_type)
    assert error["errorLevel"] == "WARNING"
    assert {"referenceKey": "actionId", "referenceValue": "a"} in error["errorReferences"]


def test_where_no_level_is_promised_a_robot_is_not_everywhere() -> None:
    adapter = Adapter()
    adapter._see(seen(position=PLACE._replace(radius_m=np.inf)))
    state = adapter.ask("initializePosition", x=99, y=2, theta=3, mapId="hall", lastNodeId="n")
    assert "98.00 m" in state["actionResult"]


def test_an_action_that_ends_by_a_fault_of_ours_does_not_run_for_ever() -> None:
    adapter = Adapter()
    with pytest.raises(AttributeError):  # FakeMaps has no download
        adapter.ask("downloadMap", mapId="hall", mapVersion="3", mapDownloadLink="https://maps.example/3")
    assert [state["actionStatus"] for state in adapter.said()["instantActionStates"]] == ["FAILED"]
    assert adapter.offers == adapter.priors == []


def test_others_actions_repeated_actions_and_floods() -> None:
    adapter = Adapter(robot_actions=("startPause",))
    with pytest.raises(StopIteration):
        adapter.ask("startPause")
    adapter.ask("makeCoffee")
    adapter.ask("makeCoffee")
    assert adapter.error_types().count("INVALID_INSTANT_ACTION") == 1, "the same actionId again is the same action"
    for number in range(300):
        adapter.ask("stateRequest", f"s-{number}")
    assert len(adapter.said()["instantActionStates"]) == 200
    adapter.ask("clearInstantActions", "c")
    assert [state["actionId"] for state in adapter.said()["instantActionStates"]] == ["c"]


@pytest.mark.parametrize(("version", "left"), [("2.0.0", "bc"), ("2.1.0", "bc"), ("3.0.0", "abc")])
def test_a_new_order_ends_the_states_of_finished_actions_in_2_x(version: str, left: str) -> None:
    """Source: actionStates in the schemas of 2.0.0 and 2.1.0, kept until a new order is received."""
    adapter = Adapter(version=version)

    def ids(**order: object) -> str:
        adapter.robot_part(json.dumps({**PART, **order}).encode())
        return "".join(state["actionId"] for state in adapter.said()["instantActionStates"])

    assert ids(orderId="o-1") == ""
    adapter.ask("stateRequest", "a")
    adapter.ask("enableMap", "b", mapId="hall", mapVersion="2")
    assert ids() == ids(orderId="o-1") == ids(orderId="o-1", orderUpdateId=1) == "ab", "an update is no new order"
    untold = {"actionId": "c", "actionType": "stateRequest", "blockingType": "NONE"}
    adapter.instant_actions(json.dumps({**HEADER, "actions": [untold]}).encode())
    assert ids(orderId="o-2") == left, "b is running, and the end of c was in no state yet"
    assert ids(orderId="o-3") == left.replace("c", "" if left == "bc" else "c")


def test_a_version_on_trial_is_running_until_the_localizer_decides() -> None:
    adapter = Adapter()
    assert adapter.ask(name="a", mapId="hall", mapVersion="1")["actionStatus"] == "FINISHED", "it is enabled already"
    assert adapter.ask(name="b", mapId="hall", mapVersion="2")["actionStatus"] == "RUNNING"
    assert adapter.ask(name="c", mapId="hall", mapVersion="2")["actionStatus"] == "WAITING"
    (wanted,) = adapter.offers
    adapter._maps.held = [(1, False), (2, True)]
    adapter.changed_version(VersionChange(wanted, Change.ADOPTED))
    statuses = [entry["mapStatus"] for entry in adapter.said()["maps"]]
    assert statuses == ["DISABLED", "ENABLED"], "finished and enabled in one state"
    adapter._maps.held = [(1, True), (2, False)]
    adapter.work()
    adapter.changed_version(VersionChange(wanted, Change.REFUSED, "fixes contradict it"))
    by_name = {state["actionId"]: state for state in adapter.said()["instantActionStates"]}
    assert by_name["b"]["actionStatus"] == "FINISHED"
    assert "fixes contradict it" in by_name["c"]["actionResult"]
    adapter.ask(name="d", mapId="hall", mapVersion="2")
    adapter.now_s += 121.0
    adapter.work()
    assert "not confirmed" in str(adapter.said()["instantActionStates"])


def test_a_position_is_reset_or_not() -> None:
    adapter = Adapter(initialize_s=5.0)
    given = {"x": 4.0, "y": 4.0, "theta": 1.0, "mapId": "hall", "lastNodeId": "n-7"}
    adapter._see(seen(Status.LOST))
    assert adapter.ask("initializePosition", "a", **given)["actionStatus"] == "RUNNING"
    (prior,) = adapter.priors
    assert (prior.stamp_ns, prior.map_from_base[:2, 3].tolist()) == (11, [4.0, 4.0])
    adapter._see(seen(position=Position(4.2, 3.9, 1.1, 0.2)))
    adapter._judge_position()
    assert adapter.said()["instantActionStates"][0]["actionStatus"] == "FINISHED"
    assert adapter.said()["lastNodeId"] == "n-7"
    adapter._see(seen(Status.LOST))
    adapter.ask("initializePosition", "b", **given)
    adapter.now_s += 6.0
    adapter._judge_position()
    assert "not localized there" in adapter.said()["instantActionStates"][1]["actionResult"]


def test_an_order_on_a_map_that_is_not_here() -> None:
    adapter = Adapter()
    adapter.order(_order("hall", "yard"))
    (error,) = (error for error in adapter.said()["errors"] if error["errorType"] == "UNKNOWN_MAP_ID")
    assert {"referenceKey": "orderId", "referenceValue": "o-7"} in error["errorReferences"]
    adapter.order(_order("hall"))
    assert "UNKNOWN_MAP_ID" not in adapter.error_types()
    adapter.order(_order("yard").replace(b'"x": 0', b'"theta": null, "mapDescription": null, "x": 0'))
    assert "UNKNOWN_MAP_ID" in adapter.error_types()


def _order(*map_ids: str) -> bytes:
    nodes = [{"nodeId": "n", "sequenceId": 0, "nodePosition": {"x": 0, "y": 0, "mapId": map_id}} for map_id in map_ids]
    return json.dumps({**HEADER, "orderId": "o-7", "orderUpdateId": 0, "nodes": nodes, "edges": []}).encode()


def _sheet() -> dict[str, Any]:
    return {
        "typeSpecification": {
            "seriesName": "T", "mobileRobotKinematics": "DIFFERENTIAL", "mobileRobotClass": "TUGGER", "maximumLoadMass": 500,
            "localizationTypes": ["RFID"], "navigationTypes": ["FREELY_NAVIGATING"],
        },
        "physicalParameters": {
            "minimumSpeed": 0, "maximumSpeed": 2, "maximumAcceleration": 1, "maximumDeceleration": 1, "minimumHeight": 1,
            "maximumHeight": 1, "width": 1, "length": 2,
        },
        "protocolLimits": {
            "maximumStringLengths": {}, "maximumArrayLengths": {}, "timing": {"minimumOrderInterval": 1, "minimumStateInterval": 1},
        },
        "protocolFeatures": {"optionalParameters": [], "mobileRobotActions": []},
        "mobileRobotGeometry": {}, "loadSpecification": {},
    }  # fmt: skip


def test_a_factsheet_is_completed(tmp_path: Path) -> None:
    path = tmp_path / "factsheet.json"
    path.write_text(json.dumps(_sheet()))
    sheet = read_factsheet(path, Dialect("3.0.0"))
    assert list(validator("factsheet").iter_errors({**HEADER, **sheet})) == []
    assert sheet["typeSpecification"]["localizationTypes"] == ["RFID", "NATURAL"]
    assert "downloadMap" in [action["actionType"] for action in sheet["protocolFeatures"]["mobileRobotActions"]]
    spoil: list[Callable[[dict[str, Any]], object]] = [
        lambda s: s.pop("physicalParameters"), lambda s: s["typeSpecification"].pop("seriesName"),
        lambda s: s["physicalParameters"].update(maximumSpeed=-1), lambda s: s.update(loadSpecification=[]),
    ]  # fmt: skip
    for change in spoil:
        spoiled = _sheet()
        change(spoiled)
        path.write_text(json.dumps(spoiled))
        with pytest.raises(UsageError, match="factsheet"):
            read_factsheet(path, Dialect("3.0.0"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"broker": "tcp://x"}, "not like mqtts"),
        ({"broker": "mqtt://10.0.0.9"}, "without TLS"),
        ({"broker": "mqtts://x", "serial_number": "a/b"}, "serial_number"),
        ({"broker": "mqtts://x", "username": "u"}, "belong together"),
        ({"broker": "mqtts://x", "version": "2.0.0"}, "no actions on maps"),
        ({"broker": "mqtts://x", "state_interval_s": 31.0}, "<= 30"),
        ({"broker": "mqtts://x", "initial_sigma_m": 0.05}, ">= 0.15"),
        ({"broker": "mqtts://x", "username": "u", "password_file": "/nowhere"}, "cannot be read"),
    ],
)
def test_settings_that_cannot_be_right(settings: dict[str, Any], words: str) -> None:
    given = {"manufacturer": "acme", "serial_number": "1", **settings}
    with pytest.raises((UsageError, ValidationError), match=words):
        check_section(convert(given, Vda5050Section), insecure=False)


def test_the_session_in_the_manual_is_one() -> None:
    text = (Path(hooks.__file__).parent / "plugins/vda5050/service.md").read_text("utf-8")
    part, *asked, state = (json.loads(block.split("```")[0]) for block in text.split("```json\n")[1:])
    adapter = Adapter()
    adapter.robot_part(json.dumps(part).encode())
    for message in asked:
        assert list(validator("instantActions").iter_errors({**HEADER, **message})) == []
        adapter.instant_actions(json.dumps({**HEADER, **message}).encode())
    said = adapter.said()
    assert [one["actionType"] for one in said["instantActionStates"]] == ["downloadMap", "enableMap"]
    assert list(adapter.schema.iter_errors({**HEADER, **state})) == []
    assert state.keys() == said.keys() - HEADER.keys()


def test_moments_are_written_as_the_standard_does() -> None:
    assert timestamp(1_767_323_045_123_456_789) == "2026-01-02T03:04:05.123Z"
    assert datetime.strptime(timestamp(0), "%Y-%m-%dT%H:%M:%S.%f%z") == datetime(1970, 1, 1, tzinfo=UTC)
