"""When the localizer says that it knows where it is: scripted odometry and scripted fixes, every status by its cause.

The robot drives along x. Odometry is exact; what a frame's fixes say is where the robot truly is, moved by the offsets
that the script gives for that frame.
"""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fleetmap.bow import Vocabulary
from fleetmap.calibration import CameraCalibration, RigCalibration
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.rectification import RectifiedFrame, StereoCamera
from fleetmap.samples import PositionPrior
from locclient import localizer as module
from locclient.estimate import Estimate, Status
from locclient.localizer import Localizer
from locclient.relocalizer import Fix
from locclient.settings import LocalizerSettings, TrackSettings
from locclient.sight import Cause
from locclient.telling_apart import Expected

BODY_FROM_CAM = se3(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.05, 0.3]))
MAP_FROM_ODOM = se3(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([12.0, -5.0, 1.0]))
FRAME_NS = 200_000_000  # as often as the localizer looks
CLONES = 8
NO_FIX: tuple[Array, ...] = ()
TRUE = (np.zeros(3),)


def off(*metres: float) -> Array:
    """A wrong place, so far from the true one."""
    return np.array([*metres, 0.0, 0.0])[:3]


class ScriptedOdometry:
    """Exact, with a covariance that grows with the way; forgets frames as the real one does."""

    def __init__(self) -> None:
        self.odom_from_body: list[Array] = []
        self.next_motion = np.eye(4)
        self.redefine: Array | None = None
        self.drift_share = 0.0

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        change, self.redefine = self.redefine, None
        if change is not None:
            self.odom_from_body = [change @ earlier for earlier in self.odom_from_body]
        last = self.odom_from_body[-1] if self.odom_from_body else np.eye(4)
        self.odom_from_body.append(last @ self.next_motion)
        return OdometryEstimate(
            frame.stamp_ns, len(self.odom_from_body) - 1, self.odom_from_body[-1], 1e-6 * np.eye(6), np.zeros(3),
            np.zeros(3), np.zeros(3), OdometryStatus.TRACKING, np.arange(50), 5.0, 1.0, False, True, change,
        )  # fmt: skip

    def will_forget(self, frame_index: int) -> bool:
        return frame_index <= max(0, len(self.odom_from_body) - CLONES)

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        if frame_index < len(self.odom_from_body) - CLONES:
            return None
        motion = se3_inverse(self.odom_from_body[frame_index]) @ self.odom_from_body[-1]
        sigma_m = self.drift_share * float(np.linalg.norm(motion[:3, 3]))
        return motion, np.diag([1e-8] * 3 + [sigma_m**2 + 1e-8] * 3)


@dataclass
class ScriptedRelocalizer:
    """Offers the fixes of the present frame: near the prediction the one that lies there, anywhere all of them."""

    fixes: list[Fix] = field(default_factory=list)
    twin_share: float = 0.1

    @property
    def view(self) -> Any:
        return type("View", (), {"map_from_cam": np.tile(np.eye(4), (4, 1, 1))})

    def look(self, frame: RectifiedFrame) -> Generator[None, None, list[Fix]]:
        seen = self.fixes
        yield
        return seen

    def near(self, seen: list[Fix], map_from_cam: Array, cov_rot_trans: Array) -> Fix | None:
        reach_m = 0.3 + 3 * np.sqrt(np.trace(cov_rot_trans[3:, 3:]))
        close = [f for f in seen if np.linalg.norm(f.map_from_cam[:3, 3] - map_from_cam[:3, 3]) < reach_m]
        return close[0] if close else None

    def anywhere(
        self, seen: list[Fix], allowed: object = None, rotation: object = None, found: object = ()
    ) -> Generator[None, None, list[Fix]]:
        yield
        return list(seen)


class Robot:
    """A localizer on a ride; `go` plays one frame."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **track: Any) -> None:
        self.relocalizer = ScriptedRelocalizer()
        monkeypatch.setattr(module, "MapView", lambda *_: None)
        monkeypatch.setattr(module, "Relocalizer", lambda *_: self.relocalizer)
        lens = CameraCalibration(
            "radial-tangential", 640, 480, np.array([400, 400, 320, 240.0]), np.zeros(4), BODY_FROM_CAM
        )
        camera = StereoCamera(400.0, 320.0, 240.0, 0.1, 640, 480)
        settings = LocalizerSettings(track=TrackSettings(**track))
        self.localizer = Localizer(RigCalibration((lens,)), camera, BODY_FROM_CAM, 0.0, settings)
        self.odometry = ScriptedOdometry()
        self.localizer._odometry = self.odometry  # type: ignore[assignment]
        self.frames = 0
        self.inliers = 40
        self.is_dark = False
        self.rng = np.random.default_rng(0)
        self.map_from_body = MAP_FROM_ODOM.copy()

    def load(self, version: int = 1) -> "Robot":
        self.localizer.handle_version(version, [], Vocabulary.__new__(Vocabulary), 400.0)
        return self

    def go(self, step_m: float, offsets: Iterable[Array] = TRUE, turn_rad: float = 0.02) -> Estimate:
        """One frame after so much way along the body's x; the fixes are the true place moved by each offset."""
        motion = se3(so3_exp(np.array([0, 0, turn_rad])), np.array([step_m, 0, 0])) if self.frames else np.eye(4)
        self.map_from_body = self.map_from_body @ motion
        self.odometry.next_motion = motion
        self.relocalizer.fixes = [self._fix(offset) for offset in offsets]
        self.frames += 1
        picture = np.zeros((480, 640), np.uint8) if self.is_dark else self.rng.integers(0, 255, (480, 640), np.uint8)
        return self.localizer.handle_stereo(RectifiedFrame(self.frames * FRAME_NS, picture, None, None))

    def ride(self, steps: int, step_m: float, offsets: Sequence[Array] = TRUE) -> list[Estimate]:
        return [self.go(step_m, offsets) for _ in range(steps)]

    def _fix(self, offset: Array) -> Fix:
        moved = self.map_from_body.copy()
        moved[:3, 3] += offset
        return Fix(
            moved @ BODY_FROM_CAM,
            np.diag([0.002**2] * 3 + [0.01**2] * 3),
            self.inliers,
            20,
            twin_share=self.relocalizer.twin_share,
        )

    def error_m(self, estimate: Estimate) -> float:
        assert estimate.map_from_body is not None
        return float(np.linalg.norm(estimate.map_from_body[:3, 3] - self.map_from_body[:3, 3]))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(monkeypatch).load()


@pytest.fixture
def tracking(robot: Robot) -> Robot:
    """One that knows where it is."""
    assert robot.ride(6, 0.4)[-1].status is Status.TRACKING
    return robot


def prior(robot: Robot, sigma_m: float, offset: Array | None = None) -> PositionPrior:
    map_from_base = robot.map_from_body.copy()
    map_from_base[:3, 3] += np.zeros(3) if offset is None else offset
    covariance = np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    return PositionPrior(0, map_from_base, covariance)


def test_without_a_map_there_is_nothing_to_say(monkeypatch: pytest.MonkeyPatch) -> None:
    estimate = Robot(monkeypatch).go(0.1)
    assert estimate.status is Status.INITIALISING
    assert estimate.map_from_body is estimate.cov_rot_trans is estimate.map_version is estimate.fix is None


def test_tracking_takes_three_fixes_however_far_the_way(robot: Robot) -> None:
    said = [e.status for e in robot.ride(3, 3.0)]
    assert said == [Status.INITIALISING, Status.INITIALISING, Status.TRACKING]


def test_tracking_takes_a_metre_however_many_the_fixes(robot: Robot) -> None:
    said = robot.ride(12, 0.13)  # the first frame stands; 8 steps are 1.04 m
    assert [e.status for e in said] == [Status.INITIALISING] * 8 + [Status.TRACKING] * 4
    assert all(e.fix is not None for e in said[:10])
    assert all(robot.error_m(e) < 1e-6 for e in said[-1:])


def test_fixes_that_do_not_agree_never_confirm(robot: Robot) -> None:
    """Each frame shows another place."""
    rng = np.random.default_rng(4)
    for _ in range(30):
        estimate = robot.go(0.4, [rng.uniform(-30, 30, 3)])
        assert estimate.status is not Status.TRACKING


def test_a_tight_prior_confirms_the_first_fix(robot: Robot) -> None:
    robot.localizer.handle_prior(prior(robot, 0.5))
    estimate = robot.go(0.0)
    assert estimate.status is Status.TRACKING
    assert robot.error_m(estimate) < 1e-6


def test_a_wide_prior_only_narrows_the_search(robot: Robot) -> None:
    """Aliased places 9 m apart: the one outside the prior is never believed, the other must still be confirmed."""
    robot.localizer.handle_prior(prior(robot, 2.0))
    said = [robot.go(0.4, [off(9.0), off(0.0)]) for _ in range(4)]
    assert said[0].status is Status.INITIALISING
    assert said[-1].status is Status.TRACKING
    assert robot.error_m(said[-1]) < 1e-6


def test_a_fix_that_a_tight_prior_denies_is_not_believed_before_a_long_way(robot: Robot) -> None:
    """3 m off with 0.3 m of doubt: never while standing; after metres of way the prior is doubted more."""
    robot.localizer.handle_prior(prior(robot, 0.3, off(3.0)))
    assert {e.status for e in robot.ride(8, 0.0)} == {Status.INITIALISING}
    said = robot.ride(24, 0.4)
    assert {e.status for e in said[:8]} == {Status.INITIALISING}
    assert said[-1].status is Status.TRACKING
    assert robot.error_m(said[-1]) < 1e-6


def test_the_way_leads_back_to_the_prior_and_not_to_its_twin(robot: Robot) -> None:
    """Nothing was to be seen for metres, then two places 5 m apart: the robot's own way decides which of them it was."""
    robot.localizer.handle_prior(prior(robot, 0.5))
    robot.ride(8, 0.5, NO_FIX)
    said = [robot.go(0.4, [off(5.0), off(0.0)]) for _ in range(4)]
    assert {e.status for e in said[:2]} == {Status.INITIALISING}
    assert said[-1].status is Status.TRACKING
    assert robot.error_m(said[-1]) < 1e-6


def test_a_prior_is_no_longer_tight_after_some_way(robot: Robot) -> None:
    """Two metres without a fix: the next ones must be confirmed as anywhere else."""
    robot.localizer.handle_prior(prior(robot, 0.5))
    robot.ride(6, 0.4, NO_FIX)
    said = [e.status for e in robot.ride(4, 0.6)]
    assert said == [Status.INITIALISING] * 2 + [Status.TRACKING] * 2


def whole_prior(robot: Robot, sigma_m: float, offset: Array) -> PositionPrior:
    """As a dock tells it: with a heading and a height."""
    known = prior(robot, sigma_m, offset)
    return replace(known, cov_rot_trans=np.diag([0.02**2] * 3 + [sigma_m**2] * 3))


def test_where_the_map_shows_nothing_a_dock_is_a_place_with_a_covariance(robot: Robot) -> None:
    """An aisle that was surveyed the other way only: never tracking, never silent about what is known."""
    robot.odometry.drift_share = 0.1
    robot.localizer.handle_prior(whole_prior(robot, 0.1, off(0.1)))
    for _ in range(6):
        estimate = robot.go(0.5, NO_FIX)
        assert (estimate.status, estimate.cause) == (Status.DEGRADED, Cause.UNMATCHED)
        assert estimate.cov_rot_trans is not None
        assert 0.05 < robot.error_m(estimate) < 3 * np.sqrt(np.trace(estimate.cov_rot_trans[3:, 3:]))
    far = robot.ride(54, 0.5, NO_FIX)[-1]
    assert far.status is Status.INITIALISING, "so far from the dock it is no place any more"
    assert robot.ride(3, 1.0)[-1].status is Status.TRACKING
    assert robot.error_m(robot.go(0.1)) < 0.01


def test_a_kidnapped_robot_does_not_trust_the_dock_that_it_was_carried_from(tracking: Robot) -> None:
    tracking.localizer.handle_prior(whole_prior(tracking, 0.1, off(0.0)))
    tracking.map_from_body[:3, 3] += off(-8.0)
    after = tracking.ride(9, 0.25)
    assert Status.DEGRADED not in {estimate.status for estimate in after}
    assert after[-1].status is Status.TRACKING
    assert tracking.error_m(after[-1]) < 1e-6


def test_two_places_that_fit_are_ambiguous_until_motion_decides(robot: Robot) -> None:
    places = [off(0.0), off(0.0, 5.0)]
    said = [robot.go(0.4, places) for _ in range(8)]
    assert {e.status for e in said} == {Status.AMBIGUOUS}
    last = said[-1]
    assert last.map_from_body is None
    assert last.fix is None
    assert "2 places" in last.refused
    found = sorted(float(np.linalg.norm(h.map_from_body[:3, 3] - robot.map_from_body[:3, 3])) for h in last.hypotheses)
    assert found == pytest.approx([0.0, 5.0], abs=1e-6)
    after = [robot.go(0.4, places[:1]) for _ in range(10)]
    assert after[-1].status is Status.TRACKING
    assert robot.error_m(after[-1]) < 1e-6


def test_a_wrong_fix_is_refused_and_said(tracking: Robot) -> None:
    for metres in (0.4, 2.0, 30.0):
        estimate = tracking.go(0.2, [off(metres)])
        assert estimate.status is Status.TRACKING
        assert estimate.fix is None
        assert f"{metres:.2f} m off" in estimate.refused
        assert estimate.innovation is not None
        assert estimate.innovation > TrackSettings().innovation_limit
        assert tracking.error_m(estimate) < 0.01
        assert tracking.go(0.2).fix is not None


def test_a_kidnapped_robot_leaves_tracking_and_finds_its_new_place(tracking: Robot) -> None:
    """Carried 8 m away without a turn of its wheels: the fixes say so, three times in a row."""
    tracking.map_from_body[:3, 3] += off(-8.0)
    said = [tracking.go(0.25).status for _ in range(3)]
    assert said[:2] == [Status.TRACKING] * 2
    assert said[2] is not Status.TRACKING
    after = tracking.ride(6, 0.25)
    assert after[-1].status is Status.TRACKING
    assert tracking.error_m(after[-1]) < 1e-6
    moved = [estimate.moved_m for estimate in after if estimate.moved_m is not None]
    assert moved == pytest.approx([float(np.linalg.norm(off(-8.0)))], abs=0.1), "told once, when it was sure"


def test_who_knew_that_he_might_be_anywhere_has_not_moved(tracking: Robot) -> None:
    """Odometry that begins anew far off in its own view: what was said before the gap is given up, but had admitted as much."""
    tracking.odometry.drift_share = 0.5
    tracking.ride(30, 0.5, NO_FIX)
    tracking.map_from_body[:3, 3] += off(-1.0)
    after = tracking.ride(12, 0.25)
    assert after[-1].status is Status.TRACKING
    assert all(estimate.moved_m is None for estimate in after)


def test_wrong_fixes_that_disagree_kidnap_nobody(tracking: Robot) -> None:
    rng = np.random.default_rng(8)
    for number in range(12):
        place = [rng.uniform(10, 40, 3)] if number % 4 else TRUE
        estimate = tracking.go(0.05, place)
        assert estimate.status is Status.TRACKING
        assert tracking.error_m(estimate) < 0.01


def test_without_fixes_tracking_ages_into_degraded(tracking: Robot) -> None:
    """Standing still, odometry without drift: only the age tells."""
    said = tracking.ride(12, 0.0, NO_FIX)
    ages = [(k + 1) * FRAME_NS * 1e-9 for k in range(12)]
    for age_s, estimate in zip(ages, said, strict=True):
        expected = Status.DEGRADED if age_s > TrackSettings().degraded_after_s + 1e-9 else Status.TRACKING
        assert estimate.status is expected
        assert "nothing in the map" in estimate.refused
    assert tracking.go(0.0).status is Status.TRACKING


def test_drift_without_fixes_ends_lost_and_the_radius_says_so(tracking: Robot) -> None:
    tracking.odometry.drift_share = 0.2
    said = tracking.ride(60, 0.5, NO_FIX)
    order = [Status.TRACKING, Status.DEGRADED, Status.LOST]
    ranks = [order.index(e.status) for e in said]
    assert ranks == sorted(ranks)
    assert ranks[-1] == 2
    assert 1 in ranks
    radii = []
    for estimate in said:
        assert estimate.cov_rot_trans is not None
        radii.append(2.796 * float(np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[3:, 3:])[-1])))
    assert all(later > earlier for earlier, later in pairwise(radii))
    first_lost = ranks.index(2)
    assert radii[first_lost] > TrackSettings().lost_radius_m > 0.95 * radii[first_lost - 1]


def test_a_new_version_is_taken_over_without_losing_the_place(tracking: Robot) -> None:
    tracking.load(2)
    estimate = tracking.go(0.1)
    assert (estimate.status, estimate.map_version) == (Status.TRACKING, 2)
    assert tracking.error_m(estimate) < 1e-6


def test_odometry_that_redefines_its_frame_moves_nothing(tracking: Robot) -> None:
    tracking.odometry.redefine = se3(so3_exp(np.array([0.1, -0.2, 2.0])), np.array([4.0, 5.0, -1.0]))
    estimate = tracking.go(0.2, NO_FIX)
    assert tracking.error_m(estimate) < 1e-6


def test_no_number_of_fixes_claims_more_than_the_map_knows(tracking: Robot) -> None:
    estimate = tracking.ride(40, 0.05)[-1]
    assert estimate.cov_rot_trans is not None
    settings = TrackSettings()
    assert np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[3:, 3:])[0]) >= settings.map_sigma_m
    assert np.sqrt(np.linalg.eigvalsh(estimate.cov_rot_trans[:3, :3])[0]) >= settings.map_sigma_rad


def test_the_map_is_looked_at_as_often_as_set_over_frames_that_lie_closer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first look is done at once, the others go on in the frame after, while the robot moves on; nothing is lost by that."""
    robot = Robot(monkeypatch, fix_interval_s=0.6, settled_interval_s=0.6).load()
    robot.inliers = 100
    said = [robot.go(0.5, [off(0.0)]) for _ in range(11)]
    numbers = {(e.stamp_ns // FRAME_NS, e.fix_stamp_ns // FRAME_NS) for e in said if e.fix_stamp_ns is not None}
    assert numbers == {(1, 1), (5, 4), (8, 7), (11, 10)}


def test_a_look_that_took_two_frames_corrects_the_present(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fixes are those of the frame that was looked at; the robot has turned and moved since."""
    robot = Robot(monkeypatch, fix_interval_s=0.6).load()
    said = [robot.go(0.4, turn_rad=0.2) for _ in range(30)]
    assert said[-1].status is Status.TRACKING
    assert all(robot.error_m(e) < 1e-6 for e in said[-1:])


def test_one_strong_fix_alone_is_believed(robot: Robot) -> None:
    robot.inliers = 100
    estimate = robot.go(0.0)
    assert estimate.status is Status.TRACKING
    assert robot.error_m(estimate) < 1e-6


def test_a_strong_fix_where_the_map_has_a_twin_must_be_confirmed(robot: Robot) -> None:
    robot.inliers, robot.relocalizer.twin_share = 100, 0.55
    assert [e.status for e in robot.ride(3, 0.6)] == [Status.INITIALISING] * 2 + [Status.TRACKING]


def test_a_strong_fix_with_a_rival_is_not_believed(robot: Robot) -> None:
    robot.inliers = 100
    said = robot.ride(8, 0.0, [off(0.0), off(0.0, 5.0)])
    assert {e.status for e in said} == {Status.AMBIGUOUS}


TWIN = off(0.0, 5.0)


@pytest.fixture
def sure_robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    """One that may take it that its own aisle is in the map."""
    return Robot(monkeypatch, is_whole_site_mapped=True).load()


class Signs:
    """What the map holds at the end of an aisle and of its twin: two signs each, which look different. The robot sees those of
    one of them (0, 1) or, in an aisle that is not in the map, of none."""

    def __init__(self, robot: Robot, seen: int | None) -> None:
        rng = np.random.default_rng(5)
        corners = np.concatenate([rng.uniform(0.0, 0.5, (12, 3)) + at for at in ((9.0, 2.0, 1.5), (9.0, -2.0, 1.8))])
        ahead = corners @ MAP_FROM_ODOM[:3, :3].T + MAP_FROM_ODOM[:3, 3]
        self.points_map = [ahead, ahead + TWIN]
        self.looks = rng.integers(0, 256, (2, len(corners), 32), np.uint8)
        self.seen, self.rng, self._fix = seen, rng, robot._fix

    def fix(self, offset: Array) -> Fix:
        aisle = int(np.any(offset != 0.0))
        found = self.rng.random(24) < (0.4 if aisle == self.seen else 0.03)
        expected = Expected(np.arange(24, dtype=np.uint32), self.points_map[aisle], self.looks[aisle], found)
        return replace(self._fix(offset), witnessed=expected)


@pytest.mark.parametrize("own", [0, 1])
def test_a_twin_is_told_by_its_signs(sure_robot: Robot, monkeypatch: pytest.MonkeyPatch, own: int) -> None:
    """Although as many landmarks agree in the other aisle; and whichever is thought of first."""
    monkeypatch.setattr(sure_robot, "_fix", Signs(sure_robot, own).fix)
    said = sure_robot.ride(20, 0.4, [off(0.0), TWIN])
    assert said[0].status is Status.AMBIGUOUS
    known = next(e for e in said if e.status is Status.TRACKING)
    assert known.map_from_body is not None
    assert all(e.status in (Status.AMBIGUOUS, Status.INITIALISING) for e in said[: said.index(known)])
    truth = sure_robot.map_from_body[:3, 3] + own * TWIN
    assert said[-1].map_from_body is not None
    assert np.linalg.norm(said[-1].map_from_body[:3, 3] - truth) < 0.05


def test_signs_of_neither_twin_leave_it_open(sure_robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot's own aisle is a third one, which is not in the map."""
    monkeypatch.setattr(sure_robot, "_fix", Signs(sure_robot, None).fix)
    assert {e.status for e in sure_robot.ride(30, 0.4, [off(0.0), TWIN])} == {Status.AMBIGUOUS}


def test_signs_from_a_standing_robot_are_seen_once(sure_robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same look again and again is no more evidence."""
    monkeypatch.setattr(sure_robot, "_fix", Signs(sure_robot, 0).fix)
    said = [sure_robot.go(0.0, [off(0.0), TWIN], turn_rad=0.0) for _ in range(30)]
    assert {e.status for e in said} == {Status.AMBIGUOUS}


def test_signs_tell_nothing_where_the_own_aisle_may_not_be_in_the_map(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot, "_fix", Signs(robot, 0).fix)
    assert {e.status for e in robot.ride(20, 0.4, [off(0.0), TWIN])} == {Status.AMBIGUOUS}


def test_darkness_is_named_within_a_second(tracking: Robot) -> None:
    tracking.is_dark = True
    said = [tracking.go(0.2, NO_FIX) for _ in range(5)]
    assert said[-1].status is Status.DEGRADED
    assert said[-1].cause is Cause.DARK
    assert said[0].cause is Cause.NONE
    tracking.is_dark = False
    after = tracking.ride(3, 0.2)[-1]
    assert (after.status, after.cause) == (Status.TRACKING, Cause.NONE)


def test_what_was_never_seen_says_so(tracking: Robot) -> None:
    said = [tracking.go(0.2, NO_FIX) for _ in range(9)]
    assert said[-1].status is Status.DEGRADED
    assert said[-1].cause is Cause.UNMATCHED


def test_metres_of_an_innovation_are_told_of_what_lies_near_or_was_believed(tracking: Robot) -> None:
    """Believed: where it was found. Refused beside the prediction: how far. Refused elsewhere: it may be a twin, which says nothing."""
    tracking.go(0.4, [off(0.03)])
    near = tracking.go(0.4, [off(0.04)])
    assert near.fix is not None
    assert near.innovation_m == pytest.approx(0.04, abs=0.02)
    beside = tracking.go(0.4, [off(0.25)])
    assert beside.fix is None
    assert beside.innovation_m == pytest.approx(0.25, abs=0.05)
    assert tracking.go(0.4, []).innovation_m is None
    for _ in range(TrackSettings().search_after_failed):
        elsewhere = tracking.go(0.4, [off(9.0)])
    assert elsewhere.innovation is not None
    assert elsewhere.innovation_m is None
