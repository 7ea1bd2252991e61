"""Stage 1: odometry over all frames, and the choice of keyframes on the way."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, rotation_between_vectors, se3
from fleetmap.odometry import OdometryEstimate, OdometryStatus, make_odometry
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample, wheel_between
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.keyframes.keyframes import (
    FrameSummary,
    ImageStore,
    Keyframe,
    KeyframePolicy,
    make_keyframes,
    sharpness,
)
from mapserver.survey.settings import SurveySettings

_LEAD_NS = 30_000_000  # by which IMU and wheels are ahead of a frame, as its stamp may be too early
_GIVEN_UP_RAD, _GIVEN_UP_M = 0.1, 1.0


@dataclass(frozen=True, slots=True)
class OdometryPass:
    """Odometry of F frames and K keyframes.

    odom_from_body (F, 4, 4), covariances (F, 6, 6) in odom axes, rotation first; tracked (F,) false where nothing tied the frame
    to the ones before; inertial: whether gravity was found; scale_known: whether metres are metres; has_wheels: whether wheels were
    listened to. Of one camera's frames only those tracked belong together, and only they give keyframes.
    """

    estimates: list[OdometryEstimate]
    odom_from_body: Array
    covariances: Array
    tracked: Array
    keyframes: list[Keyframe]
    inertial: bool
    scale_known: bool = True
    has_wheels: bool = False


def run_odometry(
    frames: Iterable[CameraFrame | RectifiedFrame], imu: ImuSamples, calibration: RigCalibration, rectifier: Rectifier,
    settings: SurveySettings, progress: Callable[[int], None], shelf: ImageStore | None = None,
    wheel: Sequence[WheelSample] = (), worker: Executor = SERIAL,
) -> OdometryPass:  # fmt: skip
    """Feeds frames (in order), the IMU and the wheels up to each into the odometry.

    frames: as they were recorded, or rectified by who reads them ahead. progress is called with each frame's number. While the
    odometry goes on, the worker finds the features of the keyframes that it has chosen.
    """
    odometry = make_odometry(
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

    def chosen() -> Iterator[tuple[int, RectifiedFrame]]:
        fed_ns = -(2**62)
        for number, raw in enumerate(frames):
            frame = raw if isinstance(raw, RectifiedFrame) else rectifier.rectify(raw)
            until_ns = raw.stamp_ns + int(rectifier.imu_minus_cam_s * 1e9) + _LEAD_NS
            odometry.handle_imu(imu.between(fed_ns, until_ns))
            odometry.handle_wheel(wheel_between(wheel, fed_ns, until_ns))
            fed_ns = until_ns
            estimate = odometry.handle_stereo(frame)
            _take(estimate, estimates, odom_from_body)
            progress(number)
            if policy.wants(_summary(frame, estimate)):
                yield number, frame

    keyframes = list(make_keyframes(chosen(), rectifier.camera, settings, shelf, worker))
    inertial = bool(estimates) and calibration.imu is not None and estimates[-1].inertial
    guess = OdometryPass(
        estimates,
        np.array(odom_from_body),
        carried_on(estimates),
        np.array([e.status is not OdometryStatus.DEGRADED for e in estimates]),
        keyframes,
        inertial,
        bool(estimates) and estimates[-1].scale_known,
        inertial and len(wheel) > 0 and settings.odometry.filter.use_wheels,
    )
    return guess if rectifier.camera.baseline_m > 0 else connected_part(guess, rectifier.body_from_cam)


def _take(estimate: OdometryEstimate, estimates: list[OdometryEstimate], odom_from_body: list[Array]) -> None:
    """Adds one frame's estimate, and moves the ones before as it says."""
    if estimate.new_odom_from_old_odom is not None:
        odom_from_body[:] = [estimate.new_odom_from_old_odom @ earlier for earlier in odom_from_body]
    estimates.append(estimate)
    odom_from_body.append(estimate.odom_from_body)
    for earlier_number, placed in estimate.revised:
        odom_from_body[earlier_number] = placed
        estimates[earlier_number] = replace(
            estimates[earlier_number], odom_from_body=placed, status=OdometryStatus.TRACKING,
            scale_known=estimate.scale_known,
        )  # fmt: skip


def carried_on(estimates: Sequence[OdometryEstimate]) -> Array:
    """(F, 6, 6) covariances that go on where the odometry began anew, which knows its own place for sure then.

    What it said just before it gave up its gravity is hardly worth more than that it did not jump.
    """
    carried = np.zeros((6, 6))
    covariances: list[Array] = []
    for number, estimate in enumerate(estimates):
        change = estimate.new_odom_from_old_odom
        if number and change is not None:
            turn = np.kron(np.eye(2), change[:3, :3])
            carried = turn @ covariances[-1] @ turn.T
            if not estimate.inertial:
                carried = carried + np.diag([_GIVEN_UP_RAD**2] * 3 + [_GIVEN_UP_M**2] * 3)
        covariances.append(carried + estimate.cov_rot_trans)
    return np.array(covariances)


def _summary(frame: RectifiedFrame, estimate: OdometryEstimate) -> FrameSummary:
    return FrameSummary(
        frame.stamp_ns,
        estimate.odom_from_body,
        estimate.track_ids,
        estimate.scene_depth_m,
        sharpness(frame),
        estimate.after_gap,
    )


def connected_part(guess: OdometryPass, body_from_cam: Array) -> OdometryPass:
    """One camera's longest run of frames in one frame and scale; without gravity it is turned upright as cameras are.

    With an IMU what follows its start hangs together through gaps in the pictures, without one every gap begins another scale.
    """
    same = np.array([e.scale_known == guess.scale_known for e in guess.estimates], bool)
    placed = same & np.array([e.status is not OdometryStatus.INITIALISING for e in guess.estimates], bool)
    if not guess.scale_known:
        placed &= guess.tracked
    edges = np.flatnonzero(np.diff(np.concatenate([[False], placed, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    first, end = max(runs.tolist(), key=lambda run: run[1] - run[0], default=[0, 0])
    inside = np.zeros(len(placed), bool)
    inside[first:end] = True
    odom_from_body, covariances = guess.odom_from_body, guess.covariances
    if not guess.inertial and end > first:
        odom_from_body, covariances = _levelled(odom_from_body, covariances, body_from_cam, inside)
    return replace(
        guess, odom_from_body=odom_from_body, covariances=covariances, tracked=guess.tracked & inside,
        keyframes=[k for k in guess.keyframes if inside[k.frame_index]],
    )  # fmt: skip


def _levelled(
    odom_from_body: Array, covariances: Array, body_from_cam: Array, chosen: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """The same turned so that z points up, where no accelerometer tells: cameras are taken to be upright on the whole."""
    down = (odom_from_body[chosen, :3, :3] @ body_from_cam[:3, 1]).mean(axis=0)
    if np.linalg.norm(down) < 1e-6:
        return odom_from_body, covariances
    level_from_odom = se3(rotation_between_vectors(down, np.array([0.0, 0.0, -1.0])), np.zeros(3))
    turn = np.kron(np.eye(2), level_from_odom[:3, :3])
    return level_from_odom @ odom_from_body, turn @ covariances @ turn.T
