"""One adjustment of the map's keyframes, held where they were unless much speaks against it, and the new survey's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import inertial_edges
from mapserver.survey.bundle.problem import BundleProblem, InertialTerms, PriorTerm
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.settings import BundleSettings, SessionSettings, SurveySettings
from mapserver.survey.state import Landmarks, RelativeTerm, SurveyState


@dataclass(frozen=True)
class JointSolution:
    """What the adjustment found.

    map_from_body (K, 4, 4) of the new keyframes; base_keyframes (B,) of the map that took part, base_from_body (B, 4, 4) where
    they are now; base_rows (R,) landmarks of the map that were seen, base_points_map (R, 3); own_points_map (N, 3) of the
    survey's own landmarks, NaN where they took no part; sightings without those that did not fit.
    """

    map_from_body: Array
    base_keyframes: Rows
    base_from_body: Array
    base_rows: Rows
    base_points_map: Array
    own_points_map: Array
    sightings: list[Sighting | None]


def adjust_jointly(
    base: BaseMap,
    state: SurveyState,
    map_from_body: Array,
    sightings: list[Sighting | None],
    settings: SurveySettings,
    *,
    anchored: bool,
) -> JointSolution:
    """Old and new keyframes and landmarks that fit all observations best; map_from_body (K, 4, 4) is where the new ones start.

    anchored: the map is published, its keyframes stay within `anchor_sigma_m`; else only its first one holds it. A survey that
    sees nothing of the map keeps its shape, and its first keyframe its place.
    """
    for how in (settings.rough_bundle, settings.bundle):  # the first one tells what does not fit
        solution = _solved(base, state, map_from_body, sightings, settings, how, anchored)
        map_from_body, sightings = solution.map_from_body, solution.sightings
    return solution


def _solved(
    base: BaseMap,
    state: SurveyState,
    map_from_body: Array,
    sightings: list[Sighting | None],
    settings: SurveySettings,
    how: BundleSettings,
    anchored: bool,
) -> JointSolution:
    """One adjustment: first the map's keyframes and landmarks, then the survey's."""
    marks, motion = state.landmarks, state.motion
    seen = [(k, s) for k, s in enumerate(sightings) if s is not None]
    rows = np.unique(np.concatenate([s.rows for _, s in seen])) if seen else np.zeros(0, np.int64)
    number = np.full(len(base.points_map), -1)
    number[rows] = np.arange(len(rows))
    old_obs = np.flatnonzero(number[base.map.obs_landmark] >= 0)
    base_keyframes = np.unique(base.map.obs_keyframe[old_obs]).astype(np.int64)
    old = len(base_keyframes)
    # A feature that shows a landmark of the map counts there.
    free = free_observations(marks, sightings)
    own_used = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map)) >= 2
    own = free & own_used[marks.obs_landmark]
    own_number = np.cumsum(own_used) - 1 + len(rows)
    keyframes: list[AnyArray] = [
        np.searchsorted(base_keyframes, base.map.obs_keyframe[old_obs]),
        *(np.full(len(s.rows), old + k) for k, s in seen),
        old + marks.obs_keyframe[own],
    ]
    landmarks = [number[base.map.obs_landmark[old_obs]], *(number[s.rows] for _, s in seen)]
    landmarks.append(own_number[marks.obs_landmark[own]])

    turn = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    shift = map_from_body[:, :3, 3] - np.einsum("kij,kj->ki", turn, state.map_from_body[:, :3, 3])
    first = np.zeros(len(marks.points_map), np.int64)
    first[marks.obs_landmark[::-1]] = marks.obs_keyframe[::-1]  # carried with the keyframe that defines them
    carried = np.einsum("nij,nj->ni", turn[first], marks.points_map) + shift[first]
    fixed = np.zeros(old + len(map_from_body), bool)
    if not (anchored and old):  # the map's first keyframe, or the survey's where it sees none of the map
        fixed[0] = True
    problem = BundleProblem(
        camera=base.camera,
        body_from_cam=state.body_from_cam,
        map_from_body=np.concatenate([base.map_from_body[base_keyframes], map_from_body]),
        fixed=fixed,
        points_map=np.concatenate([base.points_map[rows], carried[own_used]]),
        obs_keyframe=np.concatenate(keyframes).astype(np.int32),
        obs_landmark=np.concatenate(landmarks).astype(np.int32),
        obs_pixels=np.concatenate([base.obs_pixels[old_obs], *(s.pixels for _, s in seen), marks.obs_pixels[own]]),
        obs_sigma_px=np.concatenate(
            [base.obs_sigma_px[old_obs], *(s.sigmas_px for _, s in seen), marks.obs_sigma_px[own]]
        ),
        inertial=_inertial(state, turn, old, settings) if motion.inertial else None,
        relative=[RelativeTerm(r.i + old, r.j + old, r.i_from_j, r.information) for r in motion.relative],
        priors=_anchors(base, base_keyframes, settings.sessions, anchored),
    )
    result = optimize(problem, how)

    fits = result.squared_sigmas < settings.noise.cut_sigmas**2
    fitting, start = list[Sighting | None](), len(old_obs)
    for sighting in sightings:
        count = 0 if sighting is None else len(sighting.rows)
        fitting.append(None if sighting is None else sighting.only(fits[start : start + count]))
        start += count
    own_points_map = np.full((len(marks.points_map), 3), np.nan)
    own_points_map[own_used] = result.points_map[len(rows) :]
    return JointSolution(
        map_from_body=result.map_from_body[old:],
        base_keyframes=base_keyframes,
        base_from_body=result.map_from_body[:old],
        base_rows=rows,
        base_points_map=result.points_map[: len(rows)],
        own_points_map=own_points_map,
        sightings=fitting,
    )


def _anchors(base: BaseMap, keyframes: Rows, settings: SessionSettings, anchored: bool) -> list[PriorTerm]:
    scale = 1.0 if anchored else 10.0
    sigma = scale * np.array([np.radians(settings.anchor_sigma_deg)] * 3 + [settings.anchor_sigma_m] * 3)
    return [PriorTerm(n, base.map_from_body[k], np.diag(1.0 / sigma**2)) for n, k in enumerate(keyframes)]


def free_observations(marks: Landmarks, sightings: Sequence[Sighting | None]) -> NDArray[np.bool_]:
    """(M,) observations of the survey's own landmarks whose feature shows no landmark of the map."""
    stride = int(marks.obs_feature.max(initial=0)) + 1
    taken = [k * stride + s.features[s.features < stride] for k, s in enumerate(sightings) if s is not None]
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    return ~np.isin(codes, np.concatenate(taken)) if taken else np.ones(len(codes), bool)


def _inertial(state: SurveyState, turn: Array, old: int, settings: SurveySettings) -> InertialTerms:
    """The survey's motion behind that of `old` keyframes, which have none; turn (K, 3, 3) is that of its keyframes since."""
    motion, none = state.motion, np.zeros((old, 3))
    velocities = np.einsum("kij,kj->ki", turn, motion.velocities_mps)
    return InertialTerms(
        np.concatenate([none, velocities]),
        np.concatenate([none, motion.gyro_bias_radps]),
        np.concatenate([none, motion.accel_bias_mps2]),
        inertial_edges(state, settings, first=old),
        fixed=np.r_[np.ones(old, bool), np.zeros(len(turn), bool)],
    )
