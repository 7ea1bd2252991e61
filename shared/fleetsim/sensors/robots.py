"""The robots: drive, mounting, cameras, sensor errors. To add one: a line in ROBOTS."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from fleetmap.errors import chosen
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration, check_camera
from fleetsim.motion import Limits, Shake

_BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looking along body x
# Model, distortion, focal length as a share of the image width.
LENSES: dict[str, tuple[str, tuple[float, ...], float]] = {
    "pinhole": ("radial-tangential", (), 420 / 640),
    "radial-tangential": ("radial-tangential", (-0.28, 0.074, 0.0002, 0.0002), 0.62),
    "plumb-bob": ("radial-tangential", (-0.3, 0.11, 0.0003, -0.0002, -0.018), 0.62),
    "rational": ("radial-tangential", (0.42, 0.03, 0.0002, -0.0001, 0.001, 0.72, 0.14, 0.004), 0.62),
    "equidistant": ("equidistant", (-0.013, 0.02, -0.015, 0.004), 0.55),
    "omni": ("omni", (-0.02, 0.004, 0.0002, -0.0001, 0.9), 1.04),
    "double-sphere": ("double-sphere", (0.0, 0.0, 0.0, 0.0, -0.17, 0.59), 0.46),
    "eucm": ("eucm", (0.0, 0.0, 0.0, 0.0, 0.6, 1.1), 0.55),
    "fisheye": ("double-sphere", (0.0, 0.0, 0.0, 0.0, -0.17, 0.59), 0.2505),  # 190 degrees from left to right
}


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """White noise and walks are those of `noise`; the biases start at random with these rms."""

    noise: ImuNoise = field(default_factory=lambda: ImuNoise(1.7e-4, 2e-5, 2e-3, 3e-4))
    gyro_bias_radps: float = 2e-3
    accel_bias_mps2: float = 0.02
    rate_hz: float = 200.0


@dataclass(frozen=True, slots=True)
class HiddenErrors:
    """Errors that the calibration does not contain.

    imu_minus_cam_s: of both cameras. turn_rad, shift_m: of each camera separately, in its own direction.
    """

    imu_minus_cam_s: float = 0.0
    turn_rad: float = 0.0
    shift_m: float = 0.0


@dataclass(frozen=True, slots=True)
class ViewMount:
    """A further view of a robot: turned left by yaw_rad, its middle at forward_m and left_m; of a pair unless baseline_m is 0."""

    yaw_rad: float
    forward_m: float
    left_m: float = 0.0
    baseline_m: float = 0.12
    has_depth: bool = False


RIGS: dict[str, tuple[ViewMount, ...]] = {  # beside the pair in front
    "pair": (),
    "front-rear": (ViewMount(math.pi, -0.3),),
    "front-depth": (ViewMount(math.pi, -0.3, 0.0, 0.0, has_depth=True),),
    "front-sides": (ViewMount(math.pi / 2, 0.0, 0.25, 0.0), ViewMount(-math.pi / 2, 0.0, -0.25, 0.0)),
}


@dataclass(frozen=True, slots=True)
class RobotKind:
    """One model of robot.

    The IMU is the body, straight above the base; cameras sit baseline_m apart around their mount.

    pitch_rad: cameras look down by this. rig: a key of RIGS.
    hidden: differences between the true mounting and clock and the calibration.
    """

    limits: Limits
    shake: Shake
    body_height_m: float = 0.25
    camera_height_m: float = 0.9
    camera_forward_m: float = 0.2
    pitch_rad: float = 0.05
    baseline_m: float = 0.12
    width_px: int = 640
    height_px: int = 480
    lens: str = "pinhole"
    rig: str = "pair"
    clearance_m: float = 0.3
    imu: ImuErrors = field(default_factory=ImuErrors)
    hidden: HiddenErrors = field(default_factory=HiddenErrors)


ROBOTS = {
    "surveyor": RobotKind(Limits(1.5, 0.8, 1.0, 0.8), Shake()),
    "tote": RobotKind(Limits(2.0, 1.2, 1.6, 0.7), Shake(), camera_height_m=0.38, camera_forward_m=0.3, pitch_rad=-0.03),
    "runner": RobotKind(Limits(2.0, 1.2, 1.6, 0.7), Shake()),
    "pallet-mover": RobotKind(
        Limits(1.6, 0.7, 0.9, 1.0), Shake(0.002, 0.0009), camera_height_m=0.6, pitch_rad=0.0, clearance_m=0.4
    ),
}


def nominal_calibration(kind: RobotKind) -> RigCalibration:
    """Nominal calibration, as used by the robot."""
    model, distortion, focal_share = chosen("lens", kind.lens, LENSES)
    focal = focal_share * kind.width_px
    intrinsics = np.array([focal, focal, (kind.width_px - 1) / 2, (kind.height_px - 1) / 2])
    cosine, sine = np.cos(kind.pitch_rad), np.sin(kind.pitch_rad)
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]) @ _BODY_FROM_OPTICAL
    cameras = list[CameraCalibration]()
    height_m = kind.camera_height_m - kind.body_height_m
    for view in (ViewMount(0.0, kind.camera_forward_m, 0.0, kind.baseline_m), *chosen("rig", kind.rig, RIGS)):
        middle = np.array([view.forward_m, view.left_m, height_m])
        turn = so3_exp(np.array([0.0, 0.0, view.yaw_rad])) if view.yaw_rad else np.eye(3)
        for side in (0.5, -0.5) if view.baseline_m else (0.0,):
            place = middle + turn @ np.array([0.0, side * view.baseline_m, 0.0])
            lens = model, kind.width_px, kind.height_px, intrinsics, np.array(distortion)
            camera = CameraCalibration(*lens, se3(turn @ rotation, place), has_depth=view.has_depth)
            cameras.append(check_camera(camera, f"cam{len(cameras)}"))
    return RigCalibration(tuple(cameras), kind.imu.noise, se3(np.eye(3), np.array([0.0, 0.0, kind.body_height_m])))


def true_calibration(kind: RobotKind, rng: np.random.Generator) -> RigCalibration:
    """The true calibration: the nominal values with this robot's hidden errors, in directions drawn from rng."""
    nominal, hidden = nominal_calibration(kind), kind.hidden
    cameras = []
    for camera in nominal.cameras:
        turn, shift = (direction / np.linalg.norm(direction) for direction in rng.standard_normal((2, 3)))
        body_from_cam: Array = camera.body_from_cam @ se3(so3_exp(turn * hidden.turn_rad), shift * hidden.shift_m)
        cameras.append(replace(camera, body_from_cam=body_from_cam, imu_minus_cam_s=hidden.imu_minus_cam_s))
    return RigCalibration(tuple(cameras), nominal.imu, nominal.base_from_body)
