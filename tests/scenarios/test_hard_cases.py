"""Recordings with something wrong end in a refusal that says what, or in a map that is right as far as it goes and says how far."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.mcap.writer import copy_to_mcap
from mapserver.cli import app
from support.recordings.calibration_faults import pair_turn, swapped
from support.recordings.recording_samples import write_mcap
from support.recordings.spoiled_recording import (
    with_clock_shift,
    with_darkness,
    with_imu,
    with_lost_frames,
    without_imu,
)
from support.room_site import run
from support.worlds.box_room import out_and_back, ride_sample

FRAMES, FRAME_S = 60, 0.1
GOOD_M = 0.02  # what the room is mapped to when nothing is wrong, with room to spare


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("good")
    return open_recording(write_mcap(folder / "survey", ride_sample(out_and_back(6.0), FRAMES, FRAME_S)))


@pytest.fixture(scope="module")
def another(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Another ride of the same robot in the same room."""
    ride = out_and_back(4.0, reach_m=1.8, start_m=(-0.8, -0.4, 0.2), yaw_rad=-1.2)
    folder = tmp_path_factory.mktemp("another")
    return open_recording(write_mcap(folder / "survey", ride_sample(ride, 10, 0.6, seed=3)))


def built(recording: Recording, folder: Path) -> dict[str, Any]:
    """The report of a build of a recording that is written to `folder`; raises what the build raises."""
    copy_to_mcap(recording, folder / "r.mcap")
    to_store = ("--site", "lab", "--store", folder / "store")
    run(app, "build", folder / "r.mcap", *to_store, "--report", folder / "r.json")
    return json.loads((folder / "r.json").read_text())  # type: ignore[no-any-return]


def remarks(report: dict[str, Any]) -> str:
    (words,) = report["findings"].values()
    return " | ".join(words)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        pytest.param(swapped, "left and right are swapped", id="swapped"),
        pytest.param(pair_turn("pitch", 1.0).recording, r"look [+-](0\.9|1\.0)\d degrees apart", id="tilted"),
    ],
)
def test_cameras_unlike_their_calibration_are_refused(
    good: Recording, tmp_path: Path, spoil: Callable[[Recording], Recording], says: str
) -> None:
    with pytest.raises(RecordingError, match=says) as refusal:
        built(spoil(good), tmp_path)
    assert "a map of it would be wrong" in str(refusal.value)
    assert not (tmp_path / "store").exists()


def test_the_imu_of_another_run_is_refused(good: Recording, another: Recording, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the IMU belongs to this camera"):
        built(with_imu(good, another.imu), tmp_path)


def test_a_clock_that_is_off_is_measured_and_corrected(good: Recording, tmp_path: Path) -> None:
    report = built(with_clock_shift(good, -0.02), tmp_path)
    (corrections,) = report["corrections"].values()
    assert corrections["time offset"] == pytest.approx(-0.02, abs=2e-3), remarks(report)
    assert "corrected: time offset by" in remarks(report)
    assert report["ate_rmse_m"] < GOOD_M


def test_lost_frames_cost_nothing_but_themselves(good: Recording, tmp_path: Path) -> None:
    report = built(with_lost_frames(good, 0.2, np.random.default_rng(1)), tmp_path)
    assert report["frames"] == 0.8 * FRAMES
    assert report["evaluated_share"] == 1.0
    assert report["ate_rmse_m"] < GOOD_M


def test_what_was_driven_in_the_dark_is_left_out_and_named(good: Recording, tmp_path: Path) -> None:
    """Two seconds at either end of six are lit, and without an IMU nothing carries through the rest."""
    report = built(without_imu(with_darkness(good, 2.0, 4.0)), tmp_path)
    assert [part["kept"] for part in report["parts"][0]].count(True) == 1
    assert "left out" in remarks(report)
    assert report["ate_rmse_m"] < GOOD_M
    assert 0.1 < report["evaluated_share"] < 0.75
