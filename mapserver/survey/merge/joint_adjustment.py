"""One adjustment of the map's keyframes, held where they were unless much speaks against it, and the new survey's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial import preintegrate
from fleetmap.odometry.sensor_buffer import is_pause
from fleetmap.relocalization.landmark_visibility import Rows
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import scaled_noise
from mapserver.survey.bundle.problem import BundleProblem, BundleResult, InertialTerms, PriorTerm
from mapserver.survey.bundle.settings import BundleSettings
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.guided_matching import Sighting
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import KeyframeMotion, Landmarks, RelativeTerm, SurveyState


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
        problem = _Problem(base, state, map_from_body, sightings, settings, anchored)
        result = problem.solve(how)
        sightings = problem.fitting(result.squared_sigmas, sightings)
        map_from_body = result.map_from_body[problem.old :]
    points = np.full((len(state.landmarks.points_map), 3), np.nan)
    points[problem.own_used] = result.points_map[len(problem.rows) :]
    old_map_from_body, old_points_map = result.map_from_body[: problem.old], result.points_map[: len(problem.rows)]
    old = (problem.base_keyframes, old_map_from_body, problem.rows, old_points_map)
    return JointSolution(map_from_body, *old, points, sightings)


class _Problem:
    """The bundle problem: first the map's keyframes and landmarks, then the survey's."""

    def __init__(
        self,
        base: BaseMap,
        state: SurveyState,
        map_from_body: Array,
        sightings: list[Sighting | None],
        settings: SurveySettings,
        anchored: bool,
    ) -> None:
        self.base, self.state, self.settings, self.anchored = base, state, settings, anchored
        self.start = map_from_body
        seen = [s for s in sightings if s is not None]
        self.rows = np.unique(np.concatenate([s.rows for s in seen])) if seen else np.zeros(0, np.int64)
        number = np.full(len(base.points_map), -1)
        number[self.rows] = np.arange(len(self.rows))
        old_obs = np.flatnonzero(number[base.map.obs_landmark] >= 0)
        self.base_keyframes = np.unique(base.map.obs_keyframe[old_obs]).astype(np.int64)
        self.old = len(self.base_keyframes)
        self.own_kept, self.own_used = _own(state.landmarks, sightings)
        marks = state.landmarks
        own_number = np.cumsum(self.own_used) - 1 + len(self.rows)
        keyframes: list[AnyArray] = [np.searchsorted(self.base_keyframes, base.map.obs_keyframe[old_obs])]
        landmarks, pixels, sigmas = (
            [number[base.map.obs_landmark[old_obs]]],
            [base.obs_pixels[old_obs]],
            [base.obs_sigma_px[old_obs]],
        )
        for k, sighting in enumerate(sightings):
            if sighting is not None:
                keyframes.append(np.full(len(sighting.rows), self.old + k))
                landmarks.append(number[sighting.rows])
                pixels.append(sighting.pixels)
                sigmas.append(sighting.sigmas_px)
        self.sighted = slice(len(old_obs), sum(len(part) for part in keyframes))
        keyframes.append(self.old + marks.obs_keyframe[self.own_kept])
        landmarks.append(own_number[marks.obs_landmark[self.own_kept]])
        pixels.append(marks.obs_pixels[self.own_kept])
        sigmas.append(marks.obs_sigma_px[self.own_kept])
        numbers = (np.concatenate(keyframes).astype(np.int32), np.concatenate(landmarks).astype(np.int32))
        self.observations = (*numbers, np.concatenate(pixels), np.concatenate(sigmas))

    def solve(self, how: BundleSettings) -> BundleResult:
        """The optimum, as near as `how` asks for."""
        base, state = self.base, self.state
        turn = self.start[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
        shift = self.start[:, :3, 3] - np.einsum("kij,kj->ki", turn, state.map_from_body[:, :3, 3])
        marks = state.landmarks
        first = np.zeros(len(marks.points_map), np.int64)
        first[marks.obs_landmark[::-1]] = marks.obs_keyframe[::-1]  # carried with the keyframe that defines them
        carried = np.einsum("nij,nj->ni", turn[first], marks.points_map) + shift[first]
        fixed = np.zeros(self.old + len(self.start), bool)
        if not (self.anchored and self.old):  # the map's first keyframe, or the survey's where it sees none of the map
            fixed[0] = True
        motion, old = state.motion, self.old
        problem = BundleProblem(
            base.camera,
            state.body_from_cam,
            np.concatenate([base.map_from_body[self.base_keyframes], self.start]),
            fixed,
            np.concatenate([base.points_map[self.rows], carried[self.own_used]]),
            *self.observations,
            inertial=_inertial(motion, state.stamps_ns, turn, old, self.settings) if motion.inertial else None,
            relative=[RelativeTerm(r.i + old, r.j + old, r.i_from_j, r.information) for r in motion.relative],
            priors=self._anchors(),
        )
        return optimize(problem, how)

    def _anchors(self) -> list[PriorTerm]:
        s = self.settings.sessions
        scale = 1.0 if self.anchored else 10.0
        sigma = scale * np.array([np.radians(s.anchor_sigma_deg)] * 3 + [s.anchor_sigma_m] * 3)
        return [
            PriorTerm(n, self.base.map_from_body[k], np.diag(1.0 / sigma**2)) for n, k in enumerate(self.base_keyframes)
        ]

    def fitting(self, squared: Array, sightings: list[Sighting | None]) -> list[Sighting | None]:
        """The sightings whose residual is within the cut."""
        good = squared[self.sighted] < self.settings.noise.cut_sigmas**2
        out: list[Sighting | None] = []
        start = 0
        for sighting in sightings:
            if sighting is None:
                out.append(None)
                continue
            out.append(sighting.only(good[start : start + len(sighting.rows)]))
            start += len(sighting.rows)
        return out


def free_observations(marks: Landmarks, sightings: Sequence[Sighting | None]) -> NDArray[np.bool_]:
    """(M,) observations of the survey's own landmarks whose feature shows no landmark of the map."""
    stride = int(marks.obs_feature.max(initial=0)) + 1
    taken = [k * stride + s.features[s.features < stride] for k, s in enumerate(sightings) if s is not None]
    codes = marks.obs_keyframe.astype(np.int64) * stride + marks.obs_feature
    return ~np.isin(codes, np.concatenate(taken)) if taken else np.ones(len(codes), bool)


def _own(marks: Landmarks, sightings: Sequence[Sighting | None]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the survey's own observations (M,) and landmarks (N,) take part: a feature that shows a landmark of the map counts there."""
    free = free_observations(marks, sightings)
    used = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map)) >= 2
    return free & used[marks.obs_landmark], used


def _inertial(
    motion: KeyframeMotion, stamps_ns: NDArray[np.int64], turn: Array, old: int, settings: SurveySettings
) -> InertialTerms:
    assert motion.noise is not None
    noise, offset_ns = scaled_noise(motion.noise, settings), int(motion.imu_minus_cam_s * 1e9)
    edges = []
    for k in range(len(stamps_ns) - 1):
        start, end = int(stamps_ns[k]) + offset_ns, int(stamps_ns[k + 1]) + offset_ns
        if is_pause(motion.imu.stamps_ns, start, end):
            continue
        summed = preintegrate(motion.imu, start, end, motion.gyro_bias_radps[k], motion.accel_bias_mps2[k], noise)
        edges.append((old + k, old + k + 1, summed))
    none = np.zeros((old, 3))
    held = np.r_[np.ones(old, bool), np.zeros(len(stamps_ns), bool)]
    velocities = np.einsum("kij,kj->ki", turn, motion.velocities_mps)
    states = (velocities, motion.gyro_bias_radps, motion.accel_bias_mps2)
    velocities, gyro_biases, accel_biases = (np.concatenate([none, values]) for values in states)
    return InertialTerms(velocities, gyro_biases, accel_biases, edges, fixed=held)
