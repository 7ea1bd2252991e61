"""Stage 1: odometry over all frames, and the choice of keyframes on the way."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.calibration import RigCalibration
from fleetmap.geometry import Array, rotation_between_vectors, se3
from fleetmap.odometry import Odometry, OdometryEstimate, OdometryStatus
from fleetmap.rectification import RectifiedFrame, Rectifier
from fleetmap.samples import CameraFrame, ImuSamples, WheelSample
from mapserver.survey.keyframes import FrameSummary, Keyframe, KeyframePolicy, PictureShelf, make_keyframe, sharpness
from mapserver.survey.settings import SurveySettings


@dataclass(frozen=True, slots=True)
class FirstGuess:
    """Odometry of F frames and K keyframes.

    odom_from_body (F, 4, 4), covariances (F, 6, 6) in odom axes, rotation first; tracked (F,) false where nothing tied the frame
    to the ones before; inertial: whether gravity was found.
    """

    estimates: list[OdometryEstimate]
    odom_from_body: Array
    covariances: Array
    tracked: Array
    keyframes: list[Keyframe]
    inertial: bool


def run_odometry(
    frames: Iterable[CameraFrame], imu: ImuSamples, calibration: RigCalibration, rectifier: Rectifier, settings: SurveySettings,
    progress: Callable[[int], None], shelf: PictureShelf | None = None,
    wheel: Sequence[WheelSample] = (),
) -> FirstGuess:  # fmt: skip
    """Feeds frames (in order), the IMU and the wheels up to each into the odometry.

    progress is called with each frame's number.
    """
    odometry = Odometry(
        calibration,
        rectifier.camera,
        rectifier.body_from_cam,
        rectifier.imu_minus_cam_s,
        settings.odometry,
        settings.stereo,
    )
    policy = KeyframePolicy(settings.keyframes)
    estimates: list[OdometryEstimate] = []
    odom_from_body: list[Array] = []
    keyframes: list[Keyframe] = []
    fed_ns = -(2**62)
    for number, raw in enumerate(frames):
        frame = rectifier.rectify(raw)
        until_ns = raw.stamp_ns + int(rectifier.imu_minus_cam_s * 1e9) + 10_000_000
        odometry.handle_imu(imu.between(fed_ns, until_ns))
        odometry.handle_wheel([sample for sample in wheel if fed_ns <= sample.stamp_ns < until_ns])
        fed_ns = until_ns
        estimate = odometry.handle_stereo(frame)
        if estimate.new_odom_from_old_odom is not None:
            odom_from_body = [estimate.new_odom_from_old_odom @ earlier for earlier in odom_from_body]
        estimates.append(estimate)
        odom_from_body.append(estimate.odom_from_body)
        if policy.wants(_summary(frame, estimate)):
            keyframes.append(make_keyframe(frame, number, rectifier.camera, settings, shelf))
        progress(number)
    inertial = bool(estimates) and calibration.imu is not None and estimates[-1].inertial
    return FirstGuess(
        estimates,
        np.array(odom_from_body),
        np.array([e.cov_rot_trans for e in estimates]),
        np.array([e.status is not OdometryStatus.DEGRADED for e in estimates]),
        keyframes,
        inertial,
    )


def _summary(frame: RectifiedFrame, estimate: OdometryEstimate) -> FrameSummary:
    return FrameSummary(
        frame.stamp_ns,
        estimate.odom_from_body,
        estimate.track_ids,
        estimate.scene_depth_m,
        sharpness(frame),
        estimate.after_gap,
    )


def _levelled(odom_from_body: Array, covariances: Array, body_from_cam: Array) -> tuple[Array, Array]:
    """The same turned so that z points up, where no accelerometer tells: cameras are taken to be upright on the whole."""
    down = (odom_from_body[:, :3, :3] @ body_from_cam[:3, 1]).mean(axis=0)
    if np.linalg.norm(down) < 1e-6:
        return odom_from_body, covariances
    level_from_odom = se3(rotation_between_vectors(down, np.array([0.0, 0.0, -1.0])), np.zeros(3))
    turn = np.kron(np.eye(2), level_from_odom[:3, :3])
    return level_from_odom @ odom_from_body, turn @ covariances @ turn.T
