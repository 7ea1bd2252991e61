"""The robots: drive, mounting, cameras, sensor errors; what their IMU, wheels and coarse position sources measure of the exact motion; and
faults of sensors, by name and time.

To add one: a line in ROBOTS, or a line in FAULTS and its effect below.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from fleetmap.errors import UsageError, chosen
from fleetmap.geometry import Array, Array32, se3, so3_exp
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration, check_camera
from fleetmap.sensors.samples import ImuSamples, PositionPrior, Stamps, WheelSample
from fleetsim.motion import Limits, Motion, Shake

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


_DEPTH_BASE_M, _DEPTH_SIGMA_PX, _DEPTH_RANGE_M = 0.05, 0.08, (0.3, 10.0)
_WHEEL_HZ = 50.0
_SPEED_SCALE, _YAW_SCALE = 0.005, 0.01  # rms over robots; sideways slip is in the motion already
_WHEEL_NOISE_MPS, _WHEEL_NOISE_RADPS = 0.01, 0.005  # per sample
START_NS = 1_700_000_000_000_000_000  # the sensor clock at the start of every recording


def stamps_from_s(times_s: Array) -> Stamps:
    """Stamps on the sensor clock of times from the start."""
    return START_NS + np.rint(times_s * 1e9).astype(np.int64)


def sample_times(duration_s: float, rate_hz: float) -> Array:
    """Times from 0 to the end, both included if they fit."""
    return np.arange(int(np.floor(duration_s * rate_hz + 1e-9)) + 1) / rate_hz


def measure_imu(motion: Motion, errors: ImuErrors, rng: np.random.Generator) -> ImuSamples:
    """IMU samples with white noise, bias walks and random first biases.

    Source of the discrete noise: density / sqrt(dt).
    """
    times = sample_times(motion.duration_s, errors.rate_hz)
    gyro, accel = motion.rates(times)
    dt_s, noise = 1.0 / errors.rate_hz, errors.noise
    gyro_bias = _bias(rng, len(times), errors.gyro_bias_radps, noise.gyro_walk_radps2_rthz, dt_s)
    accel_bias = _bias(rng, len(times), errors.accel_bias_mps2, noise.accel_walk_mps3_rthz, dt_s)
    gyro_noise = rng.standard_normal((len(times), 3)) * noise.gyro_noise_radps_rthz / np.sqrt(dt_s)
    accel_noise = rng.standard_normal((len(times), 3)) * noise.accel_noise_mps2_rthz / np.sqrt(dt_s)
    return ImuSamples(stamps_from_s(times), gyro + gyro_bias + gyro_noise, accel + accel_bias + accel_noise)


def _bias(rng: np.random.Generator, count: int, first: float, walk: float, dt_s: float) -> Array:
    steps = rng.standard_normal((count, 3)) * walk * np.sqrt(dt_s)
    return np.asarray(rng.normal(0.0, first, 3) + np.cumsum(steps, axis=0))


def measure_depth(depth_m: Array32, camera: CameraCalibration, rng: np.random.Generator) -> Array32:
    """Depth (H, W) in whole mm as an active stereo camera gives it, 0 out of its range.

    Source of range and noise: Keselman et al. 2017, Intel RealSense stereoscopic depth cameras; a base of 50 mm, matched to 0.08 px.
    """
    per_m = _DEPTH_SIGMA_PX / (camera.intrinsics_px[0] * _DEPTH_BASE_M)
    noisy = depth_m + rng.standard_normal(depth_m.shape, np.float32) * per_m * depth_m**2
    is_seen = (noisy > _DEPTH_RANGE_M[0]) & (noisy < _DEPTH_RANGE_M[1])
    return (np.rint(np.where(is_seen, noisy, 0.0) * 1000.0) / 1000.0).astype(np.float32)


def measure_wheels(motion: Motion, height_m: float, rng: np.random.Generator) -> tuple[WheelSample, ...]:
    """Wheel odometry of the base, height_m straight below the body: scale errors of this robot, noise per sample.

    Wheels cannot measure sideways slip: they always report 0 to the left.
    """
    times = sample_times(motion.duration_s, _WHEEL_HZ)
    velocity, (gyro, _) = motion.velocity_body(times), motion.rates(times)
    forward = velocity[:, 0] - gyro[:, 1] * height_m
    speed_scale, yaw_scale = 1.0 + rng.normal(0.0, 1.0, 2) * (_SPEED_SCALE, _YAW_SCALE)
    noise = rng.standard_normal((len(times), 2)) * np.where((np.abs(forward) < 1e-3)[:, None], 0.0, 1.0)
    speeds = forward * speed_scale + noise[:, 0] * _WHEEL_NOISE_MPS
    turns = gyro[:, 2] * yaw_scale + noise[:, 1] * _WHEEL_NOISE_RADPS
    sigma_mps = float(np.hypot(_WHEEL_NOISE_MPS, _SPEED_SCALE))
    sigma_radps = float(np.hypot(_WHEEL_NOISE_RADPS, _YAW_SCALE * 0.5))
    return tuple(
        WheelSample(int(stamp), np.array([speed, 0.0, 0.0]), float(turn), sigma_mps, sigma_radps)
        for stamp, speed, turn in zip(stamps_from_s(times), speeds, turns, strict=True)
    )


def measure_priors(
    motion: Motion, base_from_body: Array, zone_period_s: float, rng: np.random.Generator
) -> tuple[PositionPrior, ...]:
    """A dock at the start (5 cm, 1 degree), then a zone each zone_period_s (1 m, heading unknown) unless that is 0."""
    dock_sigma, zone_sigma = (0.0, 0.0, 0.02, 0.05, 0.05, 0.02), (0.0, 0.0, np.inf, 1.0, 1.0, 0.02)
    zones_s = np.arange(zone_period_s, motion.duration_s, zone_period_s) if zone_period_s > 0 else ()
    priors = list[PositionPrior]()
    for moment_s in (np.array([time_s]) for time_s in (0.0, *zones_s)):
        sigma = np.array(zone_sigma if priors else dock_sigma)
        map_from_base = motion.map_from_body(moment_s)[0] @ np.linalg.inv(base_from_body)
        error = np.where(np.isfinite(sigma), sigma, 0.0) * rng.standard_normal(6)
        rotation = so3_exp(error[:3]) @ map_from_base[:3, :3] if np.isfinite(sigma[2]) else np.eye(3)
        told = np.append(np.where(sigma[:2] == 0.0, 0.05, sigma[:2]), sigma[2:])
        place = se3(rotation, map_from_base[:3, 3] + error[3:])
        priors.append(PositionPrior(int(stamps_from_s(moment_s)[0]), place, np.diag(told**2)))
    return tuple(priors)


FAULTS = {
    "camera-dark": "both cameras see nothing",
    "camera-frozen": "the right camera repeats its last picture",
    "frames-dropped": "frames do not arrive",
    "frames-late": "frames are stamped 50 ms late",
    "imu-gap": "no IMU samples",
    "imu-spike": "one wild IMU sample",
    "over-exposure": "eight times too much gain",
    "person-in-front": "a person stands 0.8 m before the cameras",
    "wheel-slip": "the wheels turn 1.6 times as fast as the robot moves",
}
LATE_S, OVER_EXPOSURE, SLIP = 0.05, 8.0, 1.6


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault in force from start_s to end_s of a recording."""

    name: str
    start_s: float
    end_s: float

    def covers(self, time_s: float) -> bool:
        """True if it is active."""
        return self.start_s <= time_s < self.end_s


def parse_fault(text: str) -> Fault:
    """Parse a fault written as NAME@START+DURATION, seconds; UsageError otherwise."""
    name, _, times = text.partition("@")
    start, _, duration = times.partition("+")
    chosen("fault", name, FAULTS)
    try:
        start_s, duration_s = float(start), float(duration or 1.0)
    except ValueError as error:
        wanted = "NAME@START+DURATION in seconds, such as camera-dark@8+2"
        raise UsageError(f"fault {text!r} should read {wanted}") from error
    if not (0 <= start_s < math.inf and 0 < duration_s < math.inf):
        raise UsageError(f"fault {text!r} needs a start of 0 s or later and a duration above 0 s")
    return Fault(name, start_s, start_s + duration_s)


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of one recording."""

    faults: tuple[Fault, ...] = ()

    def has(self, name: str, time_s: float) -> bool:
        """True if a fault of that name is active."""
        return any(fault.name == name and fault.covers(time_s) for fault in self.faults)

    def spoil_imu(self, samples: ImuSamples) -> ImuSamples:
        """Remove samples in gaps and insert spikes: one sample of 20 rad/s and 60 m/s^2 per fault."""
        times = (samples.stamps_ns - START_NS) * 1e-9
        gyro, accel = samples.gyro_radps.copy(), samples.accel_mps2.copy()
        for fault in self.faults:
            if fault.name == "imu-spike" and len(times):
                index = min(int(np.searchsorted(times, fault.start_s)), len(times) - 1)
                gyro[index] += (20.0, -20.0, 20.0)
                accel[index] += (60.0, 60.0, -60.0)
        kept = np.array([not self.has("imu-gap", float(time_s)) for time_s in times], bool)
        return ImuSamples(samples.stamps_ns[kept], gyro[kept], accel[kept])

    def spoil_wheels(self, samples: tuple[WheelSample, ...]) -> tuple[WheelSample, ...]:
        """The samples with slip."""
        return tuple(
            replace(sample, velocity_base_mps=sample.velocity_base_mps * SLIP)
            if self.has("wheel-slip", (sample.stamp_ns - START_NS) * 1e-9)
            else sample
            for sample in samples
        )
