"""Calibration of recordings: the stretches with the most motion are tracked as in a survey, then adjusted with the calibration."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, Indices, Mask, rotation_angle_rad
from fleetmap.recordings.recording import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import ImuSamples, SensorSet, Stamps, WheelSample
from mapserver.calibration.estimate import CalibrationEstimate, continued_from, estimate_from
from mapserver.calibration.motion_rows import CalibrationData, MotionState
from mapserver.calibration.parameters import COLUMNS, CalibrationParameter, RigAxes, corrected_rig
from mapserver.survey.odometry_pass import parts_between_lifts
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import begin_survey
from mapserver.survey.state import Keyframe, SurveyState
from mapserver.survey.survey_inputs import AdjustedChain, SurveyInputs, SurveyTools, Watch

IsEnough = Callable[[CalibrationEstimate, Sequence[CalibrationParameter]], bool]
Follow = Callable[[Recording, RigCalibration, Watch], CalibrationData]
"""Returns the tracked data of a recording under a calibration; the watch gets every frame."""
LONGEST_S = 30.0  # of a recording: its stretch with the most motion
_FEATURES = 700  # of a keyframe: a calibration needs fewer than a map
_PASSES = 3


def estimate_calibration(
    recordings: Sequence[Recording],
    follow: Follow,
    is_enough: IsEnough = lambda *_: False,
    first: CalibrationData | None = None,
) -> CalibrationEstimate:
    """Return the calibration estimated from recordings of one rig together.

    is_enough: True if an estimate is accurate enough, however far the named parameters are from the given calibration.
    first: the data of a single recording under its own calibration, None if they are not followed yet.
    RecordingError if their calibrations differ; SurveyError if one of them is too short to be tracked.
    """
    rig = recordings[0].calibration
    for other in recordings[1:]:
        if not _is_same(rig, other.calibration):
            raise RecordingError(
                f"{other.path} has another calibration than {recordings[0].path}; calibrate the rigs one by one, or name the "
                "calibration that both have with --calibration FILE"
            )
    estimate, before = None, np.zeros(len(COLUMNS))
    for _ in range(_PASSES):
        current = corrected_rig(rig, RigAxes.of(rig, Rectifier(rig)), before) if before.any() else rig
        data = [follow(each, current, lambda _: None) for each in recordings] if first is None else [first]
        estimate, first = continued_from(before, estimate_from(data)), None
        after = estimate.corrections()
        moved = [p for p, change in zip(COLUMNS, after - before, strict=True) if abs(change) > p.anew_above]
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


def stretches(settings: SurveySettings, tools: SurveyTools) -> Follow:
    """Return what tracks the stretch of a recording with the most motion."""
    fewer = structs.replace(settings, orb=structs.replace(settings.orb, count=_FEATURES))
    return lambda recording, rig, watch: followed(recording, rig, fewer, replace(tools, watch=watch))


def followed(
    recording: Recording, rig: RigCalibration, settings: SurveySettings, tools: SurveyTools
) -> CalibrationData:
    """Return the stretch with the most motion, tracked under the calibration `rig`."""
    recording, chosen = recording.readable(busiest_frames(recording.frame_stamps_ns, recording.imu))
    rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD)
    frames = (recording.read_frame(int(index)) for index in chosen)
    inputs = SurveyInputs(frames, len(chosen), recording.imu, rig, rectifier, recording.wheel)
    return busiest_stretch(begin_survey(inputs, settings, tools), (rig, rectifier), recording.wheel)


def busiest_frames(stamps: Stamps, imu: ImuSamples) -> Indices:
    """Return the numbers of the frames of the LONGEST_S seconds with the most motion by gyro and accelerometer, the first without IMU."""
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


MOST_KEYFRAMES, _SEEN = 120, 300  # of one stretch, and landmarks of each: more cost time and add little
_ROW_SIGMA_PX = 0.15
# Stereo windows are off by 0.02 px on slanted surfaces, measured in the simulator
_BIAS_PX = 0.02
_ROW_SEARCH_PX = 3.0


def busiest_stretch(
    begun: AdjustedChain, rig: tuple[RigCalibration, Rectifier], wheel: Sequence[WheelSample]
) -> CalibrationData:
    """Return the keyframes of a survey with the most rotation, and their observations. rig: the survey's calibration and rectifier."""
    keyframes, frames = begun.odometry.keyframes, np.arange(len(begun.odometry.estimates))
    parts = [frames[part] for part in parts_between_lifts(begun.odometry.estimates)]
    chosen = max((np.isin(begun.odometry.keyframe_frames, part) for part in parts), key=np.count_nonzero)
    chosen[chosen] = _busiest(begun.state.of(chosen))
    part = begun.state.of(chosen)
    motion, marks = part.motion, part.landmarks
    share = min(1.0, _SEEN * len(part.stamps_ns) / max(len(marks.obs_landmark), 1))
    kept = np.diff(np.floor(share * np.arange(len(marks.points_map) + 1))) > 0  # an even choice
    marks = marks.keep_observations(kept[marks.obs_landmark], 1)
    order = np.argsort(marks.obs_landmark, kind="stable")
    number = np.flatnonzero(chosen).tolist()
    pixels = _with_rows(marks.obs_pixels, marks.obs_keyframe, [keyframes[k] for k in number])
    sigmas = np.column_stack([marks.obs_sigma_px, np.full(len(pixels), _ROW_SIGMA_PX)])
    motions = motion.motions if motion.inertial else np.zeros((len(part.stamps_ns), 9))
    calibration, rectifier = rig
    return CalibrationData(
        calibration=calibration if motion.inertial else replace(calibration, imu=None),
        rectifier=rectifier,
        stamps_ns=part.stamps_ns,
        start=MotionState(part.map_from_body, motions, marks.points_map),
        obs_keyframe=marks.obs_keyframe[order],
        obs_landmark=marks.obs_landmark[order],
        obs_pixels=pixels[order],
        obs_sigma_px=sigmas[order],
        imu=motion.imu,
        wheel=wheel,
        bias_px=_BIAS_PX,
    )


def _busiest(state: SurveyState) -> Mask:
    """Return (K,) the run of keyframes with the most rotation, all of them if they are few."""
    count = len(state.stamps_ns)
    chosen = np.ones(count, bool)
    if count <= MOST_KEYFRAMES:
        return chosen
    turned = [rotation_angle_rad(a.T @ b) for a, b in pairwise(state.map_from_body[:, :3, :3])]
    total = np.concatenate([[0.0], np.cumsum(turned)])
    starts = np.arange(count - MOST_KEYFRAMES + 1)
    best = int(np.argmax(total[starts + MOST_KEYFRAMES - 1] - total[starts]))
    chosen[:] = False
    chosen[best : best + MOST_KEYFRAMES] = True
    return chosen


def _with_rows(pixels: Array, obs_keyframe: NDArray[np.int32], keyframes: Sequence[Keyframe]) -> Array:
    """Return (M, 4) the observations with their rows in the right image, NaN without a match."""
    found = np.full((len(pixels), 4), np.nan)
    found[:, :3] = pixels
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero((obs_keyframe == k) & np.isfinite(pixels[:, 2]))
        if len(rows) and not keyframe.from_views:
            found[rows, 3] = _right_rows(keyframe.frame, pixels[rows])
    found[~np.isfinite(found[:, 3]), 2] = np.nan
    return found


def _right_rows(frame: RectifiedFrame, pixels: Array) -> Array:
    """Return (M,) rows in the right image of the left image's `pixels` (M, 3), by Lucas-Kanade; NaN without a match."""
    if frame.right is None:
        return np.full(len(pixels), np.nan)
    left = pixels[:, :2].astype(np.float32).reshape(-1, 1, 2)
    guess = pixels[:, [2, 1]].astype(np.float32).reshape(-1, 1, 2).copy()
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        frame.left, frame.right, left, guess, winSize=(11, 11), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    found = found.reshape(-1, 2).astype(np.float64)
    near = np.abs(found - pixels[:, [2, 1]]).max(axis=1) < _ROW_SEARCH_PX
    return np.where((status.ravel() == 1) & near, found[:, 1], np.nan)
