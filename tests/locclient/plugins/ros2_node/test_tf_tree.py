"""The tree of frames that a real tf2 composes of what the driver and the localizer publish, against the true drive."""

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.geometry import (
    Array,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    se3,
    se3_inverse,
    so3_exp,
    so3_log,
)
from fleetmap.sensors.source_settings import Topics
from fleetmap.sources.intake import Intake
from locclient.daemon.publishers import output_of
from locclient.localization.estimate import Estimate
from locclient.outputs import OutputSection, Publisher
from locclient.plugins.ros2_node.driver_odometry import Missing, PoseHistory
from locclient.plugins.ros2_node.keys import RmwZenohKeys
from locclient.plugins.ros2_node.localizer import OUTPUT
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.nav2_client import typestore
from support.fleet.tf2_buffer import tf2_lookups
from support.recordings.recording_samples import calibration

STORE = typestore()
TYPES = STORE.types
BEGUN_NS, MS = 1_700_000_000_000_000_000, 1_000_000
FRAME_MS, DRIVER_MS, LATENCY_MS, END_MS = 100, 20, 60, 3200
BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, 0.4])), np.array([0.3, 0.1, 0.6]))  # base_link is not the body
FOOTPRINT_FROM_BASE = se3(np.eye(3), np.array([0.1, 0.0, 0.2]))


def planar(x_m: float, y_m: float, yaw_rad: float) -> Array:
    return se3(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.0]))


def truth(at_ms: float) -> Array:
    """map_from_base: 1.5 m/s on a curve in a hall far from the origin."""
    angle = 0.5e-3 * at_ms
    return planar(20 + 3 * np.sin(angle), -7 - 3 * np.cos(angle), angle)


@dataclass(frozen=True)
class Case:
    """A drive. changes_ms: when the driver's odometry starts anew at zero. lost_ms: no driver from, to."""

    publish_odom: bool = False
    begun_at: Array | None = None
    changes_ms: tuple[int, ...] = ()
    lost_ms: tuple[int, int] = (0, 0)
    restart_ms: int = -1
    delay_ms: int = 0
    is_shuffled: bool = False
    child: str = "base_link"
    section: tuple[tuple[str, Any], ...] = ()

    def odom_from_base(self, at_ms: float) -> Array:
        """The driver's: it drifts."""
        since = max((ms for ms in self.changes_ms if ms <= at_ms), default=None)
        begun = (self.begun_at if self.begun_at is not None else np.eye(4)) if since is None else np.eye(4)
        drift = planar(2e-5 * at_ms, 0, 3e-5 * at_ms)
        return begun @ drift @ se3_inverse(truth(since or 0)) @ truth(at_ms)

    def is_known(self, at_ms: int) -> bool:
        """True if the driver's pose is: between two messages of one life."""
        before = at_ms // DRIVER_MS * DRIVER_MS
        is_lost = self.lost_ms[0] <= before + DRIVER_MS and before < self.lost_ms[1]
        return not is_lost and not any(before < ms <= before + DRIVER_MS for ms in self.changes_ms)


CASES = {
    "we publish odom -> base_link": Case(publish_odom=True),
    "the driver": Case(),
    "a driver that ran long before": Case(begun_at=planar(-140.0, 320.0, 2.5)),
    "the driver starts anew after 1.5 s": Case(begun_at=planar(40, 2, 1), changes_ms=(2500,), lost_ms=(1000, 2500)),
    "the driver's odometry is reset": Case(begun_at=planar(40, 2, 1), changes_ms=(1510, 2310)),
    "we start anew": Case(begun_at=planar(40, 2, 1), restart_ms=1990),
    "we start anew, alone": Case(publish_odom=True, restart_ms=1990),
    "late messages": Case(delay_ms=250),
    "late and out of order": Case(delay_ms=150, is_shuffled=True),
    "base_footprint": Case(child="base_footprint"),
    "other names": Case(
        section=(("map_frame", "site"), ("odom_frame", "wheels"), ("base_frame", "base_link"), ("tf_topic", "/r1/tf"))
    ),
    "dated ahead": Case(begun_at=planar(40, 2, 1), section=(("transform_tolerance_s", 0.2),)),
}  # fmt: skip


def stamped(frame: str, at_ms: float) -> Any:
    seconds, nanoseconds = divmod(BEGUN_NS + round(at_ms * MS), 10**9)
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame)


def tf_message(frames: tuple[str, str], parent_from_child: Array, at_ms: float) -> Any:
    xyzw = quat_wxyz_from_rotation(parent_from_child[:3, :3])[[1, 2, 3, 0]]
    moved = TYPES["geometry_msgs/msg/Vector3"](*parent_from_child[:3, 3])
    placed = TYPES["geometry_msgs/msg/Transform"](moved, TYPES["geometry_msgs/msg/Quaternion"](*xyzw))
    link = TYPES["geometry_msgs/msg/TransformStamped"](stamped(frames[0], at_ms), frames[1], placed)
    return TYPES["tf2_msgs/msg/TFMessage"]([link])


class World:
    """A hub with the localizer, the driver, and a listener to what tf2 would hear, in order."""

    def __init__(self, case: Case) -> None:
        self.case, self.hub = case, MemoryHub()
        self.heard_by_tf2: list[tuple[Any, bool]] = []
        self.section = OutputSection(format="ros2", publish_odom=case.publish_odom, **dict(case.section))
        self.bus = MemoryBus(self.hub)
        self.sent: dict[tuple[str, str], list[tuple[int, Array]]] = {}
        for suffix in ("", "_static"):
            self.bus.subscribe(
                self.key(suffix), lambda key, data: self._hear(data, is_static=key == self.key("_static"))
            )
        self.localizer: Publisher | None = None
        self.restart(0)

    def key(self, suffix: str) -> str:
        return RmwZenohKeys(0).key(f"/{self.section.tf_topic.lstrip('/')}{suffix}", "tf2_msgs/TFMessage")

    def _hear(self, data: bytes, *, is_static: bool) -> None:
        message = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
        self.heard_by_tf2.append((message, is_static))
        for link in message.transforms:
            stamp = link.header.stamp
            entry = self.sent.setdefault((link.header.frame_id, link.child_frame_id), [])
            t, q = link.transform.translation, link.transform.rotation
            parent_from_child = se3(rotation_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), np.array([t.x, t.y, t.z]))
            entry.append((stamp.sec * 10**9 + stamp.nanosec, parent_from_child))

    def restart(self, at_ms: int) -> None:
        """Another run of the localizer; its odometry begins where the robot is."""
        self.close()
        intake = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
        inputs = (MemoryBus(self.hub), "hall", "r1", calibration(), intake)
        self.localizer = output_of(self.section).open(self.section, *inputs)
        self.odom, self.begun_ms = ContinuousOdom(BASE_FROM_BODY), at_ms
        if self.case.child != "base_link":
            self.put(
                self.key("_static"),
                tf_message((self.case.child, "base_link"), FOOTPRINT_FROM_BASE, 0),
                "tf2_msgs/msg/TFMessage",
            )

    def put(self, key: str, message: Any, type_name: str) -> None:
        self.bus.publish(key, bytes(STORE.serialize_cdr(message, type_name)))

    def drive(self, at_ms: int) -> None:
        """The driver's message of a moment."""
        base = self.case.odom_from_base(at_ms)
        odom_from_child = base if self.case.child == "base_link" else base @ se3_inverse(FOOTPRINT_FROM_BASE)
        message = tf_message((self.section.odom_frame, self.case.child), odom_from_child, at_ms)
        self.put(self.key(""), message, "tf2_msgs/msg/TFMessage")

    def frame(self, at_ms: int, **changes: Any) -> None:
        """A localized frame, taken at this moment."""
        one: Estimate = estimate(0.0)
        visual = (
            planar(0, 1e-5 * at_ms, 2e-5 * at_ms) @ se3_inverse(truth(self.begun_ms)) @ truth(at_ms) @ BASE_FROM_BODY
        )
        odometry = replace(one.odometry, odom_from_body=visual, stamp_ns=BEGUN_NS + at_ms * MS)
        place = truth(at_ms) @ BASE_FROM_BODY
        one = replace(one, stamp_ns=BEGUN_NS + at_ms * MS, map_from_body=place, odometry=odometry, **changes)
        self.localizer.publish(one, self.odom.handle(one), BASE_FROM_BODY)

    def close(self) -> None:
        if self.localizer is not None:
            self.localizer.close()

    @property
    def map_stamps_ms(self) -> set[int]:
        """Of map -> odom, as of its frames."""
        ahead_ns = round(1e9 * self.section.transform_tolerance_s)
        return {
            (stamp_ns - BEGUN_NS - ahead_ns) // MS
            for stamp_ns, _ in self.sent.get((self.section.map_frame, self.section.odom_frame), [])
        }


def moments(case: Case) -> list[Callable[[World], None]]:
    """What happens, in order of its arrival."""
    events: list[tuple[float, Callable[[World], None]]] = []
    dice = random.Random(5)
    if not case.publish_odom:
        for at_ms in range(0, END_MS, DRIVER_MS):
            if not case.lost_ms[0] <= at_ms < case.lost_ms[1]:
                jitter_ms = dice.uniform(0, 90) if case.is_shuffled else 0
                events.append((at_ms + case.delay_ms + jitter_ms, partial(World.drive, at_ms=at_ms)))
    events += [(at_ms + LATENCY_MS, partial(World.frame, at_ms=at_ms)) for at_ms in range(103, END_MS - 500, FRAME_MS)]
    if case.restart_ms > 0:
        events.append((case.restart_ms, lambda world: world.restart(case.restart_ms)))
    return [action for _, action in sorted(events, key=lambda event: event[0])]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_the_tree_holds_the_true_pose_at_every_frame_and_so_says_tf2(case: Case) -> None:
    world = World(case)
    for happen in moments(case):
        happen(world)
    world.close()
    wanted = {ms for ms in range(103, END_MS - 500, FRAME_MS) if case.publish_odom or case.is_known(ms)}
    assert world.map_stamps_ms == wanted, "for every frame whose pose of the driver is known, and no other"
    section, ahead_ms = world.section, round(1e3 * world.section.transform_tolerance_s)
    if not case.publish_odom:
        for stamp_ns, map_from_odom in world.sent[section.map_frame, section.odom_frame]:
            at_ms = (stamp_ns - BEGUN_NS) // MS - ahead_ms
            np.testing.assert_allclose(map_from_odom @ case.odom_from_base(at_ms), truth(at_ms), atol=1e-2)
    links = ((section.map_frame, section.odom_frame, ahead_ms), (section.odom_frame, "base_link", 0))
    questions = [
        (target, source, BEGUN_NS + (ms + later) * MS) for ms in sorted(wanted) for target, source, later in links
    ]
    answers = tf2_lookups(world.heard_by_tf2, questions)
    for at_ms, map_from_odom, odom_from_base in zip(sorted(wanted), answers[::2], answers[1::2], strict=True):
        # A message that comes later lies between two that a frame was placed by.
        atol = 1e-3 if case.is_shuffled else 1e-6
        np.testing.assert_allclose(matrix(map_from_odom) @ matrix(odom_from_base), truth(at_ms), atol=atol)


def matrix(values: list[float] | str) -> Array:
    assert isinstance(values, list), values
    return se3(rotation_from_quat_wxyz(np.array([values[6], *values[3:6]])), np.array(values[:3]))


def heard(world: World) -> tuple[int, str]:
    """Level and words of the diagnosis of now."""
    told: list[bytes] = []
    handle = world.bus.subscribe(
        RmwZenohKeys(0).key("/diagnostics", "diagnostic_msgs/DiagnosticArray"), lambda _, data: told.append(data)
    )
    world.localizer.alive(False)
    handle.close()
    status = STORE.deserialize_cdr(told[-1], "diagnostic_msgs/msg/DiagnosticArray").status[0]
    return status.level, status.message


def driven(sends: Callable[[World, int], None]) -> World:
    """Two seconds of frames with what is sent for every message of the driver."""
    world = World(Case())
    for at_ms in range(0, 2000, DRIVER_MS):
        sends(world, at_ms)
        if at_ms % FRAME_MS == 0 and at_ms > 0:
            world.frame(at_ms - 7)
    return world


def link(frames: tuple[str, str], shift_ms: int = 0) -> Callable[[World, int], None]:
    def send(world: World, at_ms: int) -> None:
        message = tf_message(frames, world.case.odom_from_base(at_ms), at_ms + shift_ms)
        world.put(world.key(""), message, "tf2_msgs/msg/TFMessage")

    return send


def two_drivers(world: World, at_ms: int) -> None:
    """The wheels' driver and a filter, both as odom -> base_link."""
    for begun in (np.eye(4), planar(5, 5, 1)):
        message = tf_message(
            ("odom", "base_link"), begun @ world.case.odom_from_base(at_ms), at_ms + 7 * (begun[0, 3] > 0)
        )
        world.put(world.key(""), message, "tf2_msgs/msg/TFMessage")


@pytest.mark.parametrize(
    ("sends", "words"),
    [
        (lambda *_: None, "none has come"),
        (link(("odom_combined", "base_link")), "'base_link' in 'odom_combined': set [output] odom_frame"),
        (link(("odom", "base_footprint")), "'base_footprint' in 'odom', and /tf_static has no chain"),
        (link(("odom", "base_link"), shift_ms=-9000), "the newest one is stamped 8.9"),
        (link(("odom", "base_link"), shift_ms=9000), "the oldest one is stamped"),
        (two_drivers, "do two programs publish it?"),
    ],
    ids=["silent", "another odom", "base_footprint without /tf_static", "old", "of another clock", "two drivers"],
)
def test_map_to_odom_is_not_sent_without_the_drivers_pose_and_diagnostics_say_why(sends: Any, words: str) -> None:
    world = driven(sends)
    assert ("map", "odom") not in world.sent
    level, message = heard(world)
    assert level == 2, "nothing works without it"
    assert message.startswith(
        "TRACKING; map -> odom is not sent: the driver's pose of base_link in odom is not known: "
    )
    assert words in message
    world.close()


def test_stray_stamps_cost_moments_and_a_clock_that_is_set_back_half_a_second() -> None:
    history, second = PoseHistory(), 10**9
    stamps = [*range(0, 10), 10**6, *range(10, 20), -(10**6), *range(20, 30)]  # tenths of a second
    known = []
    for number in [*stamps, *(stamp - 10**5 for stamp in range(30, 40))]:
        history.add(number * second // 10, planar(number, 0, 0))
        known += [number] if not isinstance(history.at(number * second // 10), Missing) else []
    assert known == [*range(0, 10), 10**6, *range(14, 20), *range(20, 30), *(stamp - 10**5 for stamp in range(34, 40))]


def test_other_programs_with_the_same_transforms_are_named() -> None:
    for publish_odom, frames in ((True, ("odom", "base_link")), (True, ("map", "odom")), (False, ("map", "odom"))):
        world = World(Case(publish_odom=publish_odom))
        world.frame(0)
        assert heard(world) == (0, "TRACKING"), "what it sent itself comes back to it"
        world.put(world.key(""), tf_message(frames, np.eye(4), 0), "tf2_msgs/msg/TFMessage")
        level, message = heard(world)
        assert (level, f"another program publishes {frames[0]} -> {frames[1]} too" in message) == (2, True)
        world.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"odom_frame": "map"}, "three different names"),
        ({"base_frame": "/base_link"}, "begin with a slash"),
        ({"odom_topic": "odom"}, "for that of its wheels"),
    ],
)
def test_a_tree_that_cannot_be_right_is_refused_at_start(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        OUTPUT.check(OutputSection(format="ros2", **settings), Topics())


def test_the_covariance_is_that_of_the_base() -> None:
    """A thousand poses of the body, drawn by its covariance, have bases with the covariance that is sent."""
    told: list[bytes] = []
    world = World(Case(publish_odom=True))
    key = RmwZenohKeys(0).key("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")
    world.bus.subscribe(key, lambda _, data: told.append(data))
    covariance = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6])
    world.frame(700, cov_rot_trans=covariance)
    world.close()
    sent = STORE.deserialize_cdr(told[0], "geometry_msgs/msg/PoseWithCovarianceStamped").pose.covariance.reshape(6, 6)
    place, mean = truth(700) @ BASE_FROM_BODY, truth(700)
    drawn = []
    for rot_trans in np.random.default_rng(3).multivariate_normal(np.zeros(6), covariance, 4000):
        base = se3(so3_exp(rot_trans[:3]) @ place[:3, :3], place[:3, 3] + rot_trans[3:]) @ se3_inverse(BASE_FROM_BODY)
        drawn.append(np.concatenate([base[:3, 3] - mean[:3, 3], so3_log(base[:3, :3] @ mean[:3, :3].T)]))
    scale = np.sqrt(np.diag(sent))
    np.testing.assert_allclose(
        np.cov(np.array(drawn).T) / np.outer(scale, scale), sent / np.outer(scale, scale), atol=0.06
    )
