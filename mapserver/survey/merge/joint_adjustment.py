"""Joint adjustment of the map's keyframes and the new survey's.

A published map is anchored: each keyframe stays unless the evidence against its pose is strong. A map in construction is
constrained by its own data: all observations and inertial terms of its surveys take part, as in the final adjustments of maplab (Schneider
et al. 2018) and ORB-SLAM3 (Campos et al. 2021), so that it changes only where the new survey is more accurate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from fleetmap.geometry import Array, Mask, se3_inverse, transform_points
from fleetmap.relocalization.map_view import Rows
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_problem, inertial_edges
from mapserver.survey.bundle.problem import OBSERVED, BundleProblem, InertialTerms, continued, measured_sigmas
from mapserver.survey.merge.base_map import BaseMap, baseline_ratio, with_baseline
from mapserver.survey.merge.guided_matching import Sightings
from mapserver.survey.merge.merge import Change
from mapserver.survey.pose_graph.odometry_factors import INERTIAL_FLOOR
from mapserver.survey.pose_graph.position_priors import in_frame, judged_priors, level_fit
from mapserver.survey.rig import Rig
from mapserver.survey.settings import BundleSettings, SessionSettings, SurveySettings
from mapserver.survey.state import Landmarks, PriorTerm, RelativeTerm, SurveyState, image_numbers
from mapserver.survey.survey_map import SurveyMap, history_of

_LONGEST_GAP_NS = 10_000_000_000
# Of a step between keyframes of a published map: that of adjusted ones with an IMU. It has no share by errors of calibration: by these a
# new survey would bend or scale the map.
_STEP = INERTIAL_FLOOR._replace(rotation_share=0.0, translation_share=0.0)


@dataclass(frozen=True)
class Measured:
    """Constraints of a map, at its optimum: the observations, motion and priors of its keyframes.

    keyframes (K,), cameras (K,), landmarks (N,): numbers of those of the map in the problem, where each keyframe is an image by a camera;
    -1 if not included.
    map_from_docks (4, 4): the map keeps the frame of its first survey, whose docks place it only to their own accuracy; None for a map
    without docks. is_anchored: True for a published map.
    """

    problem: BundleProblem
    keyframes: Rows
    cameras: Rows
    landmarks: Rows
    map_from_docks: Array | None = None
    is_anchored: bool = False


@dataclass(frozen=True)
class Joined:
    """What a survey adds to the problem of a map.

    Numbers there of its images (P,), by the keyframe and the camera, and of its landmarks (N,), -1 if not included. marks: its landmarks by
    image; rows (m,): their observations that take part. rig: the cameras of both. rig_from_body (4, 4): of the body in the problem.
    """

    first_keyframe: int
    keyframe: Rows
    camera: Rows
    landmarks: Rows
    marks: Landmarks
    rows: Rows
    rig: Rig
    rig_from_body: Array

    @classmethod
    def to(cls, problem: BundleProblem, state: SurveyState, sightings: Sightings) -> "Joined":
        """Return the numbers after the map's. A feature that shows a landmark of the map counts as its observation alone."""
        old, points = len(problem.map_from_body), len(problem.points_map)
        rig, cameras = _with_cameras_of(problem.rig, state.rig)
        numbers = image_numbers(len(state.stamps_ns), len(state.rig))
        keyframe, camera = np.indices(numbers.shape).reshape(2, -1)
        marks = state.landmarks.by_image(numbers)
        free = free_observations(marks, sightings)
        used = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map)) >= 2
        landmarks = np.where(used, np.cumsum(used) - 1 + points, -1)
        rows = np.flatnonzero(free & used[marks.obs_landmark])
        rig_from_body = problem.rig.body_from_cam[0] @ se3_inverse(state.rig.body_from_cam[0])
        return cls(old, old + keyframe, cameras[camera], landmarks, marks, rows, rig, rig_from_body)

    @property
    def is_alike(self) -> bool:
        """False for a survey by another mount, which contributes its pictures only."""
        return bool(np.allclose(self.rig_from_body, np.eye(4), atol=1e-9))


@dataclass(frozen=True)
class JointSolution:
    """Result of the adjustment.

    map_from_body (K, 4, 4) of the new keyframes; base_keyframes (B,) of the map that took part, base_from_body (B, 4, 4) their
    poses; base_rows (R,) landmarks of the map that took part, base_points_map (R, 3); own_points_map (N, 3) of the
    survey's own landmarks, NaN if not included; sightings without outliers. measured: the problem at its optimum,
    the map's keyframes first; own: the survey's part of it. priors_refused: docks, tags and zones
    of the survey that contradict it or the map.
    """

    map_from_body: Array
    base_keyframes: Rows
    base_from_body: Array
    base_rows: Rows
    base_points_map: Array
    own_points_map: Array
    sightings: Sightings
    measured: Measured
    own: Joined
    priors_refused: int


def adjust_jointly(
    base: BaseMap,
    known: Measured | None,
    state: SurveyState,
    map_from_body: Array,
    sightings: Sightings,
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
    sightings: Sightings,
    settings: SurveySettings,
    how: BundleSettings,
) -> JointSolution:
    """Solve one adjustment: first the map's keyframes and landmarks, then the survey's."""
    known = known or _published(base, state, sightings, settings.sessions)
    own = Joined.to(known.problem, state, sightings)
    problem = _joint_problem(known, own, _carried(state, map_from_body), sightings, settings)
    result = optimize(replace(problem, obs_sigma_px=measured_sigmas(problem, how.huber_sigmas)), how)
    map_from_docks, old = known.map_from_docks, own.first_keyframe
    if map_from_docks is not None:
        stay = level_fit(problem.map_from_body[:old, :3, 3], result.map_from_body[:old, :3, 3])
        motions, points_map = result.motions, transform_points(stay, result.points_map)
        if motions is not None:
            motions = np.column_stack([motions[:, :3] @ stay[:3, :3].T, motions[:, 3:]])
        result = replace(result, map_from_body=stay @ result.map_from_body, points_map=points_map, motions=motions)
        map_from_docks = stay @ map_from_docks
        problem.priors = [in_frame(prior, stay) for prior in problem.priors]
    start = len(known.problem.obs_keyframe)
    fits = result.squared_sigmas[start : start + len(sightings.rows)] < settings.noise.cut_sigmas**2
    base_keyframes, base_rows = np.flatnonzero(known.keyframes >= 0), np.flatnonzero(known.landmarks >= 0)
    places = problem.rig.as_bodies(result.map_from_body)
    own_points_map = np.full((len(own.landmarks), 3), np.nan)
    own_points_map[own.landmarks >= 0] = result.points_map[len(known.problem.points_map) :]
    return JointSolution(
        map_from_body=result.map_from_body[old:] @ own.rig_from_body,
        base_keyframes=base_keyframes,
        base_from_body=places[known.keyframes[base_keyframes], known.cameras[base_keyframes]] @ own.rig_from_body,
        base_rows=base_rows,
        base_points_map=result.points_map[known.landmarks[base_rows]],
        own_points_map=own_points_map,
        sightings=sightings.only(fits),
        measured=replace(known, problem=continued(problem, result), map_from_docks=map_from_docks),
        own=own,
        priors_refused=sum(not prior.is_believed for prior in state.priors),
    )


def _with_cameras_of(rig: Rig, own: Rig) -> tuple[Rig, Rows]:
    """Return the rig of a problem with the cameras of a survey's rig, and their numbers (V,) in it."""
    mounts, kinds, which = list(rig.body_from_cam), list(rig.kinds), [0]
    rig_from_own = rig.body_from_cam[0] @ se3_inverse(own.body_from_cam[0])
    for mount, kind in zip(rig_from_own @ own.body_from_cam[1:], own.kinds[1:], strict=True):
        same = [n for n, known in enumerate(mounts) if np.allclose(known, mount, atol=1e-9)]
        which.append(same[0] if same else len(mounts))
        if not same:
            mounts.append(mount)
            kinds.append(kind)
    camera = rig.camera if rig.camera.baseline_m else own.camera  # only a pair measures distances
    return Rig(camera, np.array(mounts), tuple(kinds)), np.array(which)


def _joint_problem(
    known: Measured, own: Joined, state: SurveyState, seen: Sightings, settings: SurveySettings
) -> BundleProblem:
    """Return the map's problem with the survey's keyframes, landmarks, motion and observations of both."""
    earlier, marks, old, map_from_body = known.problem, own.marks, own.first_keyframe, state.map_from_body
    pixels, sigmas_px = with_baseline(
        np.concatenate([seen.pixels, marks.obs_pixels[own.rows]]),
        np.concatenate([seen.sigmas_px, marks.obs_sigma_px[own.rows]]),
        baseline_ratio(own.rig.camera, state.rig.camera),
    )
    images = np.concatenate([seen.image, marks.obs_keyframe[own.rows]])
    landmarks = np.concatenate([known.landmarks[seen.rows], own.landmarks[marks.obs_landmark[own.rows]]])
    owners = own.keyframe[images], own.camera[images], landmarks
    columns = zip(OBSERVED, (*owners, pixels, sigmas_px), strict=True)
    observed: dict[str, Any] = {name: np.concatenate([getattr(earlier, name), column]) for name, column in columns}
    fixed = np.concatenate([earlier.fixed, np.zeros(len(map_from_body), bool)])
    fixed[0] |= old == 0
    problem = replace(
        earlier,
        rig=own.rig,
        map_from_body=np.concatenate([earlier.map_from_body, map_from_body @ se3_inverse(own.rig_from_body)]),
        fixed=fixed,
        points_map=np.concatenate([earlier.points_map, state.landmarks.points_map[own.landmarks >= 0]]),
        **observed,
    )
    if own.is_alike:
        relative = [RelativeTerm(r.i + old, r.j + old, r.i_from_j, r.information) for r in state.motion.relative]
        priors = [replace(p, k=p.k + old) for p in _placed(state.priors, known) if p.is_believed]
        problem = replace(problem, relative=earlier.relative + relative, priors=earlier.priors + priors)
    felt = state.motion.inertial and own.is_alike
    if earlier.inertial is not None or felt:
        before = earlier.inertial or InertialTerms(np.zeros((old, 9)), [])
        edges = before.edges + (inertial_edges(state, settings, first=old) if felt else [])
        motions = np.concatenate([before.motions, state.motion.motions])
        problem.inertial = replace(before, motions=motions, edges=edges)
    return problem


def _published(base: BaseMap, state: SurveyState, sightings: Sightings, settings: SessionSettings) -> Measured:
    """Return the constraints of a published map: keyframes with landmarks seen by the survey, with an anchor for each.

    All landmarks that two of these keyframes see take part, and relative poses stand for what the map's surveys knew beyond: the
    observations of earlier landmarks by a later survey are not kept. By the new survey's landmarks alone a keyframe with few of
    them would move with their noise, up to 9 mm.
    """
    used = np.zeros(len(base.points_map), bool)
    landmarks, keyframes = np.full(len(base.points_map), -1), np.full(len(base.map_from_body), -1)
    used[sightings.rows] = True
    held = np.unique(base.map.obs_keyframe[used[base.map.obs_landmark]]).astype(np.int64)
    keyframes[held] = np.arange(len(held))
    own = keyframes[base.map.obs_keyframe] >= 0
    used |= np.bincount(base.map.obs_landmark[own], minlength=len(used)) >= 2
    landmarks[used] = np.arange(used.sum())
    obs = np.flatnonzero(own & used[base.map.obs_landmark])
    sigma = np.array([np.radians(settings.anchor_sigma_deg)] * 3 + [settings.anchor_sigma_m] * 3)
    problem = BundleProblem(
        rig=Rig.of_one(base.camera, state.rig.body_from_cam[0]),
        map_from_body=base.map_from_body[held],
        fixed=np.zeros(len(held), bool),
        points_map=base.points_map[used],
        obs_keyframe=keyframes[base.map.obs_keyframe[obs]],
        obs_camera=np.zeros(len(obs), np.int32),
        obs_landmark=landmarks[base.map.obs_landmark[obs]],
        obs_pixels=base.obs_pixels[obs],
        obs_sigma_px=base.obs_sigma_px[obs],
        relative=_steps(base, held),
        priors=[PriorTerm(n, base.map_from_body[k], np.diag(1.0 / sigma**2)) for n, k in enumerate(held)],
    )
    return Measured(problem, keyframes, np.zeros_like(keyframes), landmarks, is_anchored=True)


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


def _carried(state: SurveyState, map_from_body: Array) -> SurveyState:
    """Return the survey with its keyframes at map_from_body (K, 4, 4), and its landmarks moved with their defining keyframes."""
    marks = state.landmarks
    turn = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    shift = map_from_body[:, :3, 3] - np.einsum("kij,kj->ki", turn, state.map_from_body[:, :3, 3])
    first = marks.obs_keyframe[marks.firsts]
    points_map = np.einsum("nij,nj->ni", turn[first], marks.points_map) + shift[first]
    return replace(state.moved(map_from_body), landmarks=replace(marks, points_map=points_map))


def free_observations(marks: Landmarks, sightings: Sightings) -> Mask:
    """Return (M,) observations of the survey's own landmarks, by image, whose feature shows no landmark of the map."""
    stride = 1 + max(int(marks.obs_feature.max(initial=0)), int(sightings.features.max(initial=0)))
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    return ~np.isin(codes, sightings.image * stride + sightings.features)


def begun(state: SurveyState, survey_map: SurveyMap, landmarks: Rows, settings: SurveySettings) -> Measured:
    """Return the constraints of a map's first survey, its state in the map's frame; landmarks (N,): rows of the state in the map."""
    keyframes = np.searchsorted(state.stamps_ns, survey_map.keyframe_stamps_ns)
    # The camera that is where the first one would be with a body at the pose of the map's keyframe.
    beside = state.rig.as_bodies(state.map_from_body)[keyframes]
    cameras = np.abs(beside - survey_map.map_from_body[:, None]).sum(axis=(2, 3)).argmin(axis=1)
    problem = bundle_problem(state, settings, None)
    return Measured(problem, keyframes, cameras, landmarks, np.eye(4) if problem.priors else None)


def grown(joint: JointSolution, change: Change, base: BaseMap, after: SurveyMap) -> Measured:
    """Return the constraints of the map after a change; a moved landmark is at its position by the new survey."""
    before, problem, is_new = joint.measured, joint.measured.problem, change.added_rows < 0
    own, images = joint.own, np.unique(change.added.obs_keyframe)
    stay = np.isin(base.history.keyframe_ids, history_of(after).keyframe_ids)
    keyframes = np.concatenate([before.keyframes[stay], own.keyframe[images]])
    cameras = np.concatenate([before.cameras[stay], own.camera[images]])
    added = np.where(is_new, own.landmarks[change.added_own], before.landmarks[change.added_rows])
    landmarks = np.concatenate([before.landmarks[change.keep], added])
    keep = (problem.obs_keyframe >= own.first_keyframe) | ~np.isin(problem.obs_landmark, added[~is_new])
    problem.points_map[added[~is_new]] = change.added.points_map[~is_new]
    return Measured(problem.observed(keep), keyframes, cameras, landmarks, before.map_from_docks)
