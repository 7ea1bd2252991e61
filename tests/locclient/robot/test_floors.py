"""A robot in a building of several floors: it wakes up on any of them, and names those between which it cannot tell."""

from collections.abc import Iterator
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


def robot_of(store: MapStore, site: str = "low", *, missing: bool = False) -> Robot:
    source = LocalMapSource(store.folder, site)
    floors, robot = BuildingMaps(source, lambda other: LocalMapSource(store.folder, other)), robot_world.new_robot()
    floors.refresh()
    change = floors.changes.popleft()
    tiles, _ = source.tiles(source.manifest(source.newest()))
    robot.use(replace(robot_world.loaded(store, site=site), tiles=tiles))
    robot.use_building(change.building, [] if missing else change.maps)
    return robot


def drive(robot: Robot, frames: int = 50) -> list[Estimate]:
    outcomes = (robot.handle(bundle) for bundle in robot_world.bundles(frames))
    return [outcome.estimate for outcome in outcomes if outcome is not None]


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    return tmp_path / "store"


@pytest.mark.parametrize("own", SITES)
def test_it_wakes_up_on_any_floor(folder: Path, own: str) -> None:
    with house(folder, strange(robot_world.tiles()), robot_world.tiles(), x_m=3.0) as store:
        robot = robot_of(store, own)
        estimates = drive(robot)
        manifest = robot.running.manifest if robot.running else None
    assert estimates[-1].status is Status.TRACKING
    assert {e.floor for e in estimates if e.status is Status.TRACKING} == {"" if own == "high" else "high"}
    assert np.linalg.norm((estimates[-1].map_from_body - robot_world.truth(49))[:3, 3]) < 0.05, "in that floor's map"
    assert manifest.site == "high"
    assert robot._building_from_map()[:3, 3].tolist() == [3.0, 0.0, 4.0]  # type: ignore[index]


def test_floors_that_are_the_same_are_both_named(folder: Path) -> None:
    with house(folder, robot_world.tiles(), robot_world.tiles(), x_m=3.0) as store:
        estimates = drive(robot_of(store), frames=22)
    assert not [e for e in estimates if e.map_from_body is not None]
    assert estimates[-1].status is Status.AMBIGUOUS
    assert {h.floor for h in estimates[-1].hypotheses} == {"", "high"}


def test_a_floor_whose_map_is_missing_is_where_it_may_be(folder: Path) -> None:
    """Its map may look the same; a robot does not take its own floor for it."""
    with house(folder, robot_world.tiles(), strange(robot_world.tiles())) as store:
        robot = robot_of(store, missing=True)
        assert not [e for e in drive(robot, frames=30) if e.status is Status.TRACKING]
        assert drive(robot_of(store))[-1].status is Status.TRACKING


def test_a_site_without_a_building_is_as_before(folder: Path) -> None:
    with MapStore.open(folder, create=True) as store:
        robot_world.save(store, site="low")
        source = LocalMapSource(folder, "low")
        floors = BuildingMaps(source, lambda other: LocalMapSource(folder, other))
        floors.refresh()
        assert not floors.changes


def test_changes_of_floors_reach_the_robot_once(folder: Path) -> None:
    lift = geojson({"name": "a", "box": (1.0, 1.0, 3.0, 3.0), "lift": "A"})
    with house(folder, robot_world.tiles(), robot_world.tiles()) as store:
        floors = BuildingMaps(LocalMapSource(folder, "low"), lambda other: LocalMapSource(folder, other))
        floors.refresh()
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


def test_a_robot_that_visits_a_floor_reports_no_pose_on_its_own(folder: Path) -> None:
    with house(folder, strange(robot_world.tiles()), robot_world.tiles()) as store:
        robot = robot_of(store)
        outcomes = [robot.handle(bundle) for bundle in robot_world.bundles(50)]
    last = outcomes[-1]
    assert last.published.level == "L1"
    np.testing.assert_allclose(
        last.published.map_from_base, last.estimate.map_from_body @ se3_inverse(robot.base_from_body), atol=1e-9
    )
    assert last.pose_message() is None
