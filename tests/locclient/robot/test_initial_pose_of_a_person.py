"""A pose that a person gives a robot: believed over what the robot tracked, and until fixes outweigh it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse
from fleetmap.messages import Status
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate
from locclient.robot.robot import Robot
from mapserver.store import MapStore
from support.worlds import robot_world

FRAMES, GIVEN = 150, 60


def ride(
    folder: Path, off_m: float, *, frames: int = FRAMES, is_revisable: bool = True, stands: bool = False
) -> list[Estimate]:
    """The robot's ride; at frame GIVEN it is told a place off_m beside its own, with a sigma of half a metre."""
    with MapStore.open(folder / "store", create=True) as store:
        robot_world.save(store)
        robot: Robot = robot_world.new_robot()
        robot.use(robot_world.loaded(store))
    told = robot_world.truth(GIVEN) @ se3_inverse(robot.base_from_body)
    told[0, 3] += off_m
    covariance = np.diag([0.05**2, 0.05**2, 0.26**2, 0.5**2, 0.5**2, 0.25**2])
    bundles = robot_world.carried(frames, GIVEN) if stands else robot_world.bundles(frames)
    estimates = []
    for number, bundle in enumerate(bundles):
        priors = [PositionPrior(0, told, covariance, is_revisable)] if number == GIVEN else []
        outcome = robot.handle(replace(bundle, priors=priors))
        assert outcome is not None
        estimates.append(outcome.estimate)
    assert estimates[GIVEN - 1].status is Status.TRACKING
    return estimates


def off_m(estimate: Estimate, number: int) -> float:
    assert estimate.map_from_body is not None
    return float(np.linalg.norm(estimate.map_from_body[:2, 3] - robot_world.truth(number)[:2, 3]))


def test_a_pose_that_agrees_changes_nothing(tmp_path: Path) -> None:
    estimates = ride(tmp_path, 0.3)
    assert {one.status for one in estimates[GIVEN:]} == {Status.TRACKING}


def test_a_wrong_pose_is_believed_until_fixes_outweigh_it(tmp_path: Path) -> None:
    estimates = ride(tmp_path, 6.0)
    told = estimates[GIVEN]
    assert told.status is Status.DEGRADED
    assert off_m(told, GIVEN) == pytest.approx(6.0, abs=0.1)
    assert (estimates[-1].status, off_m(estimates[-1], FRAMES - 1) < 0.1) == (Status.TRACKING, True)
    back = next(n for n in range(GIVEN, FRAMES) if estimates[n].status is Status.TRACKING)
    agreed = sum(one.fix is not None or "outside the given" in one.refused for one in estimates[GIVEN:back])
    assert agreed > robot_world.SETTINGS.track.confirming_fixes, "one search does not move it"
    passed = np.array([robot_world.truth(number)[:3, 3] for number in range(GIVEN, back + 1)])
    travelled_m = np.linalg.norm(np.diff(passed, axis=0), axis=1).sum()
    assert travelled_m > 0.9 * robot_world.SETTINGS.track.confirming_distance_m, (
        "by its odometry, whose noise adds some"
    )
    assert all(one.status is not Status.TRACKING or off_m(one, n) < 0.3 for n, one in enumerate(estimates))


def test_a_docks_place_is_not_doubted(tmp_path: Path) -> None:
    """The control: what is not from a person neither unseats a tracked pose, as before."""
    estimates = ride(tmp_path, 6.0, is_revisable=False)
    assert {one.status for one in estimates[GIVEN:]} == {Status.TRACKING}


@pytest.mark.parametrize("forget", [False, True])
def test_a_robot_that_forgets_claims_nothing_until_it_finds_itself(tmp_path: Path, forget: bool) -> None:
    """In the dark, where nothing can be found: what it claims there is what it remembers."""
    with MapStore.open(tmp_path / "store", create=True) as store:
        robot_world.save(store)
        robot = robot_world.new_robot()
        robot.use(robot_world.loaded(store))
    estimates = []
    for number, bundle in enumerate(robot_world.bundles(FRAMES, dark=range(GIVEN, GIVEN + 5))):
        outcome = robot.handle(replace(bundle, forget=forget and number == GIVEN))
        assert outcome is not None
        estimates.append(outcome.estimate)
    assert all((one.map_from_body is None) == forget for one in estimates[GIVEN : GIVEN + 5])
    assert (estimates[GIVEN].status is Status.INITIALISING) == forget
    assert (estimates[-1].status, off_m(estimates[-1], FRAMES - 1) < 0.1) == (Status.TRACKING, True)
