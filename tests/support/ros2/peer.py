"""Programs of a robot's ROS 2 for tests: rclpy clients that know nothing of fleetmap, each in a process of its own.

`python -m support.ros2.peer NAME` is such a node: a call of `Node` a line on its standard input, the answer on its standard output.
"""

import json
import os
import sys
import threading
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

from support.ros2.environment import ros_program
from support.waiting import eventually

PATIENCE_S = 60.0  # with what takes a second on an idle machine
LATCHED, BEST_EFFORT = {"durability": 1}, {"reliability": 2}
POSE, TF = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"


class RosPeer:
    """A `Node` elsewhere."""

    def __init__(self, process: Any) -> None:
        self._process = process

    def __getattr__(self, method: str) -> Callable[..., Any]:
        def call(*words: Any, **keywords: Any) -> Any:
            self._process.stdin.write(json.dumps([method, words, keywords]) + "\n")
            self._process.stdin.flush()
            answer = json.loads(self._process.stdout.readline())
            assert "error" not in answer, answer
            return answer["answer"]

        return call


@contextmanager
def ros_peer(name: str) -> Iterator[RosPeer]:
    with ros_program("-m", "support.ros2.peer", name) as process:
        yield RosPeer(process)


# --- the process ------------------------------------------------------------------------------------------------------


def plain(value: Any) -> Any:
    """A message as dictionaries, lists and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        return value[0]
    return [plain(each) for each in value] if isinstance(value, list) else value


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
    """A node of rclpy. Messages are dictionaries of their fields, and whatever discovery has yet to find is waited for."""

    def __init__(self, name: str) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        self._node, self._heard = rclpy.create_node(name), dict[str, list[Any]]()
        self._clients, self._publishers = dict[str, Any](), dict[str, Any]()
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def call(self, service: str, type_name: str, **request: Any) -> Any:
        """The response of a service."""
        kind = message_class(type_name)
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, service)
        assert self._clients[service].wait_for_service(PATIENCE_S), f"nobody serves {service}"
        future = self._clients[service].call_async(fill(kind.Request(), request))
        assert eventually(future.done, PATIENCE_S), f"{service} does not answer"
        return plain(future.result())

    def publish(self, topic: str, type_name: str, *, qos: Any = None, raw: Any = None, **fields: Any) -> None:
        """Publish a message, or raw bytes, once somebody else listens. qos: values of a QoSProfile by their names."""
        from rclpy.qos import QoSProfile

        kind = message_class(type_name)
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(kind, topic, QoSProfile(depth=1000, **(qos or {})))
        publisher, own = self._publishers[topic], int(topic in self._heard)
        assert eventually(lambda: publisher.get_subscription_count() > own, PATIENCE_S), f"nobody listens to {topic}"
        publisher.publish(fill(kind(), fields) if raw is None else bytes(raw))

    def listen(self, topic: str, type_name: str, **qos: Any) -> None:
        """Keep the messages of a topic for `heard`."""
        from rclpy.qos import QoSProfile

        keep = self._heard.setdefault(topic, []).append
        self._node.create_subscription(message_class(type_name), topic, keep, QoSProfile(depth=1000, **qos))

    def heard(self, topic: str) -> list[Any]:
        """All messages of the topic so far."""
        return [plain(message) for message in list(self._heard[topic])]

    def newest(self, topic: str) -> Any:
        """The topic's last message, once one has come."""
        assert eventually(lambda: bool(self._heard[topic]), PATIENCE_S), f"nothing comes on {topic}"
        return plain(self._heard[topic][-1])

    def nodes(self) -> list[str]:
        return list(self._node.get_node_names())

    def endpoints(self, name: str, namespace: str = "/") -> list[str]:
        """Publishers, subscriptions and services of a node that are discovered so far, as ["publisher /tf", ...]."""
        node, found = self._node, list[str]()
        kinds = {
            "publisher": node.get_publisher_names_and_types_by_node,
            "subscription": node.get_subscriber_names_and_types_by_node,
            "service": node.get_service_names_and_types_by_node,
        }
        with suppress(RuntimeError):  # the graph does not know the node yet
            for kind, listed in kinds.items():
                found += [f"{kind} {topic}" for topic, _ in listed(name, namespace)]
        return found


def main() -> None:
    node = Node(sys.argv[1])
    for line in sys.stdin:
        method, words, keywords = json.loads(line)
        try:
            answer = {"answer": getattr(node, method)(*words, **keywords)}
        except Exception as error:
            answer = {"error": repr(error)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
    os._exit(0)  # the executor's thread still runs
