"""Twins that are told apart by what stands in one of them alone: scripted odometry, fixes and landmarks."""

from collections.abc import Generator
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array
from fleetmap.messages import Status
from fleetmap.relocalization.map_view import CovisibleLandmarks
from fleetmap.relocalization.relocalizer import Fix
from support.fleet import scripted_robot
from support.fleet.scripted_robot import MAP_FROM_ODOM, Robot, off

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
        expected = CovisibleLandmarks(np.arange(24, dtype=np.uint32), self.points_map[aisle], self.looks[aisle], found)
        return replace(self._fix(offset), covisible=expected)


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


@pytest.mark.parametrize(
    ("is_whole", "seen", "step_m", "turn_rad"),
    [
        (True, None, 0.4, 0.02),  # the robot's own aisle is a third one, which is not in the map
        (True, 0, 0.0, 0.0),  # a robot that stands: the same look again and again is no more evidence
        (False, 0, 0.4, 0.02),  # its own aisle may not be in the map
    ],
)
def test_signs_that_leave_it_open(
    monkeypatch: pytest.MonkeyPatch, is_whole: bool, seen: int | None, step_m: float, turn_rad: float
) -> None:
    robot = Robot(monkeypatch, is_whole_site_mapped=is_whole).load()
    monkeypatch.setattr(robot, "_fix", Signs(robot, seen).fix)
    said = [robot.go(step_m, [off(0.0), TWIN], turn_rad) for _ in range(30)]
    assert {e.status for e in said} == {Status.AMBIGUOUS}


@pytest.mark.parametrize("is_whole", [False, True])
def test_a_person_who_names_the_twin_is_not_believed_at_once(monkeypatch: pytest.MonkeyPatch, is_whole: bool) -> None:
    robot = Robot(monkeypatch, is_whole_site_mapped=is_whole).load()
    monkeypatch.setattr(robot, "_fix", Signs(robot, 0).fix)
    robot.told(0.4, TWIN, is_whole=True, is_revisable=True)
    said = robot.ride(30, 0.4, [TWIN, off(0.0)])
    assert said[0].status is Status.AMBIGUOUS
    known = [e for e in said if e.status is Status.TRACKING and e.map_from_body is not None]
    assert all(np.linalg.norm(e.map_from_body[:2, 3] - robot.map_from_body[:2, 3]) < 20.0 for e in known)
    assert bool(known) is is_whole, "by the signs, where they may tell"
    if known:
        assert said[-1].map_from_body is not None
        assert np.linalg.norm(said[-1].map_from_body[:3, 3] - robot.map_from_body[:3, 3]) < 0.05


def test_a_persons_right_word_needs_fewer_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Than none, for the same robot in the same aisle."""
    frames = []
    for is_told in (False, True):
        robot = Robot(monkeypatch, is_whole_site_mapped=True).load()
        monkeypatch.setattr(robot, "_fix", Signs(robot, 0).fix)
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
    robot, taken = Robot(monkeypatch, is_whole_site_mapped=is_whole).load(), [0]

    def anywhere(seen: list[Fix], *_: object) -> Generator[None, None, list[Fix]]:
        for _ in range(12):
            taken[-1] += 1
            yield
        return seen

    monkeypatch.setattr(robot.relocalizer, "anywhere", anywhere)
    for _ in range(160):
        assert robot.go(0.1, [off(0.0), TWIN]).status in (Status.AMBIGUOUS, Status.INITIALISING)
        taken.append(0)
    assert max(taken[120:]) == (2 if is_whole else 1)
