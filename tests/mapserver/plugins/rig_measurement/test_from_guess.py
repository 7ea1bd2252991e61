"""Lenses from a guess: matches without pictures, seen through lenses that nobody described."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings import open_recording, read_calibration
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame
from fleetsim.recorder import Order
from mapserver.calibration import CalibrationParameter
from mapserver.calibration.estimator import adjust
from mapserver.calibration.parameters import COLUMNS, DISTORTION
from mapserver.cli import app
from mapserver.plugins.rig_measurement.from_guess import RawMatches, first_rig, guessed_rig
from support.command_line import status
from support.recordings.recording_samples import calibration, make_sample, write_euroc
from support.recordings.rig_samples import write_kitti_raw
from support.worlds.box_room import out_and_back, ride_sample
from support.worlds.calibration_scene import Stretch, estimate, make_stretch, measured

DISTORTED = np.array([-0.28, 0.07, 0.0, 0.0])


@pytest.fixture(scope="module")
def loop() -> Stretch:
    """The turns of a loop."""
    return make_stretch(Order("small-loop", seed=1), 5.0, 18.0, step_s=0.4, per_frame=80)


def bent(rig: RigCalibration) -> RigCalibration:
    """The rig with the lenses of a wide camera, its right camera turned."""
    left, right = (replace(camera, distortion=DISTORTED) for camera in rig.cameras)
    turned = right.body_from_cam.copy()
    turned[:3, :3] = turned[:3, :3] @ so3_exp(np.radians([0.8, 0.0, -0.4]))
    return replace(rig, cameras=(left, replace(right, body_from_cam=turned)))


def raw_pixels(stretch: Stretch, rig: RigCalibration, seed: int) -> tuple[Array, Array]:
    """(M, 2) of both cameras, with errors."""
    body = stretch.map_from_body[stretch.obs_keyframe]
    points = stretch.points_map[stretch.obs_landmark] - body[:, :3, 3]
    in_body = np.einsum("mji,mj->mi", body[:, :3, :3], points)
    sides = [c.pixel_from_ray((in_body - c.body_from_cam[:3, 3]) @ c.body_from_cam[:3, :3]) for c in rig.cameras]
    rng = np.random.default_rng(seed)
    left, right = (side + rng.normal(0.0, 0.4, side.shape) for side in sides)
    return left, right


def matches(stretch: Stretch, rig: RigCalibration, keyframes: range, seed: int) -> RawMatches:
    left, right = raw_pixels(stretch, rig, seed)
    motions = []
    for k in keyframes:
        first, second = (np.flatnonzero(stretch.obs_keyframe == n) for n in (k, k + 1))
        _, a, b = np.intersect1d(stretch.obs_landmark[first], stretch.obs_landmark[second], return_indices=True)
        if len(a) >= 20:
            motions.append(np.column_stack([left[first[a]], left[second[b]]]))
    return RawMatches(np.column_stack([left, right])[:2000], motions)


def test_lenses_are_found_from_a_focal_length_of_the_image_width(loop: Stretch) -> None:
    """Truth: 420 of 640 px, a third less than the guess, and a distortion of 20 % at the corner."""
    true = bent(loop.session.true)
    left, right = guessed_rig(first_rig(640, 480, 0.12), matches(loop, true, range(0, 40, 3), 1)).cameras
    assert left.intrinsics_px[0] == pytest.approx(420.0, rel=0.1)
    assert left.distortion[0] == pytest.approx(-0.28, abs=0.08)
    turn = np.degrees(so3_log((se3_inverse(left.body_from_cam) @ right.body_from_cam)[:3, :3]))
    assert turn[0] == pytest.approx(0.8, abs=0.6)
    assert np.linalg.norm(right.body_from_cam[:3, 3] - left.body_from_cam[:3, 3]) == pytest.approx(0.12)


def test_a_drive_without_turns_shows_no_focal_length() -> None:
    straight = make_stretch(Order("small-loop", seed=1), 3.0, 2.0, step_s=0.3, per_frame=80)
    seen = matches(straight, straight.session.true, range(0, 6), 1)
    with pytest.raises(RecordingError, match="turns"):
        guessed_rig(first_rig(640, 480, 0.12), seen)


def test_too_few_matches_are_refused() -> None:
    with pytest.raises(RecordingError, match="too few to guess"):
        guessed_rig(first_rig(640, 480, 0.12), RawMatches(np.zeros((20, 4)), []))


def test_the_adjustment_finds_distortion_where_it_is_left_open(loop: Stretch) -> None:
    """Of a rig whose lenses are said to be ideal."""
    true = loop.session.true
    lens = np.array([-0.02, 0.004, 0.0, 0.0])
    rig = replace(true, cameras=tuple(replace(c, distortion=lens) for c in true.cameras))
    exact = [
        c.pixel_from_ray(c0.ray_from_pixel(px))
        for c, c0, px in zip(rig.cameras, true.cameras, (loop.left_px, loop.right_px), strict=True)
    ]
    data = measured(replace(loop, left_px=exact[0], right_px=exact[1]), true, 1)
    wide = np.array([0.3, 0.3, 1e-3, 1e-3] + [1e-2, 1e-2, 1e-3, 1e-3] + [15.0] * 2)
    found = adjust(replace(data, lens_sigmas=wide)).lens
    assert found[0] == pytest.approx(-0.02, abs=0.005)
    assert found[DISTORTION : 2 * DISTORTION] == pytest.approx(0.0, abs=0.01)


# `mapserver calibrate` over a recording with a damaged picture.


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


def test_the_other_cameras_of_a_rig_are_kept(tmp_path: Path, monkeypatch) -> None:
    """The first pair's baseline is 1 % longer; the file has all four cameras, the others as they were."""
    sample, front = make_sample(4), calibration(has_imu=False)
    turned = se3(np.diag([-1.0, -1.0, 1.0]), np.array([-0.3, 0.0, 0.0]))  # body_from_turned
    rear = tuple(replace(camera, body_from_cam=turned @ camera.body_from_cam) for camera in front.cameras)
    shown = [CameraFrame(int(s), a, b) for s, a, b in zip(sample.stamps_ns, sample.left, sample.right, strict=True)]
    frames = [replace(frame, others=(frame,)) for frame in shown]
    drive = write_kitti_raw(tmp_path / "drive", replace(front, cameras=(*front.cameras, *rear)), frames)
    unknown = {p: "" for p in COLUMNS if p is not CalibrationParameter.BASELINE}
    found = estimate(unknown=unknown, baseline=0.012)
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
    assert apart[1] == pytest.approx(1.012 * apart[0])


def test_exit_statuses(tmp_path: Path) -> None:
    assert status("mapserver", "calibrate") == 2
    assert status("mapserver", "calibrate", tmp_path / "none.mcap") == 3
    assert status("mapserver", "calibrate", tmp_path / "none.mcap", "--out", tmp_path / "no" / "o.yaml") == 2
    assert status("mapserver", "calibrate", tmp_path / "none.mcap", "--guess", "752:0.1") == 2
