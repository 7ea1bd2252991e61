"""A robot, frame by frame: versions on trial, and what a person says of its place."""

import gc
import resource
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.free_memory import give_back_free_memory
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.messages import Status
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate
from locclient.robot.robot import Robot
from locclient.robot.version_trial import Change
from mapserver.store import MapStore
from support.worlds import robot_world

LAPS, LAP_FRAMES = 20, 70


def off_m(estimate: Estimate, number: int) -> float:
    return float(np.linalg.norm(estimate.map_from_body[:3, 3] - robot_world.truth(number)[:3, 3]))


def drive(robot: Robot, bundles: list[SensorBundle], first: int = 0) -> list[float]:
    """Errors in metres of the tracked frames; all others are infinite."""
    estimates = [outcome.estimate for outcome in map(robot.handle, bundles)]
    return [off_m(e, n) if e.status is Status.TRACKING else np.inf for n, e in enumerate(estimates, first)]


def test_the_first_version_is_taken_and_the_robot_finds_itself(store: MapStore) -> None:
    robot, bundles = robot_world.new_robot(), list(robot_world.bundles(70))
    assert robot.handle(bundles[0]).estimate.map_version is None
    robot.use(robot_world.loaded(store))
    errors = drive(robot, bundles[1:], 1)
    assert [change.change for change in robot.versions.changes] == [Change.ADOPTED]
    assert max(errors[45:]) < 0.05


def test_a_robot_knows_where_its_map_lies_in_the_building(store: MapStore) -> None:
    robot, loaded = robot_world.new_robot(), robot_world.loaded(store)
    frame = {"x_m": 3.0, "y_m": -4.0, "yaw_rad": 0.5}
    aligned = msgspec.structs.replace(loaded.manifest, configuration={"building": frame})
    found = []

    def look() -> None:
        found.append(robot.handle(next(robot_world.bundles(1))).published.building_from_map)

    for one in (loaded, replace(loaded, manifest=aligned), loaded):
        robot.use(one)
        look()
    assert found[0] is found[2] is None
    robot.use(replace(loaded, manifest=aligned))
    for frame_of_site in (BuildingFrame(x_m=9.0, y_m=8.0, yaw_rad=0.0), None):  # aligned anew, and that forgotten
        robot.use_building({}, [], frame_of_site)
        look()
    assert found[3][:2, 3].tolist() == [9.0, 8.0]
    np.testing.assert_array_equal(found[4], found[1])
    np.testing.assert_allclose(found[1], se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, -4.0, 0.0])))


def test_a_version_that_slipped_is_refused_and_the_place_kept(store: MapStore) -> None:
    """Status: never wrong; after the trial TRACKING in the old version. Flag: refused, with both versions named."""
    robot, bundles = robot_world.new_robot(store), list(robot_world.bundles(130))
    drive(robot, bundles[:70])
    slipped = robot_world.moved(np.array([2.0, 0.0, 0.0]))
    robot_world.save(store)
    robot.use(robot_world.loaded(store, of=slipped))
    errors = drive(robot, bundles[70:], 70)
    _, *changes = robot.versions.changes
    assert [(change.change, change.wanted.version) for change in changes] == [(Change.REFUSED, 2)]
    assert "of version 2 0 fixes and 2 that contradict it" in changes[0].reason
    assert "version 1 gives fixes" in changes[0].reason
    assert robot.running.version == 1
    assert max(errors) < 0.1


def test_darkness_is_no_verdict_about_a_version(store: MapStore) -> None:
    robot, bundles = robot_world.new_robot(store), list(robot_world.bundles(120, dark=range(71, 120)))
    drive(robot, bundles[:70])
    robot_world.save(store)
    robot.use(robot_world.loaded(store))
    drive(robot, bundles[70:])
    assert [change.change for change in robot.versions.changes] == [Change.ADOPTED, Change.POSTPONED]
    assert [held.version for held in robot.versions.held] == [1]


def test_laps_cost_no_memory(store: MapStore) -> None:
    """What a robot keeps is full after ten laps: ten more leave less than a page of memory a frame."""

    def resident_bytes() -> int:
        gc.collect()
        give_back_free_memory()
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    robot, resident = robot_world.new_robot(store), []
    for number, bundle in enumerate(robot_world.bundles(LAPS * LAP_FRAMES)):
        robot.handle(bundle)
        robot.versions.changes.clear()
        if number % LAP_FRAMES == LAP_FRAMES - 1:
            resident.append(resident_bytes())
    assert resident[-1] - resident[LAPS // 2 - 1] < LAPS // 2 * LAP_FRAMES * resource.getpagesize()


FRAMES, GIVEN = 150, 60


def prior(map_from_base: Array, sigma_m: float, *, is_revisable: bool = True) -> PositionPrior:
    covariance = np.diag([0.05**2, 0.05**2, 0.26**2, sigma_m**2, sigma_m**2, 0.25**2])
    return PositionPrior(0, map_from_base, covariance, is_revisable)


def ride(store: MapStore, off_m: float, *, is_revisable: bool = True) -> list[Estimate]:
    """The robot's ride; at frame GIVEN it is told a place off_m beside its own, with a sigma of half a metre."""
    robot, bundles = robot_world.new_robot(store), list(robot_world.bundles(FRAMES))
    told = robot_world.truth(GIVEN) @ se3_inverse(robot.base_from_body)
    told[0, 3] += off_m
    bundles[GIVEN] = replace(bundles[GIVEN], priors=[prior(told, 0.5, is_revisable=is_revisable)])
    estimates = [outcome.estimate for outcome in map(robot.handle, bundles)]
    assert estimates[GIVEN - 1].status is Status.TRACKING
    return estimates


@pytest.mark.parametrize(("off_m", "is_revisable"), [(0.3, True), (6.0, False)])
def test_a_pose_that_agrees_or_is_not_from_a_person_unseats_none(
    store: MapStore, off_m: float, is_revisable: bool
) -> None:
    estimates = ride(store, off_m, is_revisable=is_revisable)
    assert {one.status for one in estimates[GIVEN:]} == {Status.TRACKING}


def test_a_wrong_pose_is_believed_until_fixes_outweigh_it(store: MapStore) -> None:
    estimates = ride(store, 6.0)
    told = estimates[GIVEN]
    assert told.status is Status.DEGRADED
    assert off_m(told, GIVEN) == pytest.approx(6.0, abs=0.1)
    assert (estimates[-1].status, off_m(estimates[-1], FRAMES - 1) < 0.1) == (Status.TRACKING, True)
    back = next(n for n in range(GIVEN, FRAMES) if estimates[n].status is Status.TRACKING)
    agreed = sum(one.fix is not None or "outside the given" in one.refused for one in estimates[GIVEN:back])
    assert agreed > robot_world.SETTINGS.track.confirming_fixes, "one search does not move it"
    passed = np.array([robot_world.truth(number)[:3, 3] for number in range(GIVEN, back + 1)])
    travelled_m = np.linalg.norm(np.diff(passed, axis=0), axis=1).sum()
    # By its odometry, whose noise adds some.
    assert travelled_m > 0.9 * robot_world.SETTINGS.track.confirming_distance_m
    assert all(one.status is not Status.TRACKING or off_m(one, n) < 0.3 for n, one in enumerate(estimates))


@pytest.mark.parametrize(
    ("beside_m", "sigma_m", "is_covered"), [(16.5, 0.5, True), (18.5, 0.5, False), (18.5, 5.0, True)]
)
def test_who_may_be_within_a_tile_of_the_map_may_see_it(
    store: MapStore, beside_m: float, sigma_m: float, is_covered: bool
) -> None:
    robot, loaded = robot_world.new_robot(), robot_world.loaded(store)
    robot.use(loaded)
    last = max(loaded.manifest.tiles, key=lambda tile: tile.x)
    x_m, y_m = (last.x + 1) * robot_world.TILE_M + beside_m, (last.y + 0.5) * robot_world.TILE_M
    told = prior(se3(np.eye(3), np.array([x_m, y_m, 0.0])), sigma_m)
    outcome = robot.handle(replace(next(iter(robot_world.bundles(1))), priors=[told]))
    assert outcome.may_be_mapped == is_covered


@pytest.mark.parametrize("forget", [False, True])
def test_a_robot_that_forgets_claims_nothing_until_it_finds_itself(store: MapStore, forget: bool) -> None:
    """In the dark, where nothing can be found: what it claims there is what it remembers."""
    bundles = list(robot_world.bundles(FRAMES, dark=range(GIVEN, GIVEN + 5)))
    bundles[GIVEN] = replace(bundles[GIVEN], forget=forget)
    estimates = [outcome.estimate for outcome in map(robot_world.new_robot(store).handle, bundles)]
    assert all((one.map_from_body is None) == forget for one in estimates[GIVEN : GIVEN + 5])
    assert (estimates[GIVEN].status is Status.INITIALISING) == forget
    assert (estimates[-1].status, off_m(estimates[-1], FRAMES - 1) < 0.1) == (Status.TRACKING, True)
