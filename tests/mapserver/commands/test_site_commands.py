"""The commands over a site's building: alignment and areas."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fleetmap.mapformat import decode_manifest, encode_manifest
from fleetmap.mapformat.building import building_frame
from mapserver import releases
from mapserver.store import MapStore, Retention
from support.storage.map_samples import publish_samples, save_sample_draft

# The map's x axis points up in the picture, 0.05 m a pixel, its origin at 10, -20 m.
PINS = ("a=200,400:0,0", "b=200,0:20,0", "c=0,400:0,10")


@pytest.fixture
def site(tmp_path: Path) -> tuple[str, ...]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
    cv2.imwrite(str(tmp_path / "plan.png"), np.full((500, 600), 255, np.uint8))
    return ("--site", "lab", "--store", str(tmp_path / "store"))


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
    refused = {
        "name --pin": (),
        "--show to print": ("--show", *pins(*PINS)),
        "cannot be read": ("--plan", tmp_path / "none.png", *pins(*PINS)),
        "no PNG, JPEG": ("--plan", tmp_path / "text.png", *pins(*PINS)),
        "cannot be decoded": ("--plan", tmp_path / "torn.png", *pins(*PINS)),
        "the limit is 100000000": ("--plan", tmp_path / "huge.png", *pins(*PINS)),
        "is not in plan.png, which has 600x500": ("--plan", tmp_path / "plan.png", *pins(*PINS, "d=700,0:9,9")),
        "mirrored": pins("a=200,400:0,0", "b=200,0:20,0", "c=400,400:0,10"),
    }
    for words, arguments in refused.items():
        assert words in run("align", *site, *arguments, status=2)
    assert "has no site" in run("align", "--site", "hall", *site[2:], *pins(*PINS), status=2)
    assert run("align", *site, "--show") == before
