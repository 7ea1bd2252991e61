"""A simulated drive as calibration sees it: landmarks of a simulated site in keyframes, with IMU and wheels, without pictures."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import ImuSamples
from fleetsim.recorder import Order, Session, prepare
from mapserver.calibration import CalibrationEstimate, CalibrationParameter, ParameterEstimate
from mapserver.calibration.motion_rows import CalibrationData, MotionState
from mapserver.calibration.parameters import COLUMNS, RigAxes, corrected_rig
from support.estimator.simulated_run import EstimatorSession

SIGMAS_PX = np.array([0.25, 0.12, 0.15])  # of the left pixel, the disparity, the row difference


@dataclass(frozen=True)
class Stretch:
    """Exact observations on one stretch of a drive: K keyframes, sorted observations of landmarks, raw pixels (M, 2) of each camera."""

    session: Session
    stamps_ns: Array
    map_from_body: Array
    velocities_mps: Array
    points_map: Array
    obs_keyframe: Array
    obs_landmark: Array
    left_px: Array
    right_px: Array


def make_stretch(order: Order, start_s: float, duration_s: float, step_s: float = 0.3, per_frame: int = 150) -> Stretch:
    """Keyframes every step_s and some landmarks that are seen at least three times."""
    session = prepare(order)
    seen = EstimatorSession(session)
    times = np.array(session.frame_times_s)
    wanted = np.arange(start_s, min(start_s + duration_s, times[-1]), step_s)
    frames = np.unique(np.searchsorted(times, wanted))
    pixels, ids, points, keyframes = [], [], [], []
    for k, frame in enumerate(frames.tolist()):
        look = seen.sighting(frame)
        chosen = np.argsort(look.keys[:, 2] * np.uint64(11400714819323198485))[:per_frame]
        ids.append(look.ids[chosen])
        points.append(look.points_map[chosen])
        pixels.append(look.pixels[chosen])
        keyframes.append(np.full(len(chosen), k))
    _, of, count = np.unique(np.concatenate(ids), return_inverse=True, return_counts=True)
    keep = count[of] >= 3
    landmark = np.unique(of[keep], return_inverse=True)[1]
    order_of = np.lexsort((np.concatenate(keyframes)[keep], landmark))
    landmark, keyframe = landmark[order_of], np.concatenate(keyframes)[keep][order_of]
    where = np.concatenate(points)[keep][order_of]
    firsts = np.flatnonzero(np.diff(landmark, prepend=-1))
    rig, motion, at = session.true, session.motion, times[frames]
    map_from_body = motion.map_from_body(at)
    in_body = np.einsum("mji,mj->mi", map_from_body[keyframe, :3, :3], where - map_from_body[keyframe, :3, 3])
    sides = []
    for camera in rig.cameras:
        rays = (in_body - camera.body_from_cam[:3, 3]) @ camera.body_from_cam[:3, :3]
        sides.append(camera.pixel_from_ray(rays))
    velocities = np.einsum("kij,kj->ki", map_from_body[:, :3, :3], motion.velocity_body(at))
    stamps = np.array(session.frame_stamps_ns(), np.int64)[frames]
    return Stretch(session, stamps, map_from_body, velocities, where[firsts], keyframe, landmark, sides[0], sides[1])


def with_errors(rig: RigCalibration, theta: Array) -> RigCalibration:
    """A calibration to which the corrections theta (C,) must be applied to get `rig`, to first order in each."""
    return corrected_rig(rig, RigAxes.of(rig, Rectifier(rig)), -theta)


def measured(
    stretch: Stretch, given: RigCalibration, seed: int, *, inertial: bool = True, wheels: bool = True
) -> CalibrationData:
    """The stretch with random errors of SIGMAS_PX, as a survey under the calibration `given` has it."""
    rng = np.random.default_rng(seed)
    rectifier = Rectifier(given)
    count = len(stretch.left_px)
    left = stretch.left_px + rng.normal(0.0, SIGMAS_PX[0], (count, 2))
    apart = rng.normal(0.0, 1.0, (count, 2)) * SIGMAS_PX[1:]
    right = stretch.right_px + (left - stretch.left_px) - apart
    pixels = np.column_stack([_rectified(rectifier, given, left, 0), _rectified(rectifier, given, right, 1)])
    rig = given if inertial else replace(given, imu=None)
    motions = np.zeros((len(stretch.stamps_ns), 9))
    motions[:, :3] = stretch.velocities_mps if inertial else 0.0
    return CalibrationData(
        calibration=rig,
        rectifier=rectifier,
        stamps_ns=stretch.stamps_ns,
        start=MotionState(stretch.map_from_body, motions, stretch.points_map),
        obs_keyframe=stretch.obs_keyframe,
        obs_landmark=stretch.obs_landmark,
        obs_pixels=pixels,
        obs_sigma_px=np.tile(SIGMAS_PX, (count, 1)),
        imu=stretch.session.imu if inertial else ImuSamples.empty(),
        wheel=stretch.session.wheel if wheels else (),
    )


def _rectified(rectifier: Rectifier, rig: RigCalibration, raw_px: Array, number: int) -> Array:
    camera = rig.cameras[number]
    rays = camera.ray_from_pixel(raw_px) @ camera.body_from_cam[:3, :3].T @ rectifier.body_from_cam[:3, :3]
    pinhole = rectifier.camera
    return rays[:, :2] / rays[:, 2:] * pinhole.focal_px + [pinhole.cx_px, pinhole.cy_px]


def estimate(*, unknown: dict[CalibrationParameter, str] | None = None, **off: float) -> CalibrationEstimate:
    """All parameters right to a tenth of their limit, but for those that are off, by name of the member, and those that nothing shows."""
    sigmas = np.array([0.1 * p.warn_above for p in COLUMNS])
    values = {CalibrationParameter[name.upper()]: value for name, value in off.items()}
    parameters = [
        ParameterEstimate(p, values.get(p, 0.0), float(s), p not in (unknown or {}), (unknown or {}).get(p, ""))
        for p, s in zip(COLUMNS, sigmas, strict=True)
    ]
    return CalibrationEstimate(tuple(parameters), np.diag(sigmas**2), 40, 4000)
