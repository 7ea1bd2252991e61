"""Data of a calibration from a survey's first stages: its keyframes, tracks and odometry as they are."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import WheelSample
from mapserver.calibration.problem import CalibrationData, MotionState
from mapserver.survey.state import Keyframe, SurveyState

MOST_KEYFRAMES = 120  # of one stretch: more would cost time and say little more
_ROW_SIGMA_PX = 0.15
# Stereo windows are off by 0.02 px on slanted surfaces, measured in the simulator
_BIAS_PX = 0.02
_ROW_SEARCH_PX = 3.0


def stretch_of_survey(
    state: SurveyState,
    keyframes: Sequence[Keyframe],
    rig: tuple[RigCalibration, Rectifier],
    wheel: Sequence[WheelSample] = (),
) -> CalibrationData:
    """The keyframes of a survey that turn most, with what they see. rig: the calibration that the survey used, and its rectifier."""
    chosen = _busiest(state)
    part = state.of(chosen)
    marks, motion = part.landmarks, part.motion
    order = np.argsort(marks.obs_landmark, kind="stable")
    number = np.flatnonzero(chosen).tolist()
    pixels = _with_rows(marks.obs_pixels, marks.obs_keyframe, [keyframes[k] for k in number])
    sigmas = np.column_stack([marks.obs_sigma_px, np.full(len(pixels), _ROW_SIGMA_PX)])
    motions = np.zeros((len(part.stamps_ns), 9))
    if motion.inertial:
        motions = np.column_stack([motion.velocities_mps, motion.gyro_bias_radps, motion.accel_bias_mps2])
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


def _busiest(state: SurveyState) -> NDArray[np.bool_]:
    """(K,) the run of keyframes with the most turning, all of them where they are few."""
    count = len(state.stamps_ns)
    chosen = np.ones(count, bool)
    if count <= MOST_KEYFRAMES:
        return chosen
    rotations = state.map_from_body[:, :3, :3]
    turned = [rotation_angle_rad(a.T @ b) for a, b in pairwise(rotations)]
    total = np.concatenate([[0.0], np.cumsum(turned)])
    starts = np.arange(count - MOST_KEYFRAMES + 1)
    best = int(np.argmax(total[starts + MOST_KEYFRAMES - 1] - total[starts]))
    chosen[:] = False
    chosen[best : best + MOST_KEYFRAMES] = True
    return chosen


def _with_rows(pixels: Array, obs_keyframe: NDArray[np.int32], keyframes: Sequence[Keyframe]) -> Array:
    """(M, 4) the observations with their rows in the right image, NaN where it shows none."""
    found = np.full((len(pixels), 4), np.nan)
    found[:, :3] = pixels
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero((obs_keyframe == k) & np.isfinite(pixels[:, 2]))
        if len(rows) and not keyframe.from_views:
            found[rows, 3] = right_rows(keyframe.frame, pixels[rows])
    found[~np.isfinite(found[:, 3]), 2] = np.nan
    return found


def right_rows(frame: RectifiedFrame, pixels: Array) -> Array:
    """(M,) rows at which the right image shows what the left one has at `pixels` (M, 3), by Lucas-Kanade; NaN where it does not."""
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
