"""Rigs of several views: cameras of a further pair, and its mounting against the first one, are checked by name."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings import OpenOptions, format_calibration, open_recording
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import CameraFrame, SensorSet
from fleetsim.recorder import Order, prepare
from mapserver.cli import app
from mapserver.doctor.camera_motion import motion_between
from mapserver.doctor.findings import Finding, Verdict
from mapserver.doctor.rig import check_mountings, check_rig, further_findings, judge_mounting, mounting_error
from support.recordings.painted_room import frame_at, frame_of_both, from_behind, rig, standing_first
from support.recordings.recording_samples import FRAME_NS
from support.recordings.rig_samples import write_rig
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, view

HALF_DEGREE = np.radians(0.5)
DEGREE_Z = np.array([0.0, 0.0, 2.0 * HALF_DEGREE])


def motions(
    rng: np.random.Generator, error: Array, *, turns: bool = True, has_ways: bool = True, count: int = 400
) -> list[tuple[Array, Array]]:
    """Steps of 20 cm and a few degrees by two views, each with noise of 2 mm and 0.4 mrad; some of the second are wrong altogether."""
    found = []
    for number in range(count):
        turn = np.array([0.0, 0.0, rng.normal(0.0, 0.06 if turns else 1e-5)])
        true = se3(so3_exp(turn), np.array([0.2, 0.0, 0.0]))
        seen = [true, se3_inverse(error) @ true @ error]
        seen = [m @ se3(so3_exp(rng.normal(0.0, 4e-4, 3)), rng.normal(0.0, 2e-3, 3)) for m in seen]
        if number % 15 == 0:
            seen[1] = se3(so3_exp(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 0.3, 3))
        if not has_ways:
            seen[1][:3, 3] = np.nan
        found.append((seen[0], seen[1]))
    return found


def test_errors_are_as_large_as_their_covariance_says() -> None:
    """Of 60 drives: the squared Mahalanobis distance of the true error has the mean of three degrees of freedom."""
    distances = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        turn = rng.normal(0.0, 0.02, 3)
        found = mounting_error(motions(rng, se3(so3_exp(turn), rng.normal(0.0, 0.02, 3)), count=100))
        off = found.turn_rad - turn
        distances.append(off @ np.linalg.solve(found.cov, off))
    assert 2.0 < np.mean(distances) < 4.5


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("degrees", [0.0, 0.5, -0.5, 30.0, 178.0])
def test_half_a_degree_between_two_pairs_is_found(axis: int, degrees: float) -> None:
    rng = np.random.default_rng(round(degrees) + 7 * axis + 400)
    error = se3(so3_exp(np.radians(degrees) * np.eye(3)[axis]), np.array([0.01, -0.02, 0.0]))
    found = judge_mounting("cam2 and cam3 against cam0 and cam1", mounting_error(motions(rng, error)))
    if degrees:
        assert found.verdict is (Verdict.WARN if abs(degrees) < 1 else Verdict.FAIL)
        assert found.value == pytest.approx(abs(degrees), abs=0.2)
    else:
        assert found.verdict is Verdict.OK


def test_what_a_drive_does_not_show_is_not_judged() -> None:
    """A single camera without a way, on the level: its turn about the vertical axis has no effect."""
    rng = np.random.default_rng(1)
    aside = se3(so3_exp(np.array([0.0, 0.0, HALF_DEGREE])), np.zeros(3))
    assert judge_mounting("cam2", mounting_error(motions(rng, aside, has_ways=False))).verdict is Verdict.NOT_JUDGED
    straight = mounting_error(motions(rng, np.eye(4), turns=False))
    assert judge_mounting("cam2", straight).verdict is Verdict.NOT_JUDGED, "a roll about the way"
    assert judge_mounting("cam2", mounting_error(motions(rng, np.eye(4), count=10))).verdict is Verdict.NOT_JUDGED


STAMPS_NS = range(2_000_000_000, 4_500_000_000, FRAME_NS)


RIDE = standing_first()


@lru_cache(maxsize=1)
def ride() -> tuple[RigCalibration, list[CameraFrame]]:
    """A ride in the box room with a pair in front and one behind, without an IMU."""
    return rig(SensorSet.STEREO, has_rear=True), [frame_of_both(RIDE, stamp) for stamp in STAMPS_NS]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig") / "ride.mcap", *ride())


def with_turned(calibration: RigCalibration, numbers: tuple[int, ...], turn: Array = DEGREE_Z) -> RigCalibration:
    """Cameras turned in their place."""
    off = se3(so3_exp(turn), np.zeros(3))
    middle = se3(np.eye(3), np.mean([calibration.cameras[n].body_from_cam[:3, 3] for n in numbers], axis=0))
    turned = middle @ off @ se3_inverse(middle)
    cameras = list(calibration.cameras)
    for n in numbers:
        cameras[n] = replace(cameras[n], body_from_cam=turned @ cameras[n].body_from_cam)
    return replace(calibration, cameras=tuple(cameras))


@pytest.mark.parametrize("turned", [(), (2, 3)])
def test_a_rear_pair_turned_by_a_degree_is_named(recorded: Path, tmp_path: Path, turned: tuple[int, ...]) -> None:
    (tmp_path / "cams.yaml").write_text(format_calibration(with_turned(ride()[0], turned) if turned else ride()[0]))
    with open_recording(recorded, OpenOptions(tmp_path / "cams.yaml")) as recording:
        (found,) = check_mountings(recording)
    assert found.name == "cam2 and cam3 against cam0 and cam1"
    assert found.verdict is (Verdict.WARN if turned else Verdict.OK), found.sentence


@pytest.mark.parametrize("turned", [(), (2,)])
def test_a_depth_camera_behind_is_checked_and_its_mounting_named(tmp_path: Path, turned: tuple[int, ...]) -> None:
    calibration, frames = ride()
    rear = replace(calibration.cameras[2], has_depth=True)
    rig_of_both = replace(calibration, cameras=(*calibration.cameras[:2], rear))
    rig_of_both = with_turned(rig_of_both, turned) if turned else rig_of_both
    with McapRecordingWriter(tmp_path / "ride.mcap", rig_of_both) as writer:
        for frame, stamp_ns in zip(frames, STAMPS_NS, strict=True):
            behind = frame_at(from_behind(RIDE), stamp_ns, SensorSet.RGBD)
            writer.write_frame(replace(frame, others=(behind,)))
    with open_recording(tmp_path / "ride.mcap") as recording:
        found = {finding.name: finding for finding in check_rig(recording)}
    assert found["depth of cam2"].verdict is Verdict.OK, found["depth of cam2"].sentence
    mounting = found["cam2 against cam0 and cam1"]
    assert mounting.verdict is (Verdict.WARN if turned else Verdict.OK), mounting.sentence


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_a_straight_drive_does_not_turn_a_right_mounting(tmp_path: Path, seed: int) -> None:
    """What a camera sees there is the same for seconds, and so is the error of its motion; a mounting that is quite wrong is found."""
    session = prepare(Order("small-loop", seed=seed, frames=80, size_px=(320, 240), rig="front-rear"))
    try:
        file = write_rig(tmp_path / "drive.mcap", replace(session.nominal, imu=None), session.frames())
    finally:
        session.renderer.close()
    for turn in (np.zeros(3), np.radians([0.0, 6.0, 0.0])):
        wrong = with_turned(replace(session.nominal, imu=None), (2, 3), turn)
        (tmp_path / "cams.yaml").write_text(format_calibration(wrong))
        with open_recording(file, OpenOptions(tmp_path / "cams.yaml")) as recording:
            (found,) = check_mountings(recording)
        assert found.verdict is (Verdict.WARN if turn.any() else Verdict.NOT_JUDGED), found.sentence


def test_a_view_with_another_lens_is_named(recorded: Path, tmp_path: Path) -> None:
    calibration = ride()[0]
    wide = [replace(c, intrinsics_px=c.intrinsics_px * [0.5, 0.5, 1, 1]) for c in calibration.cameras[2:]]
    other = replace(calibration, cameras=(*calibration.cameras[:2], *wide))
    (tmp_path / "cams.yaml").write_text(format_calibration(other))
    with open_recording(recorded, OpenOptions(tmp_path / "cams.yaml")) as recording:
        few = recording.part(np.arange(0, len(recording), 8))
        found = {finding.name: finding for finding in further_findings(few)}
    assert found["field of view of cam2 and cam3"].verdict is Verdict.WARN
    assert "use a lens alike" in found["field of view of cam2 and cam3"].sentence


def test_the_doctor_names_the_pair_whose_images_are_exchanged(tmp_path: Path) -> None:
    calibration, frames = ride()
    with McapRecordingWriter(tmp_path / "ride.mcap", calibration) as writer:
        for frame in frames[::4]:
            (rear,) = frame.others
            assert rear is not None and rear.right is not None
            writer.write_frame(replace(frame, others=(replace(rear, left=rear.right, right=rear.left),)))
    ride_file = str(tmp_path / "ride.mcap")
    done = CliRunner().invoke(app, ["doctor", ride_file, "--json", "-"])
    assert done.exit_code == 3
    findings = {f["name"]: Finding(**f) for f in json.loads(done.stdout)["findings"]}
    assert findings["left and right"].verdict == "ok"
    assert findings["left and right of cam2 and cam3"].verdict == "fail"
    assert "camera rate of cam2 and cam3" in findings
    built = CliRunner().invoke(app, ["build", ride_file, "--site", "s", "--store", str(tmp_path / "s")])
    assert isinstance(built.exception, RecordingError)
    assert "left and right of cam2 and cam3" in str(built.exception)


# The camera's turn between two frames, by the images of one camera, where the essential matrix says little.

SINGLE = replace(CAMERA, baseline_m=0.0)


@pytest.mark.parametrize("way_m", [0.0, 0.002, 0.05])
def test_one_camera_that_hardly_moves_does_not_turn_round(way_m: float) -> None:
    turn = so3_exp(np.array([0.004, -0.01, 0.006]))
    there = BODY_FROM_CAM @ se3(turn if way_m else np.eye(3), np.array([way_m, 0.0, 0.0]))
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pictures = [view(place) for place in (BODY_FROM_CAM, there)]
        noisy = [np.clip(each + rng.normal(0.0, 2.0, each.shape), 0, 255).astype(np.uint8) for each in pictures]
        before, after = (RectifiedFrame(stamp, picture, None, None) for stamp, picture in enumerate(noisy))
        found, _ = motion_between(before, after, SINGLE)
        expected = turn if way_m else np.eye(3)
        assert np.linalg.norm(so3_log(expected.T @ found[:3, :3])) < 0.02
