"""A real drive is admitted with the findings of its own pictures, and a copy with a fault is refused in the same words, early or late."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from mapserver.drafting.admission import CheckedRecording, checked
from mapserver.drafting.survey_recordings import BegunSurvey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools
from support.recordings.calibration_faults import swapped
from support.recordings.realdata import real_data
from support.recordings.spoiled_recording import imu, with_clock_shift

X, Y = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])


def wider(recording: Recording) -> Recording:
    rig = recording.calibration
    cameras = tuple(replace(c, intrinsics_px=c.intrinsics_px * [1.25, 1.25, 1.0, 1.0]) for c in rig.cameras)
    return replace(recording, calibration=replace(rig, cameras=cameras))


def admitted(change: Callable[[Recording], Recording]) -> CheckedRecording:
    recording = change(open_recording(real_data("euroc_mh01_start")))
    follow = BegunSurvey(recording, np.arange(len(recording)), SurveySettings(), SurveyTools())
    return checked(recording, follow=follow)


def test_a_sound_drive_has_nothing_to_warn_of() -> None:
    found = admitted(lambda recording: recording)
    assert Counter(f.verdict for f in found.findings) == {"ok": 38, "not judged": 3}
    assert not found.corrections


def test_a_clock_that_is_late_is_warned_of_and_corrected() -> None:
    found = admitted(partial(with_clock_shift, shift_s=0.02))
    assert {f.name for f in found.findings if f.verdict == "warn"} == {"camera-imu time offset", "time offset"}
    assert found.corrections == {"time offset": pytest.approx(0.02, abs=5e-4)}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (imu(gyro=Y), "gyro axes: the gyro has the wrong sign on its y axis"),
        (imu(accel=X), "accelerometer axes: the accelerometer has the wrong sign on its x axis"),
        (imu(gyro=180 / np.pi), "gyro scale: .*degrees per second"),
        (swapped, "left and right: 93% of the matches have negative disparity"),
        (wider, "epipolar error: rows differ by 1.49 px"),
    ],
)
def test_a_fault_is_refused_by_name(change: Callable[[Recording], Recording], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        admitted(change)
