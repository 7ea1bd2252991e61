"""Adjustment of the frames between keyframes: each is located by points shared with the adjusted keyframes.

Keyframes are fixed. Between two of them the frames, and their points tracked by odometry, are adjusted
together. The IMU constrains neighbouring frames; odometry does without an IMU, or if pictures show too little.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, Indices, Mask, interpolate_se3, se3_inverse
from fleetmap.inertial import preintegrate
from fleetmap.odometry.sensor_buffer import is_pause
from fleetmap.sensors.samples import Stamps
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import scaled_noise
from mapserver.survey.bundle.problem import BundleProblem, InertialTerms, MotionPrior, continued
from mapserver.survey.bundle.stereo_yaw_check import disparity_shift
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.pose_graph.odometry_factors import edge_covariance
from mapserver.survey.settings import MIN_SEEN, BundleSettings, SurveySettings
from mapserver.survey.state import OdometryPass, RelativeTerm, SurveyState

_BATCH = 8  # intervals
_BESIDE = 1  # keyframes beyond the ends used for points; tracks slip, so distant ones would bend the result
_MIN_SPREAD = np.radians(1.0) ** 2 / 4  # of a point's rays: that of two rays 1 degree apart
_BIAS_SIGMAS = np.repeat([np.inf, 1e-4, 1e-3], 3)  # m/s, rad/s, m/s^2, around the adjusted values of the keyframes
# Frames begin near their optimum; further steps would gain hundredths of a millimetre.
_ROUGH = BundleSettings(max_iterations=10, relative_cost_tolerance=1e-2, lambda_start=1e-6)
_FINAL = BundleSettings(
    max_iterations=10, relative_cost_tolerance=1e-3, lambda_start=1e-6, huber_sigmas=0.7, cutoff_sigmas=2.5
)
_WIDE = 25.0  # factor on odometry's covariance where it only determines what pictures cannot


class PlacedFrames(NamedTuple):
    """map_from_body (F, 4, 4); seen (F,): True for frames located by points of keyframes, else by odometry or the IMU alone."""

    map_from_body: Array
    seen: Mask


class _Interval(NamedTuple):
    """Frames (n,) from one keyframe to the next, their slots (n,) in the problem, and a mask of observations (M,) of points seen
    by keyframes."""

    frames: Indices
    slots: Indices
    problem: BundleProblem
    tied: Mask


def place_frames(
    odometry: OdometryPass,
    state: SurveyState,
    settings: SurveySettings,
    correction_px: float = 0.0,
    executor: Executor = SERIAL,
) -> PlacedFrames:
    """Return all F frames of a survey with adjusted keyframes; carried by odometry if no points of the map are seen.

    correction_px: subtracted from disparities by the survey.
    """
    chain = _Chain(odometry, state, settings, correction_px)
    placed, seen = chain.map_from_body.copy(), np.zeros(len(chain.map_from_body), bool)
    seen[chain.numbers] = np.bincount(state.landmarks.obs_keyframe, minlength=len(chain.numbers)) >= MIN_SEEN
    ends = pairwise([-1, *chain.numbers.tolist(), len(placed)])
    batches = in_batches([(a, b) for a, b in ends if b - a > 1], _BATCH)
    built = ([i for a, b in batch if (i := chain.interval(a, b)) is not None] for batch in batches)
    for results in executor.map(_adjust, settings.noise.cut_sigmas, built):
        for frames, map_from_body, is_seen in results:
            placed[frames], seen[frames] = map_from_body, is_seen
    return PlacedFrames(placed, seen)


def _adjust(cut_sigmas: float, intervals: list[_Interval]) -> list[tuple[Indices, Array, Mask]]:
    """Return the frames, map_from_body and whether they are seen, of each interval; outliers are dropped."""
    out = []
    for interval in intervals:
        problem = interval.problem
        result = optimize(problem, _ROUGH)
        keep = result.squared_sigmas < cut_sigmas**2
        problem = continued(problem, result).observed(keep)
        result = optimize(problem, _FINAL)
        ties = np.bincount(problem.obs_keyframe[interval.tied[keep]], minlength=len(problem.fixed))
        seen = ties[interval.slots] >= MIN_SEEN
        out.append((interval.frames, result.map_from_body[interval.slots], seen))
    return out


class _Chain:
    """All frames at their odometry poses, and the observations of tracked points by them and by keyframes."""

    def __init__(
        self, odometry: OdometryPass, state: SurveyState, settings: SurveySettings, correction_px: float
    ) -> None:
        self._odometry, self._state, self._noise = odometry, state, settings.noise
        self._imu_noise = None if state.motion.noise is None else scaled_noise(state.motion.noise, settings)
        self._stamps_ns = odometry.stamps_ns
        self.numbers = np.array(odometry.keyframe_frames, np.int64)
        self.map_from_body = frame_trajectory(
            self._stamps_ns, odometry.odom_from_body, self.numbers.tolist(), state.map_from_body
        )
        self.is_keyframe = np.zeros(len(self.map_from_body), bool)
        self.is_keyframe[self.numbers] = True
        self._correction_px = correction_px

    def interval(self, a: int, b: int) -> _Interval | None:
        """Return the frames between keyframes a and b, of which one may lie beyond the ends; None if they see no points of the map."""
        first, last = np.searchsorted(self.numbers, [a, b])
        beside = self.numbers[max(first - _BESIDE, 0) : last + _BESIDE + 1]
        frames, lost = np.arange(a + 1, b), np.flatnonzero(~self._odometry.tracked[a + 1 : b].astype(bool))
        if len(lost) and a < 0:  # before the first keyframe, and after the last, those connected without a break
            frames = frames[lost[-1] + 1 :]
        elif len(lost) and b == len(self.is_keyframe):
            frames = frames[: lost[0]]
        nodes = np.union1d(frames, beside)
        ids, which, pixels = self._odometry.tracks.of(nodes)
        pixels[:, 2] += self._correction_px * disparity_shift(self._state.rig.camera, pixels)
        fixed = self.is_keyframe[nodes]
        _, marks = np.unique(ids, return_inverse=True)
        points, known = self._points(nodes, which, marks, pixels)
        moving, held = (np.bincount(marks[rows], minlength=len(points)) for rows in (~fixed[which], fixed[which]))
        known &= (moving > 0) & (moving + held > 1)
        rows = np.flatnonzero(known[marks])
        which, marks, pixels = which[rows], (np.cumsum(known) - 1)[marks[rows]], pixels[rows]
        tied = held[known][marks] > 0
        ties = np.bincount(which[tied], minlength=len(nodes))
        if (ties[~fixed] < MIN_SEEN).all():
            return None
        sigmas = np.tile([self._noise.aligned_sigma_px, self._noise.disparity_sigma_px], (len(rows), 1))
        joined = np.flatnonzero((nodes >= max(a, 0)) & (nodes <= b))
        problem = BundleProblem(
            rig=self._state.rig.first,
            map_from_body=self.map_from_body[nodes],
            fixed=fixed,
            points_map=points[known],
            obs_keyframe=which,
            obs_camera=np.zeros_like(which),
            obs_landmark=marks,
            obs_pixels=pixels,
            obs_sigma_px=sigmas,
            inertial=self._inertial(nodes, joined) if self._state.motion.inertial else None,
            relative=self._relative(nodes, joined, ties >= MIN_SEEN),
        )
        return _Interval(frames, np.searchsorted(nodes, frames), problem, tied)

    def _points(self, nodes: Indices, which: Indices, marks: Indices, pixels: Array) -> tuple[Array, Mask]:
        """Return initial points_map (N, 3) and which are known: by a disparity, preferably of the nearest keyframe, else by rays."""
        camera, count = self._state.rig.camera, int(marks.max(initial=-1)) + 1
        map_from_cam = self.map_from_body[nodes] @ self._state.rig.body_from_cam[0]
        at_keyframe, disparities = self.is_keyframe[nodes][which], pixels[:, 0] - pixels[:, 2]
        with np.errstate(invalid="ignore"):
            measured = np.isfinite(disparities) & (disparities > 0) & (camera.baseline_m > 0)
        firsts = np.searchsorted(np.sort(marks), np.arange(count))
        best = np.lexsort((-disparities, ~at_keyframe, ~measured, marks))[firsts]
        seen = camera.point_from_pixel(pixels[best, :2], disparities[best])
        at = map_from_cam[which[best]]
        points, known = np.einsum("nij,nj->ni", at[:, :3, :3], seen) + at[:, :3, 3], measured[best]
        if not known.all():
            held = np.bincount(marks[at_keyframe], minlength=count) > 1
            rows = np.flatnonzero(~known[marks] & (at_keyframe | ~held[marks]))
            crossed, sure = self._crossings(map_from_cam[which[rows]], pixels[rows], marks[rows], count)
            points[sure], known = crossed[sure], known | sure
        return points, known

    def _crossings(self, map_from_cam: Array, pixels: Array, marks: Indices, count: int) -> tuple[Array, Mask]:
        """Return (count, 3) the nearest point to all rays of each point, and whether their directions differ enough."""
        camera = self._state.rig.camera
        rays = np.column_stack([(pixels[:, :2] - camera.lens[1:3]) / camera.focal_px, np.ones(len(pixels))])
        rays = np.einsum("mij,mj->mi", map_from_cam[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        systems, sides = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(systems, marks, across)
        np.add.at(sides, marks, np.einsum("mij,mj->mi", across, map_from_cam[:, :3, 3]))
        rays_of = np.bincount(marks, minlength=count)
        sure = np.linalg.eigvalsh(systems)[:, 0] > _MIN_SPREAD * np.maximum(rays_of, 1)
        points = np.full((count, 3), np.nan)
        points[sure] = np.linalg.solve(systems[sure], sides[sure][:, :, None])[:, :, 0]
        return points, sure

    def _inertial(self, nodes: Indices, joined: Indices) -> InertialTerms:
        """Return IMU terms between the joined nodes, which are neighbours in time."""
        motion, offset_ns = self._state.motion, int(self._state.motion.imu_minus_cam_s * 1e9)
        assert self._imu_noise is not None
        nearest = np.clip(np.searchsorted(self.numbers, nodes), 0, len(self.numbers) - 1)
        motions = np.pad(motion.motions[nearest, 3:], ((0, 0), (3, 0)))
        stamps_ns = self._stamps_ns[nodes] + offset_ns
        seconds = (stamps_ns[joined] - stamps_ns[joined[0]]) * 1e-9
        priors = [MotionPrior(k, motions[k].copy(), _BIAS_SIGMAS) for k in joined[[0, -1]].tolist()]
        motions[joined, :3] = np.gradient(self.map_from_body[nodes[joined], :3, 3], seconds, axis=0)
        edges = []
        for i, j in pairwise(joined.tolist()):
            start_ns, end_ns = int(stamps_ns[i]), int(stamps_ns[j])
            if not is_pause(motion.imu.stamps_ns, start_ns, end_ns):
                biases = motions[i, 3:6], motions[i, 6:]
                edges.append((i, j, preintegrate(motion.imu, start_ns, end_ns, *biases, self._imu_noise)))
        return InertialTerms(motions, edges, priors)

    def _relative(self, nodes: Indices, joined: Indices, sees: Mask) -> list[RelativeTerm]:
        """Return odometry between neighbours: weakly without an IMU, and at full weight if either sees too little."""
        odometry, terms = self._odometry, []
        for i, j in pairwise(joined.tolist()):
            if (sees[i] and sees[j]) and self._state.motion.inertial:
                continue
            f, g = int(nodes[i]), int(nodes[j])
            wide = _WIDE if sees[i] and sees[j] else 1.0
            i_from_j = se3_inverse(odometry.odom_from_body[f]) @ odometry.odom_from_body[g]
            information = np.linalg.inv(wide * edge_covariance(odometry, f, g)).astype(np.float64)
            terms.append(RelativeTerm(i, j, i_from_j, information))
        return terms


def frame_trajectory(
    frame_stamps_ns: Stamps, odom_from_body: Array, keyframe_frames: list[int], map_from_body: Array
) -> Array:
    """Return map_from_body (F, 4, 4) of all frames: carried from the previous and the next keyframe, blended by time.

    odom_from_body (F, 4, 4): the motion; keyframe_frames (K,) frame numbers, ascending; map_from_body (K, 4, 4).
    """
    out = np.empty((len(frame_stamps_ns), 4, 4))
    afters = np.searchsorted(keyframe_frames, np.arange(len(out))).tolist()
    for f, after in enumerate(afters):
        if after < len(keyframe_frames) and keyframe_frames[after] == f:
            out[f] = map_from_body[after]
            continue
        sides = [k for k in (after - 1, after) if 0 <= k < len(keyframe_frames)]
        there = [(map_from_body[k], odom_from_body[keyframe_frames[k]]) for k in sides]
        carried = [map_from_k @ se3_inverse(odom_from_k) @ odom_from_body[f] for map_from_k, odom_from_k in there]
        if len(sides) == 1:
            out[f] = carried[0]
            continue
        start, end = (int(frame_stamps_ns[keyframe_frames[k]]) for k in sides)
        out[f] = interpolate_se3(carried[0], carried[1], (int(frame_stamps_ns[f]) - start) / (end - start))
    return out
