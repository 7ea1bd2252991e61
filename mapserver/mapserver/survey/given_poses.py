"""Poses of another system in place of odometry: the first stage of a survey whose initial trajectory is given."""

from collections.abc import Iterator

import cv2
import numpy as np

from fleetmap.features import stereo
from fleetmap.geometry import Array, rotation_between_vectors, se3, se3_inverse, so3_log
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.survey.keyframes.keyframes import FrameSummary, KeyframePolicy, make_keyframes, sharpness
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

# Assumed drift of the poses, a random walk: standard deviations after one metre.
_WALK_RAD, _WALK_M = 0.01, 0.05
_UPRIGHT = np.cos(np.radians(20.0))  # what a ramp does not exceed
_CORNERS, _UNKNOWN_DEPTH_M = 100, 5.0


def poses_as_odometry(
    given: Trajectory, inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools
) -> OdometryPass:
    """The odometry pass that given poses of all F frames amount to; keyframes are chosen by motion alone.

    With an IMU the poses are levelled by its mean specific force, and the gyro's bias is estimated from them; without one a frame in
    which the body begins upright is kept, any other gives way to the body's axes at the first pose, as our odometry has them.
    """
    inertial = inputs.calibration.imu is not None and len(inputs.imu) > 0
    offset_ns = int(inputs.rectifier.imu_minus_cam_s * 1e9)
    gyro_bias = np.zeros(3)
    odom_from_body = given.frame_from_body
    if not inertial and len(given) and odom_from_body[0, 2, 2] < _UPRIGHT:
        start_from_frame = se3_inverse(given.frame_from_body[0])
        odom_from_body = start_from_frame @ given.frame_from_body
    if inertial:
        moved = Trajectory(given.stamps_ns + offset_ns, given.frame_from_body)
        odom_from_body, gyro_bias = _levelled(moved, inputs), _gyro_bias(moved, inputs)
    seconds = (given.stamps_ns - given.stamps_ns[0]) * 1e-9
    velocities = np.zeros((len(given), 3))
    if len(given) > 1:
        velocities = np.asarray(np.gradient(odom_from_body[:, :3, 3], seconds, axis=0)).reshape(-1, 3)
    covariances = _covariances(odom_from_body)
    estimates = [
        OdometryEstimate(
            stamp_ns=int(stamp_ns),
            frame_index=number,
            odom_from_body=odom_from_body[number],
            cov_rot_trans=covariances[number],
            velocity_odom_mps=velocities[number],
            gyro_bias_radps=gyro_bias,
            accel_bias_mps2=np.zeros(3),
            status=OdometryStatus.TRACKING,
            track_ids=np.zeros(1, np.int64),  # the same for all frames: the policy goes by motion
            scene_depth_m=_UNKNOWN_DEPTH_M,
            inlier_share=1.0,
            after_gap=False,
            inertial=inertial,
            new_odom_from_old_odom=None,
        )
        for number, stamp_ns in enumerate(given.stamps_ns)
    ]
    policy, rectifier = KeyframePolicy(settings.keyframes), inputs.rectifier

    def chosen() -> Iterator[tuple[int, RectifiedFrame]]:
        for number, raw in enumerate(inputs.frames):
            frame = raw if isinstance(raw, RectifiedFrame) else rectifier.rectify(raw)
            tools.progress("odometry", number + 1, inputs.frame_count)
            depth_m, ids = _scene_depth_m(frame, rectifier.camera, settings), estimates[number].track_ids
            summary = FrameSummary(
                frame.stamp_ns, odom_from_body[number], ids, depth_m, sharpness(frame), after_gap=False
            )
            if policy.wants(summary):
                yield number, frame

    keyframes = list(make_keyframes(chosen(), rectifier.camera, settings, tools.images, tools.executor))
    return OdometryPass(estimates, odom_from_body, covariances, np.ones(len(given), bool), keyframes, inertial)


def _levelled(given: Trajectory, inputs: SurveyInputs) -> Array:
    """(F, 4, 4) the poses in a frame with z up: specific force is +g upwards on average, as accelerations cancel out."""
    imu = inputs.imu.between(int(given.stamps_ns[0]), int(given.stamps_ns[-1]) + 1)
    if not len(imu):
        return given.frame_from_body
    nearest = np.clip(np.searchsorted(given.stamps_ns, imu.stamps_ns), 0, len(given) - 1)
    up = np.einsum("nij,nj->i", given.frame_from_body[nearest, :3, :3], imu.accel_mps2) / len(imu)
    level = se3(rotation_between_vectors(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    return np.asarray(level @ given.frame_from_body)


def _gyro_bias(given: Trajectory, inputs: SurveyInputs) -> Array:
    """(3,) median difference between the gyro's mean rate and that of the poses, over intervals between frames."""
    rotations, found = given.frame_from_body[:, :3, :3], []
    for k in range(len(given) - 1):
        imu = inputs.imu.between(int(given.stamps_ns[k]), int(given.stamps_ns[k + 1]))
        if len(imu):
            dt_s = (given.stamps_ns[k + 1] - given.stamps_ns[k]) * 1e-9
            found.append(imu.gyro_radps.mean(axis=0) - so3_log(rotations[k].T @ rotations[k + 1]) / dt_s)
    return np.median(found, axis=0) if found else np.zeros(3)


def _covariances(odom_from_body: Array) -> Array:
    """(F, 6, 6) of a random walk along the way, with a floor for each step."""
    steps_m = np.linalg.norm(np.diff(odom_from_body[:, :3, 3], axis=0, prepend=odom_from_body[:1, :3, 3]), axis=1)
    variances = np.repeat([_WALK_RAD**2, _WALK_M**2], 3) * np.cumsum(steps_m + 1e-4)[:, None]
    return np.asarray(variances[:, :, None] * np.eye(6))


def _scene_depth_m(frame: RectifiedFrame, camera: StereoCamera, settings: SurveySettings) -> float:
    """Median depth of some corners."""
    corners = cv2.goodFeaturesToTrack(frame.left, _CORNERS, 0.01, 12)
    if corners is None:
        return _UNKNOWN_DEPTH_M
    pixels = corners.reshape(-1, 2).astype(np.float64)
    disparities = stereo.disparities(frame, camera, pixels, settings.stereo)[:, 0]
    known = disparities[np.isfinite(disparities) & (disparities > 0)]
    return float(camera.focal_px * camera.baseline_m / np.median(known)) if len(known) else _UNKNOWN_DEPTH_M
