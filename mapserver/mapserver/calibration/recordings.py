"""Calibration of recordings: their busiest stretches are followed as a survey would, and adjusted together with the calibration."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.calibration.estimate import CalibrationEstimate, estimate_from
from mapserver.calibration.problem import CalibrationData
from mapserver.calibration.survey_data import stretch_of_survey
from mapserver.survey.odometry_pass import run_odometry
from mapserver.survey.pipeline import adjusted_chain
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

LONGEST_S = 30.0  # of a recording: its busiest stretch


def estimate_calibration(
    recordings: Sequence[Recording], settings: SurveySettings, tools: SurveyTools | None = None
) -> CalibrationEstimate:
    """The calibration that recordings of one rig show together.

    RecordingError where there is none or where their calibrations differ; SurveyError where one of them holds too little to be followed.
    """
    if not recordings:
        raise RecordingError("no recording to calibrate from; name at least one")
    rig = recordings[0].calibration
    stretches = [followed(recording, rig, settings, tools or SurveyTools()) for recording in recordings]
    return estimate_from(stretches)


def followed(
    recording: Recording, rig: RigCalibration, settings: SurveySettings, tools: SurveyTools
) -> CalibrationData:
    """The busiest stretch of a recording, followed under the calibration `rig`."""
    chosen = busiest_frames(recording)
    rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD)
    frames = (recording.read_frame(int(index)) for index in chosen)
    inputs = SurveyInputs(frames, len(chosen), recording.imu, rig, rectifier, recording.wheel)
    chain = adjusted_chain(run_odometry(inputs, settings, tools), inputs, settings, tools)
    return stretch_of_survey(chain.state, chain.odometry.keyframes, (rig, rectifier), recording.wheel)


def busiest_frames(recording: Recording) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Numbers of the frames of the LONGEST_S seconds in which gyro and accelerometer feel most, the first where there is no IMU."""
    stamps, imu = recording.frame_stamps_ns, recording.imu
    last = np.searchsorted(stamps, stamps + int(LONGEST_S * 1e9))
    starts = np.flatnonzero(last < len(stamps))
    if not len(starts):
        return np.arange(len(stamps), dtype=np.int64)
    if not len(imu):
        return np.arange(last[0], dtype=np.int64)
    turning = np.linalg.norm(imu.gyro_radps - np.median(imu.gyro_radps, axis=0), axis=1)
    pushing = np.linalg.norm(imu.accel_mps2 - np.median(imu.accel_mps2, axis=0), axis=1)
    felt = np.minimum(turning, 3.0) / max(float(turning.mean()), 1e-6) + pushing / max(float(pushing.mean()), 1e-6)
    total = np.concatenate([[0.0], np.cumsum(felt)])
    edges = np.searchsorted(imu.stamps_ns, stamps)
    best = int(starts[np.argmax(total[edges[last[starts]]] - total[edges[starts]])])
    return np.arange(best, last[best], dtype=np.int64)


def with_calibration(recording: Recording, rig: RigCalibration) -> Recording:
    """The recording under another calibration of its sensors."""
    return replace(recording, calibration=rig)
