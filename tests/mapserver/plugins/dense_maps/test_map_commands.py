"""Surfels of a version as a file of Gaussians, read by another program."""

import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from fleetmap.geometry import quat_wxyz_from_rotation
from fleetmap.sensors.samples import SensorSet
from mapserver.store import MapStore
from support.recordings.painted_room import Ride, write_ride
from support.storage.dense_samples import save_surfel_draft, seen_wall, wall
from support.storage.map_samples import save_sample_draft


@pytest.fixture
def site(tmp_path: Path) -> tuple[str, ...]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store)
        save_surfel_draft(store, wall())
    return ("--site", "lab", "--store", str(tmp_path / "store"))


def test_another_reader_finds_the_wall(run, site, tmp_path: Path) -> None:
    assert f"{len(wall())} surfels of version 2" in run("map", "splats", *site, 2, tmp_path / "a.ply")
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
    wanted = quat_wxyz_from_rotation(turned)
    assert np.abs(rotations @ wanted).min() == pytest.approx(1.0, abs=1e-4)


def test_what_changed_is_written_as_a_plan_and_as_geojson(run, site, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store") as store:
        for with_board in (False, True):
            save_surfel_draft(store, seen_wall(with_board=with_board))
    said = run("map", "changes", *site, 3, 4, tmp_path / "c.png")
    assert "1 patches appeared" in said
    assert "0 patches vanished" in said
    run("map", "changes", *site, 3, 4, tmp_path / "C.PNG")
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in ("c.png", "C.PNG"))
    run("map", "changes", *site, 4, 3, tmp_path / "c.geojson")
    found = json.loads((tmp_path / "c.geojson").read_text())
    assert [feature["properties"]["change"] for feature in found["features"]] == ["vanished"]
    assert "must end in .png or .geojson" in run("map", "changes", *site, 3, 4, tmp_path / "c.txt", status=2)
    assert "surfel_map = true" in run("map", "changes", *site, 1, 4, tmp_path / "d.png", status=2)
    assert not list(tmp_path.glob("d.*"))


def test_wrong_orders_are_told(run, site, tmp_path: Path) -> None:
    assert "surfel_map = true" in run("map", "splats", *site, 1, tmp_path / "a.ply", status=2)
    assert "has no version 7" in run("map", "splats", *site, 7, tmp_path / "a.ply", status=2)
    assert "must end in .ply" in run("map", "splats", *site, 2, tmp_path / "a.obj", status=2)
    assert not list(tmp_path.glob("a.*"))


def test_refinement_refuses_what_does_not_fit(run, site, tmp_path: Path) -> None:
    write_ride(tmp_path / "other.mcap", Ride(), SensorSet.STEREO)
    wanted = (*site, 2, tmp_path / "other.mcap")
    assert "must end in .ply" in run("map", "refine", *wanted, tmp_path / "a.obj", status=2)
    assert "is not of version 2" in run("map", "refine", *wanted, tmp_path / "a.ply", status=2)
    assert "surfel_map = true" in run("map", "refine", *site, 1, tmp_path / "other.mcap", tmp_path / "a.ply", status=2)
    assert not list(tmp_path.glob("a.*"))
