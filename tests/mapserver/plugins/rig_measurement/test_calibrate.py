"""`mapserver calibrate` over a recording with a damaged picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.geometry import se3, se3_inverse
from fleetmap.recordings import open_recording, read_calibration
from fleetmap.sensors.samples import CameraFrame
from mapserver.calibration import CalibrationEstimate, CalibrationParameter, ParameterEstimate
from mapserver.calibration.parameters import COLUMNS
from mapserver.cli import app
from support.command_line import status
from support.recordings.recording_samples import calibration, make_sample, write_euroc
from support.recordings.rig_samples import write_kitti_raw
from support.worlds.box_room import out_and_back, ride_sample


@pytest.mark.parametrize("image_type", ["jpg", "png"])
def test_a_damaged_picture_costs_its_frame(tmp_path: Path, image_type: str) -> None:
    folder = write_euroc(tmp_path / "ride", ride_sample(out_and_back(6.0), 31, 0.1), image_type=image_type)
    file = folder / f"mav0/cam1/data/image9.{image_type}"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 3] + data[len(data) // 2 :])
    done = CliRunner().invoke(app, ["calibrate", str(folder)])
    assert done.exit_code == 0, done.output
    assert "damaged" in done.stderr
    assert "corrections to the calibration" in done.stdout


def test_the_other_cameras_of_a_rig_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first pair's baseline is 1 % longer; the file has all four cameras, the others as they were."""
    sample, front = make_sample(4), calibration(has_imu=False)
    turned = se3(np.diag([-1.0, -1.0, 1.0]), np.array([-0.3, 0.0, 0.0]))  # body_from_turned
    rear = tuple(replace(camera, body_from_cam=turned @ camera.body_from_cam) for camera in front.cameras)
    shown = [CameraFrame(int(s), a, b) for s, a, b in zip(sample.stamps_ns, sample.left, sample.right, strict=True)]
    frames = [replace(frame, others=(frame,)) for frame in shown]
    drive = write_kitti_raw(tmp_path / "drive", replace(front, cameras=(*front.cameras, *rear)), frames)
    is_wrong = [p is CalibrationParameter.BASELINE for p in COLUMNS]
    parameters = [ParameterEstimate(p, 0.01 * wrong, 1e-4, wrong) for p, wrong in zip(COLUMNS, is_wrong, strict=True)]
    found = CalibrationEstimate(tuple(parameters), 1e-8 * np.eye(len(COLUMNS)), 9, 99)
    monkeypatch.setattr("mapserver.calibration.estimate_calibration", lambda *_: found)
    done = CliRunner().invoke(app, ["calibrate", str(drive), "--out", str(tmp_path / "cams.yaml")])
    assert done.exit_code == 0, done.output
    with open_recording(drive) as recording:
        before = recording.calibration.cameras
    after = read_calibration(tmp_path / "cams.yaml").cameras
    assert "camera position z: NOT JUDGED" in (tmp_path / "cams.yaml").read_text()
    assert len(after) == 4
    np.testing.assert_allclose(after[3].body_from_cam, before[3].body_from_cam)
    apart = [np.linalg.norm((se3_inverse(c[0].body_from_cam) @ c[1].body_from_cam)[:3, 3]) for c in (before, after)]
    assert apart[1] == pytest.approx(1.01 * apart[0])


def test_exit_statuses(tmp_path: Path) -> None:
    assert status("mapserver", "calibrate") == 2
    assert status("mapserver", "calibrate", tmp_path / "none.mcap") == 3
    assert status("mapserver", "calibrate", tmp_path / "none.mcap", "--out", tmp_path / "no" / "o.yaml") == 2
    assert status("mapserver", "calibrate", tmp_path / "none.mcap", "--guess", "752:0.1") == 2
