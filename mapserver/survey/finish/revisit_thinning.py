"""Thinning of revisits: some visits to each place are adjusted, the others are localized in the result.

A global adjustment takes memory and time with the square of the visits to a place. Beyond some visits another one gains nothing:
places are then known more accurately than the calibration.
"""

from dataclasses import replace

import numpy as np

from fleetmap import core
from fleetmap.geometry import Indices, Mask
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import apply_result, bundle_problem, bundle_rounds
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Landmarks, RigImages, SurveyState, image_numbers, of_features
from mapserver.survey.tracks.tracks import Tracks

_LONGEST_GAP_S = 3.0  # longest IMU bridge across left-out keyframes


def redundant_keyframes(tracks: Tracks, posed: RigImages, settings: SurveySettings) -> Mask:
    """Return (K,) keyframes without which `repeated_visits` other visits still see `repeated_share` of their tracks, as finely.

    A visit ends when no keyframe has seen a track for longer than the shortest loop. The last keyframes are removed first, so that
    whole drives remain. None are redundant if no place has more visits than those. Keyframes that then share too
    few tracks with the others, such as blind ones, are redundant too: their neighbours are more accurate.
    """
    cull = settings.cull
    octaves = of_features(tracks.images, tracks.features, [k.features.octaves for k in posed.images])
    starts = np.append(tracks.starts, len(tracks.images))
    owners = posed.keyframe[tracks.images]
    order = np.argsort(owners, kind="stable")
    track = np.repeat(np.arange(len(tracks.starts)), np.diff(starts))
    row_starts = np.searchsorted(owners[order], np.arange(len(posed.numbers) + 1))
    gap, least = settings.loops.min_gap_keyframes, settings.loops.alone_inliers
    members = track, starts, owners, octaves
    limits = gap, cull.repeated_visits, cull.repeated_share, least
    last_first = np.arange(len(posed.numbers) - 1, 0, -1)
    redundant = core.redundant_keyframes(last_first, order, row_starts, *members, *limits)
    while (alone := _left_alone(owners, track, redundant, least)).any():
        redundant |= alone
    return redundant


def _left_alone(keyframes: Indices, track: Indices, redundant: Mask, least: int) -> Mask:
    """Return (K,) keyframes next to redundant ones that share fewer tracks than `least` with the others."""
    used = ~redundant[keyframes]
    shared = used & (np.bincount(track[used], minlength=len(track))[track] > 1)
    beside = np.zeros(len(redundant), bool)
    beside[1:] = redundant[:-1]
    beside[1:-1] |= redundant[2:]
    return np.asarray(~redundant & beside & (np.bincount(keyframes[shared], minlength=len(redundant)) < least))


def without_redundant(state: SurveyState, redundant: Mask) -> SurveyState:
    """Return the state of all other keyframes; inertial factors do not span long gaps left by redundant ones."""
    if not redundant.any():
        return state
    part, chosen = state.of(~redundant), np.flatnonzero(~redundant)
    goes_on = (np.diff(chosen, prepend=-1) == 1) | (np.diff(part.stamps_ns, prepend=0) < int(_LONGEST_GAP_S * 1e9))
    return replace(part, motion=replace(part.motion, goes_on=goes_on))


def adjust_visits(state: SurveyState, settings: SurveySettings, redundant: Mask, rounds: int) -> SurveyState:
    """Run the final adjustment without redundant keyframes (K,), and then localize those among its landmarks."""
    if not redundant.any():
        return bundle_rounds(state, settings, rounds=rounds, final=True)
    part = bundle_rounds(without_redundant(state, redundant), settings, rounds=rounds, final=True)
    chosen = np.flatnonzero(~redundant).astype(np.int32)
    adjusted = replace(part.landmarks, obs_keyframe=chosen[part.landmarks.obs_keyframe])
    seen = _seen_by(redundant, state.landmarks, adjusted, image_numbers(len(redundant), len(state.rig)))
    map_from_body, motions = state.map_from_body.copy(), state.motion.motions.copy()
    map_from_body[chosen], motions[chosen] = part.map_from_body, part.motion.motions
    motion = replace(state.motion, motions=motions)
    state = _localize(replace(state, map_from_body=map_from_body, motion=motion, landmarks=seen), settings, redundant)
    both = Landmarks.concatenated(adjusted.points_map, [adjusted, state.landmarks])
    order = np.argsort(both.obs_landmark, kind="stable")  # of each landmark the adjusted ones first
    marks = both.taken(order, both.points_map, both.obs_keyframe[order], both.obs_landmark[order])
    return replace(state, landmarks=marks)


def _seen_by(redundant: Mask, marks: Landmarks, adjusted: Landmarks, numbers: Indices) -> Landmarks:
    """Return redundant keyframes' observations of `adjusted`, the rest of `marks`; numbers (K, V): of the images of both."""
    stride, first = int(marks.obs_feature.max(initial=0)) + 1, adjusted.firsts
    codes = numbers[marks.obs_keyframe, marks.obs_camera] * stride + marks.obs_feature
    sought = numbers[adjusted.obs_keyframe[first], adjusted.obs_camera[first]] * stride + adjusted.obs_feature[first]
    order = np.argsort(codes)
    found = order[np.searchsorted(codes, sought, sorter=order)]
    number = np.full(len(marks.points_map), -1, np.int32)
    number[marks.obs_landmark[found]] = np.arange(len(found))
    rows = np.flatnonzero(redundant[marks.obs_keyframe] & (number[marks.obs_landmark] >= 0))
    return marks.taken(rows, adjusted.points_map, marks.obs_keyframe[rows], number[marks.obs_landmark[rows]])


def _localize(state: SurveyState, settings: SurveySettings, redundant: Mask) -> SurveyState:
    """Locate the redundant keyframes by their observations of fixed landmarks, and by the IMU; outliers are dropped."""
    for how in (settings.rough_bundle, settings.final_bundle):
        result = optimize(replace(bundle_problem(state, settings, redundant), points_held=True), how)
        keep = result.squared_sigmas < settings.noise.cut_sigmas**2
        state = apply_result(state, result)
        state = replace(state, landmarks=state.landmarks.keep_observations(keep, 0))
    return state
