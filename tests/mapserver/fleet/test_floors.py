"""Sites as the floors of a building: the command, what robots get, who may fetch what."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from msgspec.structs import replace

from fleetmap.access import Access, Holder
from fleetmap.bus.zenoh_bus import Bus
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
from fleetmap.messages import RobotHealth, encode_message, robot_key
from mapserver.cli import app
from mapserver.fleet.building import floors_of, forget_alignment, keep_areas, keep_building
from mapserver.floor_plan.alignment import encode_alignment
from mapserver.releases import publish
from mapserver.store import NOBODY, MapStore
from mapserver.trust.signing import admitted_versions
from support.drawn_areas import geojson
from support.fleet.dashboard_scene import serving
from support.recordings.realdata import real_data
from support.room_site import run
from support.storage.map_samples import align, save_sample_draft
from support.waiting import eventually

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
                align(store, site, 10.0 * number)
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
        keep_areas(store, "hall-1", to_json(store.areas("hall-1").geojson("hall-1")), "", NOBODY)
        assert store.areas("hall-1").areas[0].lift == "A", "it survives a change of the areas by a page"


def test_pages_lead_to_the_other_floors_and_list_robots_where_they_are(house: Path) -> None:
    with MapStore.open(house) as store:
        keep_building(store, TOWER, NOBODY)
    with serving(house) as served, Bus(served.zenoh).open() as bus:

        def shown(path: str) -> str:
            return httpx.get(f"{served.http}/dashboard/{path}", timeout=60).text

        links = '<p id="floors">tower: <a href="/dashboard/map?site=hall-2">L2</a> · <strong>L1</strong></p>'
        assert links in shown("map?site=hall-1")
        health = RobotHealth(
            site="hall-1", robot="r1", stamp_ns=1, version=1, status="TRACKING", metrics={"floor": "hall-2"}
        )
        bus.publish(robot_key("hall-1", "r1", "health"), encode_message(health))
        assert eventually(lambda: 'href="/dashboard/robots/r1?site=hall-1">r1 of hall-1</a>' in shown("?site=hall-2"))
        assert ">L2 (1)</a>" in shown("?site=hall-2")
        assert ">on the floor L2</span>" in shown("?site=hall-1")
        lost = replace(health, site="yard", status="LOST", metrics={})
        bus.publish(robot_key("yard", "r1", "health"), encode_message(lost))
        assert eventually(lambda: "Overview of yard</h1>" in shown(""), 20.0), "where somebody is needed"
        assert "Robots of yard that are not localised: 1." in shown("?site=hall-2")


def test_lifts_drawn_in_the_building_come_back_in_the_map(house: Path) -> None:
    with MapStore.open(house) as store:
        keep_areas(store, "hall-2", areas("B", "building"), "", NOBODY)
        ((ring,),) = read_lifts(store.site_file("hall-2", AREAS), store.alignment("hall-2").frame)["B"]
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


def hotel(folder: Path, change: Callable[[dict[str, Any]], object] = lambda _: None) -> Path:
    """The file of Open-RMF's hotel, with a change."""
    content = yaml.load((real_data("rmf") / "hotel.building.yaml").read_text(), yaml.CSafeLoader)
    change(content)
    (folder / "hotel.building.yaml").write_text(yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False))
    return folder / "hotel.building.yaml"


def draw_lift_on_the_third_level(content: dict[str, Any]) -> None:
    """Place it by its own vertex there, in another picture."""
    x, y = next(v[:2] for v in content["levels"]["L3"]["vertices"] if v[4:] == [{"lift_cabin": [1, "Lift1"]}])
    content["lifts"]["Lift1"] |= {"x": x, "y": y, "reference_floor_name": "L3"}


@pytest.mark.parametrize("change", [lambda _: None, draw_lift_on_the_third_level])
def test_a_building_of_open_rmf_comes_with_its_lifts_and_is_written_again(
    house: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    file = hotel(tmp_path, change)
    floors, in_store = ("--floor", "hall-1=L1", "--floor", "hall-2=L3"), ("--store", house)
    said = run(app, "building", "set", "--from", file, *floors, *in_store)
    assert said.splitlines()[1:] == [
        "  L3  hall-2  16 m  lifts: Lift1, Lift2",
        "  L1  hall-1  0 m  lifts: Lift1, Lift2",
    ]
    written = run(app, "building", "list", "--as", "rmf", *in_store)
    content = yaml.safe_load(written)
    assert content["levels"] == {"L1": {"elevation": 0.0}, "L3": {"elevation": 16.0}}
    vertices = yaml.load(file.read_text(), yaml.CSafeLoader)["levels"]["L1"]["vertices"]
    metres_per_px = 3.4 / np.hypot(*np.subtract(vertices[54][:2], vertices[53][:2]))  # its measurement
    for name, x_px, y_px in (("Lift1", 355, 340), ("Lift2", 305, 435)):
        lift = content["lifts"][name]
        assert (lift["x"], lift["y"]) == pytest.approx((x_px * metres_per_px, -y_px * metres_per_px), abs=0.1)
        assert (lift["width"], lift["depth"], abs(lift["yaw"])) == pytest.approx((2.7, 2.7, 0.0), abs=0.002)
        assert (lift["lowest_floor"], lift["highest_floor"], [*lift["level_doors"]]) == ("L1", "L3", ["L1", "L3"])
    with MapStore.open(house) as store:
        map_2 = {area.lift: area.rings[0].mean(axis=0) for area in store.areas("hall-2").areas}
    assert map_2["Lift2"] == pytest.approx(np.array([305, -435]) * metres_per_px - (10, 0), abs=0.01)
    run(app, "areas", "correct", "Lift1", "never-use", "--site", "hall-1", *in_store, "--reason", "mirrors")
    (tmp_path / "again.building.yaml").write_text(written)
    run(app, "building", "set", "--from", tmp_path / "again.building.yaml", *floors, *in_store)
    assert run(app, "building", "list", "--as", "rmf", *in_store) == written
    with MapStore.open(house) as store:
        assert [area.lift for area in store.areas("hall-1").corrections] == ["Lift1"]


@pytest.mark.parametrize(
    ("change", "floors", "words"),
    [
        (lambda c: None, ("hall-1=L1", "hall-2=L2@8"), "the file's levels are L1, L2, L3"),
        (
            lambda c: None,
            ("hall-1=L1", "hall-2=L3"),
            "aligned by hotel_L3.png, .* pixels of hotel_L1.png, with --metres-",
        ),
        (lambda c: c["levels"]["L1"].update(measurements=[]), (), "level L1: no measurement"),
        (lambda c: c["levels"]["L1"].update(measurements=[[5, 999, {"distance": [3, 2.0]}]]), (), "level L1: no meas"),
        (lambda c: c["levels"]["L3"].update(fiducials=[[1.0, 2.0, "ref1"]]), (), "level L3: two fiducials of level L1"),
        (lambda c: c["levels"]["L3"]["fiducials"][0].__setitem__(0, 900.0), (), "fiducials are .* m off"),
        (lambda c: c["lifts"]["Lift1"].update(reference_floor_name="L9"), (), "no level 'L9', but L1, L2, L3"),
        (lambda c: c["lifts"]["Lift1"].update(x=float("nan")), (), "cannot be read"),
        (lambda c: c.update(coordinate_system="wgs84"), (), "drawn on pictures or in metres"),
        (lambda c: c.clear(), (), "cannot be read"),
        (lambda c: c.update(graphs=[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]), (), "nested deeper"),
    ],
)
def test_buildings_of_open_rmf_that_cannot_be(
    house: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], floors: tuple[str, ...], words: str
) -> None:
    with MapStore.open(house) as store:
        aligned = replace(store.alignment("hall-2"), plan="hotel_L3.png")
        store.keep_site_files("hall-2", {"alignment": encode_alignment(aligned)}, "")
    named = [f"--floor={floor}" for floor in floors or ("hall-1=L1", "hall-2=L3")]
    with pytest.raises(UsageError, match=words):
        run(app, "building", "set", "--from", hotel(tmp_path, change), *named, "--store", house)
    with MapStore.open(house) as store:
        assert store.building("hall-1") is None
        assert [area.lift for area in store.areas("hall-1").areas] == ["A"]


def test_a_building_of_one_level_is_a_site(house: Path) -> None:
    with pytest.raises(UsageError, match="'building': two floors or more make a building"):
        office = real_data("rmf") / "office.building.yaml"
        run(app, "building", "set", "--from", office, "--floor", "hall-1=L1", "--store", house)
