"""One adjustment of the map's keyframes and the new survey's.

A map that robots have is held: each keyframe stays where it was unless much speaks against it. A map that is only being made is
held by what it knows of itself: all that its surveys have seen and felt takes part, as in the final adjustments of maplab (Schneider
et al. 2018) and ORB-SLAM3 (Campos et al. 2021), so that it bends only where the new survey knows better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_problem, inertial_edges
from mapserver.survey.bundle.measured_noise import measured_sigmas
from mapserver.survey.bundle.problem import BundleProblem, InertialTerms, PriorTerm, continued
from mapserver.survey.merge.base_map import BaseMap, baseline_ratio, with_baseline
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.merge.merge import Change
from mapserver.survey.settings import BundleSettings, SessionSettings, SurveySettings
from mapserver.survey.state import Landmarks, RelativeTerm, SurveyState
from mapserver.survey.survey_map import SurveyMap, history_of


@dataclass(frozen=True)
class Measured:
    """What holds a map, at its optimum: the observations, motion and priors of its keyframes.

    keyframes (K,), landmarks (N,): the numbers that those of the map have in the problem, -1 for what takes no part.
    """

    problem: BundleProblem
    keyframes: Rows
    landmarks: Rows


@dataclass(frozen=True)
class JointSolution:
    """What the adjustment found.

    map_from_body (K, 4, 4) of the new keyframes; base_keyframes (B,) of the map that took part, base_from_body (B, 4, 4) where
    they are now; base_rows (R,) landmarks of the map that took part, base_points_map (R, 3); own_points_map (N, 3) of the
    survey's own landmarks, NaN where they took no part; sightings without those that did not fit. measured: the problem at its optimum,
    the map's keyframes first; own_numbers (N,): those of the own landmarks in it, -1 where they took no part.
    """

    map_from_body: Array
    base_keyframes: Rows
    base_from_body: Array
    base_rows: Rows
    base_points_map: Array
    own_points_map: Array
    sightings: list[Sighting | None]
    measured: Measured
    own_numbers: Rows


def adjust_jointly(
    base: BaseMap,
    known: Measured | None,
    state: SurveyState,
    map_from_body: Array,
    sightings: list[Sighting | None],
    settings: SurveySettings,
    *,
    finely: bool,
) -> JointSolution:
    """Old and new keyframes and landmarks that fit all observations best; map_from_body (K, 4, 4) is where the new ones start.

    known: what holds the map; None for a published one, whose keyframes stay within `anchor_sigma_m`. A survey that sees nothing of
    the map keeps its shape, and its first keyframe its place. The first adjustment tells what does not fit. finely: a second one takes
    the redescending cost with measured noise, as a survey's own last one does: at the noise that observations claim, depth edges
    would pull the scale that the survey had found.
    """
    final = settings.final_bundle
    for how in (msgspec.structs.replace(final, cutoff_sigmas=np.inf), final)[: 1 + finely]:
        solution = _solved(base, known, state, map_from_body, sightings, settings, how)
        map_from_body, sightings = solution.map_from_body, solution.sightings
    return solution


def _solved(
    base: BaseMap,
    known: Measured | None,
    state: SurveyState,
    map_from_body: Array,
    sightings: list[Sighting | None],
    settings: SurveySettings,
    how: BundleSettings,
) -> JointSolution:
    """One adjustment: first the map's keyframes and landmarks, then the survey's."""
    marks = state.landmarks
    seen = [(k, s) for k, s in enumerate(sightings) if s is not None]
    known = known or _published(base, state, seen, settings.sessions)
    earlier, old, points = known.problem, len(known.problem.map_from_body), len(known.problem.points_map)
    # A feature that shows a landmark of the map counts there.
    free = free_observations(marks, sightings)
    own_used = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map)) >= 2
    own = free & own_used[marks.obs_landmark]
    own_numbers = np.where(own_used, np.cumsum(own_used) - 1 + points, -1)
    turn, carried = _carried(state, map_from_body)
    rig_from_body = earlier.body_from_cam @ se3_inverse(state.body_from_cam)  # of the body that the problem speaks of
    own_rig = bool(np.allclose(rig_from_body, np.eye(4), atol=1e-9))
    camera = earlier.camera if earlier.camera.baseline_m else state.camera  # only a pair sees distances
    pixels, sigmas_px = with_baseline(
        np.concatenate([*(s.pixels for _, s in seen), marks.obs_pixels[own]]),
        np.concatenate([*(s.sigmas_px for _, s in seen), marks.obs_sigma_px[own]]),
        baseline_ratio(camera, state.camera),
    )
    keyframes = [earlier.obs_keyframe, *(np.full(len(s.rows), old + k) for k, s in seen), old + marks.obs_keyframe[own]]
    landmarks = [
        earlier.obs_landmark,
        *(known.landmarks[s.rows] for _, s in seen),
        own_numbers[marks.obs_landmark[own]],
    ]
    fixed = np.concatenate([earlier.fixed, np.zeros(len(map_from_body), bool)])
    fixed[0] |= old == 0
    problem = replace(
        earlier,
        camera=camera,
        map_from_body=np.concatenate([earlier.map_from_body, map_from_body @ se3_inverse(rig_from_body)]),
        fixed=fixed,
        points_map=np.concatenate([earlier.points_map, carried[own_used]]),
        obs_keyframe=np.concatenate(keyframes).astype(np.int32),
        obs_landmark=np.concatenate(landmarks).astype(np.int32),
        obs_pixels=np.concatenate([earlier.obs_pixels, pixels]),
        obs_sigma_px=np.concatenate([earlier.obs_sigma_px, sigmas_px]),
    )
    if own_rig:  # a survey by another mounting takes part by its pictures alone
        relative = [RelativeTerm(r.i + old, r.j + old, r.i_from_j, r.information) for r in state.motion.relative]
        problem = replace(problem, relative=earlier.relative + relative)
    problem.inertial = _inertial(earlier, state, turn, settings, own_rig)
    result = optimize(replace(problem, obs_sigma_px=measured_sigmas(problem, how.huber_sigmas)), how)

    fits = result.squared_sigmas < settings.noise.cut_sigmas**2
    fitting, start = list[Sighting | None](), len(earlier.obs_keyframe)
    for sighting in sightings:
        count = 0 if sighting is None else len(sighting.rows)
        fitting.append(None if sighting is None else sighting.only(fits[start : start + count]))
        start += count
    base_keyframes, base_rows = np.flatnonzero(known.keyframes >= 0), np.flatnonzero(known.landmarks >= 0)
    own_points_map = np.full((len(marks.points_map), 3), np.nan)
    own_points_map[own_used] = result.points_map[points:]
    placed = result.map_from_body @ rig_from_body
    return JointSolution(
        map_from_body=placed[old:],
        base_keyframes=base_keyframes,
        base_from_body=placed[known.keyframes[base_keyframes]],
        base_rows=base_rows,
        base_points_map=result.points_map[known.landmarks[base_rows]],
        own_points_map=own_points_map,
        sightings=fitting,
        measured=Measured(continued(problem, result), known.keyframes, known.landmarks),
        own_numbers=own_numbers,
    )


def _published(
    base: BaseMap, state: SurveyState, seen: Sequence[tuple[int, Sighting]], settings: SessionSettings
) -> Measured:
    """What holds a published map: the landmarks that the survey sees, the keyframes that see them too, and an anchor for each of these."""
    rows = np.unique(np.concatenate([s.rows for _, s in seen])) if seen else np.zeros(0, np.int64)
    landmarks, keyframes = np.full(len(base.points_map), -1), np.full(len(base.map_from_body), -1)
    landmarks[rows] = np.arange(len(rows))
    obs = np.flatnonzero(landmarks[base.map.obs_landmark] >= 0)
    held = np.unique(base.map.obs_keyframe[obs])
    keyframes[held] = np.arange(len(held))
    sigma = np.array([np.radians(settings.anchor_sigma_deg)] * 3 + [settings.anchor_sigma_m] * 3)
    problem = BundleProblem(
        camera=base.camera,
        body_from_cam=state.body_from_cam,
        map_from_body=base.map_from_body[held],
        fixed=np.zeros(len(held), bool),
        points_map=base.points_map[rows],
        obs_keyframe=keyframes[base.map.obs_keyframe[obs]],
        obs_landmark=landmarks[base.map.obs_landmark[obs]],
        obs_pixels=base.obs_pixels[obs],
        obs_sigma_px=base.obs_sigma_px[obs],
        priors=[PriorTerm(n, base.map_from_body[k], np.diag(1.0 / sigma**2)) for n, k in enumerate(held)],
    )
    return Measured(problem, keyframes, landmarks)


def _carried(state: SurveyState, map_from_body: Array) -> tuple[Array, Array]:
    """How the survey's keyframes turned (K, 3, 3), and its landmarks (N, 3) where those went that define them."""
    marks = state.landmarks
    turn = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    shift = map_from_body[:, :3, 3] - np.einsum("kij,kj->ki", turn, state.map_from_body[:, :3, 3])
    first = marks.obs_keyframe[marks.firsts]
    return turn, np.einsum("nij,nj->ni", turn[first], marks.points_map) + shift[first]


def free_observations(marks: Landmarks, sightings: Sequence[Sighting | None]) -> NDArray[np.bool_]:
    """(M,) observations of the survey's own landmarks whose feature shows no landmark of the map."""
    stride = int(marks.obs_feature.max(initial=0)) + 1
    taken = [k * stride + s.features[s.features < stride] for k, s in enumerate(sightings) if s is not None]
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    return ~np.isin(codes, np.concatenate(taken)) if taken else np.ones(len(codes), bool)


def _inertial(
    earlier: BundleProblem, state: SurveyState, turn: Array, settings: SurveySettings, own_rig: bool
) -> InertialTerms | None:
    """The motion of the map's keyframes, if it is known, and the survey's behind it; turn (K, 3, 3) is that of its keyframes since."""
    motion, old, felt = state.motion, len(earlier.map_from_body), state.motion.inertial and own_rig
    if earlier.inertial is None and not felt:
        return None
    none = np.zeros((old, 3))
    before = earlier.inertial or InertialTerms(none, none, none, [])
    velocities = np.einsum("kij,kj->ki", turn, motion.velocities_mps)
    return replace(
        before,
        velocities_map_mps=np.concatenate([before.velocities_map_mps, velocities]),
        gyro_bias_radps=np.concatenate([before.gyro_bias_radps, motion.gyro_bias_radps]),
        accel_bias_mps2=np.concatenate([before.accel_bias_mps2, motion.accel_bias_mps2]),
        edges=before.edges + (inertial_edges(state, settings, first=old) if felt else []),
    )


def begun(state: SurveyState, survey_map: SurveyMap, landmarks: Rows, settings: SurveySettings) -> Measured:
    """What holds the map that a survey begins, whose state is in the map's frame; landmarks (N,): rows of the state that the map has."""
    keyframes = np.searchsorted(state.stamps_ns, survey_map.keyframe_stamps_ns)
    return Measured(bundle_problem(state, settings, None), keyframes, landmarks)


def grown(joint: JointSolution, change: Change, base: BaseMap, after: SurveyMap) -> Measured:
    """What holds the map after a change; a landmark that stands elsewhere by now is where the new survey saw it."""
    before, problem, is_new = joint.measured, joint.measured.problem, change.added_rows < 0
    old = len(problem.map_from_body) - len(joint.map_from_body)
    stay = np.isin(base.history.keyframe_ids, history_of(after).keyframe_ids)
    keyframes = np.concatenate([before.keyframes[stay], old + np.unique(change.added.obs_keyframe)])
    added = np.where(is_new, joint.own_numbers[change.added_own], before.landmarks[change.added_rows])
    landmarks = np.concatenate([before.landmarks[change.keep], added])
    keep = (problem.obs_keyframe >= old) | ~np.isin(problem.obs_landmark, added[~is_new])
    problem.points_map[added[~is_new]] = change.added.points_map[~is_new]
    problem = replace(
        problem,
        obs_keyframe=problem.obs_keyframe[keep],
        obs_landmark=problem.obs_landmark[keep],
        obs_pixels=problem.obs_pixels[keep],
        obs_sigma_px=problem.obs_sigma_px[keep],
    )
    return Measured(problem, keyframes, landmarks)
