"""Calibration of a pair of which only the image size and the baseline are known: focal length = image width, no distortion.

First epipolar geometry, then passes of the self-calibrating adjustment with wide priors, images alone; after each the images are
rectified again and followed anew. It ends where nothing moves any more, and says so where that does not happen.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from msgspec import structs

from fleetmap.errors import RecordingError
from fleetmap.features.matching import hamming_knn2
from fleetmap.features.orb import Features, detect
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, se3
from fleetmap.recordings.recording import Recording
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.calibration.epipolar_guess import RawMatches, guessed_rig
from mapserver.calibration.estimate import MIN_KEYFRAMES
from mapserver.calibration.estimator import Adjusted, adjust
from mapserver.calibration.parameters import INDEX, CalibrationParameter, RigAxes, corrected_rig
from mapserver.calibration.recordings import busiest_frames, followed
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools

P = CalibrationParameter
# Radial and tangential terms of any pinhole lens, their difference between two of one make, the right principal point in pixels
_WIDE_SIGMAS = np.array([0.3, 0.3, 1e-3, 1e-3] + [1e-2, 1e-2, 1e-3, 1e-3] + [15.0] * 2)
_MOST_PASSES, _SETTLED = 7, 0.003  # of the focal length, as a share
_LARGEST_PIXEL_SCALE = 3.0  # of the pixels' errors: above, no pinhole lens explains the images
# What images alone leave, in addition to their own sigma: the recordings of the development were off by 0.8 to 1.1 %
FOCAL_FLOOR = 0.01
_MOMENTS, _STEPS, _MATCHES = 20, (4, 10), 120
_LEAST_FLOW_PX = 8.0  # of a motion, in the median


@dataclass(frozen=True, slots=True)
class GuessedCalibration:
    """rig: found by images alone, its baseline as it was given. focal_sigma: as a share. passes: how often the images were followed."""

    rig: RigCalibration
    focal_sigma: float
    keyframes: int
    passes: int


def first_rig(width_px: int, height_px: int, baseline_m: float) -> RigCalibration:
    """Two parallel pinholes so far apart, with a focal length of the image's width, and no IMU."""
    lens = np.array([width_px, width_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1)], np.float64)
    places = (np.zeros(3), np.array([baseline_m, 0.0, 0.0]))
    return RigCalibration(
        tuple(
            CameraCalibration("radial-tangential", width_px, height_px, lens, np.zeros(4), se3(np.eye(3), place))
            for place in places
        )
    )


def calibration_from_guess(
    recording: Recording, settings: SurveySettings, tools: SurveyTools | None = None
) -> GuessedCalibration:
    """The lenses and the pair's shape of a recording that was opened with `first_rig`.

    RecordingError where they cannot be told from it: too little motion, passes that do not settle, images that no pinhole lens explains.
    """
    if len(recording.calibration.cameras) < 2:
        raise RecordingError(f"{recording.path} has one camera: only the lenses of a pair can be guessed")
    tools = tools or SurveyTools()
    settings = structs.replace(settings, orb=structs.replace(settings.orb, count=700))
    sound, _ = recording.readable(busiest_frames(recording.frame_stamps_ns, recording.imu))
    alone = replace(sound, wheel=())
    rig = guessed_rig(recording.calibration, raw_matches(alone, tools.progress))
    for number in range(_MOST_PASSES):
        data = replace(followed(alone, rig, settings, tools), lens_sigmas=_WIDE_SIGMAS)
        found = adjust(data)
        theta = found.theta.copy()
        theta[[INDEX[P.BASELINE], INDEX[P.WHEEL_SCALE]]] = 0.0  # images alone say nothing about metres
        rig = corrected_rig(rig, RigAxes.of(rig, Rectifier(rig)), np.concatenate([theta, found.lens]))
        if number > 0 and abs(theta[INDEX[P.FOCAL]]) < _SETTLED:
            return _judged(rig, found, len(data.stamps_ns), number + 1)
    raise RecordingError(
        f"{recording.path}: after {_MOST_PASSES} passes the focal length still moves by {100 * abs(theta[INDEX[P.FOCAL]]):.1f} % a "
        "pass, so nothing is written; record turns to both sides near to things, or calibrate with a board"
    )


def _judged(rig: RigCalibration, found: Adjusted, keyframes: int, passes: int) -> GuessedCalibration:
    own = float(np.sqrt(np.linalg.inv(found.information)[INDEX[P.FOCAL], INDEX[P.FOCAL]]))
    scale = float(found.scales.images[0])
    if keyframes < MIN_KEYFRAMES or own > FOCAL_FLOOR or scale > _LARGEST_PIXEL_SCALE:
        raise RecordingError(
            f"{keyframes} keyframes show the focal length to {100 * own:.1f} %, with errors of {scale:.1f} times what corners have: "
            f"not enough to tell the lenses; {MIN_KEYFRAMES} keyframes with turns and pinhole lenses are needed"
        )
    return GuessedCalibration(rig, float(np.hypot(own, FOCAL_FLOOR)), keyframes, passes)


def raw_matches(recording: Recording, on_progress: Callable[[str, int, int], None]) -> RawMatches:
    """Matches of unrectified images at moments spread over the busiest stretch."""
    frames = busiest_frames(recording.frame_stamps_ns, recording.imu)
    settings, rng = OrbSettings(count=1500), np.random.default_rng(0)
    pairs, motions = [], []
    for n, at in enumerate(np.linspace(0, len(frames) - 1 - max(_STEPS), _MOMENTS).astype(int).tolist()):
        on_progress("matching", n, _MOMENTS)
        frame = recording.read_frame(int(frames[max(at, 0)]))
        left = detect(frame.left, settings)
        if frame.right is not None:
            pairs.append(_chosen(_matched(left, detect(frame.right, settings)), rng))
        for step in _STEPS:
            later = recording.read_frame(int(frames[min(max(at, 0) + step, len(frames) - 1)]))
            match = _matched(left, detect(later.left, settings))
            if len(match) > 60 and np.median(np.linalg.norm(match[:, :2] - match[:, 2:], axis=1)) > _LEAST_FLOW_PX:
                motions.append(_chosen(match, rng))
    return RawMatches(np.concatenate(pairs) if pairs else np.zeros((0, 4)), motions)


def _chosen(matches: Array, rng: np.random.Generator) -> Array:
    return matches[rng.permutation(len(matches))[:_MATCHES]]


def _matched(first: Features, second: Features) -> Array:
    """(N, 4) raw pixels of mutual nearest descriptors that one epipolar geometry explains to 3 px."""
    if min(len(first.pixels), len(second.pixels)) < 30:
        return np.zeros((0, 4))
    there, distance, _ = hamming_knn2(first.descriptors, second.descriptors)
    back, _, _ = hamming_knn2(second.descriptors, first.descriptors)
    mutual = np.flatnonzero((back[there] == np.arange(len(there))) & (distance < 45))
    if len(mutual) < 30:
        return np.zeros((0, 4))
    matches = np.column_stack([first.pixels[mutual], second.pixels[there[mutual]]]).astype(np.float64)
    cv2.setRNGSeed(0)
    _, fits = cv2.findFundamentalMat(matches[:, :2], matches[:, 2:], cv2.FM_RANSAC, 3.0, 0.99)
    return matches[fits.ravel() > 0] if fits is not None else np.zeros((0, 4))
