"""Programs of a robot's ROS 2 for tests: rclpy clients that know nothing of fleetmap, each in a process of its own.

`python -m support.ros2.peer NAME` is such a node: a command a line on its standard input, the answer on its standard output. `RosPeer` is
its other end, and `LifecycleManager` nav2's manager of one node.
"""

import json
import os
import sys
import threading
import uuid
from array import array
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

from support.ros2.environment import ros_program
from support.waiting import eventually

ACTIVE, INACTIVE, UNCONFIGURED, FINALIZED = 3, 2, 1, 4
PATIENCE_S = 60.0  # with what takes a second on an idle machine
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class RosPeer:
    """A node elsewhere. Messages are dictionaries of their fields."""

    def __init__(self, process: Any) -> None:
        self._process = process

    def ask(self, **command: Any) -> Any:
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        assert "error" not in answer, answer
        return answer["answer"]

    def call(self, service: str, type_name: str, **request: Any) -> dict[str, Any]:
        """The response of a service."""
        answer: dict[str, Any] = self.ask(call=service, type=type_name, request=request)
        return answer

    def publish(self, topic: str, type_name: str, *, qos: dict[str, Any] | None = None, **fields: Any) -> None:
        self.ask(publish=topic, type=type_name, qos=qos or {}, fields=fields)

    def listen(self, topic: str, type_name: str, **qos: Any) -> None:
        """Keep the messages of a topic for `heard`. qos: fields of a QoSProfile by the names of their values."""
        self.ask(listen=topic, type=type_name, qos=qos)

    def heard(self, topic: str) -> list[dict[str, Any]]:
        """All messages of the topic so far."""
        found: list[dict[str, Any]] = self.ask(heard=topic)
        return found

    def newest(self, topic: str) -> dict[str, Any]:
        """The topic's last message, once one has come."""
        assert eventually(lambda: bool(self.heard(topic)), PATIENCE_S), f"nothing comes on {topic}"
        return self.heard(topic)[-1]

    def nodes(self) -> list[str]:
        found: list[str] = self.ask(nodes=True)
        return found

    def endpoints(self, node: str) -> dict[str, dict[str, list[str]]]:
        """Publishers, subscriptions and services of a node by their names, as far as they are discovered: ask until they are."""
        found: dict[str, dict[str, list[str]]] = self.ask(endpoints=node)
        return found


class LifecycleManager(RosPeer):
    """nav2's, of one node."""

    def __init__(self, process: Any, node: str) -> None:
        super().__init__(process)
        self.node, self.instance = node, str(uuid.uuid4())

    def state(self) -> int:
        return int(self.call(f"/{self.node}/get_state", "lifecycle_msgs/srv/GetState")["current_state"]["id"])

    def change(self, number: int, label: str = "") -> bool:
        transition = {"id": number, "label": label}
        answer = self.call(f"/{self.node}/change_state", "lifecycle_msgs/srv/ChangeState", transition=transition)
        return bool(answer["success"])

    def startup(self) -> bool:
        """Configures, activates, and waits for the bond."""
        if not (self.change(1) and self.state() == INACTIVE and self.change(3) and self.state() == ACTIVE):
            return False
        self.listen("/bond", "bond/msg/Status")
        self.tell_bond(active=True)
        return eventually(lambda: any(beat["active"] for beat in self.beats()), PATIENCE_S)

    def beats(self) -> list[dict[str, Any]]:
        """Messages of the robot on the bond: a subscriber receives its own too."""
        said = self.heard("/bond")
        return [beat for beat in said if beat["id"] == self.node and beat["instance_id"] != self.instance]

    def tell_bond(self, *, active: bool) -> None:
        fields = {"id": self.node, "instance_id": self.instance, "active": active}
        self.publish("/bond", "bond/msg/Status", heartbeat_timeout=4.0, heartbeat_period=0.1, **fields)


@contextmanager
def ros_peer(name: str = "peer") -> Iterator[RosPeer]:
    with ros_program("-m", "support.ros2.peer", name) as process:
        yield RosPeer(process)


@contextmanager
def lifecycle_manager(node: str) -> Iterator[LifecycleManager]:
    with ros_program("-m", "support.ros2.peer", "lifecycle_manager_localization") as process:
        yield LifecycleManager(process, node)


# --- the process ------------------------------------------------------------------------------------------------------


def plain(value: Any) -> Any:
    """A message as dictionaries, lists and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        return list(value) if len(value) != 1 else value[0]
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def fill(message: Any, fields: dict[str, Any]) -> Any:
    for name, value in fields.items():
        now = getattr(message, name)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            of = message.get_fields_and_field_types()[name].removeprefix("sequence<").removesuffix(">")
            setattr(message, name, [fill(message_class(of.replace("/", "/msg/"))(), each) for each in value])
        elif isinstance(value, dict):
            fill(now, value)
        else:
            setattr(message, name, array(now.typecode, value) if isinstance(now, array) else value)
    return message


def message_class(type_name: str) -> Any:
    package, kind, name = type_name.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


class Node:
    """Executes commands by a node of rclpy."""

    def __init__(self, name: str) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        self.node, self.heard, self.publishers = rclpy.create_node(name), dict[str, list[Any]](), dict[str, Any]()
        self.clients = dict[str, Any]()
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def qos(self, given: dict[str, Any]) -> Any:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        kinds = {"durability": DurabilityPolicy, "reliability": ReliabilityPolicy}
        return QoSProfile(depth=1000, **{name: kinds[name][value] for name, value in given.items()})

    def answer(self, command: dict[str, Any]) -> Any:
        match command:
            case {"call": service, "type": type_name, "request": fields}:
                kind = message_class(type_name)
                client = self.clients.setdefault(service, None) or self.node.create_client(kind, service)
                self.clients[service] = client
                assert client.wait_for_service(PATIENCE_S), f"nobody serves {service}"
                future = client.call_async(fill(kind.Request(), fields))
                assert eventually(future.done, PATIENCE_S), f"{service} does not answer"
                return plain(future.result())
            case {"publish": topic, "type": type_name, "qos": given, "fields": fields}:
                if topic not in self.publishers:
                    self.publishers[topic] = self.node.create_publisher(
                        message_class(type_name), topic, self.qos(given)
                    )
                own = int(topic in self.heard)
                is_heard = lambda: self.publishers[topic].get_subscription_count() > own  # noqa: E731
                assert eventually(is_heard, PATIENCE_S), f"nobody else listens to {topic}"
                raw = fields.get("raw")
                message = fill(message_class(type_name)(), fields) if raw is None else bytes(raw)
                self.publishers[topic].publish(message)
            case {"listen": topic, "type": type_name, "qos": given}:
                heard = self.heard.setdefault(topic, [])
                self.node.create_subscription(message_class(type_name), topic, heard.append, self.qos(given))
            case {"heard": topic}:
                return [plain(message) for message in list(self.heard[topic])]
            case {"nodes": _}:
                return self.node.get_node_names()
            case {"endpoints": name}:
                lists = {
                    "publishers": self.node.get_publisher_names_and_types_by_node,
                    "subscriptions": self.node.get_subscriber_names_and_types_by_node,
                    "services": self.node.get_service_names_and_types_by_node,
                }
                found = {what: dict[str, list[str]]() for what in lists}
                with suppress(RuntimeError):  # the graph does not know the node yet
                    found |= {what: dict(listed(name, "/")) for what, listed in lists.items()}
                return found
        return None


def main() -> None:
    node = Node(sys.argv[1])
    for line in sys.stdin:
        try:
            answer = {"answer": node.answer(json.loads(line))}
        except Exception as error:
            answer = {"error": repr(error)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
    os._exit(0)  # the executor's thread still runs
