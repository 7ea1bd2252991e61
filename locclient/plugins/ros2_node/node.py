"""A node of ROS 2's graph without ROS: publishers, subscriptions and services on a participant of the bus."""

import hashlib
import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import FleetmapError, RecordingError
from locclient.plugins.ros2_node.keys import (
    PUBLISHER,
    SERVICE,
    SUBSCRIPTION,
    Endpoint,
    KeyLayout,
    NodeName,
    Qos,
    answer_attachment,
    attachment,
)

Send = Callable[[bytes], None]
_GID_BYTES = 16
_log = logging.getLogger(__name__)


class Ros2Node:
    """A node whose declarations appear in ROS's graph until `close`. Names resolve as in ROS: /absolute, relative, ~/private."""

    def __init__(self, bus: Bus, layout: KeyLayout, name: str, namespace: str = "") -> None:
        """namespace: empty or /like/this."""
        self._bus, self._layout = bus, layout
        self.name = NodeName(bus.session_id(), name, namespace.rstrip("/"))
        self._numbers = count(1)
        self._declared = ExitStack()
        self._declared.callback(bus.declare_alive(layout.node_token(self.name)).close)

    def resolved(self, name: str) -> str:
        """The fully qualified name of a topic or service."""
        if name.startswith("~/"):
            return f"{self.name.namespace}/{self.name.name}{name[1:]}"
        return name if name.startswith("/") else f"{self.name.namespace}/{name}"

    def publisher(self, topic: str, type_name: str, qos: Qos = Qos()) -> Send:  # noqa: B008 - a value
        """Declare a publisher. A latched one keeps its last message; others drop messages that cannot be sent at once."""
        endpoint = self._endpoint(PUBLISHER, topic, type_name, qos)
        key = self._layout.key(endpoint.name, type_name)
        # Subscribers of rmw_zenoh count lost messages by the publisher's name and sequence number, so each publisher needs its own.
        gid = hashlib.sha256(self._layout.token(self.name, endpoint).encode()).digest()[:_GID_BYTES]
        numbers = count(1)
        latched = self._bus.latched_publisher(key) if qos.is_transient_local else None
        if latched is not None:
            self._declared.callback(latched.close)

        def send(payload: bytes) -> None:
            note = attachment(next(numbers), time.time_ns(), gid)
            if latched is not None:
                latched.put(payload, note)
            else:
                self._bus.publish(key, payload, may_drop=True, attachment=note)

        self._show(endpoint)
        return send

    def subscribe(self, topic: str, type_name: str, listen: Callable[[bytes], object], qos: Qos = Qos()) -> None:  # noqa: B008 - a value
        """Call `listen` with every message, on a thread of the bus; refused (FleetmapError) and invalid messages are logged."""
        endpoint = self._endpoint(SUBSCRIPTION, topic, type_name, qos)

        def take(_: str, payload: bytes) -> None:
            try:
                listen(payload)
            except (FleetmapError, ValueError) as error:
                _log.warning("%s: %s", endpoint.name, error)

        key = self._layout.key(endpoint.name, type_name)
        self._declared.callback(self._bus.subscribe(key, take, is_latched=qos.is_transient_local).close)
        self._show(endpoint)

    def serve(self, service: str, type_name: str, answer: Callable[[bytes], bytes]) -> None:
        """Answer requests, on a thread of the bus. A refused or undecodable request gets an error reply, which the client logs."""
        endpoint = self._endpoint(SERVICE, service, type_name, Qos())

        def reply(_: str, payload: bytes) -> bytes:
            try:
                return answer(payload)
            except ValueError as error:
                raise RecordingError(f"{endpoint.name}: invalid {type_name} request ({error})") from error

        echo = lambda question: answer_attachment(question, time.time_ns())  # noqa: E731
        self._declared.callback(self._bus.queryable(self._layout.key(endpoint.name, type_name), reply, echo).close)
        self._show(endpoint)

    def close(self) -> None:
        """Undeclare everything."""
        self._declared.close()

    def _endpoint(self, kind: str, name: str, type_name: str, qos: Qos) -> Endpoint:
        return Endpoint(kind, self.resolved(name), type_name, next(self._numbers), qos)

    def _show(self, endpoint: Endpoint) -> None:
        self._declared.callback(self._bus.declare_alive(self._layout.token(self.name, endpoint)).close)
