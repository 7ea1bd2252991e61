"""What both halves of the robot's ROS 2 need of rclpy: its start, messages as bytes on a thread of the caller, and who is not connected."""

import atexit
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import msgspec
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.signals import SignalHandlerOptions

from fleetmap.errors import FleetmapError, LinkError, UsageError

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_CHECK_S = 0.2
_log = logging.getLogger(__name__)


@contextmanager
def ros_errors() -> Iterator[None]:
    """Turn what ROS 2 refuses at the start into a UsageError."""
    try:
        yield
    except (RuntimeError, NameValidationException, ParameterException, msgspec.ValidationError) as error:
        raise UsageError(f"ROS 2 refuses a name or a parameter, or does not start: {error}") from error


@contextmanager
def ros_sends() -> Iterator[None]:
    """Turn what the middleware does not send, such as Cyclone to a subscriber that takes nothing, into a LinkError."""
    try:
        yield
    except rclpy_implementation.RCLError as error:
        raise LinkError(f"ROS 2 did not send: {error}; does a subscriber over a slow network hold it up?") from error


def ensure_ros() -> None:
    """Start ROS 2 in this process, which keeps its own handlers of signals."""
    if not rclpy.ok():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        atexit.register(rclpy.try_shutdown)


@dataclass(frozen=True)
class Feed:
    """One of several topics with their classes of messages, in order of preference, and what takes the class and bytes (CDR) of each."""

    choices: Sequence[tuple[str, type]]
    take: Callable[[type, bytes], object]
    depth: int = 10
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE


class MessageReader:
    """Subscriptions that are read by calls of `read`, without an executor of rclpy, which costs 1.4 ms CPU for two compressed images; this
    0.5 ms. An executor waits for all entities of a node, and makes a task of every message.

    Of a feed's topics the first is subscribed to that somebody publishes: a driver that saw a subscriber on each would compress its images
    in vain. A subscription is reliable as long as no publisher on its topic is best effort, and then receives from both. Best effort alone
    would lose images: Fast DDS keeps 512 kB for a process, so of two raw images sent one after the other most first ones do not arrive.
    """

    def __init__(self, node: Node, feeds: Sequence[Feed]) -> None:
        """Subscribe; UsageError for an invalid topic."""
        self._node, self._feeds = node, feeds
        self._subscriptions: dict[int, Any] = {}  # by feed
        self._publishers: list[int] = []
        with ros_errors():
            self._suit_publishers()

    def read(self, timeout_s: float) -> None:
        """Hand over a message of each topic that has one, or else of the first within the timeout; log those that are refused."""
        if time.monotonic() - self._suited_s > _CHECK_S:
            self._suit_publishers()
        self._waiting.clear_entities()
        for subscription in self._subscriptions.values():
            self._waiting.add_subscription(subscription.handle)
        self._waiting.wait(int(timeout_s * 1e9))
        ready = self._waiting.get_ready_entities("subscription")
        for subscription in self._subscriptions.values():
            if subscription.handle.pointer not in ready:
                continue
            try:
                taken = subscription.handle.take_message(subscription.msg_type, True)
                if taken is not None:
                    subscription.callback(taken[0])
            except (FleetmapError, ValueError, RuntimeError) as error:
                _log.warning("%s: %s", subscription.topic_name, error)

    def _suit_publishers(self) -> None:
        """Subscribe where nothing is subscribed to yet, and anew where publishers changed."""
        self._suited_s = time.monotonic()
        named = self._node.resolve_topic_name  # of these calls, only the counting does not remap the topic itself
        counts = [self._node.count_publishers(named(topic)) for feed in self._feeds for topic, _ in feed.choices]
        if counts == self._publishers:
            return
        self._publishers = counts
        for number, feed in enumerate(self._feeds):
            offers = {topic: self._node.get_publishers_info_by_topic(topic) for topic, _ in feed.choices}
            types = {topic: {offer.topic_type for offer in offers[topic]} for topic in offers}
            sent = [(topic, kind) for topic, kind in feed.choices if _type_name(kind) in types[topic]]
            topic, kind = (sent or feed.choices)[0]
            is_lossy = ReliabilityPolicy.BEST_EFFORT in {offer.qos_profile.reliability for offer in offers[topic]}
            reliability = ReliabilityPolicy.BEST_EFFORT if is_lossy else ReliabilityPolicy.RELIABLE
            now = self._subscriptions.get(number)
            if now is not None:
                if (now.topic, now.msg_type, now.qos_profile.reliability) == (topic, kind, reliability):
                    continue
                self._node.destroy_subscription(now)
            qos = QoSProfile(depth=feed.depth, durability=feed.durability, reliability=reliability)
            self._subscriptions[number] = self._node.create_subscription(
                kind, topic, partial(feed.take, kind), qos, raw=True, callback_group=_NotExecuted()
            )
        self._waiting = rclpy_implementation.WaitSet(len(self._subscriptions), 0, 0, 0, 0, 0, self._node.context.handle)


class _NotExecuted(CallbackGroup):
    """Entities that the node's executor leaves alone."""

    def can_execute(self, entity: object) -> bool:
        return False


def _type_name(message: type) -> str:
    return f"{message.__module__.partition('.')[0]}/msg/{message.__name__}"


def unconnected(node: Node) -> list[str]:
    """Return which publishers and subscriptions ROS 2 does not connect with the node's because their quality of service differs: both
    sides of each, and the reason."""
    own = node.get_name(), node.get_namespace()
    lists, found = list[Any](), list[str]()
    with suppress(RuntimeError):  # the graph does not know the node yet
        lists = [node.get_publisher_names_and_types_by_node(*own), node.get_subscriber_names_and_types_by_node(*own)]
    for topic in sorted({topic for listed in lists for topic, _ in listed}):
        readers = node.get_subscriptions_info_by_topic(topic)
        for writer, reader in product(node.get_publishers_info_by_topic(topic), readers):
            if own[0] not in (writer.node_name, reader.node_name):  # all nodes have /parameter_events
                continue
            verdict, reason = qos_check_compatible(writer.qos_profile, reader.qos_profile)
            if verdict == QoSCompatibility.ERROR:
                why = reason.replace("ERROR: ", "").rstrip(";")
                found.append(f"{topic}: {reader.node_name} does not receive from {writer.node_name}: {why}")
    return found
