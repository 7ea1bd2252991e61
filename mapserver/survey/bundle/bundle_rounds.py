"""Bundle adjustment of a survey: assembly of the problem, rounds with removal of outliers, local windows."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from fleetmap.geometry import Mask
from fleetmap.inertial import Preintegrated, preintegrate
from fleetmap.odometry.sensor_buffer import is_pause
from fleetmap.sensors.calibration import ImuNoise
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.problem import OBSERVED, BundleProblem, BundleResult, InertialTerms, measured_sigmas
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import RelativeTerm, SurveyState


def bundle_rounds(state: SurveyState, settings: SurveySettings, rounds: int = 3, *, final: bool = False) -> SurveyState:
    """Return the adjusted state; outlying observations are dropped between rounds.

    final: near the optimum; the last round uses the redescending cost of `final_bundle` with noise measured from residuals.
    Inertial factors: Forster et al. 2017. Observations dominate the memory: a caller that holds no `state` of its own
    during the call saves half of it.
    """
    for round_number in range(rounds):
        last = round_number + 1 == rounds
        how = settings.rough_bundle if not last else settings.final_bundle if final else settings.bundle
        problem = bundle_problem(state, settings, None)
        if last and final:
            problem = replace(problem, obs_sigma_px=measured_sigmas(problem, how.huber_sigmas))
        result = optimize(problem, how)
        state = apply_result(state, result)
        if not last:
            keep = result.squared_sigmas < settings.noise.cut_sigmas**2
            state = replace(state, landmarks=state.landmarks.keep_observations(keep, settings.min_observations))
        del problem, result  # frees the dropped observations
    return state


# Observations by keyframe and by landmark, relative terms by their first keyframe: the cost of a window depends on its size only.
_WindowIndex = tuple["scipy.sparse.csr_array", "scipy.sparse.csr_array", dict[int, list[RelativeTerm]]]


def local_windows(state: SurveyState, settings: SurveySettings) -> SurveyState:
    """Run local bundle adjustment: overlapping windows in order, all else fixed; global drift is left to the loops."""
    count, window = len(state.stamps_ns), settings.local_window
    if count <= window:
        return state
    marks, motion, relative = state.landmarks, state.motion, dict[int, list[RelativeTerm]]()
    for term in motion.relative:
        relative.setdefault(term.i, []).append(term)
    seen = _observations_of(marks.obs_keyframe, count), _observations_of(marks.obs_landmark, len(marks.points_map))
    index = *seen, relative
    # Windows write into these arrays: copying them for each window would be too slow.
    state = replace(
        state,
        map_from_body=state.map_from_body.copy(),
        landmarks=replace(marks, points_map=marks.points_map.copy()),
        motion=replace(motion, motions=motion.motions.copy()),
    )
    for start in range(0, max(count - window // 2, 1), window // 2):
        free = np.zeros(count, bool)
        free[start : start + window] = True
        _adjust_window(state, settings, free, index)
    return state


def _observations_of(owners: NDArray[np.int32], count: int) -> "scipy.sparse.csr_array":
    """Return (count, M) which of M observations each owner has; owners (M,)."""
    return scipy.sparse.csr_array((np.ones(len(owners), bool), (owners, np.arange(len(owners)))), (count, len(owners)))


def _adjust_window(state: SurveyState, settings: SurveySettings, free: Mask, index: _WindowIndex) -> None:
    """Adjust one window with fixed earlier keyframes that see the same landmarks; landmarks seen only from elsewhere are unchanged.

    Writes to the arrays of `state`.
    """
    marks, motion, (by_keyframe, by_landmark, by_first) = state.landmarks, state.motion, index
    inside = np.flatnonzero(free)
    first, last = inside[[0, -1]]
    touched = np.unique(marks.obs_landmark[by_keyframe[inside].indices]).astype(np.int64)
    rows = np.sort(by_landmark[touched].indices)
    # Later keyframes are still at their odometry poses: fixed, they would pull the window back to the drift.
    rows = rows[marks.obs_keyframe[rows] <= last]
    used = np.zeros(len(free), bool)
    used[marks.obs_keyframe[rows]] = True
    used[max(first - 1, 0) : last + 1] = True
    relative = [term for k in np.flatnonzero(used).tolist() for term in by_first.get(k, ())]
    keyframe = (np.cumsum(used) - 1)[marks.obs_keyframe[rows]]
    landmark = np.searchsorted(touched, marks.obs_landmark[rows])
    landmarks = marks.taken(rows, marks.points_map[touched], keyframe, landmark)
    part = replace(state, motion=replace(motion, relative=relative)).with_landmarks(used, landmarks)
    result = optimize(bundle_problem(part, settings, free[used]), settings.rough_bundle)
    part = apply_result(part, result)
    state.map_from_body[used], marks.points_map[touched] = part.map_from_body, part.landmarks.points_map
    motion.motions[used] = part.motion.motions


def bundle_problem(state: SurveyState, settings: SurveySettings, free: Mask | None) -> BundleProblem:
    """Return the bundle problem of a state; `free` (K,) are the keyframes that may move, all for None.

    Believed priors fix the map; without any the first keyframe does.
    """
    marks, motion, priors = state.landmarks, state.motion, [p for p in state.priors if p.is_believed]
    fixed = np.zeros(len(state.stamps_ns), bool) if free is None else ~free
    if not fixed.any() and not priors:
        fixed[0] = True
    holds_all, inertial = free is None or bool(free[0]), None
    if motion.inertial:
        held = None if holds_all else fixed
        inertial = InertialTerms(motion.motions, inertial_edges(state, settings, held), fixed=held)
    return BundleProblem(
        rig=state.rig,
        map_from_body=state.map_from_body,
        fixed=fixed,
        points_map=marks.points_map,
        **{name: getattr(marks, name) for name in OBSERVED},
        inertial=inertial,
        relative=motion.relative,
        priors=priors,
        gauge="yaw_position" if motion.inertial and holds_all and not priors else "pose",
    )


def inertial_edges(
    state: SurveyState, settings: SurveySettings, held: Mask | None = None, first: int = 0
) -> list[tuple[int, int, Preintegrated]]:
    """Return IMU edges between neighbouring keyframes, numbered from `first`; not between two fixed ones, nor over pauses."""
    motion, edges = state.motion, []
    assert motion.noise is not None
    noise = scaled_noise(motion.noise, settings)
    stamps_ns = state.stamps_ns + int(motion.imu_minus_cam_s * 1e9)
    for k, (start, end) in enumerate(pairwise(stamps_ns.tolist())):
        is_held = held is not None and held[k] and held[k + 1]
        goes_on = motion.goes_on is None or motion.goes_on[k + 1]
        if is_held or not goes_on or is_pause(motion.imu.stamps_ns, start, end):
            continue
        _, gyro_bias, accel_bias = np.split(motion.motions[k], 3)
        edges.append((first + k, first + k + 1, preintegrate(motion.imu, start, end, gyro_bias, accel_bias, noise)))
    return edges


def scaled_noise(noise: ImuNoise, settings: SurveySettings) -> ImuNoise:
    """Return the data sheet's densities times the survey's scales: an IMU on a robot is noisier than on a desk."""
    s = settings.noise
    return ImuNoise(
        noise.gyro_noise_radps_rthz * s.gyro_noise_scale,
        noise.gyro_walk_radps2_rthz * s.walk_scale,
        noise.accel_noise_mps2_rthz * s.accel_noise_scale,
        noise.accel_walk_mps3_rthz * s.walk_scale,
    )


def apply_result(state: SurveyState, result: BundleResult) -> SurveyState:
    """Return the state with its variables at the values of `result`."""
    motion = state.motion if result.motions is None else replace(state.motion, motions=result.motions)
    landmarks = replace(state.landmarks, points_map=result.points_map)
    return replace(state, map_from_body=result.map_from_body, landmarks=landmarks, motion=motion)
