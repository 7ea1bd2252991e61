"""Versions on trial while a robot drives: it keeps its place whatever a new version turns out to be."""

import gc
import resource
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from fleetmap.free_memory import give_back_free_memory
from fleetmap.geometry import se3, so3_exp
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.messages import Status
from locclient.robot.robot import Robot
from locclient.robot.version_trial import Change
from mapserver.store import MapStore
from support.worlds import robot_world

LAPS, LAP_FRAMES = 20, 70


def drive(robot: Robot, numbers: range, bundles: list) -> list[float]:  # type: ignore[type-arg]
    """Errors in metres of the tracked frames; all others are infinite."""
    errors = []
    for number in numbers:
        estimate = robot.handle(bundles[number]).estimate
        off = np.inf
        if estimate.status is Status.TRACKING:
            off = float(np.linalg.norm(estimate.map_from_body[:3, 3] - robot_world.truth(number)[:3, 3]))
        errors.append(off)
    return errors


def test_the_first_version_is_taken_and_the_robot_finds_itself(store: MapStore) -> None:
    robot, bundles = robot_world.new_robot(), list(robot_world.bundles(70))
    assert robot.handle(bundles[0]).estimate.map_version is None
    robot.use(robot_world.loaded(store))
    errors = drive(robot, range(1, 70), bundles)
    assert [change.change for change in robot.take_changes()] == [Change.ADOPTED]
    assert max(errors[45:]) < 0.05
    assert robot.take_changes() == []


def test_a_robot_knows_where_its_map_lies_in_the_building(store: MapStore) -> None:
    robot, loaded = robot_world.new_robot(), robot_world.loaded(store)
    frame = {"x_m": 3.0, "y_m": -4.0, "yaw_rad": 0.5}
    aligned = msgspec.structs.replace(loaded.manifest, configuration={"building": frame})
    found = []
    for one in (loaded, replace(loaded, manifest=aligned), loaded):
        robot.use(one)
        outcome = robot.handle(next(iter(robot_world.bundles(1))))
        assert outcome is not None
        found.append(outcome.published.building_from_map)
    assert found[0] is found[2] is None
    robot.use(replace(loaded, manifest=aligned))
    for frame_of_site in (BuildingFrame(x_m=9.0, y_m=8.0, yaw_rad=0.0), None):  # aligned anew, and that forgotten
        robot.align(frame_of_site)
        outcome = robot.handle(next(iter(robot_world.bundles(1))))
        assert outcome is not None
        found.append(outcome.published.building_from_map)
    assert found[3][:2, 3].tolist() == [9.0, 8.0]
    np.testing.assert_array_equal(found[4], found[1])
    np.testing.assert_allclose(found[1], se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, -4.0, 0.0])))


def test_a_version_that_slipped_is_refused_and_the_place_kept(store: MapStore) -> None:
    """Status: never wrong; after the trial TRACKING in the old version. Flag: refused, with both versions named."""
    robot, bundles = robot_world.new_robot(), list(robot_world.bundles(130))
    robot.use(robot_world.loaded(store))
    drive(robot, range(70), bundles)
    robot.take_changes()
    slipped = robot_world.moved(np.array([2.0, 0.0, 0.0]))
    robot_world.save(store)
    robot.use(robot_world.loaded(store, of=slipped))
    errors = drive(robot, range(70, 130), bundles)
    changes = robot.take_changes()
    assert [(change.change, change.wanted.version) for change in changes] == [(Change.REFUSED, 2)]
    assert "of version 2 0 fixes and 2 that contradict it" in changes[0].reason
    assert "version 1 gives fixes" in changes[0].reason
    assert robot.running is not None
    assert robot.running.version == 1
    assert max(errors) < 0.1


def test_darkness_is_no_verdict_about_a_version(store: MapStore) -> None:
    robot = robot_world.new_robot()
    bundles = list(robot_world.bundles(120, dark=range(71, 120)))
    robot.use(robot_world.loaded(store))
    drive(robot, range(70), bundles)
    robot.take_changes()
    robot_world.save(store)
    robot.use(robot_world.loaded(store))
    drive(robot, range(70, 120), bundles)
    assert [change.change for change in robot.take_changes()] == [Change.POSTPONED]
    assert [held.version for held in robot.held] == [1]


def test_laps_cost_no_memory(store: MapStore) -> None:
    """What a robot keeps is full after ten laps: ten more leave less than a page of memory a frame."""

    def resident_bytes() -> int:
        gc.collect()
        give_back_free_memory()
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    robot, resident = robot_world.new_robot(), []
    robot.use(robot_world.loaded(store))
    for number, bundle in enumerate(robot_world.bundles(LAPS * LAP_FRAMES)):
        robot.handle(bundle)
        robot.take_changes()
        if number % LAP_FRAMES == LAP_FRAMES - 1:
            resident.append(resident_bytes())
    assert resident[-1] - resident[LAPS // 2 - 1] < LAPS // 2 * LAP_FRAMES * resource.getpagesize()
