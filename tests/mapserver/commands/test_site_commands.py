"""The commands over a site's building: alignment and areas. The commands that change and check a store, from the command line."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fleetmap.mapformat.manifest import building_frame, decode_manifest, encode_manifest
from fleetmap.mapformat.names import blob_path
from fleetmap.messages import FailureReport, Placement
from mapserver import releases
from mapserver.api.metrics import Metrics
from mapserver.fleet.fleet import Fleet
from mapserver.store import FailureFilter, MapStore, Retention
from support.drawn_areas import geojson
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples, save_sample_draft

# The map's x axis points up in the picture, 0.05 m a pixel, its origin at 10, -20 m.
PINS = ("a=200,400:0,0", "b=200,0:20,0", "c=0,400:0,10")


@pytest.fixture
def site(tmp_path: Path) -> tuple[str, ...]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
    cv2.imwrite(str(tmp_path / "plan.png"), np.full((500, 600), 255, np.uint8))
    return ("--site", "lab", "--store", str(tmp_path / "store"))


def placed_failure(failure_id: str, x_m: float, y_m: float) -> FailureReport:
    place = Placement(position_m=(x_m, y_m, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
    return blindness(failure_id, map_from_base=place)


def pins(*chosen: str) -> list[str]:
    return [word for pin in chosen for word in ("--pin", pin)]


def test_an_alignment_is_kept_shown_and_stamped_into_the_next_version(run, site, tmp_path: Path) -> None:
    said = run("align", *site, "--plan", tmp_path / "plan.png", *pins(*PINS))
    assert "the map's origin at 10.000, -20.000 m of the building, turned by 90.000 degrees" in said
    kept = json.loads(run("align", *site, "--show", "--json"))
    assert kept["metres_per_unit"] == pytest.approx(0.05)
    assert (kept["plan"], kept["off_m"].keys()) == ("plan.png", {"a", "b", "c"})
    block = run("align", *site, "--show", "--level", "floor 2").split("fleet adapter\n")[1].split("\n#")[0]
    points = yaml.safe_load(block)["reference_coordinates"]["floor 2"]
    for (rmf_x, rmf_y), (x, y) in zip(points["rmf"], points["robot"], strict=True):
        assert (rmf_x, rmf_y) == pytest.approx((10 - y, -20 + x))
    with MapStore.open(tmp_path / "store") as store:
        save_sample_draft(store, seed=1)
        assert building_frame(store.manifest("lab", 1)) is None
        manifest = store.manifest("lab", 2)
        frame = building_frame(decode_manifest(encode_manifest(manifest)))
        assert (frame.x_m, frame.y_m, frame.yaw_rad) == pytest.approx((10.0, -20.0, np.pi / 2))
        assert manifest.format_version == 1  # readers of before take it
        assert store.site_file("lab", "plan") == (tmp_path / "plan.png").read_bytes()
        assert releases.publish(store, "lab") == 2
        store.collect_garbage(Retention(0, 0, 0, 0))
        assert store.site_file("lab", "plan") is not None
        assert (store.verify().faults, store.verify().orphans) == ([], 0)
        assert [event.kind for event in store.events("lab")].count("alignment and plan") == 1
    assert "forgotten" in run("align", *site, "--forget")
    assert "is not aligned" in run("align", *site, "--show", status=2)


def test_a_first_version_has_a_frame_of_its_own(run, site, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store") as store:
        save_sample_draft(store, site="new")
    where = ("--site", "new", *site[2:])
    assert "publish one first" in run("align", *where, *pins(*PINS), status=2)


def test_what_gives_no_alignment_is_refused_and_changes_nothing(run, site, tmp_path: Path) -> None:
    run("align", *site, *pins(*PINS))
    before = run("align", *site, "--show")
    (tmp_path / "torn.png").write_bytes((tmp_path / "plan.png").read_bytes()[:60])
    huge = bytearray((tmp_path / "plan.png").read_bytes())
    huge[16:24] = (1 << 20).to_bytes(4, "big") * 2
    (tmp_path / "huge.png").write_bytes(huge)
    (tmp_path / "text.png").write_text("plan")
    (tmp_path / "hall.dxf").write_text("0\nSECTION\n")
    refused = {
        "name --pin": (),
        "--show to print": ("--show", *pins(*PINS)),
        "cannot be read": ("--plan", tmp_path / "none.png", *pins(*PINS)),
        "not a PNG, JPEG": ("--plan", tmp_path / "text.png", *pins(*PINS)),
        "cannot be decoded": ("--plan", tmp_path / "torn.png", *pins(*PINS)),
        "the limit is 100000000": ("--plan", tmp_path / "huge.png", *pins(*PINS)),
        "is not in plan.png, which has 600x500": ("--plan", tmp_path / "plan.png", *pins(*PINS, "d=700,0:9,9")),
        "DXF is not supported": ("--plan", tmp_path / "hall.dxf", *pins(*PINS)),
        "mirrored": pins("a=200,400:0,0", "b=200,0:20,0", "c=400,400:0,10"),
    }
    for words, arguments in refused.items():
        assert words in run("align", *site, *arguments, status=2)
    assert "has no site" in run("align", "--site", "hall", *site[2:], *pins(*PINS), status=2)
    assert run("align", *site, "--show") == before


def write_areas(path: Path, frame: str, *areas: tuple[object, ...]) -> Path:
    path.write_bytes(geojson(*({"name": name, "box": box} for name, *box in areas), frame=frame))
    return path


def test_failures_and_figures_are_named_by_areas(run, site, tmp_path: Path) -> None:
    """From the import on, also those of before; and anew when the map is aligned otherwise."""
    with MapStore.open(tmp_path / "store") as store:
        fleet = Fleet(store)
        fleet.take_failure("lab", "r1", placed_failure("f1", 3.0, 4.0))
    aisles = write_areas(tmp_path / "map.json", "map", ("aisle 5", 0, 0, 8, 8), ("gate", 20, 0, 24, 8))
    assert "2 areas (aisle 5, gate)" in run("areas", "import", aisles, *site)
    with MapStore.open(tmp_path / "store") as store:
        fleet = Fleet(store)
        fleet.take_failure("lab", "r1", placed_failure("f2", 21.0, 4.0))
        fleet.take_failure("lab", "r1", placed_failure("f3", 90.0, 4.0))
        assert [row.where for row in store.fleet.failures(FailureFilter())] == [None, "gate", "aisle 5"]
        assert [row.failure_id for row in store.fleet.failures(FailureFilter(area="gate"))] == ["f2"]
        counted = store.fleet.counters("lab", "area")
        assert {key: c.failures for (_, key), c in counted.items()} == {"gate": 1, "outside": 1}
        text = Metrics(store, fleet).text().decode()
        assert 'fleetmap_area_failures_total{area="gate",site="lab"} 1.0' in text
    out = tmp_path / "failures.jsonl"
    run("fleet", "export", out, "--store", tmp_path / "store")
    assert [json.loads(line)["area"] for line in out.read_text().splitlines()] == ["aisle 5", "gate", None]
    run("fleet", "report", tmp_path / "shift.html", *site)
    assert "gate" in (tmp_path / "shift.html").read_text()
    run("align", *site, *pins(*PINS))
    drawn = write_areas(tmp_path / "building.json", "building", ("hall", 0, -25, 12, -10))
    run("areas", "import", drawn, *site)
    with MapStore.open(tmp_path / "store") as store:
        assert [row.area for row in store.fleet.failures(FailureFilter())] == [None, None, "hall"]
    assert "run `mapserver align --plan FILE --pin ... --site lab --store" in run("align", *site, "--forget", status=2)
    run("align", *site, *pins("a=200,400:50,0", "b=200,0:70,0", "c=0,400:50,10"))  # 50 m along x of the map
    with MapStore.open(tmp_path / "store") as store:
        assert [row.area for row in store.fleet.failures(FailureFilter())] == [None, None, None]
    assert "hall: 180.0 m2" in run("areas", "list", *site)
    assert json.loads(run("areas", "list", *site, "--json"))["frame"] == "map"
    run("areas", "remove", *site)
    assert run("areas", "list", *site) == "0 areas\n"


def test_a_life_of_versions(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        for seed in range(3):
            save_sample_draft(store, seed=seed)
    in_store = ("--store", tmp_path / "store")
    where = ("--site", "lab", *in_store)
    first = run("publish", *where, "--version", 1)
    assert "version 1 is current (2 tiles, 80 landmarks" in first
    assert "held_out_frames" in first
    run("publish", *where, "--version", 2)
    assert "no version 5" in run("inspect", *where, "--version", 5, status=2)
    assert "--reason" in run("publish", *where, "--version", 3, "--force", status=2)
    rows = json.loads(run("versions", *where, "--json"))
    assert [(row["version"], row["state"]) for row in rows] == [(1, "published"), (2, "current"), (3, "draft")]
    assert "current" in run("versions", *where)
    assert "version 1 is current again" in run("rollback", *where, "--actor", "ada", "--reason", "lost robots")
    assert "version 2 is current" in run("promote", *where, 2)
    assert "error: version 3 of site lab is a draft" in run("promote", *where, 3, status=2)
    shown = json.loads(run("inspect", *where, "--version", 1, "--json"))
    assert [(event["kind"], event["actor"]) for event in shown["history"]][-1] == ("rolled_back", "ada")
    assert shown["manifest"]["report"] == {"path_m": 12.5}
    assert shown["bytes_per_m"] == pytest.approx(shown["map_bytes"] / 12.5)
    text = run("inspect", *where, "--version", 1)
    assert all(words in text for words in ("gate: accepted", "bytes per metre", "2 tiles of 16 m", "walk"))
    changed = json.loads(run("diff", *where, 1, 2, "--json"))
    assert (changed["tiles_changed"], changed["quality"]["path_m"]) == (2, {"before": 12.5, "after": 12.5})
    assert "fetches" in run("diff", *where, 1, 2)
    assert "version 2 is in" in run("export", *where, tmp_path / "lab.fmex")
    assert "(draft)" in run("import", tmp_path / "lab.fmex", "--store", tmp_path / "other")
    assert "0 files would be removed" in run("gc", *in_store, "--dry-run")
    assert json.loads(run("gc", *in_store, "--keep-drafts", 0, "--keep-days", 0, "--json"))["removed"] == [["lab", 3]]
    assert "no draft" in run("publish", *where, status=2)
    assert "clean" in run("verify", *in_store)


def test_verify_ends_with_a_status_of_its_own(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        tile = store.manifest("lab", 1).tiles[0].sha256
    (tmp_path / blob_path(tile)).write_bytes(b"other")
    assert f"{tile} is damaged" in run("verify", "--store", tmp_path, status=3)
    assert len(json.loads(run("verify", "--store", tmp_path, "--json", status=3))["faults"]) == 1


def test_gc_leaves_a_store_that_it_refuses_as_it_is(run, tmp_path: Path) -> None:
    MapStore.open(tmp_path, create=True).close()
    with closing(sqlite3.connect(tmp_path / "store.sqlite3")) as connection:
        connection.execute("PRAGMA user_version = 99")
    before = (tmp_path / "store.sqlite3").read_bytes()
    assert "store format 99" in run("gc", "--store", tmp_path, status=3)
    assert (tmp_path / "store.sqlite3").read_bytes() == before
    assert (tmp_path / "reserve").is_file()


def test_the_gate_takes_its_limits_from_the_file(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1, first=1)
        save_sample_draft(store, seed=2)
    strict = tmp_path / "strict.toml"
    strict.write_text("[gate]\nmin_landmarks_share = 1.5\n")
    where = ("--site", "lab", "--store", tmp_path / "store")
    refused = run("publish", *where, "--config", strict, status=4)
    assert "number of landmarks is 1.00 of version 1's, below the limit of 1.5" in refused
    assert "refused" in run("inspect", *where, "--version", 2)
    assert "version 2 is current" in run("publish", *where)
