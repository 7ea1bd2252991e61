"""The library: a map built from a small recording in a few lines, looked at as arrays, published."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import GateRefusedError, StateError, UsageError
from mapserver import Actor, BuildOptions, build_map, open_map, open_store


def test_a_map_in_five_lines(room_ride: Path, tmp_path: Path) -> None:
    """Paths as text; the draft, its picture, publishing, and the published version as arrays."""
    draft = build_map(str(room_ride), str(tmp_path / "maps"), "hall", BuildOptions(frame_from_ground_truth=True))
    assert draft.version == 1
    assert draft.report["keyframes"] == len(draft.map.map_from_body)
    assert draft.report["ate_rmse_m"] < 0.05
    assert len(draft.trajectory) == 61
    assert draft.left_out == {}
    draft.save_picture(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(StateError, match="no published version"):
        open_map(tmp_path / "maps", "hall")
    with pytest.raises(GateRefusedError, match="nothing judged"):  # six metres there and back
        draft.publish()
    draft.publish(trust_calibration=True, actor=Actor("ada", "the rig is known"))
    with open_store(str(tmp_path / "maps")) as maps:
        assert maps.current("hall").version == 1
    arrays = open_map(tmp_path / "maps", "hall")
    assert arrays.version == 1
    assert arrays.points_map.shape == (len(arrays.landmark_ids), 3)
    assert arrays.descriptors.shape == (len(arrays.landmark_ids), 32)
    assert arrays.map_from_cam.shape == (len(arrays.place_ids), 4, 4)
    assert sum(len(tile) for tile in arrays.tiles) == len(arrays.landmark_ids) > 100
    mine = draft.map.points_map[np.searchsorted(draft.map.landmark_ids, np.sort(arrays.landmark_ids))]
    np.testing.assert_allclose(arrays.points_map[np.argsort(arrays.landmark_ids)], mine, atol=0.01)


def test_a_wrong_site_name_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="site name"):
        build_map([tmp_path / "nowhere"], tmp_path / "maps", "Hall 1")
    with pytest.raises(UsageError, match="no recording"):
        build_map([], tmp_path / "maps", "hall")


def test_missing_libraries_are_named_with_the_extra_that_has_them() -> None:
    """As with `fleetmap[client]`: scipy is not there."""
    script = "import sys; sys.modules['scipy'] = None; from mapserver import build_map"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("fleetmap.errors.FleetmapError: mapserver.build_map needs scipy")
    assert "pip install '.[server]'" in done.stderr
