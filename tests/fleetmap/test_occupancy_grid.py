"""Planners' grids: what is written is read as the same cells, nav2's own maps too; what is wrong is told before it costs anything."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError, StoreError
from fleetmap.geometry import se3, so3_exp
from fleetmap.occupancy_grid import GridImageError, OccupancyGrid, read_grid, write_grid

NAV2 = Path(__file__).resolve().parents[3] / "shared" / "data" / "conformance" / "nav2"
TRINARY = st.sampled_from([-1, 0, 100])


def grid_of(cells: NDArray[np.int8], yaw_rad: float = 0.0) -> OccupancyGrid:
    return OccupancyGrid(cells, 0.05, se3(so3_exp(np.array([0, 0, yaw_rad])), np.array([-3.5, 2.25, 0.0])))


def assert_same(found: OccupancyGrid, wanted: OccupancyGrid) -> None:
    np.testing.assert_array_equal(found.cells, wanted.cells)
    np.testing.assert_allclose(found.map_from_grid, wanted.map_from_grid, atol=1e-12)
    assert found.resolution_m == wanted.resolution_m


@settings(max_examples=60, deadline=None)
@given(cells=arrays(np.int8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=TRINARY | st.integers(-1, 100)))
def test_what_is_written_is_read_again(cells: NDArray[np.int8], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("grid") / "hall.yaml"
    wanted = grid_of(cells, 0.3)
    write_grid(path, wanted)
    assert_same(read_grid(path), wanted)


@pytest.mark.skipif(not NAV2.is_dir(), reason="nav2's maps are missing")
@pytest.mark.parametrize("name", ["nav2_map_server/test/testmap.yaml", "nav2_bringup/maps/depot.yaml"])
def test_maps_of_nav2_pass_through(name: str, tmp_path: Path) -> None:
    theirs = read_grid(NAV2 / name)
    assert {0, 100} <= set(np.unique(theirs.cells))
    write_grid(tmp_path / "ours.yaml", theirs)
    assert_same(read_grid(tmp_path / "ours.yaml"), theirs)


@pytest.mark.skipif(not NAV2.is_dir(), reason="nav2's maps are missing")
def test_the_picture_of_nav2_that_is_none_is_refused() -> None:
    with pytest.raises(GridImageError, match=r"invalid\.png"):
        read_grid(NAV2 / "nav2_map_server" / "test" / "invalid_image.yaml")


def test_unknown_cells_are_not_read_as_free(tmp_path: Path) -> None:
    """With map_saver's own threshold of 0.25 they would be."""
    write_grid(tmp_path / "a.yaml", grid_of(np.array([[-1, 0, 100]], np.int8)))
    assert (tmp_path / "a.pgm").read_bytes() == b"P5\n3 1\n255\n" + bytes([205, 254, 0])


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("cut", b"P5\n4 4\n255\n" + bytes(15), "11 bytes|26 bytes"),
        ("cut where comments stand", b"P5\n# map_saver\n4 4\n255\n" + bytes(15), "38 bytes"),
        ("sixteen", b"P5\n2 2\n65535\n" + bytes(8), "uint16"),
        ("large", b"P5\n60000 60000\n255\n" + bytes(64), "60000"),
        ("none", b"P5\n0 0\n255\n", "0"),
        ("other", b"GIF89a", "None"),
    ],
)
def test_wrong_pictures_are_told(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    write_grid(tmp_path / "a.yaml", grid_of(np.zeros((2, 2), np.int8)))
    (tmp_path / "a.pgm").write_bytes(data)
    with pytest.raises(GridImageError, match=words):
        read_grid(tmp_path / "a.yaml")


def test_a_large_picture_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_grid(tmp_path / "a.yaml", grid_of(np.zeros((2, 2), np.int8)))
    text = (tmp_path / "a.yaml").read_text().replace("a.pgm", "a.png")
    (tmp_path / "a.yaml").write_text(text)
    whole = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    (tmp_path / "a.png").write_bytes(whole[:16] + (40000).to_bytes(4, "big") * 2 + whole[24:])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(GridImageError, match="40000"):
        read_grid(tmp_path / "a.yaml")


@pytest.mark.parametrize(("old", "new"), [("trinary", "costmap"), ("0.05", "0"), ("negate: 0", "negate: 0\norigin: 3")])
def test_wrong_entries_are_told(old: str, new: str, tmp_path: Path) -> None:
    write_grid(tmp_path / "a.yaml", grid_of(np.zeros((2, 2), np.int8)))
    (tmp_path / "a.yaml").write_text((tmp_path / "a.yaml").read_text().replace(old, new))
    with pytest.raises(MapFormatError, match=r"a\.yaml: (mode|resolution|origin)"):
        read_grid(tmp_path / "a.yaml")


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"):
        write_grid(tmp_path / "missing" / "a.yaml", grid_of(np.zeros((2, 2), np.int8)))
