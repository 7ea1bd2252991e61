"""Bundle adjustment of a survey: assembling the problem, rounds with outliers removed in between, local windows."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.inertial import preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.bundle.bundle_adjustment import BundleProblem, BundleResult, InertialTerms, RelativeTerm, optimize
from mapserver.survey.settings import SurveySettings
from mapserver.survey.tracks.tracks import Landmarks


@dataclass
class Motion:
    """What is known of motion at K keyframes; inertial is False for a rig whose gravity was never found.

    velocities_mps, gyro_bias_radps, accel_bias_mps2 (K, 3); relative: odometry between neighbours, used where there is
    no IMU, and where pictures show nothing.
    goes_on (K,): whether the IMU is believed from the keyframe before on; everywhere for None.
    """

    inertial: bool
    imu: ImuSamples
    noise: ImuNoise | None
    imu_minus_cam_s: float
    velocities_mps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    relative: list[RelativeTerm]
    goes_on: NDArray[np.bool_] | None = None


@dataclass
class SurveyState:
    """Everything that adjustment moves: K keyframes and the landmarks."""

    stamps_ns: NDArray[np.int64]
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera
    motion: Motion
    landmarks: Landmarks
    is_depth_camera: bool = False

    def cam_from_cam(self, j: int, i: int) -> Array:
        """camera j from camera i (4, 4)."""
        map_from_cam = self.map_from_body[[j, i]] @ self.body_from_cam
        return np.asarray(se3_inverse(map_from_cam[0]) @ map_from_cam[1])


def adjust(
    state: SurveyState, settings: SurveySettings, free: NDArray[np.bool_] | None = None, rounds: int = 3, *, final: bool = False
) -> BundleResult:  # fmt: skip
    """Adjusts `state` in place; outlying observations are dropped between rounds. `free` (K,) limits it to a window.

    final: near the optimum; the last round takes the redescending cost of `final_bundle`.
    """
    for round_number in range(rounds):
        problem = bundle_problem(state, settings, free)
        last = round_number + 1 == rounds
        how = settings.rough_bundle if not last else settings.final_bundle if final else settings.bundle
        result = optimize(problem, how)
        take(state, result)
        if not last:
            keep = result.squared_sigmas < settings.noise.cut_sigmas**2
            if free is not None:
                keep |= ~np.isin(state.landmarks.obs_keyframe, np.flatnonzero(free))
            state.landmarks = state.landmarks.keep_observations(keep, settings.min_observations)
    return result


def state_of(state: SurveyState, chosen: NDArray[np.bool_]) -> SurveyState:
    """A state of its own of the chosen keyframes (K,) and of the landmarks that two of them see."""
    number, motion = np.cumsum(chosen) - 1, state.motion
    marks = state.landmarks.keep_observations(chosen[state.landmarks.obs_keyframe], 2)
    marks = replace(marks, obs_keyframe=number[marks.obs_keyframe].astype(np.int32))
    relative = [
        replace(r, i=int(number[r.i]), j=int(number[r.j])) for r in motion.relative if chosen[r.i] and chosen[r.j]
    ]
    return replace(
        state, stamps_ns=state.stamps_ns[chosen], map_from_body=state.map_from_body[chosen], landmarks=marks,
        motion=replace(
            motion, velocities_mps=motion.velocities_mps[chosen], gyro_bias_radps=motion.gyro_bias_radps[chosen],
            accel_bias_mps2=motion.accel_bias_mps2[chosen], relative=relative,
        ),
    )  # fmt: skip


def adjust_windows(state: SurveyState, settings: SurveySettings) -> None:
    """Local bundle adjustment: overlapping windows in order, all else held; what drifts is left to the loops."""
    count, window = len(state.stamps_ns), settings.local_window
    for start in range(0, max(count - window // 2, 1), window // 2):
        free = np.zeros(count, bool)
        free[start : start + window] = True
        if free.all():
            return
        _local(state, settings, free)


def _local(state: SurveyState, settings: SurveySettings, free: NDArray[np.bool_]) -> None:
    """One window with the earlier keyframes that see the same landmarks held; landmarks seen from elsewhere alone stay."""
    marks = state.landmarks
    inside = free[marks.obs_keyframe]
    touched = np.zeros(len(marks.points_map), bool)
    touched[marks.obs_landmark[inside]] = True
    first, last = np.flatnonzero(free)[[0, -1]]
    # Later keyframes are where odometry left them: held, they would pull the window back to the drift.
    rows = np.flatnonzero(touched[marks.obs_landmark] & (marks.obs_keyframe <= last))
    used = np.zeros(len(free), bool)
    used[marks.obs_keyframe[rows]] = True
    used[max(first - 1, 0) : last + 1] = True
    keyframes = np.flatnonzero(used)
    number = np.cumsum(used) - 1
    landmark_number = np.cumsum(touched) - 1
    motion = state.motion
    part = SurveyState(
        state.stamps_ns[keyframes], state.map_from_body[keyframes], state.body_from_cam, state.camera,
        replace(
            motion, velocities_mps=motion.velocities_mps[keyframes], gyro_bias_radps=motion.gyro_bias_radps[keyframes],
            accel_bias_mps2=motion.accel_bias_mps2[keyframes],
            relative=[replace(r, i=int(number[r.i]), j=int(number[r.j])) for r in motion.relative if used[r.i] and used[r.j]],
        ),
        Landmarks(
            marks.points_map[touched], number[marks.obs_keyframe[rows]].astype(np.int32),
            landmark_number[marks.obs_landmark[rows]].astype(np.int32), marks.obs_feature[rows], marks.obs_pixels[rows],
            marks.obs_sigma_px[rows],
        ),
    )  # fmt: skip
    result = optimize(bundle_problem(part, settings, free[keyframes]), settings.rough_bundle)
    state.map_from_body[keyframes] = result.map_from_body
    marks.points_map[touched] = result.points_map
    if (
        result.velocities_map_mps is not None
        and result.gyro_bias_radps is not None
        and result.accel_bias_mps2 is not None
    ):
        motion.velocities_mps[keyframes] = result.velocities_map_mps
        motion.gyro_bias_radps[keyframes] = result.gyro_bias_radps
        motion.accel_bias_mps2[keyframes] = result.accel_bias_mps2


def bundle_problem(state: SurveyState, settings: SurveySettings, free: NDArray[np.bool_] | None) -> BundleProblem:
    """What there is to adjust; `free` (K,) are the keyframes that may move, all for None."""
    marks, motion = state.landmarks, state.motion
    fixed = np.zeros(len(state.stamps_ns), bool) if free is None else ~free
    if not fixed.any():
        fixed[0] = True
    holds_all = free is None or bool(free[0])
    return BundleProblem(
        state.camera, state.body_from_cam, state.map_from_body, fixed, marks.points_map, marks.obs_keyframe, marks.obs_landmark,
        marks.obs_pixels, marks.obs_sigma_px,
        inertial=_inertial(state, settings, fixed if not holds_all else None) if motion.inertial else None,
        relative=motion.relative,
        gauge="yaw_position" if motion.inertial and holds_all else "pose",
    )  # fmt: skip


def _inertial(state: SurveyState, settings: SurveySettings, held: NDArray[np.bool_] | None) -> InertialTerms:
    motion = state.motion
    assert motion.noise is not None
    noise = widened(motion.noise, settings)
    offset_ns = int(motion.imu_minus_cam_s * 1e9)
    edges = []
    for k in range(len(state.stamps_ns) - 1):
        if (held is not None and held[k] and held[k + 1]) or (motion.goes_on is not None and not motion.goes_on[k + 1]):
            continue
        start, end = int(state.stamps_ns[k]) + offset_ns, int(state.stamps_ns[k + 1]) + offset_ns
        edges.append(
            (
                k,
                k + 1,
                preintegrate(motion.imu, start, end, motion.gyro_bias_radps[k], motion.accel_bias_mps2[k], noise),
            )
        )
    return InertialTerms(motion.velocities_mps, motion.gyro_bias_radps, motion.accel_bias_mps2, edges, fixed=held)


def widened(noise: ImuNoise, settings: SurveySettings) -> ImuNoise:
    """The data sheet's densities times the survey's scales: an IMU on a robot is noisier than on a desk."""
    s = settings.noise
    return ImuNoise(
        noise.gyro_noise_radps_rthz * s.gyro_noise_scale,
        noise.gyro_walk_radps2_rthz * s.walk_scale,
        noise.accel_noise_mps2_rthz * s.accel_noise_scale,
        noise.accel_walk_mps3_rthz * s.walk_scale,
    )


def take(state: SurveyState, result: BundleResult) -> None:
    """Moves what `state` adjusts to where `result` says."""
    state.map_from_body = result.map_from_body
    state.landmarks.points_map = result.points_map
    if (
        result.velocities_map_mps is not None
        and result.gyro_bias_radps is not None
        and result.accel_bias_mps2 is not None
    ):
        state.motion.velocities_mps = result.velocities_map_mps
        state.motion.gyro_bias_radps = result.gyro_bias_radps
        state.motion.accel_bias_mps2 = result.accel_bias_mps2
