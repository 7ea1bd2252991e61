"""What both nodes of a robot need of rclpy: its start, loops that its faults do not end, messages as bytes on a thread of the caller, and
who is not connected."""

import atexit
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import msgspec
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.signals import SignalHandlerOptions

from fleetmap.errors import FleetmapError, LinkError, UsageError
from fleetmap.log_lines import LogLimit

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LOOK_S, _PAUSE_S = 1.0, 1.0
_log = logging.getLogger(__name__)
_limit = LogLimit(_log)


@contextmanager
def ros_started() -> Iterator[None]:
    """Start ROS 2 in this process, which keeps its own handlers of signals; turn what is refused then into a UsageError."""
    try:
        if not rclpy.ok():
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            atexit.register(rclpy.try_shutdown)
        yield
    except (RuntimeError, ValueError, NameValidationException, ParameterException, msgspec.ValidationError) as error:
        raise UsageError(
            f"ROS 2 does not start: {error}; correct [topics], [output], the arguments after --ros-args, or RMW_IMPLEMENTATION"
        ) from error


def keep_on(work: Callable[[], None], wait: Callable[[float], bool]) -> None:
    """Repeat the work until `wait` returns that it must stop: no fault of ROS 2 ends a robot's localization.

    LinkError once ROS 2 itself was shut down in this process.
    """
    while not wait(0.0):
        if not rclpy.ok():
            raise LinkError("ROS 2 was shut down in this process; start again")
        try:
            work()
        except Exception:
            _log.exception("ROS 2 failed; it goes on")
            wait(_PAUSE_S)


@contextmanager
def faults_logged(what: str) -> Iterator[None]:
    """Log what one message or call costs, once a minute."""
    try:
        yield
    except (FleetmapError, ValueError, RuntimeError) as error:
        _limit.warning(what, "%s: %s", what, error)


class Feed(NamedTuple):
    """One of several topics with their classes of messages, in order of preference, and what takes the class and bytes (CDR) of each.

    is_awaited: whether it is a fault that nobody publishes.
    """

    choices: Sequence[tuple[str, type]]
    take: Callable[[type, bytes], object]
    depth: int = 10
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE
    is_awaited: bool = False


class MessageReader:
    """Subscriptions that are read by calls of `read`, without an executor of rclpy, which costs 1.4 ms CPU for two compressed images; this
    0.5 ms. An executor waits for all entities of a node, and makes a task of every message.

    Of a feed's topics the first is subscribed to that somebody publishes: a driver that saw a subscriber on each would compress its images
    in vain. A subscription is reliable as long as no publisher on its topic is best effort, and then receives from both. Best effort alone
    would lose images: Fast DDS keeps 512 kB for a process, so of two raw images sent one after the other most first ones do not arrive.

    faults: of the node's topics, which are not connected and why, at the newest look at ROS's graph.
    """

    def __init__(self, node: Node, feeds: Sequence[Feed]) -> None:
        """Subscribe; UsageError for an invalid topic."""
        self.faults: list[str] = []
        self._node, self._feeds = node, feeds
        self._subscriptions: dict[int, Any] = {}  # by feed
        with ros_started():
            self._look()
            self._waiting = rclpy_implementation.WaitSet(len(feeds), 0, 0, 0, 0, 0, node.context.handle)

    def read(self, timeout_s: float) -> None:
        """Hand over a message of each topic that has one, or else of the first within the timeout; log those that are refused."""
        if time.monotonic() - self._looked_s > _LOOK_S:
            with faults_logged("the graph of ROS 2"):
                self._look()
        self._waiting.clear_entities()
        for subscription in self._subscriptions.values():
            self._waiting.add_subscription(subscription.handle)
        self._waiting.wait(int(timeout_s * 1e9))
        ready = self._waiting.get_ready_entities("subscription")
        for subscription in self._subscriptions.values():
            if subscription.handle.pointer in ready:
                with faults_logged(subscription.topic_name):
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                    if taken is not None:
                        subscription.callback(taken[0])

    def _look(self) -> None:
        """Subscribe to what is published now, and note what is not connected."""
        self._looked_s, faults = time.monotonic(), list[str]()
        for number, feed in enumerate(self._feeds):
            offers = {topic: self._node.get_publishers_info_by_topic(topic) for topic, _ in feed.choices}
            types = {topic: {offer.topic_type for offer in offers[topic]} for topic in offers}
            sent = [(topic, kind) for topic, kind in feed.choices if _type_name(kind) in types[topic]]
            topic, kind = (sent or feed.choices)[0]
            if feed.is_awaited and not offers[topic]:
                faults.append(f"{topic}: nobody publishes it, as {_type_name(kind)}")
            is_lossy = ReliabilityPolicy.BEST_EFFORT in {offer.qos_profile.reliability for offer in offers[topic]}
            reliability = ReliabilityPolicy.BEST_EFFORT if is_lossy else ReliabilityPolicy.RELIABLE
            now = self._subscriptions.pop(number, None)
            if now is not None and (now.topic, now.msg_type, now.qos_profile.reliability) != (topic, kind, reliability):
                self._node.destroy_subscription(now)
                now = None
            qos = QoSProfile(depth=feed.depth, durability=feed.durability, reliability=reliability)
            self._subscriptions[number] = now or self._node.create_subscription(
                kind, topic, partial(feed.take, kind), qos, raw=True, callback_group=_NotExecuted()
            )
        faults += _unconnected(self._node)
        for fault in faults:
            if fault not in self.faults:
                _log.warning("%s", fault)
        self.faults = faults


class _NotExecuted(CallbackGroup):
    """Entities that the node's executor leaves alone."""

    def can_execute(self, entity: object) -> bool:
        return False


def _type_name(message: type) -> str:
    return f"{message.__module__.partition('.')[0]}/msg/{message.__name__}"


def _unconnected(node: Node) -> Iterator[str]:
    """Which publishers and subscriptions ROS 2 does not connect with the node's: both sides of each, and the reason."""
    own = node.get_fully_qualified_name()
    looks = node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic
    for topic in sorted({each.topic for each in (*node.publishers, *node.subscriptions)}):
        sides = [[(f"{end.node_namespace.rstrip('/')}/{end.node_name}", end) for end in look(topic)] for look in looks]
        for (writer, offered), (reader, wanted) in product(*sides):
            if own not in (writer, reader):
                continue
            verdict, why = qos_check_compatible(offered.qos_profile, wanted.qos_profile)
            if offered.topic_type != wanted.topic_type:
                why = f"it is {offered.topic_type}, not {wanted.topic_type}"
            elif verdict != QoSCompatibility.ERROR:
                continue
            why = why.replace("ERROR: ", "").rstrip(";")
            yield f"{node.resolve_topic_name(topic)}: {reader} does not receive from {writer}: {why}"
