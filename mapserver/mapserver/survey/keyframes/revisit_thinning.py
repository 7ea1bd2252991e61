"""Places that a survey passes again and again: some visits of each make the map, the others are only placed in it.

What a global adjustment costs, in memory and in time, grows with the square of the visits to a place, and what it gains by one more
does not: after some, places are known better than the calibration is.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import SurveyState, adjust, bundle_problem, state_of, take
from mapserver.survey.keyframes.keyframes import Keyframe
from mapserver.survey.keyframes.revisit_thinning_kernels import mark_repeated
from mapserver.survey.settings import SurveySettings
from mapserver.survey.tracks.tracks import Landmarks, Tracks

_LONGEST_GAP_S = 3.0  # over which the IMU carries from one keyframe to the next where those between take no part


def redundant_keyframes(tracks: Tracks, keyframes: list[Keyframe], settings: SurveySettings) -> NDArray[np.bool_]:
    """(K,) keyframes without which `repeated_visits` other visits still see `repeated_share` of their tracks, as finely.

    A visit ends where no keyframe has seen a track for longer than a loop takes at least. The last keyframes go first, so that
    whole drives are left. None are spare where no place is seen on more visits than those. What then stands alone beside them
    is spare too: blind ones, whose neighbours know better where they are.
    """
    cull, spare = settings.cull, np.zeros(len(keyframes), bool)
    first_of = np.cumsum([0, *(len(k.features) for k in keyframes)])
    octaves = np.concatenate([np.zeros(0, np.int8), *(k.features.octaves for k in keyframes)])
    starts = np.append(tracks.starts, len(tracks.keyframes))
    order = np.argsort(tracks.keyframes, kind="stable")
    track = np.repeat(np.arange(len(tracks.starts)), np.diff(starts))
    mark_repeated(
        order, np.searchsorted(tracks.keyframes[order], np.arange(len(keyframes) + 1)),
        track, starts, tracks.keyframes,
        octaves[first_of[tracks.keyframes] + tracks.features], settings.loops.min_gap_keyframes, cull.repeated_visits,
        cull.repeated_share, settings.loops.alone_inliers, spare,
    )  # fmt: skip
    while (alone := _left_alone(tracks.keyframes, track, spare, settings.loops.alone_inliers)).any():
        spare |= alone
    return spare


def _left_alone(
    keyframes: NDArray[np.int64], track: NDArray[np.int64], spare: NDArray[np.bool_], least: int
) -> NDArray[np.bool_]:
    """(K,) keyframes next to spare ones that share fewer tracks than `least` with those that are not."""
    used = ~spare[keyframes]
    shared = used & (np.bincount(track[used], minlength=len(track))[track] > 1)
    beside = np.zeros(len(spare), bool)
    beside[1:] = spare[:-1]
    beside[1:-1] |= spare[2:]
    return np.asarray(~spare & beside & (np.bincount(keyframes[shared], minlength=len(spare)) < least))


def without_redundant(state: SurveyState, spare: NDArray[np.bool_]) -> SurveyState:
    """The state of all other keyframes; where spare ones leave long gaps, the IMU does not carry over."""
    if not spare.any():
        return state
    part, chosen = state_of(state, ~spare), np.flatnonzero(~spare)
    goes_on = (np.diff(chosen, prepend=-1) == 1) | (np.diff(part.stamps_ns, prepend=0) < int(_LONGEST_GAP_S * 1e9))
    part.motion.goes_on = goes_on
    return part


def adjust_visits(state: SurveyState, settings: SurveySettings, spare: NDArray[np.bool_], rounds: int) -> None:
    """Final adjustment, in place, of all keyframes but spare ones (K,), which then take their places among its landmarks."""
    if not spare.any():
        adjust(state, settings, rounds=rounds, final=True)
        return
    part = without_redundant(state, spare)
    adjust(part, settings, rounds=rounds, final=True)
    used, motion = ~spare, state.motion
    state.map_from_body[used] = part.map_from_body
    motion.velocities_mps[used] = part.motion.velocities_mps
    motion.gyro_bias_radps[used] = part.motion.gyro_bias_radps
    motion.accel_bias_mps2[used] = part.motion.accel_bias_mps2
    state.landmarks = _seen_by(spare, state.landmarks, part.landmarks, np.flatnonzero(used))
    _place(state, settings, spare)
    state.landmarks = _together(part.landmarks, np.flatnonzero(used), state.landmarks)


def _seen_by(spare: NDArray[np.bool_], marks: Landmarks, adjusted: Landmarks, numbers: NDArray[np.int64]) -> Landmarks:
    """What spare keyframes observe of `adjusted`, which is left of `marks`; numbers: those of the adjusted keyframes in `marks`."""
    stride = int(marks.obs_feature.max(initial=0)) + 1
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    first = np.searchsorted(adjusted.obs_landmark, np.arange(len(adjusted.points_map)))
    sought = numbers[adjusted.obs_keyframe[first]] * stride + adjusted.obs_feature[first]
    order = np.argsort(codes)
    found = order[np.searchsorted(codes, sought, sorter=order)]
    number = np.full(len(marks.points_map), -1, np.int32)
    number[marks.obs_landmark[found]] = np.arange(len(found))
    rows = np.flatnonzero(spare[marks.obs_keyframe] & (number[marks.obs_landmark] >= 0))
    return Landmarks(
        adjusted.points_map, marks.obs_keyframe[rows], number[marks.obs_landmark[rows]], marks.obs_feature[rows],
        marks.obs_pixels[rows], marks.obs_sigma_px[rows],
    )  # fmt: skip


def _place(state: SurveyState, settings: SurveySettings, spare: NDArray[np.bool_]) -> None:
    """Moves the spare keyframes to where their observations of the landmarks, which stay, and the IMU say; drops outliers."""
    for how in (settings.rough_bundle, settings.final_bundle):
        result = optimize(replace(bundle_problem(state, settings, spare), points_held=True), how)
        take(state, result)
        keep = result.squared_sigmas < settings.noise.cut_sigmas**2
        state.landmarks = state.landmarks.keep_observations(keep, 0)


def _together(adjusted: Landmarks, numbers: NDArray[np.int64], placed: Landmarks) -> Landmarks:
    """The same landmarks with the observations of both; those that were adjusted first."""
    landmark = np.concatenate([adjusted.obs_landmark, placed.obs_landmark])
    order = np.argsort(landmark, kind="stable")
    return Landmarks(
        adjusted.points_map,
        np.concatenate([numbers[adjusted.obs_keyframe].astype(np.int32), placed.obs_keyframe])[order],
        landmark[order],
        np.concatenate([adjusted.obs_feature, placed.obs_feature])[order],
        np.concatenate([adjusted.obs_pixels, placed.obs_pixels])[order],
        np.concatenate([adjusted.obs_sigma_px, placed.obs_sigma_px])[order],
    )
