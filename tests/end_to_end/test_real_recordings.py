"""A real flight with gaps of seconds; what all public recordings come to is `make acceptance NAMES=public_recordings`."""

import json
from pathlib import Path

import pytest

from mapserver.cli import app as mapserver_app
from mapserver.store import MapStore
from support.recordings.realdata import real_data
from support.room_site import run

pytestmark = pytest.mark.timeout(300)


def test_v101_as_a_whole_refuses_no_revisit_of_its_own(tmp_path: Path) -> None:
    """A gate surer than the odometry refused two dozen that shared up to 209 points, after five seconds without a picture."""
    to_store = ["--site", "s", "--store", tmp_path / "store", "--report", tmp_path / "b.json"]
    run(mapserver_app, "build", real_data("euroc_v101_keyframes"), *to_store, "--frame-from-ground-truth")
    report = json.loads((tmp_path / "b.json").read_text())
    assert report["ate_rmse_m"] <= 0.02
    assert report["loops"]["accepted"] >= 100
    refused = [r for r in report["loop_records"] if r["verdict"] == "gated_out" and r["inliers"] >= 30]
    assert not refused
    # A wall five metres away allows a second pose, 0.37 m aside: one frame between keyframes was there, and said 2 cm.
    with MapStore.open(tmp_path / "store") as store:
        evidence = store.evidence("s", 1)
    found = evidence.held_out.draft
    assert found.frames >= 5
    assert found.p95_error_m < 0.05


def test_v101_by_every_second_frame_keeps_its_imu_and_stays_one_part(tmp_path: Path) -> None:
    """Frames 2.7 s apart: where images cannot show a start in motion, the IMU's rest is the start."""
    to_store = ["--site", "s", "--store", tmp_path / "store", "--report", tmp_path / "b.json", "--frames", "::2"]
    run(mapserver_app, "build", real_data("euroc_v101_keyframes"), *to_store, "--frame-from-ground-truth")
    report = json.loads((tmp_path / "b.json").read_text())
    assert report["inertial"]
    assert [part["kept"] for parts in report["parts"] for part in parts] == [True]
