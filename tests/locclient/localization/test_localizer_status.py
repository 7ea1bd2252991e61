"""When the localizer says that it knows where it is: scripted odometry and scripted fixes, every status by its cause."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.mapformat.map_errors import UNKNOWN_ERROR, ErrorSigmas, MapErrors
from fleetmap.messages import Cause, FailureKind, Status
from fleetmap.relocalization.relocalizer import Fix
from locclient.localization.estimate import assemble
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import TrackSettings
from locclient.robot.failure_monitor import FailureMonitor
from support.fleet.estimates import estimate as estimate_at
from support.fleet.scripted_robot import FRAME_NS, NO_FIX, TRUE, Robot, off


@pytest.fixture
def robot() -> Robot:
    return Robot().load()


@pytest.fixture
def tracking(robot: Robot) -> Robot:
    """One that knows where it is."""
    assert robot.ride(6, 0.4)[-1].status is Status.TRACKING
    return robot


def drift_until(robot: Robot, radius_m: float) -> None:
    """Drive without a fix until so little is known of its place."""
    robot.odometry.drift_share = 0.2
    while radius_95_m(robot.go(0.2, NO_FIX, 0.0).cov_rot_trans) < radius_m:
        pass


def test_without_a_map_there_is_nothing_to_say() -> None:
    estimate = Robot().go(0.1)
    assert estimate.status is Status.INITIALISING
    assert estimate.map_from_body is estimate.cov_rot_trans is estimate.map_version is estimate.fix is None


I, T = Status.INITIALISING, Status.TRACKING  # noqa: E741


@pytest.mark.parametrize(
    ("step_m", "inliers", "alias_ratio", "said"),
    [
        (3.0, 40, 0.1, [I, I, T]),  # three fixes, however far the way
        (0.13, 40, 0.1, [I] * 8 + [T] * 4),  # a metre, however many the fixes: the first frame stands
        (0.0, 100, 0.1, [T]),  # one strong fix alone
        (0.6, 100, 0.55, [I, I, T]),  # where the map has a twin of its place it must be confirmed
    ],
)
def test_what_tracking_takes(robot: Robot, step_m: float, inliers: int, alias_ratio: float, said: list[Status]) -> None:
    robot.inliers, robot.relocalizer.alias_ratio = inliers, alias_ratio
    estimates = robot.ride(len(said), step_m)
    assert [estimate.status for estimate in estimates] == said
    assert said[-1] is not T or robot.knows(estimates[-1])


def test_fixes_that_do_not_agree_never_confirm(robot: Robot) -> None:
    """Each frame shows another place."""
    rng = np.random.default_rng(4)
    assert all(robot.go(0.4, [rng.uniform(-30, 30, 3)]).status is not Status.TRACKING for _ in range(30))


def test_a_tight_prior_confirms_the_first_fix(robot: Robot) -> None:
    robot.told(0.5)
    assert robot.knows(robot.go(0.0))


@pytest.mark.parametrize(
    ("sigma_m", "is_revisable", "off_m", "is_found"),
    [(0.05, False, 0.1, True), (0.05, False, 0.4, False), (0.05, True, 0.1, False), (0.6, False, 0.1, False)],
)
def test_at_a_dock_a_fix_needs_no_recall(
    robot: Robot, sigma_m: float, is_revisable: bool, off_m: float, is_found: bool
) -> None:
    """Most of what is expected is hidden from a low camera: a dock names the place, the fix must lie within its gate. Neither the
    word of an operator nor a zone as wide as the next aisle is near does as much."""
    robot.inliers, robot.landmark_recall = 35, 0.1
    robot.told(sigma_m, off(off_m), is_whole=True, is_revisable=is_revisable)
    said = robot.ride(8, 0.0)
    assert [e.status is Status.TRACKING for e in said] == [is_found] * 8
    assert is_found == robot.knows(said[-1])


def test_a_wide_prior_only_narrows_the_search(robot: Robot) -> None:
    """Aliased places 12 m apart: the one outside the prior is never believed, the other must still be confirmed."""
    robot.told(2.0)
    said = [robot.go(0.4, [off(12.0), off(0.0)]) for _ in range(4)]
    assert said[0].status is Status.INITIALISING
    assert robot.knows(said[-1])


def test_a_fix_that_a_tight_prior_denies_is_not_believed_before_a_long_way(robot: Robot) -> None:
    """3 m off with 0.3 m of doubt: never while standing; after metres of way the prior is doubted more."""
    robot.told(0.3, off(3.0))
    assert {e.status for e in robot.ride(8, 0.0)} == {Status.INITIALISING}
    said = robot.ride(24, 0.4)
    assert {e.status for e in said[:8]} == {Status.INITIALISING}
    assert robot.knows(said[-1])


def test_the_way_leads_back_to_the_prior_and_not_to_its_twin(robot: Robot) -> None:
    """Nothing was to be seen for metres, then two places 5 m apart: the robot's own way decides which of them it was."""
    robot.told(0.5)
    robot.ride(8, 0.5, NO_FIX)
    said = [robot.go(0.4, [off(5.0), off(0.0)]) for _ in range(4)]
    assert {e.status for e in said[:2]} == {Status.INITIALISING}
    assert robot.knows(said[-1])


def test_a_prior_is_no_longer_tight_after_some_way(robot: Robot) -> None:
    """Two metres without a fix: the next ones must be confirmed as anywhere else."""
    robot.told(0.5)
    robot.ride(6, 0.4, NO_FIX)
    assert [e.status for e in robot.ride(4, 0.6)] == [I, I, T, T]


def test_where_the_map_shows_nothing_a_dock_is_a_place_with_a_covariance(robot: Robot) -> None:
    """An aisle that was surveyed the other way only: never tracking, never silent about what is known."""
    robot.odometry.drift_share = 0.1
    robot.told(0.1, off(0.1), is_whole=True)
    for _ in range(6):
        estimate = robot.go(0.5, NO_FIX)
        assert (estimate.status, estimate.cause) == (Status.DEGRADED, Cause.UNMATCHED)
        assert 0.05 < robot.error_m(estimate) < 3 * np.sqrt(np.trace(estimate.cov_rot_trans[3:, 3:]))
    far = robot.ride(54, 0.5, NO_FIX)[-1]
    assert far.status is Status.INITIALISING, "so far from the dock it is no place any more"
    assert robot.ride(3, 1.0)[-1].status is Status.TRACKING
    assert robot.error_m(robot.go(0.1)) < 0.01


def test_a_kidnapped_robot_does_not_trust_the_dock_that_it_was_carried_from(tracking: Robot) -> None:
    tracking.told(0.1, is_whole=True)
    tracking.map_from_body[:3, 3] += off(-8.0)
    after = tracking.ride(9, 0.25)
    assert Status.DEGRADED not in {estimate.status for estimate in after}
    assert tracking.knows(after[-1])


def test_two_places_that_fit_are_ambiguous_until_motion_decides(robot: Robot) -> None:
    places = [off(0.0), off(0.0, 5.0)]
    *said, last = robot.ride(8, 0.4, places)
    assert {e.status for e in (*said, last)} == {Status.AMBIGUOUS}
    assert last.map_from_body is last.fix is None
    assert "2 places" in last.refused
    found = sorted(float(np.linalg.norm(h.map_from_body[:3, 3] - robot.map_from_body[:3, 3])) for h in last.hypotheses)
    assert found == pytest.approx([0.0, 5.0], abs=1e-6)
    assert robot.knows(robot.ride(10, 0.4, places[:1])[-1])


def test_a_wrong_fix_is_refused_and_said(tracking: Robot) -> None:
    for metres in (0.4, 2.0, 30.0):
        estimate = tracking.go(0.2, [off(metres)])
        assert estimate.status is Status.TRACKING
        assert estimate.fix is None
        assert f"{metres:.2f} m off" in estimate.refused
        assert estimate.innovation > TrackSettings().innovation_limit
        assert tracking.error_m(estimate) < 0.01
        assert tracking.go(0.2).fix is not None


@pytest.mark.parametrize(("missed_frames", "tracking_frames"), [(0, 2), (1, 0)])
def test_a_kidnapped_robot_leaves_tracking_and_finds_its_new_place(
    tracking: Robot, missed_frames: int, tracking_frames: int
) -> None:
    """Carried 8 m away without a turn of its wheels: the fixes say so, three times in a row, or once where a frame was missed."""
    tracking.map_from_body[:3, 3] += off(-8.0)
    tracking.frames, tracking.inliers = tracking.frames + missed_frames, 80
    said = [tracking.go(0.3).status is Status.TRACKING for _ in range(3)]
    assert said == [n < tracking_frames for n in range(3)]
    after = tracking.ride(6, 0.25)
    assert tracking.knows(after[-1])
    moved = [estimate.moved_m for estimate in after if estimate.moved_m is not None]
    assert moved == pytest.approx([float(np.linalg.norm(off(-8.0)))], abs=0.1), "told once, when it was sure"


def test_after_missed_frames_a_fix_beside_the_pose_is_no_other_place(tracking: Robot) -> None:
    """A depth camera's fixes scatter beyond their covariance: within the distance of one hypothesis nobody carried the robot."""
    tracking.frames, tracking.inliers = tracking.frames + 1, 80
    assert {tracking.go(0.3, [off(0.3)]).status for _ in range(2)} == {Status.TRACKING}


@pytest.mark.parametrize("inliers", [20, 80])
def test_a_standing_robot_leaves_its_pose_for_strong_fixes_alone(tracking: Robot, inliers: int) -> None:
    """At a dock, with nothing mapped before it, an end of another aisle agrees a little with what it sees, again and again."""
    tracking.inliers = inliers
    said = [tracking.go(0.0, [off(-8.0)]) for _ in range(12)]
    if inliers < TrackSettings().strong_inliers:
        assert {e.status for e in said} == {Status.TRACKING, Status.DEGRADED}
        assert tracking.error_m(said[-1]) < 0.01
    else:
        assert tracking.error_m(said[-1]) == pytest.approx(8.0, abs=0.1), "it is where they say"


@pytest.mark.parametrize(
    ("seen", "status"), [(TRUE, Status.TRACKING), (NO_FIX, Status.DEGRADED), ([off(-8.0)], Status.AMBIGUOUS)]
)
def test_where_tracks_break_the_map_decides_at_once(tracking: Robot, seen: list[Array], status: Status) -> None:
    """Somebody stood before the cameras, stands there, or carried the robot: one look tells, not 0.9 s without fixes."""
    tracking.inliers, tracking.odometry.breaks = 80, True
    estimate = tracking.go(0.0, seen)
    assert estimate.status is status
    assert (estimate.map_from_body is None) == (status is Status.AMBIGUOUS)
    assert tracking.go(0.0).status is Status.TRACKING
    assert tracking.go(0.0, NO_FIX).status is Status.TRACKING, "the break is forgotten with the fix after it"


def test_without_its_imu_a_pose_is_less_exact_and_doubted_until_the_map_confirms_it(tracking: Robot) -> None:
    """Not after 0.2 s, in which it cannot have gone far. A fix ends the doubt, not the wider covariance of a motion by images alone."""
    before = radius_95_m(tracking.go(0.1).cov_rot_trans)
    tracking.odometry.lacks_imu = True
    doubted = [*(tracking.go(0.1, NO_FIX) for _ in range(2)), tracking.go(0.1)]
    assert [e.status for e in doubted] == [Status.TRACKING, Status.DEGRADED, Status.TRACKING]
    assert radius_95_m(doubted[0].cov_rot_trans) > 1.5 * before
    said = [tracking.go(0.1, NO_FIX) for _ in range(2)]
    tracking.odometry.lacks_imu = False
    said += [tracking.go(0.1, NO_FIX), tracking.go(0.1)]
    radii_m = [radius_95_m(e.cov_rot_trans) for e in said]
    assert {e.status for e in said} == {Status.TRACKING}
    assert radii_m[2] > radii_m[1] > 1.5 * radii_m[3]


def test_a_robot_carried_in_the_dark_is_doubted_as_before(tracking: Robot) -> None:
    """No picture, no look: the odometry goes on by the IMU, and what it says then is worth as much as after any gap."""
    tracking.is_dark = tracking.odometry.breaks = True
    assert tracking.go(0.2, NO_FIX).status is Status.TRACKING


def test_who_knew_that_he_might_be_anywhere_has_not_moved(tracking: Robot) -> None:
    """Odometry that begins anew far off in its own view: what was said before the gap is given up, but had admitted as much."""
    tracking.odometry.drift_share = 0.5
    tracking.ride(30, 0.5, NO_FIX)
    tracking.map_from_body[:3, 3] += off(-1.0)
    after = tracking.ride(12, 0.25)
    assert after[-1].status is Status.TRACKING
    assert all(estimate.moved_m is None for estimate in after)


def test_a_robot_that_is_lifted_knows_at_once_that_it_is_lost(tracking: Robot) -> None:
    """Its report says so."""
    monitor = FailureMonitor()
    monitor.handle(tracking.go(0.2))
    tracking.odometry.lifts = True
    said = [tracking.go(0.0, NO_FIX) for _ in range(12)]
    assert {(e.status, e.cause) for e in said} == {(Status.LOST, Cause.CARRIED)}
    failures = [failure for estimate in said if (failure := monitor.handle(estimate)) is not None]
    assert [(failure.kind, failure.cause) for failure in failures] == [(FailureKind.BLIND, Cause.CARRIED)]
    tracking.inliers = 100
    assert tracking.knows(tracking.go(0.0))
    assert tracking.go(0.0).cause is Cause.NONE


def test_a_lifted_robot_in_the_dark_needs_light_first(tracking: Robot) -> None:
    """Darkness is what an operator must end before it can find itself; that it was carried is said again in the light."""
    tracking.odometry.lifts = tracking.is_dark = True
    assert [tracking.go(0.0, NO_FIX).cause for _ in range(4)][1:] == [Cause.DARK] * 3
    tracking.is_dark = False
    assert (tracking.go(0.0, NO_FIX).status, tracking.go(0.0, NO_FIX).cause) == (Status.LOST, Cause.CARRIED)


def test_a_robot_that_knew_no_place_was_not_carried_from_one(robot: Robot) -> None:
    """Lifted while it searches, it does not say for ever that it was carried."""
    robot.odometry.lifts = True
    said = [robot.go(0.0, NO_FIX) for _ in range(3)]
    assert {(e.status, e.cause) for e in said} == {(Status.INITIALISING, Cause.NONE)}


def test_lost_tracks_come_before_a_map_that_does_not_match(tracking: Robot) -> None:
    tracking.odometry.drift_share = 0.3
    far = tracking.ride(12, 0.5, NO_FIX)[-1]
    assert (far.status, far.cause) == (Status.LOST, Cause.UNMATCHED)
    tracking.odometry.breaks = True
    assert tracking.go(0.5, NO_FIX).cause is Cause.ODOMETRY


def test_wrong_fixes_that_disagree_kidnap_nobody(tracking: Robot) -> None:
    rng = np.random.default_rng(8)
    for number in range(12):
        estimate = tracking.go(0.05, [rng.uniform(10, 40, 3)] if number % 4 else TRUE)
        assert estimate.status is Status.TRACKING
        assert tracking.error_m(estimate) < 0.01


def test_without_fixes_tracking_ages_into_degraded(tracking: Robot) -> None:
    """Standing still, odometry without drift: only the age tells."""
    said = tracking.ride(12, 0.0, NO_FIX)
    for number, estimate in enumerate(said, 1):
        is_old = number * FRAME_NS * 1e-9 > TrackSettings().degraded_after_s + 1e-9
        assert estimate.status is (Status.DEGRADED if is_old else Status.TRACKING)
        assert "nothing in the map" in estimate.refused
    assert tracking.go(0.0).status is Status.TRACKING


def test_drift_without_fixes_ends_lost_and_the_radius_says_so(tracking: Robot) -> None:
    tracking.odometry.drift_share = 0.2
    said = tracking.ride(60, 0.5, NO_FIX)
    order = [Status.TRACKING, Status.DEGRADED, Status.LOST]
    ranks = [order.index(e.status) for e in said]
    assert ranks == sorted(ranks)
    assert {1, 2} <= {*ranks}
    radii = [radius_95_m(e.cov_rot_trans) for e in said]
    assert all(later > earlier for earlier, later in pairwise(radii))
    first_lost = ranks.index(2)
    assert radii[first_lost] > TrackSettings().lost_radius_m > 0.95 * radii[first_lost - 1]


@pytest.mark.parametrize(
    ("radius_m", "inliers", "alias_ratio", "places", "said"),
    [
        (3.0, 16, 0.9, [off(0, 4.5)], [Status.LOST] * 3),  # once, and in every frame until it has driven a metre
        (1.4, 16, 0.9, [off(0, 2.0)], [Status.DEGRADED] * 3),
        (3.0, 40, 0.9, [off(0, 4.5), off(0)], [Status.AMBIGUOUS] * 3),
        (3.0, 80, 0.1, TRUE, [Status.TRACKING] * 3),  # nothing else of the map can be meant
        (1.0, 16, 0.9, TRUE, [Status.TRACKING] * 3),  # the next bay is not within its gate
    ],
)
def test_a_pose_that_may_be_at_the_next_bay_is_confirmed_like_any_place(
    tracking: Robot, radius_m: float, inliers: int, alias_ratio: float, places: list[Array], said: list[Status]
) -> None:
    """Driven without a fix until its radius is that; one fix of what looks the same does not decide where it is."""
    drift_until(tracking, radius_m)
    tracking.inliers, tracking.relocalizer.alias_ratio = inliers, alias_ratio
    for status in said:
        estimate = tracking.go(0.2, places, 0.0)
        assert estimate.status is status
        assert estimate.cov_rot_trans is not None or status is Status.AMBIGUOUS
        assert estimate.map_from_body is None or tracking.error_m(estimate) < radius_95_m(estimate.cov_rot_trans)


@pytest.mark.parametrize(("alias_step_m", "status"), [(2.5, Status.DEGRADED), (5.0, Status.TRACKING)])
def test_the_map_says_how_near_a_look_alike_place_is(tracking: Robot, alias_step_m: float, status: Status) -> None:
    """A radius of 1.4 m includes a place 2.5 m away, and none 5 m away: then one weak fix within the gate is enough."""
    tracking.load(alias_step_m=alias_step_m, version=2)
    drift_until(tracking, 1.4)
    tracking.inliers, tracking.relocalizer.alias_ratio = 16, 0.9
    assert tracking.go(0.2, TRUE, 0.0).status is status


@pytest.mark.parametrize("step_m", [0.2, 0.0])
@pytest.mark.parametrize("radius_m", [1.4, 2.5])
def test_a_doubted_pose_keeps_nobody_from_where_he_was_carried(tracking: Robot, radius_m: float, step_m: float) -> None:
    drift_until(tracking, radius_m)
    tracking.inliers, tracking.relocalizer.alias_ratio = 80, 0.1
    tracking.map_from_body[:2, 3] += [20.0, 7.0]
    assert tracking.knows(tracking.ride(12, step_m)[-1])


def test_odometry_that_redefines_its_frame_moves_nothing(tracking: Robot) -> None:
    tracking.odometry.redefine = se3(so3_exp(np.array([0.1, -0.2, 2.0])), np.array([4.0, 5.0, -1.0]))
    assert tracking.error_m(tracking.go(0.2, NO_FIX)) < 1e-6


def test_no_number_of_fixes_claims_more_than_the_map_knows(tracking: Robot) -> None:
    estimate = tracking.ride(40, 0.05)[-1]
    assert np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[3:, 3:])[0]) >= UNKNOWN_ERROR.up_m
    assert np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[:3, :3])[0]) >= UNKNOWN_ERROR.turn_rad


@pytest.mark.parametrize(
    ("sigma_m", "expected"), [(0.06, Status.TRACKING), (0.2, Status.DEGRADED), (0.9, Status.DEGRADED)]
)
def test_a_map_that_says_how_wrong_it_is_is_believed(tracking: Robot, sigma_m: float, expected: Status) -> None:
    """From a radius of 0.3 m on the pose is no full knowledge; where the next place that looks alike is within it, it is a prior."""
    wide = MapErrors(100.0, {(x, y): ErrorSigmas(0.01, sigma_m, sigma_m) for x in (-1, 0) for y in (-1, 0)})
    maps = tracking.localizer.maps
    maps.by_floor[""] = maps.by_floor[""]._replace(errors=wide)
    estimate = tracking.ride(40, 0.05)[-1]
    assert estimate.status is expected
    assert tracking.error_m(estimate) < 0.05
    assert np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[3:, 3:])[0]) >= sigma_m


def test_the_map_is_looked_at_as_often_as_set_over_frames_that_lie_closer() -> None:
    """The first look is done at once, the others go on in the frame after, while the robot moves on; nothing is lost by that."""
    robot = Robot(fix_interval_s=0.6, settled_interval_s=0.6).load()
    robot.inliers = 100
    said = [robot.go(0.5, [off(0.0)]) for _ in range(11)]
    numbers = {(e.stamp_ns // FRAME_NS, e.fix_stamp_ns // FRAME_NS) for e in said if e.fix_stamp_ns is not None}
    assert numbers == {(1, 1), (5, 4), (8, 7), (11, 10)}


def test_where_tracks_break_a_look_begins_and_the_one_before_is_given_up() -> None:
    """At a frame that has no turn yet, and at one right after that of a look which is not done."""
    robot = Robot(fix_interval_s=0.6, settled_interval_s=0.6).load()
    robot.inliers, looks = 100, list[int]()
    for number in range(1, 13):
        robot.odometry.breaks = number in {6, 10}
        estimate = robot.go(0.5)
        looks += [] if estimate.fix_stamp_ns is None else [estimate.fix_stamp_ns // FRAME_NS]
    assert looks == [1, 4, 6, 10], "without breaks 1, 4, 7, 10; that of 9 was given up"
    assert estimate.status is Status.TRACKING


def test_a_look_that_took_two_frames_corrects_the_present() -> None:
    """The fixes are those of the frame that was looked at; the robot has turned and moved since."""
    robot = Robot(fix_interval_s=0.6).load()
    assert robot.knows([robot.go(0.4, turn_rad=0.2) for _ in range(30)][-1])


@pytest.mark.parametrize(
    ("step_m", "pooled"), [(0.3, [0, 1, 2, 3, 3, 0, 0, 1]), (0.11, [0, 0, 1, 1, 2, 0, 0, 0]), (0.0, [0] * 8)]
)
def test_frames_without_a_fix_count_together_until_the_next_one(
    tracking: Robot, step_m: float, pooled: list[int]
) -> None:
    """Those of other viewpoints, at most three beside the query's own; a robot that stands sees the same again."""
    asked, near = list[int](), tracking.relocalizer.near

    def counted(seen: list[Fix], place: Array, covariance: Array, earlier: Sequence[object] = ()) -> Fix | None:
        asked[-1] = max(asked[-1], len(earlier))
        return near(seen, place, covariance)

    tracking.relocalizer.near = counted  # type: ignore[method-assign]
    for number in range(8):
        asked.append(0)
        tracking.go(step_m, TRUE if number == 5 else NO_FIX, turn_rad=0.0)
    assert asked == pooled


def test_metres_of_an_innovation_are_told_of_what_lies_near_or_was_believed(tracking: Robot) -> None:
    """Believed: where it was found. Refused beside the prediction: how far. Refused elsewhere: it may be a twin, which says nothing."""
    tracking.go(0.4, [off(0.03)])
    near = tracking.go(0.4, [off(0.04)])
    assert (near.fix is not None, near.innovation_m) == (True, pytest.approx(0.04, abs=0.02))
    beside = tracking.go(0.4, [off(0.25)])
    assert (beside.fix, beside.innovation_m) == (None, pytest.approx(0.25, abs=0.05))
    assert tracking.go(0.4, []).innovation_m is None
    for _ in range(TrackSettings().search_after_failed):
        elsewhere = tracking.go(0.4, [off(9.0)])
    assert elsewhere.innovation is not None
    assert elsewhere.innovation_m is None


@pytest.mark.parametrize("broken", ["cov_rot_trans", "map_from_body"])
def test_a_pose_of_nan_is_none(tracking: Robot, broken: str) -> None:
    """Such as odometry leaves where a robot has lost most of its frames."""
    known = Place(np.eye(4), 1e-4 * np.eye(6))
    place = known._replace(**{broken: np.nan * getattr(known, broken)})
    tracking.localizer._tracker.confirmed = PoseHypothesis(0, 0, place, place)
    found = assemble(estimate_at(0.1, known=False), tracking.localizer._tracker, has_failed=False)
    assert (found.map_from_body, found.cov_rot_trans) == (None, None)
    assert found.status is Status.LOST
