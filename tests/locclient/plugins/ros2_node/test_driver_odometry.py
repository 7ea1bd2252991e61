"""Values that the localizer publishes, against the true drive: map -> odom by the driver's poses, motion, covariances; without ROS."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings.ros2.messages import FrameLink, encode_frame_links, encode_prior
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sensors.source_settings import Topics
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node import OUTPUT
from locclient.plugins.ros2_node.odometry import DriverOdometry, Missing, PoseHistory, motion_between
from locclient.plugins.ros2_node.sensor_messages import decode_initial_pose
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate

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

    begun_at: Array = field(default_factory=lambda: np.eye(4))
    changes_ms: tuple[int, ...] = ()
    lost_ms: tuple[int, int] = (0, 0)
    delay_ms: int = 0
    is_shuffled: bool = False
    child: str = "base_link"

    def odom_from_base(self, at_ms: float) -> Array:
        """The driver's: it drifts."""
        since = max((ms for ms in self.changes_ms if ms <= at_ms), default=None)
        begun = self.begun_at if since is None else np.eye(4)
        drift = planar(2e-5 * at_ms, 0, 3e-5 * at_ms)
        return begun @ drift @ se3_inverse(truth(since or 0)) @ truth(at_ms)

    def is_known(self, at_ms: int) -> bool:
        """True if the driver's pose is: between two messages of one life."""
        before = at_ms // DRIVER_MS * DRIVER_MS
        is_lost = self.lost_ms[0] <= before + DRIVER_MS and before < self.lost_ms[1]
        return not is_lost and not any(before < ms <= before + DRIVER_MS for ms in self.changes_ms)


CASES = {
    "the driver": Case(),
    "a driver that ran long before": Case(begun_at=planar(-140.0, 320.0, 2.5)),
    "the driver starts anew after 1.5 s": Case(begun_at=planar(40, 2, 1), changes_ms=(2500,), lost_ms=(1000, 2500)),
    "the driver's odometry is reset": Case(begun_at=planar(40, 2, 1), changes_ms=(1510, 2310)),
    "late messages": Case(delay_ms=250),
    "late and out of order": Case(delay_ms=150, is_shuffled=True),
    "base_footprint": Case(child="base_footprint"),
}  # fmt: skip


class World:
    """map -> odom of a driver's odometry, and what was sent, by the stamps of frames in ms."""

    def __init__(self, case: Case) -> None:
        self.case, self.sent = case, dict[int, Array]()
        self.odometry = DriverOdometry("odom", "base_link", 0.0, self._send)
        if case.child != "base_link":
            static = FrameLink(case.child, "base_link", FOOTPRINT_FROM_BASE)
            self.odometry.handle_tf_static(encode_frame_links(BEGUN_NS, [static]))

    def _send(self, stamp_ns: int, map_from_odom: Array) -> None:
        self.sent[(stamp_ns - BEGUN_NS) // MS] = map_from_odom

    def drive(self, at_ms: int) -> None:
        """The driver's message of a moment."""
        base = self.case.odom_from_base(at_ms)
        odom_from_child = base if self.case.child == "base_link" else base @ se3_inverse(FOOTPRINT_FROM_BASE)
        self.odometry.handle_tf([FrameLink("odom", self.case.child, odom_from_child, BEGUN_NS + at_ms * MS)])

    def frame(self, at_ms: int) -> None:
        """A localized frame, taken at this moment."""
        self.odometry.handle_frame(BEGUN_NS + at_ms * MS, truth(at_ms))


def moments(case: Case) -> list[Callable[[World], None]]:
    """What happens, in order of its arrival."""
    events: list[tuple[float, Callable[[World], None]]] = []
    dice = random.Random(5)
    for at_ms in range(0, END_MS, DRIVER_MS):
        if not case.lost_ms[0] <= at_ms < case.lost_ms[1]:
            jitter_ms = dice.uniform(0, 90) if case.is_shuffled else 0
            events.append((at_ms + case.delay_ms + jitter_ms, partial(World.drive, at_ms=at_ms)))
    events += [(at_ms + LATENCY_MS, partial(World.frame, at_ms=at_ms)) for at_ms in range(103, END_MS - 500, FRAME_MS)]
    return [action for _, action in sorted(events, key=lambda event: event[0])]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_map_from_odom_is_true_at_every_frame_whose_pose_of_the_driver_is_known(case: Case) -> None:
    world = World(case)
    for happen in moments(case):
        happen(world)
    assert set(world.sent) == {ms for ms in range(103, END_MS - 500, FRAME_MS) if case.is_known(ms)}
    for at_ms, map_from_odom in world.sent.items():
        np.testing.assert_allclose(map_from_odom @ case.odom_from_base(at_ms), truth(at_ms), atol=1e-2)


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([], "none has come"),
        ([("odom_combined", "base_link", 0, 0)], "'base_link' in 'odom_combined': set [output] odom_frame"),
        ([("odom", "base_footprint", 0, 0)], "'base_footprint' in 'odom', and /tf_static has no chain"),
        ([("odom", "base_link", -9000, 0)], "the newest one is stamped 8.9"),
        ([("odom", "base_link", 9000, 0)], "the oldest one is stamped"),
        ([("odom", "base_link", 0, 0), ("odom", "base_link", 7, 5)], "do two programs publish it?"),
    ],
)
def test_nothing_is_sent_without_the_drivers_pose_and_the_reason_is_told(
    links: list[tuple[str, str, int, float]], words: str
) -> None:
    """links: parent, child, how much later their stamps are in ms, and where their odometry began."""
    world = World(Case())
    for at_ms in range(0, 2000, DRIVER_MS):
        for parent, child, late_ms, begun_m in links:
            odom_from_base = planar(begun_m, begun_m, 0) @ world.case.odom_from_base(at_ms)
            world.odometry.handle_tf([FrameLink(parent, child, odom_from_base, BEGUN_NS + (at_ms + late_ms) * MS)])
        if at_ms % FRAME_MS == 0 and at_ms > 0:
            world.frame(at_ms - 7)
    assert world.sent == {}
    reason = world.odometry.fault(BEGUN_NS + 1893 * MS)
    assert reason.startswith("the driver's pose of base_link in odom is not known: ") and words in reason


def test_stray_stamps_cost_moments_and_a_clock_that_is_set_back_half_a_second() -> None:
    history, second = PoseHistory(), 10**9
    stamps = [*range(0, 10), 10**6, *range(10, 20), -(10**6), *range(20, 30)]  # tenths of a second
    known = []
    for number in [*stamps, *(stamp - 10**5 for stamp in range(30, 40))]:
        history.add(number * second // 10, planar(number, 0, 0))
        known += [number] if not isinstance(history.at(number * second // 10), Missing) else []
    assert known == [*range(0, 10), 10**6, *range(14, 20), *range(20, 30), *(stamp - 10**5 for stamp in range(34, 40))]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"odom_frame": "map"}, "three different names"),
        ({"base_frame": "/base_link"}, "begin with a slash"),
        ({"odom_topic": "odom"}, "for that of its wheels"),
        ({"endpoint": "tcp/127.0.0.1:7447"}, "ROS_DOMAIN_ID"),
    ],
)
def test_a_tree_that_cannot_be_right_is_refused_at_start(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        OUTPUT.check(OutputSection(format="ros2", **settings), Topics())


def test_the_covariance_is_that_of_the_base() -> None:
    """A thousand poses of the body, drawn by its covariance, have bases with the covariance that is sent."""
    covariance = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6])
    place, mean = truth(700) @ BASE_FROM_BODY, truth(700)
    drawn_from = replace(estimate(0.0), map_from_body=place, cov_rot_trans=covariance)
    sent = ContinuousOdom(BASE_FROM_BODY).handle(drawn_from).cov_rot_trans
    drawn = []
    for rot_trans in np.random.default_rng(3).multivariate_normal(np.zeros(6), covariance, 4000):
        base = se3(so3_exp(rot_trans[:3]) @ place[:3, :3], place[:3, 3] + rot_trans[3:]) @ se3_inverse(BASE_FROM_BODY)
        drawn.append(np.concatenate([so3_log(base[:3, :3] @ mean[:3, :3].T), base[:3, 3] - mean[:3, 3]]))
    scale = np.outer(np.sqrt(np.diag(sent)), np.sqrt(np.diag(sent)))
    np.testing.assert_allclose(np.cov(np.array(drawn).T) / scale, sent / scale, atol=0.06)


def test_odometry_has_a_twist_in_the_axes_of_the_base() -> None:
    odom = ContinuousOdom(np.eye(4))
    before, after = ((one, odom.handle(one)) for one in (estimate(1.0), estimate(1.5, x_m=0.4)))
    odom_from_base, _, twist, twist_cov = motion_between(before, after, np.eye(4))
    np.testing.assert_allclose(odom_from_base[:3, 3], [10.4, 0, 0])
    np.testing.assert_allclose(twist, [0.8, 0, 0, 0, 0, 0], atol=1e-12)
    assert 0 < np.sqrt(twist_cov[0, 0]) < 0.05


@pytest.mark.parametrize(
    ("frame", "variance", "reason"),
    [("odom", 0.25, "frame 'odom'"), ("map", np.nan, "NaN"), ("map", np.inf, "infinity"), ("map", -1.0, "positive")],
)
def test_an_initial_pose_that_cannot_be_used_is_refused_and_named(frame: str, variance: float, reason: str) -> None:
    prior = PositionPrior(BEGUN_NS, planar(2, 1, np.pi / 2), np.diag([0.0, 0, 0.0685, variance, 0.25, 0]))
    with pytest.raises(RecordingError, match=reason):
        decode_initial_pose(encode_prior(prior, frame), "map")


def test_what_an_initial_pose_leaves_at_zero_is_not_known_exactly() -> None:
    given = PositionPrior(BEGUN_NS, planar(2, 1, np.pi / 2), np.diag([0.0, 0, 0.0685, 0.25, 0.25, 0]))
    prior = decode_initial_pose(encode_prior(given, "map"), "map")
    assert prior.is_revisable
    np.testing.assert_allclose(prior.map_from_base, given.map_from_base, atol=1e-12)
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans)[[2, 3, 4]], [0.0685, 0.25, 0.25])
    assert (np.diag(prior.cov_rot_trans) > 0).all()
