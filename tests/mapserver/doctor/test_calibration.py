"""Verdicts on measured calibrations, and what a build makes of them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import numpy as np
import pytest

from fleetmap.errors import FleetmapError, StoreError, SurveyError
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.rectification import Rectifier
from mapserver.calibration import CalibrationEstimate, CalibrationParameter, ParameterEstimate, recordings
from mapserver.calibration.parameters import COLUMNS
from mapserver.doctor import Verdict
from mapserver.doctor.calibration import MeasuredCalibration, corrected, findings_of, in_words, measure_calibration
from mapserver.drafting.admission import rig_evidence
from support.recordings.realdata import real_data
from support.recordings.recording_samples import calibration
from support.worlds.calibration_scene import estimate

P = CalibrationParameter
FOCAL_PX = 420.0


def measured(found: CalibrationEstimate) -> MeasuredCalibration:
    return MeasuredCalibration(findings_of(found, FOCAL_PX), found)


def verdicts(found: CalibrationEstimate) -> dict[str, Verdict]:
    return {f.name: f.verdict for f in findings_of(found, FOCAL_PX) if f.verdict is not Verdict.OK}


@pytest.mark.parametrize("parameter", [p for p in COLUMNS if np.isfinite(p.fail_above)])
def test_an_error_that_costs_3_cm_warns_and_that_of_another_rig_fails(parameter: P) -> None:
    """Three sigmas come off first: what is not sure is no fault."""
    beside = 0.4 / FOCAL_PX if parameter.unit == "rad" else 0.0
    slack = 3.0 * float(np.hypot(0.1 * parameter.warn_above, parameter.least_sigma)) + 3.0 * beside
    name = parameter.name.lower()
    assert parameter.value not in verdicts(estimate(**{name: 0.99 * parameter.warn_above}))
    assert verdicts(estimate(**{name: -1.01 * parameter.warn_above - slack}))[parameter.value] is Verdict.WARN
    assert verdicts(estimate(**{name: 1.01 * parameter.fail_above + slack}))[parameter.value] is Verdict.FAIL


def test_noise_is_told_in_multiples_of_the_data_sheet() -> None:
    noise = ParameterEstimate(P.GYRO_NOISE, 3.3, 0.1, True)
    (told,) = findings_of(replace(estimate(), parameters=(noise,)), FOCAL_PX)
    assert told.sentence.startswith("4.3 times the data sheet")


def test_a_dear_error_that_may_be_chance_is_neither_ok_nor_a_fault() -> None:
    """One percent of baseline, 10 cm of 10 m, two and a half sigmas from nothing."""
    sigma = np.hypot(0.1 * 0.003, P.BASELINE.least_sigma)
    (finding,) = [f for f in findings_of(estimate(baseline=-0.003 - 2.5 * sigma), FOCAL_PX) if f.name == "baseline"]
    assert finding.verdict is Verdict.NOT_JUDGED
    assert "that may be chance" in finding.sentence
    assert "turns" in finding.missing


@pytest.mark.parametrize(
    ("off", "is_enough"),
    [({"principal_x": 3.5}, True), ({"principal_x": 6.5}, False), ({"principal_x": 3.5, "baseline": 0.02}, False)],
    ids=["near enough", "in doubt", "something else wrong"],
)
def test_frames_are_followed_again_only_where_that_may_change_a_verdict(
    off: dict[str, float], is_enough: bool, monkeypatch
) -> None:
    """A principal point that moved by 3.5 px is none that a robot would notice, and the recording is used as it is."""
    turned = {"camera_imu_y": off["principal_x"] / Rectifier(calibration()).camera.focal_px}  # which looks the same
    follow = Mock()
    monkeypatch.setattr(recordings, "estimate_from", lambda _: estimate(**off, **turned))
    stamps_ns = np.arange(100, dtype=np.int64) * 50_000_000
    recording = cast(Recording, SimpleNamespace(frame_stamps_ns=stamps_ns, calibration=calibration(), path="drive"))
    measure_calibration(recording, follow)
    assert (follow.call_count == 1) == is_enough
    recordings.estimate_calibration([recording], follow)
    assert follow.call_count > 2, "who writes the calibration wants the best one"


def test_an_error_far_beyond_a_coarse_sigma_is_found_and_not_corrected() -> None:
    """Twenty percent of baseline, known to half a percent: for sure wrong, too coarse to be mended."""
    found = estimate(baseline=-0.17)
    coarse = tuple(replace(p, sigma=0.005) if p.name is P.BASELINE else p for p in found.parameters)
    (failed,) = [f for f in findings_of(replace(found, parameters=coarse), FOCAL_PX) if f.name == "baseline"]
    assert failed.verdict is Verdict.FAIL
    nearer = tuple(replace(p, estimate=-0.025) if p.name is P.BASELINE else p for p in coarse)
    warned = measured(replace(found, parameters=nearer))
    assert verdicts(replace(found, parameters=nearer))["baseline"] is Verdict.WARN
    assert warned.wrong() == []
    assert set(rig_evidence("a1", warned.findings).doubted) == {"metric scale"}
    alike = tuple(replace(p, estimate=0.001) if p.name is P.BASELINE else p for p in coarse)
    assert verdicts(replace(found, parameters=alike))["baseline"] is Verdict.NOT_JUDGED


def test_a_shifted_principal_point_that_looks_like_a_turn_is_no_turn() -> None:
    assert P.CAMERA_IMU_Y.value not in verdicts(estimate(camera_imu_y=-0.0137, principal_x=-5.4))
    assert verdicts(estimate(camera_imu_y=-0.0137))[P.CAMERA_IMU_Y.value] is Verdict.WARN


def test_what_is_wrong_is_corrected_and_the_rest_kept() -> None:
    rig = calibration()
    fixed, done = corrected(rig, measured(estimate(baseline=-0.0165, pair_yaw=0.0001)))
    assert done == {"baseline": -0.0165}
    before, after = (np.linalg.inv(r.cameras[0].body_from_cam) @ r.cameras[1].body_from_cam for r in (rig, fixed))
    np.testing.assert_allclose(after[:3, 3], before[:3, 3] * (1 - 0.0165), atol=1e-9)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-9)
    assert in_words("baseline", done["baseline"]) == "-1.65 %"
    assert in_words("pair yaw", 0.00349) == "+0.200 degrees"
    assert corrected(rig, measured(estimate())) == (rig, {})


def test_subjects_are_judged_by_all_of_their_parameters() -> None:
    ways = {P.BASELINE: "record wheel odometry"}
    lacking = rig_evidence("a1", findings_of(estimate(unknown=ways), FOCAL_PX))
    assert lacking.not_judged == {"metric scale": "record wheel odometry"}
    assert lacking.judged == ["pair geometry"]
    conflict = rig_evidence("a1", findings_of(estimate(pair_yaw=0.003), FOCAL_PX))
    assert set(conflict.doubted) == {"pair geometry"}
    assert conflict.judged == ["metric scale"]


@pytest.mark.parametrize("error", [StoreError("the disk is full"), SurveyError("it is dark")])
def test_only_what_the_frames_lack_is_not_judged(error: FleetmapError) -> None:
    follow = Mock(side_effect=error)
    stamps_ns = np.arange(100, dtype=np.int64) * 50_000_000
    recording = cast(Recording, SimpleNamespace(frame_stamps_ns=stamps_ns, calibration=calibration(), path="drive"))
    if isinstance(error, StoreError):
        with pytest.raises(StoreError, match="the disk is full"):
            measure_calibration(recording, follow)
    else:
        assert "it is dark" in measure_calibration(recording, follow).findings[0].sentence


def test_keyframes_alone_are_not_judged() -> None:
    recording = open_recording(real_data("euroc_v101_keyframes"))
    found = measure_calibration(recording, lambda *_: pytest.fail("was followed"))
    assert {f.verdict for f in found.findings} == {Verdict.NOT_JUDGED}
    assert all("record every frame" in f.missing for f in found.findings)
    assert found.wrong() == []
    assert corrected(recording.calibration, found) == (recording.calibration, {})
