"""Planners' grids: the files of map_server hold the cells that were written."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from fleetmap.errors import StoreError
from fleetmap.geometry import se3, so3_exp
from fleetmap.version_grid import OccupancyGrid, write_grid

TRINARY = st.sampled_from([-1, 0, 100])


def grid_of(cells: NDArray[np.int8], yaw_rad: float = 0.0) -> OccupancyGrid:
    return OccupancyGrid(cells, 0.05, se3(so3_exp(np.array([0, 0, yaw_rad])), np.array([-3.5, 2.25, 0.0])))


@settings(max_examples=60, deadline=None)
@given(cells=arrays(np.int8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=TRINARY | st.integers(-1, 100)))
def test_nav2_reads_what_is_written(cells: NDArray[np.int8], tmp_path_factory: pytest.TempPathFactory) -> None:
    """By the definition of nav2_map_server: shares of black against thresholds in mode trinary, values themselves in mode raw."""
    path = tmp_path_factory.mktemp("grid") / "hall.yaml"
    write_grid(path, grid_of(cells, 0.3))
    entries = yaml.safe_load(path.read_text())
    pixels = cv2.imread(str(path.parent / entries["image"]), cv2.IMREAD_UNCHANGED)[::-1].astype(int)
    share = 1.0 - pixels / 255.0
    read = np.where(share >= entries["occupied_thresh"], 100, np.where(share <= entries["free_thresh"], 0, -1))
    if entries["mode"] == "raw":
        read = np.where(pixels <= 100, pixels, -1)
    np.testing.assert_array_equal(read, cells)
    np.testing.assert_allclose(entries["origin"], [-3.5, 2.25, 0.3])
    assert (entries["resolution"], entries["negate"]) == (0.05, 0)


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"):
        write_grid(tmp_path / "missing" / "a.yaml", grid_of(np.zeros((2, 2), np.int8)))
