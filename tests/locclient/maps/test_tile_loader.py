"""Tiles around the robot are in memory, the others on the disk; bad ones are left out with their reasons, and so are damaged stores."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.errors import FleetmapError, StoreError
from fleetmap.mapformat.names import blob_path
from fleetmap.messages import Status, WantedVersion
from locclient.maps.loaded_map import PositionBound, PositionBoundTracker, TileSelectionSettings
from locclient.maps.map_source import LocalMapSource
from locclient.maps.tile_loader import TileLoader
from mapserver import releases
from mapserver.store import DraftContent, MapStore
from support.fleet.estimates import estimate
from support.storage.map_samples import draft_details, random_tile
from support.worlds.robot_world import vocabulary

SETTINGS = TileSelectionSettings(reach_m=20.0, ahead_s=8.0, spare_m=10.0)


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, MapStore]]:
    """A site of ten tiles in a row along x."""
    folder = tmp_path_factory.mktemp("row") / "store"
    rng = np.random.default_rng(0)
    with MapStore.open(folder, create=True) as store:
        tiles = [random_tile(rng, cell=(x, 0)) for x in range(10)]
        store.save(
            "row", DraftContent(tiles=tiles, vocabulary=vocabulary(), details=draft_details(path_m=160.0), archive=b"a")
        )
        releases.publish(store, "row")
        yield folder, store


def at(x_m: float) -> np.ndarray:
    return np.array([x_m, 8.0, 1.0])


@pytest.mark.parametrize(("report", "step_m"), [({}, 2.5), ({"alias_step_m": None}, 2.5), ({"alias_step_m": 5.0}, 5.0)])
def test_a_manifest_says_how_near_look_alikes_are(
    row: tuple[Path, MapStore], report: dict[str, float | None], step_m: float
) -> None:
    """Those of older servers do not say it."""
    link = LocalMapSource(row[0], "row")
    loaded = TileLoader(link, SETTINGS).load(link.wanted(), PositionBound())
    assert loaded is not None
    assert replace(loaded, manifest=msgspec.structs.replace(loaded.manifest, report=report)).alias_step_m == step_m


def test_memory_follows_the_robot(row: tuple[Path, MapStore]) -> None:
    link = LocalMapSource(row[0], "row")
    loader, wanted = TileLoader(link, SETTINGS), link.wanted()
    everywhere = loader.load(wanted, PositionBound())
    assert everywhere is not None
    assert sorted(everywhere.tiles) == [(x, 0) for x in range(10)]
    near = loader.load(wanted, PositionBound(at(8.0)))
    assert near is not None
    assert sorted(near.tiles) == [(0, 0), (1, 0), (2, 0)]  # those held within reach and a spare stay
    assert loader.load(wanted, PositionBound(at(8.5))) is None, "nothing changed"
    ahead = loader.load(wanted, PositionBound(at(30.0), np.array([4.0, 0, 0])))
    assert ahead is not None
    assert sorted(ahead.tiles) == [(x, 0) for x in range(6)]
    loader.keep_only([])
    assert loader.load(wanted, PositionBound(at(8.0))) is not None, "forgotten and read again"


def test_a_lost_robot_holds_the_tiles_that_it_can_have_come_to(row: tuple[Path, MapStore]) -> None:
    """Not those where it says that it is: it would drive out of the map, and never find another bound."""
    tracker, loader = PositionBoundTracker(SETTINGS), TileLoader(LocalMapSource(row[0], "row"), SETTINGS)
    wanted = LocalMapSource(row[0], "row").wanted()
    assert tracker.handle(estimate(0.0, Status.AMBIGUOUS, known=False)).position_map_m is None, "anywhere"
    assert tracker.handle(estimate(1.0, x_m=40.0)).radius_m == 0
    held = []
    for seconds in (1, 10, 40):
        bound = tracker.handle(estimate(1.0 + seconds, Status.LOST, x_m=40.0 + 900.0 * seconds))
        np.testing.assert_array_equal(bound.position_map_m, [40.0, 0.0, 0.0])
        assert SETTINGS.most_mps * seconds <= bound.radius_m <= SETTINGS.most_mps * seconds + 10
        loaded = loader.load(wanted, bound)
        assert loaded is not None
        held.append(sorted(x for x, _ in loaded.tiles))
    assert held == [list(range(5)), list(range(6)), list(range(10))]
    found = tracker.handle(estimate(42.0, Status.DEGRADED, x_m=140.0))
    assert (float(found.position_map_m[0]), found.radius_m) == (140.0, 0.0)  # type: ignore[index]


def test_a_place_on_another_floor_bounds_no_tiles_of_its_own_site() -> None:
    """Coordinates there mean nothing here; without all tiles its own floor would not compete with an equal one."""
    tracker = PositionBoundTracker(SETTINGS)
    tracker.handle(estimate(0.0, x_m=40.0))
    assert tracker.handle(replace(estimate(1.0, x_m=140.0), floor="hall-2")).position_map_m is None
    assert tracker.handle(estimate(2.0, Status.LOST, known=False)).position_map_m is None


def test_bad_tiles_are_left_out(row: tuple[Path, MapStore]) -> None:
    folder, store = row
    manifest = store.manifest("row", 1)
    victim = folder / blob_path(manifest.tiles[4].sha256)
    good = victim.read_bytes()
    link = LocalMapSource(folder, "row")
    loader, wanted = TileLoader(link, SETTINGS), link.wanted()
    victim.chmod(0o644)
    victim.write_bytes(good[:-7])
    try:
        loaded = loader.load(wanted, PositionBound())
        assert loaded is not None
        assert len(loaded.tiles) == 9
        assert list(loader.refused(wanted)) == [(4, 0)]
        assert loader.load(wanted, PositionBound()) is None, "not read again and again"
    finally:
        victim.write_bytes(good)
    loader.retry_refused(wanted)
    mended = loader.load(wanted, PositionBound())
    assert mended is not None
    assert len(mended.tiles) == 10
    foreign = WantedVersion(site="else", version=1, manifest_sha256=wanted.manifest_sha256)
    with pytest.raises(FleetmapError, match="manifest is of row version 1"):
        TileLoader(LocalMapSource(folder, "else"), SETTINGS).load(foreign, PositionBound())


def test_a_folder_without_sites_is_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="not a map store"):
        LocalMapSource(tmp_path, "lab")


def test_a_damaged_current_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "sites" / "lab").mkdir(parents=True)
    source = LocalMapSource(tmp_path, "lab")
    assert source.wanted().manifest_sha256 is None
    (tmp_path / "sites" / "lab" / "current").write_bytes(b"\xff\xfe nonsense")
    with pytest.raises(StoreError, match="repair"):
        source.wanted()
    with pytest.raises(StoreError, match="incomplete"):
        source.blob("0" * 64)
