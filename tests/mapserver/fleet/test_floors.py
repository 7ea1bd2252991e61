"""Sites as the floors of a building: the command, what robots get, who may fetch what."""

from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from msgspec.structs import replace

from fleetmap.access import Access, Holder
from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, UsageError
from fleetmap.mapformat.building import (
    AREAS,
    FLOORS,
    Building,
    BuildingFrame,
    Floor,
    FloorEntry,
    read_building,
    read_lifts,
)
from mapserver.cli import app
from mapserver.fleet.building import floors_of, forget_alignment, keep_areas, keep_building
from mapserver.floor_plan.alignment import Alignment, encode_alignment
from mapserver.releases import publish
from mapserver.store import NOBODY, MapStore
from mapserver.trust.signing import admitted_versions
from support.drawn_areas import geojson
from support.fleet.dashboard_scene import serving
from support.room_site import run
from support.storage.map_samples import save_sample_draft

HERE = BuildingFrame(x_m=0.0, y_m=0.0, yaw_rad=0.0)
TOWER = Building(
    name="tower", floors=tuple(FloorEntry(site=f"hall-{n}", level=f"L{n}", height_m=4.0 * n) for n in (1, 2))
)


def areas(lift: str, frame: str = "map") -> bytes:
    return geojson({"name": "cabin", "box": (1.0, 1.0, 3.0, 3.0), "lift": lift}, frame=frame)


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A store with two aligned floors that have a lift, and a site that is not aligned."""
    with MapStore.open(tmp_path, create=True) as store:
        for number, site in enumerate(("hall-1", "hall-2", "yard")):
            save_sample_draft(store, site=site)
            publish(store, site)
            if site != "yard":
                frame = BuildingFrame(x_m=10.0 * number, y_m=0.0, yaw_rad=0.0)
                aligned = Alignment(frame=frame, metres_per_unit=1.0, method="pins", plan=None, off_m={})
                store.keep_site_files(site, {"alignment": encode_alignment(aligned)}, "")
                keep_areas(store, site, areas("A"), "", NOBODY)
        save_sample_draft(store, site="draft")
    return tmp_path


def test_one_command_makes_floors_that_robots_get_signed(house: Path) -> None:
    said = run(app, "building", "set", "tower", "--floor", "hall-2=L2@4.5", "--floor", "hall-1=L1@0", "--store", house)
    assert said.splitlines() == ["tower:", "  L2  hall-2  4.5 m  lifts: A", "  L1  hall-1  0 m  lifts: A"]
    with MapStore.open(house) as store:
        building = store.building("hall-1")
        assert [floor.level for floor in building.floors] == ["L1", "L2"]
        (first, second) = (admitted_versions(store.releases(site))[-1].about.files for site in ("hall-1", "hall-2"))
        assert first[FLOORS] == second[FLOORS]
        assert store.served_kind(first[FLOORS], "hall-1") == FLOORS
        with pytest.raises(UsageError, match="floors first"):
            forget_alignment(store, "hall-1", NOBODY)
        assert store.verify().faults == []
    assert "hall-1, hall-2" in run(app, "building", "remove", "tower", "--store", house)
    assert run(app, "building", "list", "--store", house) == "buildings: 0\n"


@pytest.mark.parametrize(
    ("floors", "words"),
    [
        (("hall-1=L1@0", "yard=L2@4"), "site yard has no pose"),
        (("hall-1=L1@0", "hall-2=L1@4"), "the same level, L1"),
        (("hall-1=L1@0", "hall-2=L2@0"), "the same height, 0.0"),
        (("hall-1=L1@0", "hall-1=L2@4"), "the same site, hall-1"),
        (("hall-1=L1@0", "nowhere=L2@4"), "no site nowhere; it has: draft, hall-1"),
        (("hall-1=L1@0", "draft=L2@4"), "publish one with `mapserver publish --site draft`"),
        (("hall-1=L1@0", "hall-2=L2\n@4"), "characters of one line"),
        (("hall-1=L1", "hall-2=L2@4"), "SITE=LEVEL@HEIGHT"),
        (("hall-1=L1@0",), "two floors or more"),
    ],
)
def test_floors_that_cannot_be(house: Path, floors: tuple[str, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        run(app, "building", "set", "tower", *(f"--floor={floor}" for floor in floors), "--store", house)


@pytest.mark.parametrize("name", ["", " ", "t" * 65, "a\nb"])
def test_a_building_has_a_name_of_one_line(house: Path, name: str) -> None:
    with pytest.raises(UsageError, match="characters of one line"):
        run(app, "building", "set", name, "--floor=hall-1=L1@0", "--floor=hall-2=L2@4", "--store", house)
    said = run(app, "building", "set", "Türme 塔", "--floor=hall-1=U1@-4", "--floor=hall-2=二階@4.5", "--store", house)
    assert said.startswith("Türme 塔:\n  二階  hall-2  4.5 m")


def test_a_site_is_a_floor_of_one_building_and_leaves_it(house: Path) -> None:
    with MapStore.open(house) as store:
        keep_building(store, TOWER, NOBODY)
        with pytest.raises(UsageError, match="is a floor of 'tower'; `mapserver building remove tower`"):
            keep_building(store, replace(TOWER, name="annex"), NOBODY)
        low, high = floors_of(store, TOWER)
        assert high.building_from_map[:3, 3].tolist() == [10.0, 0.0, 8.0]
        assert low.lifts_at(np.array([2.0, 2.0]), 0.0) == {"A"}
        assert not low.lifts_at(np.array([3.4, 2.0]), 0.3)
        assert low.lifts_at(np.array([3.4, 2.0]), 0.5) == {"A"}
        kept = store.areas("hall-1")
        keep_areas(store, "hall-1", to_json(kept.geojson("hall-1")), "", NOBODY)
        assert store.areas("hall-1").areas[0].lift == "A", "it survives a change of the areas by a page"


def test_the_page_of_maps_leads_to_the_other_floors(house: Path) -> None:
    with MapStore.open(house) as store:
        keep_building(store, TOWER, NOBODY)
    with serving(house) as served, urlopen(f"{served.http}/dashboard/map?site=hall-1") as answer:
        text = answer.read().decode()
    assert '<p id="floors">tower: <a href="/dashboard/map?site=hall-2">L2</a> · <strong>L1</strong></p>' in text


def test_lifts_drawn_in_the_building_come_back_in_the_map(house: Path) -> None:
    with MapStore.open(house) as store:
        keep_areas(store, "hall-2", areas("B", "building"), "", NOBODY)
        alignment = store.alignment("hall-2")
        ((ring,),) = read_lifts(store.site_file("hall-2", AREAS), alignment.frame)["B"]
    assert ring[0].tolist() == [-9.0, 1.0]


@pytest.mark.parametrize("data", [b"", b"[]", b'{"name":"t","floors":[]}', b'{"name":"t","floors":[{"site":"A"}]}'])
def test_files_that_are_no_building(data: bytes) -> None:
    with pytest.raises(MapFormatError):
        read_building(data)
    with pytest.raises(MapFormatError):
        read_lifts(data or b"{", HERE) and read_building(data)


def test_a_robot_may_fetch_the_maps_of_its_other_floors_and_report_nothing_there() -> None:
    config = Access([Holder("r1.aa", "hall-1", "r1", floors=("hall-2",))]).zenoh_config()["access_control"]
    there = {key for rule in config["rules"] for key in rule["key_exprs"] if key.startswith("fleetmap/hall-2/")}
    assert there == {f"fleetmap/hall-2/robots/r1/{part}/*" for part in ("manifests", "blobs", "trust")}


def test_a_floor_without_a_lift_has_none() -> None:
    assert not Floor(TOWER.floors[0], HERE).lifts_at(np.zeros(2), 100.0)


@pytest.mark.parametrize("ring", ["[]", "[[0.0,0.0]]", "[[],[],[],[]]"])
def test_a_lift_without_an_outline_is_refused(ring: str) -> None:
    """A robot that measured its distance from it would stop."""
    data = f'{{"features":[{{"geometry":{{"type":"Polygon","coordinates":[{ring}]}},"properties":{{"lift":"A"}}}}]}}'
    with pytest.raises(MapFormatError, match="outline"):
        read_lifts(data.encode(), HERE)
