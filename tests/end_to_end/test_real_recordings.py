"""A real flight with gaps of seconds; what all public recordings come to is `make acceptance NAMES=public_recordings`."""

import json
from pathlib import Path
from typing import Any

import pytest

from mapserver.cli import app as mapserver_app
from mapserver.store import MapStore
from support.recordings.realdata import real_data
from support.room_site import run

pytestmark = pytest.mark.timeout(300)


def built(folder: Path, *more: str) -> dict[str, Any]:
    """The report of a build of V1_01."""
    to_store = ["--site", "s", "--store", folder / "store", "--report", folder / "b.json", *more]
    run(mapserver_app, "build", real_data("euroc_v101_keyframes"), *to_store, "--frame-from-ground-truth")
    return json.loads((folder / "b.json").read_text())


def test_v101_as_a_whole_refuses_no_revisit_of_its_own(tmp_path: Path) -> None:
    """A gate surer than the odometry refused two dozen that shared up to 209 points, after five seconds without a picture."""
    report = built(tmp_path)
    assert report["ate_rmse_m"] <= 0.02
    assert report["loops"]["accepted"] >= 100
    assert not [r for r in report["loop_records"] if r["verdict"] == "gated_out" and r["inliers"] >= 30]
    # A wall five metres away allows a second pose, 0.37 m aside: one frame between keyframes was there, and said 2 cm.
    with MapStore.open(tmp_path / "store") as store:
        found = store.evidence("s", 1).held_out.draft
    assert found.frames >= 5
    assert found.p95_error_m < 0.05


def test_v101_by_every_second_frame_keeps_its_imu_and_stays_one_part(tmp_path: Path) -> None:
    """Frames 2.7 s apart: where images cannot show a start in motion, the IMU's rest is the start."""
    report = built(tmp_path, "--frames", "::2")
    assert report["inertial"]
    assert [part["kept"] for parts in report["parts"] for part in parts] == [True]
