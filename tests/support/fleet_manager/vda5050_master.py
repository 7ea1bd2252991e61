"""A fleet manager of VDA 5050 over a real mosquitto: all messages of a robot are validated against the official schemas."""

import json
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from fleetmap.bus.endpoints import handshake_fault, with_free_port
from support.waiting import eventually

SCHEMAS = Path(__file__).resolve().parents[4] / "shared" / "data" / "conformance" / "vda5050"
PATIENCE_S = 60.0


def validator(topic: str, version: str = "3.0.0") -> jsonschema_rs.Draft202012Validator:
    """The official schema of a topic; skips if it is absent."""
    folder = SCHEMAS / ("json_schemas" if version == "3.0.0" else version)
    path = next(iter(folder.glob(f"{topic}.*")), None)
    if path is None:
        pytest.skip(f"the schemas of VDA 5050 are not in {SCHEMAS}")
    return jsonschema_rs.Draft202012Validator(json.loads(path.read_text("utf-8")), validate_formats=True)


@contextmanager
def mosquitto(folder: Path) -> Iterator[int]:
    """A broker on a free port of this machine; skips where Debian's package is missing."""
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if program is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto): VDA 5050 is NOT tested over a broker")
    port = int(with_free_port("tcp/127.0.0.1:0").rpartition(":")[2])
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nuser root\n")
    with subprocess.Popen([program, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as broker:
        try:
            handshake_fault(f"tcp/127.0.0.1:{port}", None, patience_s=PATIENCE_S)
            yield port
        finally:
            broker.terminate()


def until(found: Callable[[], bool], words: object = "", patience_s: float = PATIENCE_S) -> None:
    assert eventually(found, patience_s), words() if callable(words) else words


class Master:
    """Hears one robot, and sends to it."""

    def __init__(self, port: int, version: str = "3.0.0") -> None:
        self.version, self.prefix = version, f"vda5050/v{version[0]}/acme/0001"
        mqtt = pytest.importorskip("paho.mqtt.client")
        self.states: list[dict[str, Any]] = []
        self.connections: list[str] = []
        self.visualizations: list[dict[str, Any]] = []
        self.faults: list[str] = []
        self.header_ids: dict[str, list[int]] = {}
        topics = ("state", "connection", "factsheet", "visualization", "instantActions")
        self._schemas = {topic: validator(topic, version) for topic in topics}
        self._count = 0
        self._robot_part: bytes | None = None
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id="master")
        self._client.on_message = self._hear
        self._client.connect("127.0.0.1", port)
        self._client.subscribe(f"{self.prefix}/#")
        self._client.loop_start()
        self._stop = threading.Event()
        threading.Thread(target=self._speak_for_the_robot, daemon=True).start()

    def close(self) -> None:
        self._stop.set()
        self._client.disconnect()
        self._client.loop_stop()

    def _hear(self, _: object, __: object, message: Any) -> None:
        topic = message.topic.rpartition("/")[2]
        if topic not in {"state", "connection", "factsheet", "visualization"}:
            return
        content = json.loads(message.payload)
        self.header_ids.setdefault(topic, []).append(content["headerId"])
        self.faults += [
            f"{topic}: {error.message} at {list(error.instance_path)}"
            for error in self._schemas[topic].iter_errors(content)
        ]
        if topic == "state":
            self.states.append(content)
        elif topic == "connection":
            self.connections.append(content["connectionState"])
        elif topic == "visualization":
            self.visualizations.append(content)

    def _speak_for_the_robot(self) -> None:
        """The part of the state that is the robot's own program's."""
        while not self._stop.wait(0.5):
            if self._robot_part is not None:
                self.send("robotState", self._robot_part)

    def begin_robot_part(self) -> None:
        part = {
            "operatingMode": "AUTOMATIC",
            "powerSupply": {"stateOfCharge": 71.5, "charging": False},
            "safetyState": {"activeEmergencyStop": "NONE", "fieldViolation": False},
            "orderId": "o-1", "lastNodeId": "n-1", "driving": False, "loads": [],
        }  # fmt: skip
        self._robot_part = json.dumps(part).encode()
        self.send("robotState", self._robot_part)

    def send(self, topic: str, payload: bytes) -> None:
        self._client.publish(f"{self.prefix}/{topic}", payload).wait_for_publish(5)

    def act(self, action_type: str, **parameters: Any) -> str:
        """Sends an instant action and returns its id."""
        self._count += 1
        action = {
            "actionId": f"a-{self._count}", "actionType": action_type, "blockingType": "NONE",
            "actionParameters": [{"key": key, "value": value} for key, value in parameters.items()],
        }  # fmt: skip
        stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.") + "000Z"
        message = {"headerId": self._count, "timestamp": stamp, "version": self.version, "manufacturer": "acme"}
        message |= {"serialNumber": "0001", "actions": [action]}
        assert self._schemas["instantActions"].is_valid(message)
        self.send("instantActions", json.dumps(message).encode())
        return f"a-{self._count}"

    @property
    def state(self) -> dict[str, Any]:
        return self.states[-1] if self.states else {}

    def action(self, action_id: str) -> dict[str, Any]:
        states = self.state.get("instantActionStates" if self.version == "3.0.0" else "actionStates", [])
        return next((state for state in states if state["actionId"] == action_id), {"actionStatus": "UNSEEN"})

    def done(self, action_id: str, status: str = "FINISHED", patience_s: float = PATIENCE_S) -> dict[str, Any]:
        """The state that first shows the action finished or failed."""
        until(lambda: self.action(action_id)["actionStatus"] in {"FINISHED", "FAILED"}, lambda: self.state, patience_s)
        assert self.action(action_id)["actionStatus"] == status, self.state
        return self.state

    def seen(self, action_id: str) -> list[str]:
        """The statuses of an action in all states, each once."""
        actions = (action for state in self.states for action in state["instantActionStates"])
        return list(dict.fromkeys(action["actionStatus"] for action in actions if action["actionId"] == action_id))

    def errors(self, error_type: str) -> list[dict[str, Any]]:
        return [error for error in self.state.get("errors", []) if error["errorType"] == error_type]

    def maps(self) -> dict[str, str]:
        return {entry["mapVersion"]: entry["mapStatus"] for entry in self.state.get("maps", [])}
