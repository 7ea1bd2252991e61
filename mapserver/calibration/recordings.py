"""Calibration of recordings: their busiest stretches are followed as a survey would, and adjusted together with the calibration."""

from collections.abc import Callable, Sequence

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.recordings.recording import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import ImuSamples, SensorSet, Stamps
from mapserver.calibration.estimate import CalibrationEstimate, continued_from, estimate_from
from mapserver.calibration.parameters import COLUMNS, INDEX, CalibrationParameter, RigAxes, corrected_rig
from mapserver.calibration.problem import CalibrationData
from mapserver.calibration.survey_data import stretch_of_survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import begin_survey
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

P = CalibrationParameter
IsEnough = Callable[[CalibrationEstimate, Sequence[CalibrationParameter]], bool]
LONGEST_S = 30.0  # of a recording: its busiest stretch
_FEATURES = 700  # of a keyframe: a calibration needs fewer than a map
_PASSES = 3
# A correction above this changes what is matched and how: the images are rectified again and followed anew.
_ANEW = {
    P.FOCAL: 0.005,
    P.FOCAL_RATIO: 0.002,
    P.PRINCIPAL_X: 3.0,
    P.PRINCIPAL_Y: 3.0,
    P.TIME_OFFSET: 0.005,
    P.BASELINE: 0.02,
}
_ANEW |= dict.fromkeys((P.PAIR_PITCH, P.PAIR_YAW, P.PAIR_ROLL), 0.002)
_ANEW |= dict.fromkeys((P.CAMERA_IMU_X, P.CAMERA_IMU_Y, P.CAMERA_IMU_Z), 0.02)


def estimate_calibration(
    recordings: Sequence[Recording],
    settings: SurveySettings,
    tools: SurveyTools | None = None,
    is_enough: IsEnough = lambda *_: False,
) -> CalibrationEstimate:
    """The calibration that recordings of one rig show together.

    is_enough: whether an estimate need not be any better, however far the parameters that are named are from the given calibration.
    RecordingError where there is none or where their calibrations differ; SurveyError where one of them holds too little to be followed.
    """
    if not recordings:
        raise RecordingError("no recording to calibrate from; name at least one")
    rig = recordings[0].calibration
    for other in recordings[1:]:
        if not _is_same(rig, other.calibration):
            raise RecordingError(
                f"{other.path} has another calibration than {recordings[0].path}; calibrate the rigs one by one, or name the "
                "calibration that both have with --calibration FILE"
            )
    settings = structs.replace(settings, orb=structs.replace(settings.orb, count=_FEATURES))
    estimate, before = None, np.zeros(len(COLUMNS))
    for _ in range(_PASSES):
        axes = RigAxes.of(rig, Rectifier(rig))
        current = corrected_rig(rig, axes, before) if before.any() else rig
        found = estimate_from([followed(r, current, settings, tools or SurveyTools()) for r in recordings])
        estimate = continued_from(before, found)
        after = estimate.corrections()
        moved = [p for p, limit in _ANEW.items() if abs(after[INDEX[p]] - before[INDEX[p]]) > limit]
        if not moved or is_enough(estimate, moved):
            break
        before = after
    assert estimate is not None
    return estimate


def _is_same(rig: RigCalibration, other: RigCalibration) -> bool:
    if len(rig.cameras) != len(other.cameras) or (rig.imu is None) != (other.imu is None):
        return False
    return all(
        a.model == b.model
        and np.array_equal(a.intrinsics_px, b.intrinsics_px)
        and np.array_equal(a.distortion, b.distortion)
        and np.allclose(a.body_from_cam, b.body_from_cam, atol=1e-9)
        for a, b in zip(rig.cameras, other.cameras, strict=True)
    )


def followed(
    recording: Recording, rig: RigCalibration, settings: SurveySettings, tools: SurveyTools
) -> CalibrationData:
    """The busiest stretch of a recording, followed under the calibration `rig`."""
    recording, chosen = recording.readable(busiest_frames(recording.frame_stamps_ns, recording.imu))
    rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD)
    frames = (recording.read_frame(int(index)) for index in chosen)
    inputs = SurveyInputs(frames, len(chosen), recording.imu, rig, rectifier, recording.wheel)
    chain = begin_survey(inputs, settings, tools)
    return stretch_of_survey(chain.state, chain.odometry.keyframes, (rig, rectifier), recording.wheel)


def busiest_frames(stamps: Stamps, imu: ImuSamples) -> NDArray[np.int64]:
    """Numbers of the frames of the LONGEST_S seconds in which gyro and accelerometer feel most, the first where there is no IMU."""
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
