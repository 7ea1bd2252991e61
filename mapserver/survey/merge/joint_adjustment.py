"""Joint adjustment of the map's keyframes and the new survey's.

A published map is anchored: each keyframe stays unless the evidence against its pose is strong. A map in construction is
constrained by its own data: all observations and inertial terms of its surveys take part, as in the final adjustments of maplab (Schneider
et al. 2018) and ORB-SLAM3 (Campos et al. 2021), so that it changes only where the new survey is more accurate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array, se3_inverse, transform_points
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_problem, inertial_edges
from mapserver.survey.bundle.measured_noise import measured_sigmas
from mapserver.survey.bundle.problem import BundleProblem, BundleResult, InertialTerms, continued
from mapserver.survey.merge.base_map import BaseMap, baseline_ratio, with_baseline
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.merge.merge import Change
from mapserver.survey.pose_graph.odometry_factors import floor_of
from mapserver.survey.pose_graph.position_priors import in_frame, judged_priors, level_fit
from mapserver.survey.settings import BundleSettings, SessionSettings, SurveySettings
from mapserver.survey.state import Landmarks, PriorTerm, RelativeTerm, SurveyState, poses_of_views
from mapserver.survey.survey_map import SurveyMap, history_of

_LONGEST_GAP_NS = 10_000_000_000
# Of a step between keyframes of a published map: that of adjusted ones with an IMU. It has no share by errors of calibration: by these a
# new survey would bend or scale the map.
_STEP = floor_of(inertial=True)._replace(rotation_share=0.0, translation_share=0.0)


@dataclass(frozen=True)
class Measured:
    """Constraints of a map, at its optimum: the observations, motion and priors of its keyframes.

    keyframes (K,), landmarks (N,): numbers of those of the map in the problem, where each keyframe is a view; -1 if not included.
    map_from_docks (4, 4): the map keeps the frame of its first survey, whose docks place it only to their own accuracy; None for a map
    without docks.
    """

    problem: BundleProblem
    keyframes: Rows
    landmarks: Rows
    map_from_docks: Array | None = None


@dataclass(frozen=True)
class JointSolution:
    """Result of the adjustment.

    map_from_body (K, 4, 4) of the new keyframes; base_keyframes (B,) of the map that took part, base_from_body (B, 4, 4) their
    poses; base_rows (R,) landmarks of the map that took part, base_points_map (R, 3); own_points_map (N, 3) of the
    survey's own landmarks, NaN if not included; sightings without outliers. measured: the problem at its optimum,
    the map's keyframes first; own_numbers (N,): those of the own landmarks in it, -1 if not included. priors_refused: docks, tags and zones
    of the survey that contradict it or the map. own_views: numbers of the survey's views in the problem.
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
    own_views: Rows
    priors_refused: int


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
    """Return old and new keyframes and landmarks with the best fit to all observations; map_from_body (K, 4, 4): start of the new ones.

    known: constraints of the map; None for a published one, whose keyframes stay within `anchor_sigma_m`. Docks of the survey take part if
    the map has some, and a published one is held by its anchors. A survey without sight of the map
    keeps its shape, and its first keyframe its pose. Docks of the survey that contradict the result have no influence.
    The first adjustment finds outliers. finely: a second one uses the redescending cost with measured noise, as in a survey's own
    last one: with the stated noise, depth edges would bias the scale of the survey.
    """
    final = settings.final_bundle
    for how in (msgspec.structs.replace(final, cutoff_sigmas=np.inf), final)[: 1 + finely]:
        solution = _solved(base, known, state, map_from_body, sightings, settings, how)
        priors, believed = judged_priors(_placed(state.priors, solution.measured), solution.map_from_body)
        if not believed:
            judged = zip(state.priors, priors, strict=True)
            state = replace(state, priors=[replace(own, is_believed=there.is_believed) for own, there in judged])
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
    """Solve one adjustment: first the map's keyframes and landmarks, then the survey's."""
    marks = state.landmarks
    seen = [(k, s) for k, s in enumerate(sightings) if s is not None]
    known = known or _published(base, state, seen, settings.sessions)
    known, own_views = _with_views_of(known, state)
    earlier, old, points = known.problem, len(known.problem.map_from_body), len(known.problem.points_map)
    # A feature that shows a landmark of the map is counted as its observation.
    free = free_observations(marks, sightings)
    own_used = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map)) >= 2
    own = free & own_used[marks.obs_landmark]
    own_numbers = np.where(own_used, np.cumsum(own_used) - 1 + points, -1)
    turn, carried = _carried(state, map_from_body)
    rig_from_body = earlier.body_from_cam @ se3_inverse(state.body_from_cam)  # of the body in the problem
    own_rig = bool(np.allclose(rig_from_body, np.eye(4), atol=1e-9))
    camera = earlier.camera if earlier.camera.baseline_m else state.camera  # only a pair measures distances
    pixels, sigmas_px = with_baseline(
        np.concatenate([*(s.pixels for _, s in seen), marks.obs_pixels[own]]),
        np.concatenate([*(s.sigmas_px for _, s in seen), marks.obs_sigma_px[own]]),
        baseline_ratio(camera, state.camera),
    )
    keyframes = [
        earlier.obs_keyframe,
        *(np.full(len(s.rows), own_views[k]) for k, s in seen),
        own_views[marks.obs_keyframe[own]],
    ]
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
    if own_rig:  # a survey with another mount contributes its pictures only
        relative = [RelativeTerm(r.i + old, r.j + old, r.i_from_j, r.information) for r in state.motion.relative]
        priors = [replace(p, k=p.k + old) for p in _placed(state.priors, known) if p.is_believed]
        problem = replace(problem, relative=earlier.relative + relative, priors=earlier.priors + priors)
    problem.inertial = _inertial(earlier, state, turn, settings, own_rig)
    result = optimize(replace(problem, obs_sigma_px=measured_sigmas(problem, how.huber_sigmas)), how)
    map_from_docks = known.map_from_docks
    if map_from_docks is not None:
        stay = level_fit(earlier.map_from_body[:, :3, 3], result.map_from_body[:old, :3, 3])
        result, map_from_docks = _in_frame(result, stay), stay @ map_from_docks
        problem.priors = [in_frame(prior, stay) for prior in problem.priors]

    fits = result.squared_sigmas < settings.noise.cut_sigmas**2
    fitting, start = list[Sighting | None](), len(earlier.obs_keyframe)
    for sighting in sightings:
        count = 0 if sighting is None else len(sighting.rows)
        fitting.append(None if sighting is None else sighting.only(fits[start : start + count]))
        start += count
    base_keyframes, base_rows = np.flatnonzero(known.keyframes >= 0), np.flatnonzero(known.landmarks >= 0)
    own_points_map = np.full((len(marks.points_map), 3), np.nan)
    own_points_map[own_used] = result.points_map[points:]
    map_from_view = poses_of_views(result.map_from_body, problem.body_from_view)
    return JointSolution(
        map_from_body=result.map_from_body[old:] @ rig_from_body,
        base_keyframes=base_keyframes,
        base_from_body=map_from_view[known.keyframes[base_keyframes]] @ rig_from_body,
        base_rows=base_rows,
        base_points_map=result.points_map[known.landmarks[base_rows]],
        own_points_map=own_points_map,
        sightings=fitting,
        measured=Measured(continued(problem, result), known.keyframes, known.landmarks, map_from_docks),
        own_numbers=own_numbers,
        own_views=own_views,
        priors_refused=sum(not prior.is_believed for prior in state.priors),
    )


def _with_views_of(known: Measured, state: SurveyState) -> tuple[Measured, Rows]:
    """Return the constraints with the survey's views among those of the problem, and (K * V,) their numbers after all of the map."""
    problem = known.problem
    rig_from_body = problem.body_from_cam @ se3_inverse(state.body_from_cam)
    views, which = list(problem.body_from_view), [0]
    for own in rig_from_body @ state.body_from_view[1:] @ se3_inverse(rig_from_body):
        same = [n for n, view in enumerate(views) if np.allclose(view, own, atol=1e-9)]
        which.append(same[0] if same else len(views))
        views += [] if same else [own]
    before, after = len(problem.body_from_view), len(views)

    def numbered(keyframes: AnyArray) -> AnyArray:
        return np.where(keyframes < 0, -1, keyframes // before * after + keyframes % before)

    bodies = len(problem.map_from_body) + np.arange(len(state.stamps_ns))
    own_views = (after * bodies[:, None] + which).ravel()
    if after == before:
        return known, own_views
    problem = replace(problem, obs_keyframe=numbered(problem.obs_keyframe), body_from_view=np.array(views))
    return replace(known, problem=problem, keyframes=numbered(known.keyframes)), own_views


def _published(
    base: BaseMap, state: SurveyState, seen: Sequence[tuple[int, Sighting]], settings: SessionSettings
) -> Measured:
    """Return the constraints of a published map: keyframes with landmarks seen by the survey, with an anchor for each.

    All landmarks that two of these keyframes see take part, and relative poses stand for what the map's surveys knew beyond: the
    observations of earlier landmarks by a later survey are not kept. By the new survey's landmarks alone a keyframe with few of
    them would move with their noise, up to 9 mm.
    """
    rows = np.unique(np.concatenate([s.rows for _, s in seen])) if seen else np.zeros(0, np.int64)
    used = np.zeros(len(base.points_map), bool)
    landmarks, keyframes = np.full(len(base.points_map), -1), np.full(len(base.map_from_body), -1)
    used[rows] = True
    held = np.unique(base.map.obs_keyframe[used[base.map.obs_landmark]]).astype(np.int64)
    keyframes[held] = np.arange(len(held))
    own = keyframes[base.map.obs_keyframe] >= 0
    used |= np.bincount(base.map.obs_landmark[own], minlength=len(used)) >= 2
    landmarks[used] = np.arange(used.sum())
    obs = np.flatnonzero(own & used[base.map.obs_landmark])
    sigma = np.array([np.radians(settings.anchor_sigma_deg)] * 3 + [settings.anchor_sigma_m] * 3)
    problem = BundleProblem(
        camera=base.camera,
        body_from_cam=state.body_from_cam,
        map_from_body=base.map_from_body[held],
        fixed=np.zeros(len(held), bool),
        points_map=base.points_map[used],
        obs_keyframe=keyframes[base.map.obs_keyframe[obs]],
        obs_landmark=landmarks[base.map.obs_landmark[obs]],
        obs_pixels=base.obs_pixels[obs],
        obs_sigma_px=base.obs_sigma_px[obs],
        relative=_steps(base, held),
        priors=[PriorTerm(n, base.map_from_body[k], np.diag(1.0 / sigma**2)) for n, k in enumerate(held)],
    )
    return Measured(problem, keyframes, landmarks)


def _steps(base: BaseMap, held: Rows) -> list[RelativeTerm]:
    """Return the relative poses of those of the map's keyframes held (H,) that follow each other in one survey."""
    terms, stamps_ns = [], base.map.keyframe_stamps_ns[held]
    for n, steps in enumerate(np.diff(held).tolist()):
        if 0 < stamps_ns[n + 1] - stamps_ns[n] < _LONGEST_GAP_NS:
            i_from_j = se3_inverse(base.map_from_body[held[n]]) @ base.map_from_body[held[n + 1]]
            terms.append(RelativeTerm(n, n + 1, i_from_j, np.linalg.inv(steps * _STEP.covariance(i_from_j))))
    return terms


def _placed(priors: Sequence[PriorTerm], known: Measured) -> list[PriorTerm]:
    """Return the priors of a survey in the frame of the map, none if that has no docks."""
    there = known.map_from_docks
    return [] if there is None else [in_frame(prior, there) for prior in priors]


def _in_frame(result: BundleResult, new_from_map: Array) -> BundleResult:
    """Return the result in another upright frame; new_from_map (4, 4)."""
    velocities = result.velocities_map_mps
    return replace(
        result,
        map_from_body=new_from_map @ result.map_from_body,
        points_map=transform_points(new_from_map, result.points_map),
        velocities_map_mps=None if velocities is None else velocities @ new_from_map[:3, :3].T,
    )


def _carried(state: SurveyState, map_from_body: Array) -> tuple[Array, Array]:
    """Return the rotations of the survey's keyframes (K, 3, 3), and its landmarks (N, 3) moved with their defining keyframes."""
    marks = state.landmarks
    turn = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    shift = map_from_body[:, :3, 3] - np.einsum("kij,kj->ki", turn, state.map_from_body[:, :3, 3])
    first = state.observers[marks.firsts]
    return turn, np.einsum("nij,nj->ni", turn[first], marks.points_map) + shift[first]


def free_observations(marks: Landmarks, sightings: Sequence[Sighting | None]) -> NDArray[np.bool_]:
    """Return (M,) observations of the survey's own landmarks whose feature shows no landmark of the map."""
    stride = int(marks.obs_feature.max(initial=0)) + 1
    taken = [k * stride + s.features[s.features < stride] for k, s in enumerate(sightings) if s is not None]
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    return ~np.isin(codes, np.concatenate(taken)) if taken else np.ones(len(codes), bool)


def _inertial(
    earlier: BundleProblem, state: SurveyState, turn: Array, settings: SurveySettings, own_rig: bool
) -> InertialTerms | None:
    """Return the motion of the map's keyframes, if known, followed by the survey's; turn (K, 3, 3): rotation of its keyframes since."""
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
    """Return the constraints of a map's first survey, its state in the map's frame; landmarks (N,): rows of the state in the map."""
    views = state.view_count
    keyframes = views * np.searchsorted(state.stamps_ns, survey_map.keyframe_stamps_ns)
    if views > 1:  # the view at the pose of the map's keyframe
        beside = state.map_from_view[keyframes[:, None] + np.arange(views)]
        keyframes += np.abs(beside - survey_map.map_from_body[:, None]).sum(axis=(2, 3)).argmin(axis=1)
    problem = bundle_problem(state, settings, None)
    return Measured(problem, keyframes, landmarks, np.eye(4) if problem.priors else None)


def grown(joint: JointSolution, change: Change, base: BaseMap, after: SurveyMap) -> Measured:
    """Return the constraints of the map after a change; a moved landmark is at its position by the new survey."""
    before, problem, is_new = joint.measured, joint.measured.problem, change.added_rows < 0
    old = int(joint.own_views[0])
    stay = np.isin(base.history.keyframe_ids, history_of(after).keyframe_ids)
    keyframes = np.concatenate([before.keyframes[stay], joint.own_views[np.unique(change.added.obs_keyframe)]])
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
    return Measured(problem, keyframes, landmarks, before.map_from_docks)
