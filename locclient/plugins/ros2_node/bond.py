"""The bond of a managed node with nav2's lifecycle manager: a sign of life every tenth of a second, which names the node."""

import time
import uuid
from contextlib import suppress
from typing import Any

from bond.msg import Status
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.lifecycle.managed_entity import ManagedEntity
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from locclient.plugins.ros2_node.node import Feed

PERIOD_S, _TIMEOUT_S = 0.1, 4.0  # as in nav2


class Bond(ManagedEntity):
    """Our side of it, while the node is active. Source: bondcpp."""

    def __init__(self, node: Node) -> None:
        self._node, self._instance, self._said_s = node, "", 0.0
        self._publisher = node.create_publisher(Status, "bond", 10)
        self.feed = Feed([("bond", Status)], self._hear)

    def on_activate(self, _: object) -> TransitionCallbackReturn:
        self._instance = str(uuid.uuid4())
        return TransitionCallbackReturn.SUCCESS

    def beat(self) -> None:
        """Renew it if it is time."""
        instance = self._instance  # which another thread may end meanwhile
        if instance and time.monotonic() - self._said_s >= PERIOD_S:
            self._said_s = time.monotonic()
            self._say(instance, is_active=True)

    def end(self, *_: object) -> TransitionCallbackReturn:
        instance, self._instance = self._instance, ""
        if instance:
            self._say(instance, is_active=False)
        return TransitionCallbackReturn.SUCCESS

    on_deactivate = on_cleanup = on_shutdown = on_error = end

    def _hear(self, _: type, message: bytes) -> None:
        """Acknowledge the end of the other side, as bondcpp does; the node stays active."""
        said: Any = deserialize_message(message, Status)
        if said.id == self._node.get_name() and said.instance_id != self._instance and not said.active:
            self.end()

    def _say(self, instance: str, *, is_active: bool) -> None:
        said = Status(id=self._node.get_name(), instance_id=instance, active=is_active)
        said.header.stamp = self._node.get_clock().now().to_msg()
        said.heartbeat_timeout, said.heartbeat_period = _TIMEOUT_S, PERIOD_S
        with suppress(RuntimeError):  # the other side notices
            self._publisher.publish(said)
