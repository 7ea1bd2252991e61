"""A robot in a building of several floors: it wakes up on any of them, and names those between which it cannot tell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse
from fleetmap.messages import Status
from locclient.localization.estimate import Estimate
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_source import LocalMapSource
from locclient.robot.robot import Robot
from mapserver.fleet.building import keep_areas
from mapserver.store import NOBODY, MapStore
from support.drawn_areas import geojson
from support.worlds import robot_world
from support.worlds.building import SITES, house, strange


def floors_of(folder: Path, site: str = "low") -> BuildingMaps:
    floors = BuildingMaps(LocalMapSource(folder, site), lambda other: LocalMapSource(folder, other))
    floors.refresh()
    return floors


def robot_of(store: MapStore, site: str = "low", *, missing: bool = False) -> Robot:
    source = LocalMapSource(store.folder, site)
    change, robot = floors_of(store.folder, site).changes.popleft(), robot_world.new_robot()
    tiles, _ = source.tiles(source.manifest(source.newest()))
    robot.use(replace(robot_world.loaded(store, site=site), tiles=tiles))
    robot.use_building(change.building, [] if missing else change.maps)
    return robot


def drive(robot: Robot, frames: int = 50) -> list[Estimate]:
    return [outcome.estimate for outcome in map(robot.handle, robot_world.bundles(frames))]


@pytest.mark.parametrize("own", SITES)
def test_it_wakes_up_on_any_floor(tmp_path: Path, own: str) -> None:
    with house(tmp_path, strange(robot_world.tiles()), robot_world.tiles(), x_m=3.0) as store:
        robot = robot_of(store, own)
        estimates = drive(robot)
    assert estimates[-1].status is Status.TRACKING
    assert {e.floor for e in estimates if e.status is Status.TRACKING} == {"" if own == "high" else "high"}
    assert np.linalg.norm((estimates[-1].map_from_body - robot_world.truth(49))[:3, 3]) < 0.05, "in that floor's map"
    assert robot.running.manifest.site == "high"
    assert robot._building_from_map()[:3, 3].tolist() == [3.0, 0.0, 4.0]  # type: ignore[index]


def test_floors_that_are_the_same_are_both_named(tmp_path: Path) -> None:
    with house(tmp_path, robot_world.tiles(), robot_world.tiles(), x_m=3.0) as store:
        estimates = drive(robot_of(store), frames=22)
    assert not [e for e in estimates if e.map_from_body is not None]
    assert estimates[-1].status is Status.AMBIGUOUS
    assert {h.floor for h in estimates[-1].hypotheses} == {"", "high"}


def test_a_floor_whose_map_is_missing_is_where_it_may_be(tmp_path: Path) -> None:
    """Its map may look the same; a robot does not take its own floor for it."""
    with house(tmp_path, robot_world.tiles(), strange(robot_world.tiles())) as store:
        robot = robot_of(store, missing=True)
        assert not [e for e in drive(robot, frames=30) if e.status is Status.TRACKING]
        assert drive(robot_of(store))[-1].status is Status.TRACKING


def test_a_site_without_a_building_is_as_before(tmp_path: Path) -> None:
    assert not floors_of(robot_world.stored(tmp_path, site="low")).changes


def test_changes_of_floors_reach_the_robot_once(tmp_path: Path) -> None:
    lift = geojson({"name": "a", "box": (1.0, 1.0, 3.0, 3.0), "lift": "A"})
    with house(tmp_path, robot_world.tiles(), robot_world.tiles()) as store:
        floors = floors_of(tmp_path)
        floors.refresh()
        assert [len(change.maps) for change in floors.changes] == [1]
        keep_areas(store, "high", lift, "", NOBODY)
        floors.refresh()
        assert list(floors.changes[-1].building["high"].lifts) == ["A"]
        robot_world.save(store, site="high", of=strange(robot_world.tiles()))
        floors.refresh()
        assert [loaded.version for loaded in floors.changes[-1].maps] == [2]
        assert len(floors.changes) == 3
        store.keep_site_files("low", {"floors": None}, "")
        floors.refresh()
        assert floors.changes[-1].building == {}


def test_a_robot_that_visits_a_floor_reports_no_pose_on_its_own(tmp_path: Path) -> None:
    with house(tmp_path, strange(robot_world.tiles()), robot_world.tiles()) as store:
        robot = robot_of(store)
        outcomes = [robot.handle(bundle) for bundle in robot_world.bundles(50)]
    last = outcomes[-1]
    assert last.published.level == "L1"
    on_its_floor = last.estimate.map_from_body @ se3_inverse(robot.base_from_body)
    np.testing.assert_allclose(last.published.map_from_base, on_its_floor, atol=1e-9)
    assert last.pose_message() is None
