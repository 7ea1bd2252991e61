"""Places that look like others: outside the map, by their measured similarity; inside it, told apart by what only one of them has."""

from collections.abc import Generator
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array
from fleetmap.messages import Status
from fleetmap.relocalization.map_view import CovisibleLandmarks, LookAlikes
from fleetmap.relocalization.relocalizer import Fix
from support.fleet import scripted_robot
from support.fleet.scripted_robot import MAP_FROM_ODOM, NO_FIX, Robot, off

LOOK_ALIKES = LookAlikes(0.4, 1 / 41)


@pytest.fixture
def robot() -> Robot:
    """One without a prior, which sees less than what look-alikes of this map may show; its fixes are strong."""
    found = Robot().load(LOOK_ALIKES)
    found.inliers, found.landmark_recall = 100, 0.3
    return found


def test_what_looks_no_better_than_a_look_alike_is_never_tracked(robot: Robot) -> None:
    """The only place that agrees, metre after metre: as a robot at the end of a hall of which the other end is mapped."""
    said = robot.ride(40, 0.4)
    assert {e.status for e in said} == {Status.AMBIGUOUS}
    assert all(e.map_from_body is None and len(e.hypotheses) == 1 for e in said)
    assert "not in the map" in said[-1].refused


@pytest.mark.parametrize(
    ("recall", "lookalikes", "is_whole"), [(0.5, LOOK_ALIKES, False), (0.14, None, False), (0.3, LOOK_ALIKES, True)]
)
def test_what_no_look_alike_shows_is_tracked(recall: float, lookalikes: LookAlikes | None, is_whole: bool) -> None:
    """By more landmarks than any look-alike has, in a map without them, and where the whole site is mapped."""
    robot = Robot(is_whole_site_mapped=is_whole).load(lookalikes)
    robot.landmark_recall = recall
    assert robot.ride(4, 0.5)[-1].status is Status.TRACKING


def test_a_single_good_look_is_not_enough(robot: Robot) -> None:
    """The mean of all looks at a place counts, those without a fix there included."""
    robot.inliers = 40
    for number in range(30):
        robot.landmark_recall = 0.6 if number % 5 == 4 else 0.3
        assert robot.go(0.4).status is not Status.TRACKING


@pytest.mark.parametrize(
    ("sigma_m", "status"), [(0.5, Status.TRACKING), (1.0, Status.TRACKING), (5.0, Status.AMBIGUOUS)]
)
def test_a_position_resolves_it(robot: Robot, sigma_m: float, status: Status) -> None:
    """A dock or a zone; not one so coarse that a look-alike lies within it."""
    robot.told(sigma_m, off(0.1))
    assert robot.ride(4, 0.5)[-1].status is status


def test_a_zone_that_is_passed_later_resolves_it(robot: Robot) -> None:
    assert {e.status for e in robot.ride(10, 0.4)} == {Status.AMBIGUOUS}
    robot.told(1.0, off(0.5))
    assert robot.knows(robot.ride(4, 0.4)[-1])


def test_a_robot_that_was_carried_away_is_not_believed_at_a_look_alike(robot: Robot) -> None:
    robot.told(0.3)
    assert robot.ride(6, 0.4)[-1].status is Status.TRACKING
    robot.map_from_body[:3, 3] += off(-12.0)
    assert robot.ride(20, 0.3)[-1].status is Status.AMBIGUOUS


def test_fixes_that_agree_confirm_a_standing_robot_where_look_alikes_were_measured() -> None:
    """Weak ones, as by night; where nobody measured, or by too few frames, a metre of motion must exclude a look-alike."""
    for lookalikes, last in (
        (LookAlikes(0.2, 1 / 41), Status.TRACKING),
        (LookAlikes(0.0, 1 / 20), Status.TRACKING),
        (LookAlikes(0.0, 1 / 19), Status.INITIALISING),
        (None, Status.INITIALISING),
    ):
        robot = Robot().load(lookalikes)
        robot.landmark_recall = 0.25
        said = [robot.go(0.0, turn_rad=0.0).status for _ in range(3)]
        assert said == [Status.INITIALISING, Status.INITIALISING, last]


@pytest.mark.parametrize(
    ("lookalikes", "step_m", "has_fix"),
    [
        (None, 0.0, True),
        (None, 0.4, True),
        (LookAlikes(0.14, 1 / 41, 30), 0.0, True),
        (LookAlikes(0.14, 1 / 41, 45), 0.0, False),
    ],
)
def test_few_matches_that_repeat_at_one_place_are_a_fix_and_confirm_none(
    lookalikes: LookAlikes | None, step_m: float, *, has_fix: bool
) -> None:
    """As by night, with a tenth of the landmarks in every look: an unmapped look-alike repeats as well, so the robot is not TRACKING."""
    robot = Robot().load(lookalikes)
    robot.inliers, robot.landmark_recall = 40, 0.1
    said = [robot.go(step_m, turn_rad=0.0) for _ in range(12)]
    assert [e.fix is not None for e in said] == [has_fix and number >= 2 for number in range(12)]
    assert {e.status for e in said} <= {Status.INITIALISING, Status.AMBIGUOUS}
    assert (said[-1].map_from_body is not None) is has_fix


def test_few_matches_at_changing_places_are_chance() -> None:
    robot = Robot().load()
    robot.inliers, robot.landmark_recall = 20, 0.1
    assert all(robot.go(0.0, [off(2.0 * (number % 5))], turn_rad=0.0).fix is None for number in range(12))


def counted(robot: Robot, steps: int) -> list[int]:
    """How many of a search's steps are taken, the last of the list growing with each."""
    taken = [0]

    def anywhere(seen: list[Fix], *_: object) -> Generator[None, None, list[Fix]]:
        for _ in range(steps):
            taken[-1] += 1
            yield
        return seen

    robot.relocalizer.anywhere = anywhere  # type: ignore[method-assign]
    return taken


def test_a_search_takes_more_of_a_frame_where_the_robot_stands_or_knows_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seen: driving where nothing agreed, 12.6 ms a frame and 22.7 in one of a hundred; 10 and 20 are promised. So a driving robot
    takes more only in its first ten searches, of ten frames each, and one with a prior, which has a pose, never."""
    monkeypatch.setattr(scripted_robot, "FRAME_NS", 66_666_667)
    for step_m, is_told, first, later in ((0.0, False, 3, 3), (0.1, False, 3, 1), (0.1, True, 1, 1)):
        robot = Robot().load()
        taken = counted(robot, 30)
        if is_told:
            robot.told(0.5)
        for _ in range(160):
            robot.go(step_m, NO_FIX, turn_rad=0.0)
            taken.append(0)
        assert taken[0] == 30, "the first search waits for nothing"
        assert max(taken[1:20]) == first
        assert max(taken[120:]) == later


TWIN = off(0.0, 5.0)


@pytest.fixture
def sure_robot() -> Robot:
    """One that may take it that its own aisle is in the map."""
    return Robot(is_whole_site_mapped=True).load()


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
        robot._fix = self.fix  # type: ignore[method-assign]

    def fix(self, offset: Array) -> Fix:
        aisle = int(np.any(offset != 0.0))
        found = self.rng.random(24) < (0.4 if aisle == self.seen else 0.03)
        expected = CovisibleLandmarks(np.arange(24, dtype=np.uint32), self.points_map[aisle], self.looks[aisle], found)
        return replace(self._fix(offset), covisible=expected)


@pytest.mark.parametrize("own", [0, 1])
def test_a_twin_is_told_by_its_signs(sure_robot: Robot, own: int) -> None:
    """Although as many landmarks agree in the other aisle; and whichever is thought of first."""
    Signs(sure_robot, own)
    said = sure_robot.ride(20, 0.4, [off(0.0), TWIN])
    assert said[0].status is Status.AMBIGUOUS
    known = next(e for e in said if e.status is Status.TRACKING)
    assert all(e.status in (Status.AMBIGUOUS, Status.INITIALISING) for e in said[: said.index(known)])
    truth = sure_robot.map_from_body[:3, 3] + own * TWIN
    assert np.linalg.norm(said[-1].map_from_body[:3, 3] - truth) < 0.05


@pytest.mark.parametrize(
    ("is_whole", "seen", "step_m", "turn_rad"),
    [
        (True, None, 0.4, 0.02),  # the robot's own aisle is a third one, which is not in the map
        (True, 0, 0.0, 0.0),  # a robot that stands: the same look again and again is no more evidence
        (False, 0, 0.4, 0.02),  # its own aisle may not be in the map
    ],
)
def test_signs_that_leave_it_open(is_whole: bool, seen: int | None, step_m: float, turn_rad: float) -> None:
    robot = Robot(is_whole_site_mapped=is_whole).load()
    Signs(robot, seen)
    said = [robot.go(step_m, [off(0.0), TWIN], turn_rad) for _ in range(30)]
    assert {e.status for e in said} == {Status.AMBIGUOUS}


@pytest.mark.parametrize("is_whole", [False, True])
def test_a_person_who_names_the_twin_is_not_believed_at_once(is_whole: bool) -> None:
    robot = Robot(is_whole_site_mapped=is_whole).load()
    Signs(robot, 0)
    robot.told(0.4, TWIN, is_whole=True, is_revisable=True)
    said = robot.ride(30, 0.4, [TWIN, off(0.0)])
    assert said[0].status is Status.AMBIGUOUS
    known = [e for e in said if e.status is Status.TRACKING and e.map_from_body is not None]
    assert all(np.linalg.norm(e.map_from_body[:2, 3] - robot.map_from_body[:2, 3]) < 20.0 for e in known)
    assert bool(known) is is_whole, "by the signs, where they may tell"
    if known:
        assert np.linalg.norm(said[-1].map_from_body[:3, 3] - robot.map_from_body[:3, 3]) < 0.05


def test_a_persons_right_word_needs_fewer_signs() -> None:
    """Than none, for the same robot in the same aisle."""
    frames = []
    for is_told in (False, True):
        robot = Robot(is_whole_site_mapped=True).load()
        Signs(robot, 0)
        if is_told:
            robot.told(0.4, is_whole=True, is_revisable=True)
        said = robot.ride(30, 0.4, [off(0.0), TWIN])
        frames.append(next(n for n, e in enumerate(said) if e.status is Status.TRACKING))
    assert frames[1] < frames[0]


@pytest.mark.parametrize(("is_revisable", "places"), [(True, [off(0.0)]), (False, [off(0.0), TWIN])])
def test_who_is_believed_at_once(sure_robot: Robot, is_revisable: bool, places: list[Array]) -> None:
    """A person where no other place looks like the one that was named, a dock beside its twin, too."""
    sure_robot.told(0.4, is_whole=True, is_revisable=is_revisable)
    assert sure_robot.ride(3, 0.4, places)[0].status is Status.TRACKING


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_robot_that_can_tell_places_apart_looks_more_often(monkeypatch: pytest.MonkeyPatch, is_whole: bool) -> None:
    """Seen: one of ten robots that woke among identical aisles knew its aisle only after 20 s of driving.
    Elsewhere more views decide nothing, and cost the time of a frame."""
    monkeypatch.setattr(scripted_robot, "FRAME_NS", 66_666_667)
    robot = Robot(is_whole_site_mapped=is_whole).load()
    taken = counted(robot, 12)
    for _ in range(160):
        assert robot.go(0.1, [off(0.0), TWIN]).status in (Status.AMBIGUOUS, Status.INITIALISING)
        taken.append(0)
    assert max(taken[120:]) == (2 if is_whole else 1)
