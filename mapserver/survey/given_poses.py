"""Poses of another system in place of odometry: the first stage of a survey with a given initial trajectory."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, rotation_between_vectors, se3, se3_inverse, so3_log, transport_cov
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.tracking.tracker import Tracker
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.keyframes.keyframes import KeyframePolicy, sharpness
from mapserver.survey.odometry_pass import TrackedFrame, followed
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import OdometryPass
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

# Assumed drift of the poses, a random walk: standard deviations after one metre.
_WALK_RAD, _WALK_M = 0.01, 0.05
_UPRIGHT = np.cos(np.radians(20.0))  # larger than on any ramp
_UNKNOWN_DEPTH_M = 5.0


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
        estimates.append(replace(estimate, track_ids=np.zeros(0, np.int64), track_pixels=None))
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
        return _levelled(moved, inputs), _gyro_bias(moved, inputs)
    if not len(given) or frame_from_body[0, 2, 2] >= _UPRIGHT:
        return frame_from_body, np.zeros(3)
    start_from_frame = se3_inverse(frame_from_body[0])
    return start_from_frame @ frame_from_body, np.zeros(3)


def _levelled(given: Trajectory, inputs: SurveyInputs) -> Array:
    """Return (F, 4, 4) the poses in a frame with z up: mean specific force is +g upwards, since accelerations cancel out."""
    imu = inputs.imu.between(int(given.stamps_ns[0]), int(given.stamps_ns[-1]) + 1)
    if not len(imu):
        return given.frame_from_body
    nearest = np.clip(np.searchsorted(given.stamps_ns, imu.stamps_ns), 0, len(given) - 1)
    up = np.einsum("nij,nj->i", given.frame_from_body[nearest, :3, :3], imu.accel_mps2) / len(imu)
    level = se3(rotation_between_vectors(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
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
