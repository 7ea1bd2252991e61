"""What a build makes of a recording's calibration before it surveys."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from mapserver.calibration import CalibrationParameter
from mapserver.doctor import Finding, Verdict, sensors
from mapserver.doctor.calibration import MeasuredCalibration, findings_of
from mapserver.doctor.findings import not_judged
from mapserver.doctor.gyro_images import GyroFit
from mapserver.doctor.run_checks import CheckResults
from mapserver.drafting import admission
from support.recordings.recording_samples import make_sample, write_mcap
from support.worlds.calibration_scene import estimate

P = CalibrationParameter
Checked = Callable[..., admission.CheckedRecording]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    return open_recording(write_mcap(tmp_path_factory.mktemp("admission") / "r", make_sample(3)))


def measured(parameter: P, value: float) -> MeasuredCalibration:
    """Everything right, one parameter off."""
    found = estimate(**{parameter.name.lower(): value})
    return MeasuredCalibration(findings_of(found, 200.0), found)


@pytest.fixture
def checked(recording: Recording, monkeypatch) -> Checked:
    """The recording, checked by a doctor who measures `first`, and `again` after a correction."""

    def check(
        first: MeasuredCalibration, again: MeasuredCalibration, gyro: GyroFit | None = None, **metres: Any
    ) -> Any:
        checks = CheckResults(list(first.findings), gyro, first, metres)
        monkeypatch.setattr(admission, "run_checks", lambda *_, **__: checks)
        monkeypatch.setattr(admission, "measure_calibration", lambda *_: again)
        return admission.checked(recording)

    return check


def test_a_baseline_of_another_rig_is_refused(checked: Checked) -> None:
    off = measured(P.BASELINE, -0.0476)
    with pytest.raises(RecordingError, match=r"baseline: -4.76 % from the calibration.*a map of it would be wrong"):
        checked(off, off)


def test_a_small_error_is_corrected_and_said(recording: Recording, checked: Checked) -> None:
    found = checked(measured(P.FOCAL, -0.0196), measured(P.FOCAL, 0.0))
    given = recording.calibration.cameras[0].intrinsics_px[0]
    assert found.rig.cameras[0].intrinsics_px[0] == pytest.approx(0.9804 * given)
    assert found.corrections == {"focal length": -0.0196}
    assert "corrected: focal length by -1.96 %, as measured" in found.remarks()[-1]
    assert found.calibration.doubted == {}
    assert "metric scale" in found.calibration.judged


def gyro_fit(offset_s: float, stretches_s: Sequence[float] = (), correlation: float = 0.97) -> GyroFit:
    return GyroFit(offset_s, np.eye(3), 1.0, correlation, 3, np.eye(3), {}, np.array(stretches_s))


NOTHING, SAME, OTHER = MeasuredCalibration([], None), measured(P.TIME_OFFSET, -0.1038), measured(P.TIME_OFFSET, 0.0)


@pytest.mark.parametrize(
    ("calibration", "gyro", "corrected_s", "says"),
    [
        (NOTHING, gyro_fit(-0.1038), None, "-103.8 ms in one stretch of the drive only"),
        (NOTHING, gyro_fit(-0.1038, [-0.1038]), None, "-103.8 ms in one stretch of the drive only"),
        (NOTHING, gyro_fit(-0.1038, [-0.105, -0.101]), -0.1038, "corrected: time offset by -103.8 ms"),
        (NOTHING, gyro_fit(-0.1038, [-0.105, -0.101, -0.04]), None, ""),  # it drifts
        (OTHER, gyro_fit(-0.1038, [-0.105, -0.101]), None, "+0.0 ms by the adjustment, -103.8 ms by the gyro's turns"),
        (SAME, gyro_fit(-0.1038), -0.1038, "corrected: time offset by -103.8 ms"),
        (SAME, gyro_fit(0.0), None, "-103.8 ms by the adjustment, +0.0 ms by the gyro's turns"),
        (SAME, None, None, "-103.8 ms by the adjustment, nothing sure by the gyro's turns"),
        (OTHER, gyro_fit(-0.1038, correlation=0.7), None, ""),
        (OTHER, gyro_fit(0.0), None, ""),
    ],
)
def test_a_time_offset_is_corrected_if_two_say_the_same(
    checked: Checked, calibration: MeasuredCalibration, gyro: GyroFit | None, corrected_s: float | None, says: str
) -> None:
    found = checked(calibration, OTHER, gyro)
    assert found.corrections.get("time offset") == corrected_s
    assert found.rig.cameras[0].imu_minus_cam_s == pytest.approx(corrected_s or 0.0)
    assert says in " ".join(found.remarks()) and ("not corrected" in " ".join(found.remarks())) == bool(found.held)


@pytest.mark.parametrize("parameter", [P.BASELINE, P.FOCAL])
@pytest.mark.parametrize("metres", [None, 0.98, 1.0])
@pytest.mark.parametrize(("name", "sigma"), [("the wheels", 0.001), ("the accelerometer", 0.08)])
def test_a_correction_that_leaves_the_metres_of_another_sensor_is_not_made(
    recording: Recording, checked: Checked, parameter: P, metres: float | None, name: str, sigma: float
) -> None:
    known = {} if metres is None else {name: (metres, sigma)}
    found = checked(measured(parameter, -0.02), measured(parameter, 0.0), **known)
    is_denied = metres == 1.0 and sigma < 0.01  # a coarse one cannot tell
    assert (parameter.value in found.corrections, found.rig is recording.calibration) == (not is_denied, is_denied)
    assert ("metric scale" in found.calibration.doubted) == is_denied
    assert ("a metre of the images is 1.000 m by the wheels, not 0.980 m" in found.remarks()[-1]) == is_denied


def test_a_correction_that_the_second_look_denies_is_for_a_person(checked: Checked) -> None:
    found = checked(measured(P.PAIR_YAW, 0.003), measured(P.PAIR_YAW, 0.002))
    assert "after its correction" in found.calibration.doubted["pair geometry"]


def test_a_wrong_recording_is_refused_before_its_drive_is_followed(recording: Recording, monkeypatch) -> None:
    swapped = Finding("left and right", Verdict.FAIL, None, "", "the cameras are swapped")
    monkeypatch.setattr(sensors, "stamp_order", lambda _: swapped)
    checks = sys.modules[admission.run_checks.__module__]
    monkeypatch.setattr(checks, "measure_calibration", lambda *_: pytest.fail("was followed"))
    with pytest.raises(RecordingError, match="left and right: the cameras are swapped"):
        admission.checked(recording)


def test_checks_that_lack_the_same_are_one_remark(recording: Recording) -> None:
    short, turns = "too short: 5 keyframes, 20 are needed", "drive turns"
    chance = Finding("pair roll", Verdict.NOT_JUDGED, 0.002, "", f"not judged: +0.115 degrees; {short}", short)
    unknown = [not_judged(name, "known to 9 % only", short) for name in ("baseline", "focal length")]
    findings = [unknown[0], not_judged("pair yaw", "known to 1 degrees only", turns), unknown[1], chance]
    findings += [Finding("gyro axes", Verdict.OK, 0.0, "", ""), Finding("sharpness", Verdict.WARN, 0.3, "", "blurred")]
    found = admission.CheckedRecording(recording.calibration, findings, admission.rig_evidence("a", []), {})
    assert found.remarks() == [
        f"not judged: baseline, focal length: {short}",
        f"pair yaw: not judged: known to 1 degrees only; {turns}",
        f"pair roll: not judged: +0.115 degrees; {short}",  # one that was measured keeps its figure
        "sharpness: blurred",
    ]
    assert len(found.statements()) == 5  # a report has each


def test_a_good_calibration_is_left_alone(recording: Recording, checked: Checked) -> None:
    good = measured(P.BASELINE, 0.001)
    found = checked(good, good)
    assert found.rig is recording.calibration
    assert (found.corrections, found.remarks(), found.calibration.doubted) == ({}, [], {})
    assert found.statements() == []
    other = replace(recording.calibration, base_from_body=2 * np.eye(4))
    assert found.calibration.rig == admission.fingerprint(recording.calibration) != admission.fingerprint(other)
