"""The doctor finds each fault that is put into a recording, and nothing in a good one."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import so3_exp
from fleetmap.recordings import Recording, format_calibration, open_recording, read_calibration
from fleetmap.recordings.sensor_subset import reduced
from fleetmap.sensors.samples import CameraFrame, DataIssue, ImuSamples, SensorSet, Stamps
from mapserver.calibration import CalibrationParameter
from mapserver.doctor import Finding, Verdict, run_checks
from mapserver.doctor.camera_motion import CameraTurns, body_motion
from mapserver.doctor.findings import grouped, not_judged, summary
from mapserver.doctor.gyro_images import fit_gyro, gyro_check
from mapserver.doctor.images import flicker_check, sharpness
from mapserver.doctor.metres import ImageMetres, judge_metres
from mapserver.doctor.run_checks import TURN_FRAMES, _ByTurns, _Frames
from mapserver.doctor.sensors import (
    camera_checks,
    camera_imu_overlap,
    gravity_magnitude,
    imu_checks,
    rolling_shutter,
    stamp_order,
)
from support.recordings.realdata import real_data
from support.recordings.recording_samples import make_sample, write_euroc, write_mcap
from support.recordings.spoiled_recording import changed

SAMPLE = make_sample(26)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Recording:
    return open_recording(write_mcap(tmp_path_factory.mktemp("doctor") / "r", SAMPLE))


def found(recording: Recording) -> dict[str, Finding]:
    return {finding.name: finding for finding in run_checks(recording).findings}


@pytest.fixture(scope="module")
def turns(good: Recording) -> CameraTurns:
    """What the pictures of the good recording say about its turns."""
    frames = _Frames(good, lambda: None)
    return CameraTurns.of(body_motion(frames.rig, pair) for pair in frames.consecutive(TURN_FRAMES))


def gyro_found(turns: CameraTurns, imu: ImuSamples) -> dict[str, Finding]:
    """As `found`, the findings about the gyro alone."""
    return {finding.name: finding for finding in gyro_check(turns, imu, 0.0)[0]}


def test_a_good_recording_is_all_ok(good: Recording) -> None:
    findings = run_checks(good).findings
    bad = {f.name: f.verdict for f in findings if f.verdict is not Verdict.OK}
    assert set(bad.values()) == {Verdict.NOT_JUDGED}
    assert "baseline" in bad  # a second of turning on the spot excites no accelerometer
    assert len({f.name for f in findings}) == len(findings) == 21 + len(CalibrationParameter)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("epipolar error", lambda f: replace(f, right=np.roll(f.right, 3, axis=0)), "calibrate the cameras again"),
        ("sharpness", lambda f: replace(f, left=np.full_like(f.left, 90)), "check the lens"),
    ],
)
def test_faults_in_the_images(
    good: Recording, name: str, change: Callable[[CameraFrame], CameraFrame], says: str
) -> None:
    finding = found(changed(good, change))[name]
    assert finding.verdict is Verdict.FAIL
    assert says in finding.sentence
    if name == "epipolar error":
        assert finding.value == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(("line_delay_s", "verdict"), [(1e-6, Verdict.OK), (1e-4, Verdict.WARN)])
def test_a_rolling_shutter_is_said_as_far_as_it_is_known(
    good: Recording, tmp_path: Path, line_delay_s: float, verdict: Verdict
) -> None:
    """Kalibr's line_delay; not a word of a shutter that nobody told of."""
    camera = good.calibration.cameras[0]
    assert rolling_shutter(camera, good.imu) == []
    rig = replace(good.calibration, cameras=(replace(camera, line_delay_s=line_delay_s),))
    (path := tmp_path / "rig.yaml").write_text(format_calibration(rig))
    read = read_calibration(path).cameras[0]
    assert read.line_delay_s == line_delay_s
    (finding,) = rolling_shutter(read, good.imu)
    assert finding.verdict is verdict
    assert f"within {line_delay_s * camera.height_px * 1e3:.1f} ms" in finding.sentence
    assert "not corrected" in finding.sentence
    path.write_text(format_calibration(rig).replace(f"line_delay: {line_delay_s!r}", "line_delay: 33.0"))
    with pytest.raises(CalibrationError, match="line_delay is 33 s"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("share", "bands", "verdict"),
    [(0.0, 0, Verdict.OK), (0.1, 0, Verdict.WARN), (0.2, 0, Verdict.FAIL), (0.2, 2, Verdict.WARN)],
)
def test_light_that_flickers_is_named(good: Recording, share: float, bands: int, verdict: Verdict) -> None:
    """Every other frame is darker; or, with a rolling shutter, stripes of it wander."""

    def lit(frame: CameraFrame) -> CameraFrame:
        number = int(np.searchsorted(good.frame_stamps_ns, frame.stamp_ns))
        rows = np.arange(frame.left.shape[0])[:, None] / frame.left.shape[0]
        wave = np.sin(2 * np.pi * (0.4 * number + bands * rows)) if bands else (-1.0) ** number
        return replace(frame, left=np.clip(frame.left * (1 + share * wave), 0, 255).astype(np.uint8))

    flickering = changed(good, lit)
    finding = flicker_check(flickering, flickering.read_frame)
    assert finding.verdict is verdict, finding
    assert ("10 ms with 50 Hz mains" in finding.sentence) == (verdict is not Verdict.OK)


@pytest.mark.parametrize("late_s", [-0.040, 0.030])
def test_late_imu_stamps_are_measured(good: Recording, turns: CameraTurns, late_s: float) -> None:
    late = replace(good.imu, stamps_ns=good.imu.stamps_ns + round(late_s * 1e9))
    finding = gyro_found(turns, late)["camera-imu time offset"]
    assert finding.verdict is Verdict.FAIL
    assert finding.value == pytest.approx(abs(late_s) * 1e3, abs=1.5)


def test_a_calibrated_offset_is_not_a_fault(good: Recording, turns: CameraTurns) -> None:
    """imu_minus_cam_s: stamp of the IMU's clock minus stamp of the camera's clock at one moment."""
    late_s = 0.030
    late = replace(good.imu, stamps_ns=good.imu.stamps_ns + round(late_s * 1e9))
    cameras = tuple(replace(camera, imu_minus_cam_s=late_s) for camera in good.calibration.cameras)
    assert gyro_found(turns, late)["camera-imu time offset"].verdict is Verdict.FAIL, "the control"
    calibrated = replace(good, imu=late, calibration=replace(good.calibration, cameras=cameras))
    assert found(calibrated)["camera-imu time offset"].verdict is Verdict.OK


@pytest.mark.parametrize(
    ("change", "name", "says"),
    [
        (np.diag([-1.0, -1.0, 1.0]), "gyro axes", "wrong sign on its x and y axis"),
        (so3_exp(np.array([0.0, 0.35, 0.0])), "gyro axes", "20.0 degrees|20.1 degrees|19.9 degrees"),
        (1.5 * np.eye(3), "gyro scale", "1.50|1.49|1.51"),
    ],
)
def test_a_gyro_that_turns_otherwise(
    good: Recording, turns: CameraTurns, change: np.ndarray, name: str, says: str
) -> None:
    """Negated, exchanged and in degrees it is in test_contradictions."""
    finding = gyro_found(turns, replace(good.imu, gyro_radps=good.imu.gyro_radps @ change.T))[name]
    assert finding.verdict is Verdict.FAIL
    assert any(part in finding.sentence for part in says.split("|"))


def test_sparse_frames_are_not_judged(good: Recording) -> None:
    sparse = replace(good, frame_stamps_ns=good.frame_stamps_ns[0] + 2_000_000_000 * np.arange(len(good)))
    findings = found(sparse)
    for name in ("camera rate", "camera gaps", "camera-imu time offset", "gyro axes"):
        assert findings[name].verdict is Verdict.NOT_JUDGED
        assert "record every frame" in findings[name].missing
    assert "frames are 2.00 s apart" in findings["camera rate"].sentence


def test_unreadable_frames_are_a_finding(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", make_sample(3), image_type="jpg")
    image = folder / "mav0/cam1/data/image1.jpg"
    data = image.read_bytes()
    image.write_bytes(data[: len(data) // 3] + data[len(data) // 2 :])  # whole by its first and last bytes
    finding = found(open_recording(folder))["images"]
    assert finding.verdict is Verdict.FAIL
    assert finding.sentence.startswith("1 of 3 cannot be read")  # however often it was looked at
    assert "image1.jpg" in finding.sentence
    frames = _Frames(open_recording(folder), lambda: None)
    with pytest.raises(RecordingError):
        frames.recording.read_frame(1)
    assert frames.errors.keys() == {1}, "what only the odometry reads is noted, too"


def stamps(step_s: float, count: int = 200) -> Stamps:
    return (np.arange(count) * step_s * 1e9).astype(np.int64)


GAP = np.delete(stamps(0.05), slice(50, 80))
HOURS = stamps(0.05) + np.where(np.arange(200) < 100, 0, 5 * 3600 * 10**9)


@pytest.mark.parametrize(
    ("finding", "verdict", "value", "says"),
    [
        (camera_checks(stamps(0.05))[0], Verdict.OK, 20.0, "20.0 Hz"),
        (camera_checks(stamps(0.3))[0], Verdict.WARN, 3.33, "higher frame rate"),
        (camera_checks(stamps(0.05))[1], Verdict.OK, 0.05, "longest step is 0.050 s"),
        (camera_checks(GAP)[1], Verdict.WARN, 31 * 0.05, "2.5 s after the start; check the recorder's disk"),
        (camera_checks(HOURS)[1], Verdict.FAIL, 18000.05, "5.0 s after the start; the recorder was paused"),
        (imu_checks(stamps(0.02))[0], Verdict.WARN, 50.0, "set the IMU to 200 Hz"),
        (imu_checks(np.delete(stamps(0.005), slice(50, 100)))[1], Verdict.FAIL, 0.255, "the driver's queue"),
        (stamp_order([DataIssue("imu: stamps not increasing", "3 of 9")]), Verdict.FAIL, 1.0, "check for a clock"),
        (camera_imu_overlap(stamps(0.05), stamps(0.005), 0.0), Verdict.FAIL, 0.895, "of the frames have no IMU"),
        (camera_imu_overlap(stamps(0.05), stamps(0.005, 2000), 0.0), Verdict.OK, 0.0, "the IMU covers"),
    ],
)
def test_timing(finding: Finding, verdict: Verdict, value: float, says: str) -> None:
    assert (finding.verdict, finding.value) == (verdict, pytest.approx(value, rel=1e-2))
    assert says in finding.sentence


@pytest.mark.parametrize(("has_imu", "missing"), [(True, "start, stop and turn more often"), (False, "record an IMU")])
def test_metres_that_nothing_tells_ask_for_what_is_missing(has_imu: bool, missing: str) -> None:
    _, metres = judge_metres(None, None, ImageMetres(0.11, 2.0, 0.5), has_imu=has_imu)
    assert metres.verdict is Verdict.NOT_JUDGED
    assert metres.missing.startswith(missing)


@pytest.mark.parametrize(("magnitude", "verdict"), [(9.81, Verdict.OK), (9.4, Verdict.WARN), (12.0, Verdict.FAIL)])
def test_gravity(magnitude: float, verdict: Verdict) -> None:
    rng = np.random.default_rng(6)
    accel = np.array([0.0, 0.0, magnitude]) + 0.05 * rng.standard_normal((1000, 3))
    accel[300:600] += 4 * rng.standard_normal((300, 3))  # a bumpy stretch does not matter
    finding = gravity_magnitude(ImuSamples(stamps(0.005, 1000), np.zeros((1000, 3)), accel))
    assert (finding.verdict, finding.value) == (verdict, pytest.approx(magnitude, abs=0.05))


def test_sharpness_knows_blurred_stretches() -> None:
    assert sharpness([100.0] * 20).verdict is Verdict.OK
    assert sharpness([100.0] * 13 + [5.0] * 7).verdict is Verdict.WARN


def shaken(axes: int) -> tuple[CameraTurns, ImuSamples]:
    """Ten seconds of turns about z, or about all axes, that 198 intervals of 50 ms show as the gyro feels them."""
    imu_stamps = stamps(0.005, 2000)
    times = imu_stamps * 1e-9
    gyro = np.stack([0.5 * np.sin((1.3 + k) * times) + 0.3 * np.cos((3.1 + k) * times) for k in range(3)], axis=1)
    gyro[:, : 3 - axes] = 0.0
    first = np.arange(10, 1990, 10)
    rates = np.stack([0.05 * gyro[k : k + 10].mean(axis=0) / 0.05 for k in first])
    rates += 1e-3 * np.random.default_rng(8).standard_normal(rates.shape)
    turns = CameraTurns(imu_stamps[first], imu_stamps[first] + 50_000_000, rates, np.full(rates.shape, np.nan))
    return turns, ImuSamples(imu_stamps, gyro, np.zeros((2000, 3)))


def test_a_robot_that_turns_about_one_axis_only() -> None:
    """Nothing is said about axes that never turned; a wrong sign of the one that did is found."""
    turns, imu = shaken(1)
    fit = fit_gyro(turns, imu, 0.0)
    assert fit.axes_seen == 1
    np.testing.assert_allclose(fit.body_from_gyro, np.eye(3), atol=0.01)
    wrong = fit_gyro(replace(turns, rates_body_radps=-turns.rates_body_radps), imu, 0.0)
    assert wrong.body_from_gyro[2, 2] == pytest.approx(-1, abs=0.01)
    assert wrong.offset_s == pytest.approx(0, abs=0.003)


@pytest.mark.parametrize(("sigma_radps", "verdict"), [(0.0015, Verdict.OK), (0.01, Verdict.FAIL)])
def test_slow_errors_of_a_gyro_are_no_other_drive(sigma_radps: float, verdict: Verdict) -> None:
    """On an even floor a low-passed gyro turns by nothing else about its quiet axes."""
    turns, imu = shaken(1)
    turns.ways_m[:] = 0.0
    imu.gyro_radps[:, 0] += 1.4 * sigma_radps * np.sin(30e-9 * imu.stamps_ns)
    assert gyro_found(turns, imu)["gyro axes"].verdict is verdict


@pytest.mark.parametrize("axes", [1, 3])
def test_a_person_before_the_cameras_is_no_fault_of_the_gyro(axes: int) -> None:
    """Two fifths of the run the images show somebody who stands still before them."""
    turns, imu = shaken(axes)
    turns.rates_body_radps[60:139] *= 0.02
    findings, fit = gyro_check(turns, imu, 0.0)
    assert {finding.verdict for finding in findings} == {Verdict.OK}
    assert fit is not None and fit.is_sure and fit.offset_s == pytest.approx(0.0, abs=0.004)


def test_stamps_that_move_within_the_run_are_no_time_offset() -> None:
    """For four seconds of ten images are stamped 50 ms late: no timeshift is right for all."""
    turns, imu = shaken(3)
    late = slice(100, 180)
    moved = replace(turns, starts_ns=turns.starts_ns.copy(), ends_ns=turns.ends_ns.copy())
    moved.starts_ns[late] += 50_000_000
    moved.ends_ns[late] += 50_000_000
    findings, fit = gyro_check(moved, imu, 0.0)
    offset = findings[0]
    assert fit is not None and (offset.verdict, fit.is_sure, fit.is_unsteady) == (Verdict.FAIL, False, True)
    assert offset.value == pytest.approx(50.0, abs=4.0)
    assert "stamp both by one clock" in offset.sentence
    assert "timeshift_cam_imu" not in offset.sentence
    assert {finding.verdict for finding in findings[1:]} == {Verdict.OK}
    assert _ByTurns(moved, findings, fit, findings[1], None).is_unsteady


def test_the_command_writes_json_and_ends_with_3_on_failure(run, tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    run("doctor", folder, "--json", tmp_path / "good.json")
    report = json.loads((tmp_path / "good.json").read_text())
    assert (report["verdict"], report["frames"], report["sensor_set"]) == ("not judged", 26, "stereo-inertial")
    missing = {f["name"]: f["missing"] for f in report["findings"] if f["verdict"] == "not judged"}
    assert "record wheel odometry" in missing["baseline"]
    assert missing["baseline"].startswith("too short: ")  # all that it lacks is said
    assert {f["name"] for f in report["findings"]} >= {"epipolar error", "gyro axes", "gravity magnitude"}
    for number in (0, 1):
        (folder / f"mav0/cam{number}/data").rename(folder / f"mav0/cam{number}/was")
    (folder / "mav0/cam0/was").rename(folder / "mav0/cam1/data")
    (folder / "mav0/cam1/was").rename(folder / "mav0/cam0/data")
    run("doctor", folder, "--json", tmp_path / "bad.json", status=3)
    report = json.loads((tmp_path / "bad.json").read_text())
    (swapped,) = (f for f in report["findings"] if f["name"] == "left and right")
    assert swapped["verdict"] == "fail" and "swapped" in swapped["sentence"]


@pytest.mark.parametrize(
    "name", ["euroc_v101_keyframes", "kitti_stereo_51", "tumvi_room1_fisheye_8", "7scenes_redkitchen_200"]
)
def test_no_false_alarm_on_real_recordings(name: str) -> None:
    findings = run_checks(open_recording(real_data(name))).findings
    assert [f for f in findings if f.verdict is Verdict.FAIL] == []
    assert {f.name for f in findings if f.verdict is Verdict.WARN} <= {"lost data"}


def test_the_focal_length_is_not_doubted_for_the_lens() -> None:
    """MH_01's distortion is off by ten of the sigmas of a good board: without an IMU the focal length took it up, by 1.2 %."""
    recording = reduced(open_recording(real_data("euroc_mh01_start")), SensorSet.STEREO)
    focal = found(recording)["focal length"]
    assert focal.verdict is Verdict.NOT_JUDGED
    assert "record one" in focal.missing


def test_the_real_flight_agrees_with_its_calibration() -> None:
    findings = found(open_recording(real_data("euroc_mh01_start")))
    assert {f.verdict for f in findings.values()} == {Verdict.OK, Verdict.NOT_JUDGED}
    unjudged = {name: f for name, f in findings.items() if f.verdict is Verdict.NOT_JUDGED}
    assert unjudged.keys() == {"wheels", "wheel scale", "baseline"}
    assert unjudged["wheel scale"].missing == "there is no wheel odometry"
    assert "that may be chance" in unjudged["baseline"].sentence  # fifteen seconds: beyond its limit, and not for sure
    assert unjudged["baseline"].value == pytest.approx(0, abs=0.01)
    assert findings["camera-imu time offset"].value == pytest.approx(0, abs=2)
    assert findings["gyro scale"].value == pytest.approx(1, abs=0.02)
    assert findings["gyro axes"].value == pytest.approx(0, abs=1.5)


def test_findings_in_one_line_and_those_that_lack_the_same_in_one_row() -> None:
    good, bad = Finding("images", Verdict.OK, 0.0, "", "whole"), Finding("depth", Verdict.FAIL, 1.0, "", "none")
    lacking = [not_judged(name, "0 inertial samples", "record an IMU") for name in ("imu rate", "gyro axes")]
    known = replace(not_judged("baseline", "+1 %", "record an IMU"), value=0.01)
    assert summary([good, good, *lacking], {"depth"}) == "2 ok, 2 not judged: good enough to build"
    assert summary([good, *lacking], set()).startswith("1 ok, 2 not judged: nothing is known to be wrong")
    assert "`mapserver build` refuses it: depth" in summary([good, bad], {"depth"})
    assert summary([good, bad], set()) == "1 ok, 1 fail: not good enough: depth"
    assert [([f.name for f in same], words) for same, words in grouped([good, *lacking, known])] == [
        (["images"], "whole"),
        (["imu rate", "gyro axes"], "not judged: record an IMU"),
        (["baseline"], known.sentence),
    ]
