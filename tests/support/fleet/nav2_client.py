"""Programs of a robot's ROS 2 as rmw_zenoh and nav2 define them: lifecycle manager, BasicNavigator, behaviour tree.

Written from the definitions, with zenoh and rosbags alone: nothing of fleetmap is imported.
"""

import json
import struct
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ACTIVE, INACTIVE, UNCONFIGURED, FINALIZED = 3, 2, 1, 4
SERVICES = {
    "lifecycle_msgs/srv/GetState": ("", "lifecycle_msgs/State current_state"),
    "lifecycle_msgs/srv/ChangeState": ("lifecycle_msgs/Transition transition", "bool success"),
    "lifecycle_msgs/srv/GetAvailableStates": ("", "lifecycle_msgs/State[] available_states"),
    "lifecycle_msgs/srv/GetAvailableTransitions": (
        "",
        "lifecycle_msgs/TransitionDescription[] available_transitions",
    ),
    "std_srvs/srv/Empty": ("", ""),
    "nav2_msgs/srv/SetInitialPose": ("geometry_msgs/PoseWithCovarianceStamped pose", ""),
}
BOND = (
    "std_msgs/Header header\nstring id\nstring instance_id\nbool active\nfloat32 heartbeat_timeout\nfloat32 "
    "heartbeat_period"
)
# rosidl fills a message without fields with one.
_NOTHING = "uint8 structure_needs_at_least_one_member"


def typestore() -> Any:
    """rosbags' messages of ROS 2 Jazzy with those of nav2."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(BOND, "bond/msg/Status"))
    for name, texts in SERVICES.items():
        package, _, short = name.split("/")
        for text, kind in zip(texts, ("Request", "Response"), strict=True):
            store.register(get_types_from_msg(text or _NOTHING, f"{package}/msg/{short}_{kind}"))
    return store


def message_name(service: str, kind: str) -> str:
    """The name under which the request or response of a service is in the typestore."""
    package, _, short = service.split("/")
    return f"{package}/msg/{short}_{kind}"


def _config(entries: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in ({"scouting/multicast/enabled": False, "timestamping/enabled": True} | entries).items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def rmw_router(endpoint: str) -> Iterator[None]:
    """As rmw_zenohd with its default configuration."""
    entries = {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "scouting/gossip/autoconnect": {"router": [], "peer": []},
    }
    with zenoh.open(_config(entries)):
        yield


class RosProgram:
    """A ROS 2 program in rmw_zenoh's default configuration."""

    def __init__(self, endpoint: str) -> None:
        self.store = typestore()
        entries = {
            "mode": "peer", "connect/endpoints": [endpoint], "listen/endpoints": ["tcp/127.0.0.1:0"],
            "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
            "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        }  # fmt: skip
        self.session = zenoh.open(_config(entries))
        self._number, self._gid = 0, uuid.uuid4().bytes
        self._subscribers: list[Any] = []
        self.errors: list[str] = []

    def close(self) -> None:
        self.session.close()

    def graph(self) -> list[list[str]]:
        """The parts of all tokens in the graph of domain 0."""
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]

    def endpoint(self, kind: str, name: str, within_s: float = 10.0) -> tuple[str, str]:
        """Key and quality of service of the publisher (MP), subscription (MS) or service (SS) with that name."""
        deadline = time.monotonic() + within_s
        while time.monotonic() < deadline:
            for parts in self.graph():
                if parts[5] == kind and parts[9].replace("%", "/") == name:
                    return f"{parts[1]}{name}/{parts[10]}/{parts[11]}", parts[12]
            time.sleep(0.05)
        raise AssertionError(f"{kind} {name} does not show in the graph")

    def listen(self, topic: str, type_name: str, *, is_transient_local: bool = False) -> list[Any]:
        """A list that fills with the messages of a topic."""
        heard: list[Any] = []
        key, _ = self.endpoint("MP", topic)

        def take(sample: Any) -> None:
            number, stamp_ns, length = struct.unpack_from("<qqB", sample.attachment.to_bytes())
            assert number > 0 and stamp_ns > 0 and length == 16
            heard.append(self.store.deserialize_cdr(sample.payload.to_bytes(), type_name))

        if is_transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
            options = {"history": history, "recovery": recovery, "subscriber_detection": True}
            subscriber = zenoh.ext.declare_advanced_subscriber(self.session, key, take, **options)
        else:
            subscriber = self.session.declare_subscriber(key, take)
        self._subscribers.append(subscriber)
        return heard

    def publish(self, topic: str, type_name: str, message: Any) -> None:
        payload = message if isinstance(message, bytes) else bytes(self.store.serialize_cdr(message, type_name))
        self.session.put(self.endpoint("MS", topic)[0], payload, attachment=self._attachment())

    def call(self, service: str, type_name: str, *values: Any, raw: bytes | None = None) -> Any:
        """The response; None if the service refuses, with the reason in `errors`."""
        request_type = message_name(type_name, "Request")
        request = self.store.types[request_type](*(values or (0,)))
        payload = raw if raw is not None else bytes(self.store.serialize_cdr(request, request_type))
        note = self._attachment()
        key, _ = self.endpoint("SS", service)
        target = zenoh.QueryTarget.ALL_COMPLETE
        replies = list(self.session.get(key, target=target, payload=payload, attachment=note, timeout=5.0))
        assert len(replies) == 1, "a service answers once"
        if replies[0].ok is None:
            self.errors.append(replies[0].err.payload.to_string())
            return None
        answered = replies[0].ok.attachment.to_bytes()
        assert (answered[:8], answered[16:]) == (note[:8], note[16:]), "rmw_zenoh finds its request by number and gid"
        return self.store.deserialize_cdr(replies[0].ok.payload.to_bytes(), message_name(type_name, "Response"))

    def header(self, frame: str) -> Any:
        types = self.store.types
        return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](int(time.time()), 0), frame)

    def _attachment(self) -> bytes:
        self._number += 1
        return struct.pack("<qqB", self._number, time.time_ns(), 16) + self._gid


class LifecycleManager(RosProgram):
    """nav2's, of one node."""

    def __init__(self, endpoint: str, node: str) -> None:
        super().__init__(endpoint)
        self.node, self.instance = node, str(uuid.uuid4())
        self._bond: list[Any] = []

    def state(self) -> int:
        return int(self.call(f"/{self.node}/get_state", "lifecycle_msgs/srv/GetState").current_state.id)

    def change(self, number: int, label: str = "") -> bool:
        transition = self.store.types["lifecycle_msgs/msg/Transition"](number, label)
        return bool(self.call(f"/{self.node}/change_state", "lifecycle_msgs/srv/ChangeState", transition).success)

    def startup(self) -> bool:
        """Configures, activates, and waits for the bond: half its timeout of 4 s."""
        if not (self.change(1) and self.state() == INACTIVE and self.change(3) and self.state() == ACTIVE):
            return False
        self._bond = self.listen("/bond", "bond/msg/Status")
        self.tell_bond(active=True)
        return eventually(lambda: any(beat.active for beat in self.beats), 2.0)

    @property
    def beats(self) -> list[Any]:
        """Messages of the robot on the bond: a subscriber receives its own too."""
        return [beat for beat in self._bond if beat.id == self.node and beat.instance_id != self.instance]

    def tell_bond(self, *, active: bool) -> None:
        status = self.store.types["bond/msg/Status"](self.header(""), self.node, self.instance, active, 4.0, 0.1)
        self.publish("/bond", "bond/msg/Status", status)


def eventually(condition: Callable[[], bool], within_s: float = 10.0) -> bool:
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True
