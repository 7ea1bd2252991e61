"""The first stage of a survey: odometry over all frames, or poses of another system in its place, with selection of keyframes."""

from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fleetmap import geometry
from fleetmap.geometry import Array, Mask, se3, se3_inverse, so3_log, transport_cov, turned_cov
from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate, OdometryStatus, is_away
from fleetmap.odometry.lift_check import WINDOW_NS
from fleetmap.odometry.mono.mono_modes import make_odometry
from fleetmap.odometry.tracking.tracker import Tracker
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import ImuSamples, Trajectory, WheelSample, wheel_between
from mapserver.survey.keyframes.keyframes import KeyframePolicy, make_keyframes, sharpness
from mapserver.survey.pose_graph.odometry_factors import odometry_factors
from mapserver.survey.rig import rig_of, used_cameras
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import FrameTracks, Keyframe, KeyframeMotion, Landmarks, OdometryPass, SurveyState, turned
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools, TrackedFrame

LEAD_NS = 30_000_000  # lead of IMU and wheels over a frame, whose stamp may be too early
_GIVEN_UP_RAD, _GIVEN_UP_M = 0.1, 1.0
_AWAY_RAD, _AWAY_MPS = np.pi, 1.0  # during a pause: any rotation, and a person's walking speed
_NO_IDS = np.zeros(0, np.int64)
# Assumed drift of the poses, a random walk: standard deviations after one metre.
_WALK_RAD, _WALK_M = 0.01, 0.05
_UPRIGHT = np.cos(np.radians(20.0))  # larger than on any ramp
_UNKNOWN_DEPTH_M = 5.0


class OdometryRun:
    """Odometry of a recording or of sensors, frame by frame, with selection of keyframes."""

    def __init__(
        self, rig: RigCalibration, rectifier: Rectifier, settings: SurveySettings, keyframes_at: Container[int] = ()
    ) -> None:
        """keyframes_at: numbers of frames, counted from 0, that always become keyframes."""
        mounted = MountedRig(rig, rectifier.mounted[:1], rectifier.imu_minus_cam_s)
        self._odometry = make_odometry(mounted, settings.odometry, settings.stereo)
        self._policy = KeyframePolicy(settings.keyframes, keyframes_at)
        self.chain = FrameChain()

    def handle(self, frame: RectifiedFrame, imu: ImuSamples, wheel: Sequence[WheelSample]) -> TrackedFrame:
        """Process the next frame, with the new samples of the IMU and the wheels up to it."""
        self._odometry.handle_imu(imu)
        self._odometry.handle_wheel(wheel)
        estimate = self._odometry.handle_stereo(frame)
        number = len(self.chain.estimates)
        since = self._odometry.motion_since(number - 1) if number else None
        frame_from_body = self.chain.append(estimate, None if since is None else since[1])
        wanted = self._policy.wants(estimate, frame_from_body, sharpness(frame))
        return TrackedFrame(number, frame, estimate, frame_from_body, wanted)


class SampleFeed:
    """The IMU and the wheels of a recording, frame by frame."""

    def __init__(self, imu: ImuSamples, wheel: Sequence[WheelSample], imu_minus_cam_s: float) -> None:
        self._imu, self._wheel, self._offset_ns = imu, wheel, int(imu_minus_cam_s * 1e9)
        self._fed_ns = -(2**62)

    def until(self, stamp_ns: int) -> tuple[ImuSamples, Sequence[WheelSample]]:
        """Return the samples since the last call, up to a frame."""
        since_ns, self._fed_ns = self._fed_ns, stamp_ns + self._offset_ns + LEAD_NS
        return self._imu.between(since_ns, self._fed_ns), wheel_between(self._wheel, since_ns, self._fed_ns)


def run_odometry(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> OdometryPass:
    """Feed frames (in order), the IMU and the wheels up to each into the odometry."""
    rectifier = inputs.rectifier
    run = OdometryRun(inputs.calibration, rectifier, settings, inputs.keyframes_at)
    feed = SampleFeed(inputs.imu, inputs.wheel, rectifier.imu_minus_cam_s)
    keyframes, tracks = followed(lambda frame: run.handle(frame, *feed.until(frame.stamp_ns)), inputs, settings, tools)
    estimates = run.chain.estimates
    inertial = bool(estimates) and inputs.calibration.imu is not None and estimates[-1].inertial
    done = OdometryPass(
        estimates,
        run.chain.odom_from_body(),
        run.chain.covariances(),
        np.array([e.status is not OdometryStatus.DEGRADED for e in estimates]),
        keyframes,
        inertial,
        bool(estimates) and estimates[-1].scale_known,
        inertial and len(inputs.wheel) > 0 and settings.odometry.filter.use_wheels,
        tracks,
    )
    return done if rectifier.camera.baseline_m > 0 else longest_run(done, rectifier.body_from_cam)


def followed(
    handle: Callable[[RectifiedFrame], TrackedFrame], inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools
) -> tuple[list[Keyframe], FrameTracks]:
    """Return the keyframes that `handle` chooses of all frames, given in order, and the points that it tracks.

    In parallel the executor extracts the features of the chosen keyframes.
    """
    seen: list[FrameTracks] = []

    def chosen() -> Iterator[tuple[int, RectifiedFrame]]:
        for raw in inputs.frames:
            tracked = handle(raw if isinstance(raw, RectifiedFrame) else inputs.rectifier.rectify(raw))
            seen.append(FrameTracks.of_frame(tracked.estimate))
            tools.watch(tracked)
            tools.at("odometry", tracked.number + 1, inputs.frame_count)
            if tracked.is_keyframe:
                yield tracked.number, tracked.frame

    keyframes = list(make_keyframes(chosen(), used_cameras(inputs.rectifier), settings, tools))
    return keyframes, FrameTracks.joined(seen)


def poses_as_odometry(
    given: Trajectory, inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools
) -> OdometryPass:
    """Return the odometry pass equivalent to given poses of all F frames, with points tracked by them.

    The poses only predict positions of points: kept are the observed positions, as in fleetmap's odometry. With an IMU the poses are
    levelled by its mean specific force, and the gyro's bias is estimated from them; without one a frame with an initially upright body
    is kept, any other is replaced by the body's axes at the first pose, as in fleetmap's odometry.
    """
    inertial = inputs.calibration.imu is not None and len(inputs.imu) > 0
    odom_from_body, gyro_bias = _upright(given, inputs, inertial)
    seconds, positions_m = (given.stamps_ns - given.stamps_ns[0]) * 1e-9, odom_from_body[:, :3, 3]
    velocities = np.gradient(positions_m, seconds, axis=0) if len(given) > 1 else np.zeros_like(positions_m)
    covariances = _covariances(odom_from_body)
    odom_from_cam = odom_from_body @ inputs.rectifier.body_from_cam
    policy, rectifier = KeyframePolicy(settings.keyframes, inputs.keyframes_at), inputs.rectifier
    tracker = Tracker(rectifier.camera, settings.odometry.tracker, settings.stereo)
    estimates: list[OdometryEstimate] = []

    def handle(frame: RectifiedFrame) -> TrackedFrame:
        number = len(estimates)
        tracked = tracker.track(frame, lambda earlier: se3_inverse(odom_from_cam[number]) @ odom_from_cam[earlier])
        estimate = OdometryEstimate(
            stamp_ns=frame.stamp_ns,
            frame_index=number,
            odom_from_body=odom_from_body[number],
            cov_rot_trans=covariances[number],
            velocity_odom_mps=velocities[number],
            gyro_bias_radps=gyro_bias,
            status=OdometryStatus.TRACKING,
            track_ids=tracked.ids,
            scene_depth_m=_scene_depth_m(tracked.pixels, rectifier.camera),
            inlier_share=tracked.inlier_share,
            after_gap=tracked.by_descriptors,
            inertial=inertial,
            track_pixels=tracked.pixels,
        )
        estimates.append(replace(estimate, track_ids=_NO_IDS, track_pixels=None))
        is_keyframe = policy.wants(estimate, odom_from_body[number], sharpness(frame))
        return TrackedFrame(number, frame, estimate, odom_from_body[number], is_keyframe)

    keyframes, tracks = followed(handle, inputs, settings, tools)
    tied = np.ones(len(given), bool)
    return OdometryPass(estimates, odom_from_body, covariances, tied, keyframes, inertial, tracks=tracks)


def _upright(given: Trajectory, inputs: SurveyInputs, inertial: bool) -> tuple[Array, Array]:
    """Return the poses (F, 4, 4) in an upright frame, and the gyro's bias (3,), zero without an IMU."""
    frame_from_body = given.frame_from_body
    if inertial:
        offset_ns = int(inputs.rectifier.imu_minus_cam_s * 1e9)
        moved = Trajectory(given.stamps_ns + offset_ns, frame_from_body)
        return _levelled_by_imu(moved, inputs), _gyro_bias(moved, inputs)
    if not len(given) or frame_from_body[0, 2, 2] >= _UPRIGHT:
        return frame_from_body, np.zeros(3)
    start_from_frame = se3_inverse(frame_from_body[0])
    return start_from_frame @ frame_from_body, np.zeros(3)


def _levelled_by_imu(given: Trajectory, inputs: SurveyInputs) -> Array:
    """Return (F, 4, 4) the poses in a frame with z up: mean specific force is +g upwards, since accelerations cancel out."""
    imu = inputs.imu.between(int(given.stamps_ns[0]), int(given.stamps_ns[-1]) + 1)
    if not len(imu):
        return given.frame_from_body
    nearest = np.clip(np.searchsorted(given.stamps_ns, imu.stamps_ns), 0, len(given) - 1)
    up = np.einsum("nij,nj->i", given.frame_from_body[nearest, :3, :3], imu.accel_mps2) / len(imu)
    level = se3(geometry.rotation_between_vectors(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    return np.asarray(level @ given.frame_from_body)


def _gyro_bias(given: Trajectory, inputs: SurveyInputs) -> Array:
    """Return (3,) median difference between the gyro's mean rate and that of the poses, over intervals between frames."""
    rotations, found = given.frame_from_body[:, :3, :3], []
    for k in range(len(given) - 1):
        imu = inputs.imu.between(int(given.stamps_ns[k]), int(given.stamps_ns[k + 1]))
        if len(imu):
            dt_s = (given.stamps_ns[k + 1] - given.stamps_ns[k]) * 1e-9
            found.append(imu.gyro_radps.mean(axis=0) - so3_log(rotations[k].T @ rotations[k + 1]) / dt_s)
    return np.median(found, axis=0) if found else np.zeros(3)


def _covariances(odom_from_body: Array) -> Array:
    """Return (F, 6, 6) of a random walk along the path, with a least sigma for each step."""
    steps_m = np.diff(odom_from_body[:, :3, 3], axis=0, prepend=odom_from_body[:1, :3, 3])
    of_a_metre, found = np.diag(np.repeat([_WALK_RAD**2, _WALK_M**2], 3)), [np.zeros((6, 6))]
    for step_m in steps_m:
        found.append(transport_cov(found[-1] + (np.linalg.norm(step_m) + 1e-4) * of_a_metre, step_m))
    return np.array(found[1:])


def _scene_depth_m(pixels: Array, camera: StereoCamera) -> float:
    """Return the median depth of the tracked points, (N, 3) u_left v u_right."""
    disparities = pixels[:, 0] - pixels[:, 2]
    known = disparities[np.isfinite(disparities) & (disparities > 0)]
    return float(camera.focal_px * camera.baseline_m / np.median(known)) if len(known) else _UNKNOWN_DEPTH_M


def initial_state(odometry: OdometryPass, inputs: SurveyInputs) -> SurveyState:
    """Return keyframes of the first camera at their odometry poses, without landmarks."""
    rectifier, numbers = inputs.rectifier, odometry.keyframe_frames
    estimates = [odometry.estimates[n] for n in numbers]
    map_from_body = odometry.odom_from_body[numbers]
    body_velocities = [e.odom_from_body[:3, :3].T @ e.velocity_odom_mps for e in estimates]
    biases = [np.concatenate([e.gyro_bias_radps, e.accel_bias_mps2]) for e in estimates]
    motion = KeyframeMotion(
        inertial=odometry.inertial,
        imu=inputs.imu,
        noise=inputs.calibration.imu,
        imu_minus_cam_s=rectifier.imu_minus_cam_s,
        motions=turned(np.column_stack([body_velocities, biases]), map_from_body[:, :3, :3]),
        relative=[] if odometry.inertial else odometry_factors(odometry, map_from_body),
    )
    return SurveyState(
        stamps_ns=np.array([k.stamp_ns for k in odometry.keyframes], np.int64),
        map_from_body=map_from_body.copy(),
        rig=rig_of(rectifier).first,
        motion=motion,
        landmarks=Landmarks.empty(),
    )


class FrameChain:
    """Estimates of all frames so far, the pose of each frame in one continuous frame, and its covariance."""

    def __init__(self) -> None:
        self.estimates: list[OdometryEstimate] = []
        self._frame, self._frame_from_body = ContinuousFrame(), list[Array]()
        self._covariances, self._own = list[Array](), np.zeros((6, 6))

    def append(self, estimate: OdometryEstimate, step_covariance: Array | None = None) -> Array:
        """Return frame_from_body (4, 4) of one more frame; apply its corrections of earlier frames.

        step_covariance (6, 6): of the motion since the previous frame, in axes of the body there, if the odometry has it.
        """
        self._frame_from_body.append(self._frame.handle(estimate))
        self._covariances.append(self._covariance(estimate, step_covariance))
        self.estimates.append(replace(estimate, track_ids=_NO_IDS, track_pixels=None))
        for earlier, placed in estimate.revised:
            self._frame_from_body[earlier] = self._frame.frame_from_odom @ placed
            tracked = replace(self.estimates[earlier], odom_from_body=placed, status=OdometryStatus.TRACKING)
            self.estimates[earlier] = replace(tracked, scale_known=estimate.scale_known)
        return self._frame_from_body[-1]

    @property
    def covariance(self) -> Array:
        """(6, 6) of the last frame, in axes of the continuous frame."""
        return self._covariances[-1]

    def _covariance(self, estimate: OdometryEstimate, step_covariance: Array | None) -> Array:
        """Return the accumulated covariance of the steps: the frame follows them, not later corrections by the filter.

        Errors of steps are independent while pictures are tracked. A lost filter has a constant error of speed: its covariance grows by as
        much. Across a restart, where that is zero, the previous one continues; a restart that loses gravity adds a wide one, since the
        estimate before it is barely reliable. After a pause without motion in the images a robot may be anywhere.
        """
        own_before, self._own = self._own, turned_cov(estimate.cov_rot_trans, self._frame.frame_from_odom[:3, :3])
        if not self.estimates:
            return self._own
        first, last = self._frame_from_body[-2:]
        lever_m, reached, last_ns = last[:3, 3] - first[:3, 3], self._covariances[-1], self.estimates[-1].stamp_ns
        if estimate.new_odom_from_old_odom is not None:
            own_before = np.zeros((6, 6))
            if not estimate.inertial:
                reached = reached + np.diag([_GIVEN_UP_RAD**2] * 3 + [_GIVEN_UP_M**2] * 3)
        if is_away(last_ns, estimate):
            away_m = _AWAY_MPS * (estimate.stamp_ns - last_ns) * 1e-9
            reached = reached + np.diag([_AWAY_RAD**2] * 3 + [away_m**2] * 3)
        if step_covariance is None or estimate.status is OdometryStatus.DEGRADED:
            values, vectors = np.linalg.eigh(transport_cov(self._own, -lever_m) - own_before)
            gained = (vectors * np.abs(values)) @ vectors.T
        else:
            gained = turned_cov(step_covariance, first[:3, :3])
        return transport_cov(reached + gained, lever_m)

    @property
    def level_from_frame(self) -> Array:
        """(3, 3) rotation that makes the continuous frame upright, by the present gravity estimate."""
        return np.asarray(self._frame.frame_from_odom[:3, :3].T)

    def odom_from_body(self) -> Array:
        """(F, 4, 4) in the frame of the last estimate, with the best gravity estimate."""
        return np.asarray(se3_inverse(self._frame.frame_from_odom) @ np.array(self._frame_from_body).reshape(-1, 4, 4))

    def covariances(self) -> Array:
        """(F, 6, 6) in the axes of `odom_from_body`."""
        return turned_cov(np.array(self._covariances).reshape(-1, 6, 6), self.level_from_frame)


def longest_run(odometry: OdometryPass, body_from_cam: Array) -> OdometryPass:
    """Return one camera's longest run of frames with one frame and scale, levelled by the cameras if gravity is unknown.

    With an IMU the frames after its start are connected through gaps in the pictures; without one every gap starts another scale.
    """
    same = np.array([e.scale_known == odometry.scale_known for e in odometry.estimates], bool)
    placed = same & np.array([e.status is not OdometryStatus.INITIALISING for e in odometry.estimates], bool)
    if not odometry.scale_known:
        placed &= odometry.tracked
    edges = np.flatnonzero(np.diff(np.concatenate([[False], placed, [False]]).astype(np.int8)))
    first, end = max(edges.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0], default=[0, 0])
    inside = np.zeros(len(placed), bool)
    inside[first:end] = True
    odom_from_body, covariances = odometry.odom_from_body, odometry.covariances
    if not odometry.inertial and end > first:
        odom_from_body, covariances = _levelled(odom_from_body, covariances, body_from_cam, inside)
    keyframes, tracked = [k for k in odometry.keyframes if inside[k.frame_index]], odometry.tracked & inside
    return replace(
        odometry, odom_from_body=odom_from_body, covariances=covariances, tracked=tracked, keyframes=keyframes
    )


def parts_between_lifts(estimates: Sequence[OdometryEstimate]) -> list[slice]:
    """Return the runs of frames in which the robot was on the ground: nothing measures how hands or a fork carry it to the next.

    A lift is noticed by the motion within `WINDOW_NS`, whose frames belong to no part; nor does a run that is not longer.
    """
    if not any(estimate.is_lifted for estimate in estimates):
        return [slice(None)]
    stamps_ns = np.array([estimate.stamp_ns for estimate in estimates])
    ends = [n for n, estimate in enumerate(estimates) if estimate.is_lifted]
    begins = np.searchsorted(stamps_ns, stamps_ns[ends] - WINDOW_NS).tolist()
    runs = zip([0, *(end + 1 for end in ends)], [*begins, len(estimates)], strict=True)
    return [slice(a, b) for a, b in runs if b > a and stamps_ns[b - 1] - stamps_ns[a] > WINDOW_NS]


def _levelled(odom_from_body: Array, covariances: Array, body_from_cam: Array, chosen: Mask) -> tuple[Array, Array]:
    """Rotate the pass so that z points up, without an accelerometer: cameras are assumed upright on average."""
    down = (odom_from_body[chosen, :3, :3] @ body_from_cam[:3, 1]).mean(axis=0)
    if np.linalg.norm(down) < 1e-6:
        return odom_from_body, covariances
    level_from_odom = se3(geometry.rotation_between_vectors(down, np.array([0.0, 0.0, -1.0])), np.zeros(3))
    return level_from_odom @ odom_from_body, turned_cov(covariances, level_from_odom[:3, :3])
