"""What commands write of a version's grid and surfels, read by other programs, and what they refuse."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from plyfile import PlyData

from fleetmap.geometry import quat_wxyz_from_rotation
from fleetmap.sensors.samples import SensorSet
from fleetmap.version_grid import TILE_CELLS
from mapserver import releases
from mapserver.store import MapStore, Retention
from support.drawn_areas import geojson
from support.recordings.painted_room import standing_first, write_ride
from support.storage.dense_samples import save_surfel_draft, seen_wall, surfel_extras, wall
from support.storage.map_samples import save_grid_draft, save_sample_draft


def save_dense(store: MapStore, seed: int = 0) -> None:
    """A draft with a grid and surfels that no other seed's has."""
    extras, said = surfel_extras(wall(grey=100 + seed))
    save_grid_draft(store, seed, extras=extras, surfels=said)


@pytest.fixture
def site(store: MapStore) -> tuple[str, ...]:
    save_dense(store)
    releases.publish(store, "lab")
    return "--site", "lab", "--store", str(store.folder)


@pytest.fixture
def walled(store: MapStore) -> tuple[str, ...]:
    save_sample_draft(store)
    save_surfel_draft(store, wall())
    return "--site", "lab", "--store", str(store.folder)


def read(path: Path) -> tuple[NDArray[np.uint8], list[float]]:
    """The image of a grid's files, the row with the lowest y first, and its origin. Shades: 0 occupied, 254 free, 205 unknown."""
    pixels = cv2.imread(str(path.with_suffix(".pgm")), cv2.IMREAD_UNCHANGED)
    return np.asarray(pixels[::-1]), yaml.safe_load(path.read_text())["origin"]


def test_a_grid_is_written_for_the_robots_height(run, site, tmp_path: Path) -> None:
    said = run("grid", "export", *site, tmp_path / "a.yaml", "--heights", tmp_path / "a.npz")
    assert "grid of version 1" in said
    assert "80 x 40 cells of 0.05 m, 7.8 m2 free" in said
    shades, origin = read(tmp_path / "a.yaml")
    assert shades.shape == (40, 80)
    np.testing.assert_allclose(origin, [1.0, 3.0, 0.0])
    assert (shades[10:20, 20:30] == 0).all()
    assert (shades == 254).sum() == 40 * 80 - 100
    run("grid", "export", *site, tmp_path / "low.yaml", "--robot-height", "0.3")
    assert (read(tmp_path / "low.yaml")[0] == 254).all()
    heights = np.load(tmp_path / "a.npz")
    row, column = ((np.array([4.0, 3.5])[::-1] - heights["corner_map_m"][::-1]) / heights["cell_m"]).astype(int)
    assert heights["lowest_m"][row, column] == pytest.approx(0.005)
    assert np.isnan(heights["highest_m"]).sum() == TILE_CELLS**2 - 40 * 80


def test_wrong_orders_for_grids_are_told(run, site, store: MapStore, tmp_path: Path) -> None:
    assert "has no version 7" in run("grid", "export", *site, tmp_path / "a.yaml", "--version", 7, status=2)
    assert "up to 2.10 m" in run("grid", "export", *site, tmp_path / "a.yaml", "--robot-height", "3", status=2)
    assert "above 0.1 m" in run("grid", "export", *site, tmp_path / "a.yaml", "--robot-height", "0.1", status=2)
    assert "a robot of nan m" in run("grid", "export", *site, tmp_path / "a.yaml", "--robot-height", "nan", status=2)
    assert "must end in .yaml" in run("grid", "export", *site, tmp_path / "a.pgm", status=2)
    assert "folder that exists" in run("grid", "export", *site, tmp_path / "no" / "a.yaml", status=2)
    bare = save_sample_draft(store)
    assert "occupancy_grid = true" in run("grid", "export", *site, tmp_path / "a.yaml", "--version", bare, status=2)
    assert not list(tmp_path.glob("a.*"))


def test_grid_and_surfels_travel_with_the_archive_and_go_with_their_version(
    run, site, store: MapStore, tmp_path: Path
) -> None:
    other = ("--site", "lab", "--store", str(tmp_path / "other"))
    run("export", *site, tmp_path / "v.fmex")
    run("import", "--store", tmp_path / "other", tmp_path / "v.fmex")
    run("grid", "export", *other, tmp_path / "a.yaml", "--version", 1)
    assert (read(tmp_path / "a.yaml")[0] == 0).any()
    assert f"{len(wall())} surfels of version 1" in run("map", "splats", *other, 1, tmp_path / "a.ply")
    # Robots fetch a file without them, of the format that they know.
    run("export", *site, tmp_path / "robots.fmex", "--without-archive")
    formats = [(tmp_path / f"{name}.fmex").read_bytes()[4:6] for name in ("v", "robots")]
    assert formats == [b"\x03\x00", b"\x01\x00"]
    assert store.verify().faults == []
    assert store.served_kind(store.manifest("lab", 1).report["surfels"]["sha256"]) is None  # robots never get them
    for seed in (1, 2, 3):
        save_dense(store, seed)
    before = store.verify()
    gone = store.collect_garbage(Retention(keep_drafts=1, keep_days=0.0))
    after = store.verify()
    assert (gone.removed, after.faults) == ([("lab", 2), ("lab", 3)], [])
    assert before.blobs - after.blobs >= 2 * 5  # manifest, indices and tiles of each
    run("grid", "export", *site, tmp_path / "b.yaml", "--version", 4)
    # What is damaged is told.
    manifest = store.manifest("lab", 4)
    next((tmp_path / "store").glob(f"blobs/*/{manifest.report['grid']['sha256']}")).write_bytes(b"{}")
    assert "damaged" in run("grid", "export", *site, tmp_path / "b.yaml", "--version", 4, status=3)


DOCK = {"name": "dock", "box": (1.0, 2.0, 2.0, 3.0), "mask": "keep-out"}
SLOW = {"name": "crossing", "box": (4.0, 2.0, 6.0, 3.0), "mask": "speed", "percent": 30}
SLOWER = {"name": "door", "box": (5.0, 2.0, 7.0, 3.0), "mask": "speed", "percent": 10}


def test_masks_stay_with_the_site_and_are_written_for_costmap_filters(
    run, site, store: MapStore, tmp_path: Path
) -> None:
    (tmp_path / "masks.json").write_bytes(geojson(DOCK, SLOW, SLOWER))
    assert "3 areas" in run("areas", "import", tmp_path / "masks.json", *site)
    save_grid_draft(store, 1)
    releases.publish(store, "lab")
    assert store.verify().faults == []
    assert run("areas", "list", *site).splitlines() == [
        "crossing: 2.0 m2, speed 30 %", "dock: 1.0 m2, keep-out", "door: 2.0 m2, speed 10 %", "3 areas",
    ]  # fmt: skip
    run("areas", "export", *site, "--keep-out", tmp_path / "keep.yaml", "--speed", tmp_path / "speed.yaml")
    (keep, keep_origin), (speed, speed_origin) = read(tmp_path / "keep.yaml"), read(tmp_path / "speed.yaml")
    np.testing.assert_allclose(keep_origin[:2], [1.0, 2.0])
    assert (keep[:20, :20] == 0).all()
    values = speed[10, [5, 15, 25, 35, 55]].tolist()
    assert (speed_origin[0], values) == (pytest.approx(4.0), [30, 30, 10, 10, 10])
    run("areas", "remove", *site)
    assert "0 areas" in run("areas", "list", *site)
    assert "no area with a speed mask" in run("areas", "export", *site, "--speed", tmp_path / "s.yaml", status=2)


def test_masks_over_half_a_country_are_refused(run, site, tmp_path: Path) -> None:
    far = DOCK | {"name": "far", "box": (0.0, 0.0, 5000.0, 5000.0)}
    (tmp_path / "masks.json").write_bytes(geojson(DOCK, far))
    run("areas", "import", tmp_path / "masks.json", *site)
    assert "100001 x 100001 cells" in run("areas", "export", *site, "--keep-out", tmp_path / "k.yaml", status=2)


def test_another_reader_finds_the_wall(run, walled, tmp_path: Path) -> None:
    assert f"{len(wall())} surfels of version 2" in run("map", "splats", *walled, 2, tmp_path / "a.ply")
    vertices = PlyData.read(tmp_path / "a.ply")["vertex"]
    assert len(vertices) == len(wall())
    np.testing.assert_allclose(vertices["x"], 2.0, atol=1e-3)
    assert set(np.round((0.5 + 0.28209479 * vertices["f_dc_1"]) * 255).astype(int)) == {120, 250}
    np.testing.assert_allclose(1 / (1 + np.exp(-vertices["opacity"])), 0.98, atol=1e-4)
    scales = np.exp(np.stack([vertices[f"scale_{i}"] for i in range(3)], axis=1))
    assert (scales[:, 2] < 0.2 * scales[:, 0]).all()
    # The thin axis of each Gaussian is the wall's normal: z of its rotation, up to the sign.
    turned = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    rotations = np.stack([vertices[f"rot_{i}"] for i in range(4)], axis=1)
    assert np.abs(rotations @ quat_wxyz_from_rotation(turned)).min() == pytest.approx(1.0, abs=1e-4)


def test_what_changed_is_written_as_a_plan_and_as_geojson(run, walled, store: MapStore, tmp_path: Path) -> None:
    for with_board in (False, True):
        save_surfel_draft(store, seen_wall(with_board=with_board))
    said = run("map", "changes", *walled, 3, 4, tmp_path / "c.png")
    assert "1 patches appeared" in said
    assert "0 patches vanished" in said
    run("map", "changes", *walled, 3, 4, tmp_path / "C.PNG")
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in ("c.png", "C.PNG"))
    run("map", "changes", *walled, 4, 3, tmp_path / "c.geojson")
    found = json.loads((tmp_path / "c.geojson").read_text())
    assert [feature["properties"]["change"] for feature in found["features"]] == ["vanished"]
    assert "must end in .png or .geojson" in run("map", "changes", *walled, 3, 4, tmp_path / "c.txt", status=2)
    assert "surfel_map = true" in run("map", "changes", *walled, 1, 4, tmp_path / "d.png", status=2)
    assert not list(tmp_path.glob("d.*"))


def test_wrong_orders_for_surfels_are_told(run, walled, tmp_path: Path) -> None:
    assert "surfel_map = true" in run("map", "splats", *walled, 1, tmp_path / "a.ply", status=2)
    assert "has no version 7" in run("map", "splats", *walled, 7, tmp_path / "a.ply", status=2)
    assert "must end in .ply" in run("map", "splats", *walled, 2, tmp_path / "a.obj", status=2)
    write_ride(tmp_path / "other.mcap", standing_first(), 6.0, SensorSet.STEREO)
    wanted = (*walled, 2, tmp_path / "other.mcap")
    assert "must end in .ply" in run("map", "refine", *wanted, tmp_path / "a.obj", status=2)
    assert "is not of version 2" in run("map", "refine", *wanted, tmp_path / "a.ply", status=2)
    assert "surfel_map = true" in run(
        "map", "refine", *walled, 1, tmp_path / "other.mcap", tmp_path / "a.ply", status=2
    )
    assert not list(tmp_path.glob("a.*"))
