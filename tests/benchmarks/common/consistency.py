"""Monte-Carlo runs of the odometry: how large its errors are beside what its covariance says of them."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.common import estimator_loop
from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import ImuSamples
from fleetsim import sensors
from fleetsim.motion import Route, RouteMotion
from fleetsim.recorder import Order, Session
from fleetsim.scenarios import SCENARIOS
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, unpictured

_SCENARIO = "small-loop"
_SIDEWAYS_M = 0.15  # by which a run's way points are shifted at random

_COLUMNS = "stamps_ns", "gyro_radps", "accel_mps2"


class Figures(NamedTuple):
    """One run: mean normalised errors squared per degree of freedom, rms and final error, way."""

    rotation_nees: float
    position_nees: float
    rotation_rms_rad: float
    position_rms_m: float
    final_m: float
    way_m: float
    inlier_share: float


class Site:
    """One simulated site whose world and landmarks all runs share; the drives, noises, biases and slips are each run's own."""

    def __init__(self) -> None:
        self._base = unpictured(Order(_SCENARIO))
        self._field = LandmarkField(self._base.world)
        self._robots = list(SCENARIOS[_SCENARIO]().runs)

    def session(
        self, seed: int, robot: str | None = None, rest_s: float | None = None, faults: tuple[sensors.Fault, ...] = (), *,
        camera_delay_s: float = 0.0, lost_share: float = 0.0,
    ) -> EstimatorSession:  # fmt: skip
        """The run of a seed: another robot, another drive, other errors. Faults are those of IMU, wheels and frames.

        camera_delay_s: by so much frames are stamped too early. lost_share of the frames is missing, here and there.
        """
        name, run = SCENARIOS[_SCENARIO]().run(robot or self._robots[seed % len(self._robots)])
        rng = np.random.default_rng([seed, 77])
        kind, route = run.kind, run.routes[0]
        shifts = rng.uniform(-_SIDEWAYS_M, _SIDEWAYS_M, (len(route.way_points_map), 2))
        places = tuple((x + dx, y + dy) for (x, y), (dx, dy) in zip(route.way_points_map, shifts.tolist(), strict=True))
        driven = Route(places, route.stops, route.rest_s if rest_s is None else rest_s)
        motion = RouteMotion(driven, kind.limits, kind.body_height_m, kind.shake, rng)
        plan = sensors.FaultPlan(faults)
        times = [
            t
            for t in sensors.sample_times(motion.duration_s, run.rate_hz).tolist()
            if not plan.has("frames-dropped", t)
        ]
        if lost_share > 0:
            times = [t for t in times if rng.random() >= lost_share]
        session: Session = replace(
            self._base, order=replace(self._base.order, seed=seed, robot=name), nominal=sensors.nominal_calibration(kind),
            true=sensors.true_calibration(kind, rng), motion=motion, frame_times_s=tuple(times),
            imu=plan.spoil_imu(sensors.measure_imu(motion, kind.imu, rng)),
            wheel=plan.spoil_wheels(sensors.measure_wheels(motion, kind.body_height_m, rng)), priors=(),
        )  # fmt: skip
        made = EstimatorSession(session, field=self._field)
        made.stamps_ns = [stamp_ns - int(camera_delay_s * 1e9) for stamp_ns in made.stamps_ns]
        return made


def figures(session: EstimatorSession, estimates: list[OdometryEstimate], inertial: bool) -> Figures:
    """Errors against the truth in `odom`, from where that frame was defined last.

    With gravity known only position and yaw are free to choose; without, the whole frame is the first camera's.
    """
    first = next(k for k, e in enumerate(estimates) if e.inertial) if inertial else 0
    odom_from_map = _odom_from_map(estimates[first].odom_from_body, session.map_from_body[first], inertial)
    truth = odom_from_map @ session.map_from_body
    every, squares = [], []
    for k in range(first + 1, len(estimates)):
        estimate, covariance = estimates[k].odom_from_body, estimates[k].cov_rot_trans
        every.append((so3_log(truth[k, :3, :3] @ estimate[:3, :3].T), truth[k, :3, 3] - estimate[:3, 3]))
        blocks = zip(every[-1], (covariance[:3, :3], covariance[3:, 3:]), strict=True)
        squares.append([off @ np.linalg.solve(block, off) / 3 for off, block in blocks])
    rotation, position = np.array(squares).mean(axis=0)
    rms = np.sqrt(np.square(every).sum(axis=2).mean(axis=0)).tolist()
    way = np.linalg.norm(np.diff(truth[first : len(estimates), :3, 3], axis=0), axis=1).sum()
    return Figures(
        float(rotation), float(position), *rms, float(np.linalg.norm(every[-1][1])), float(way),
        float(np.mean([e.inlier_share for e in estimates[first:]])),
    )  # fmt: skip


def run(
    session: EstimatorSession, inertial: bool, frames: int | None = None, settings: OdometrySettings | None = None
) -> tuple[Figures, list[OdometryEstimate]]:
    """One run's figures and estimates; without the IMU where not `inertial`."""
    nominal = session.session.nominal
    calibration = nominal if inertial else RigCalibration(nominal.cameras, None, nominal.base_from_body)
    estimates = estimator_loop.run_odometry(session, frames, calibration, settings)
    return figures(session, estimates, inertial), estimates


def with_imu_of(session: EstimatorSession, other: EstimatorSession, from_s: float) -> EstimatorSession:
    """The run with another run's IMU from a time on."""
    own, foreign = session.session.imu, other.session.imu
    turn_ns = sensors.START_NS + int(from_s * 1e9)
    before, after = own.between(0, turn_ns), foreign.between(turn_ns, 1 << 62)
    mixed = ImuSamples(*(np.concatenate([getattr(part, name) for part in (before, after)]) for name in _COLUMNS))
    return EstimatorSession(replace(session.session, imu=mixed), field=session._field)


def with_frozen_gyro(session: EstimatorSession, starts_s: Array, duration_s: float) -> EstimatorSession:
    """The run with a gyro that repeats its sample at each start for a while."""
    imu = session.session.imu
    times_s, gyro_radps = (imu.stamps_ns - sensors.START_NS) * 1e-9, imu.gyro_radps.copy()
    for start_s in starts_s:
        frozen = np.flatnonzero((times_s >= start_s) & (times_s < start_s + duration_s))
        gyro_radps[frozen] = gyro_radps[frozen[0]]
    return EstimatorSession(replace(session.session, imu=replace(imu, gyro_radps=gyro_radps)), field=session._field)


def _odom_from_map(odom_from_body: Array, map_from_body: Array, inertial: bool) -> Array:
    """(4, 4) that puts one frame's truth onto its estimate; where gravity is known, by a turn about it and a shift alone."""
    if not inertial:
        return np.asarray(odom_from_body @ se3_inverse(map_from_body))
    turn = odom_from_body[:3, :3] @ map_from_body[:3, :3].T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    odom_from_map = np.eye(4)
    odom_from_map[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    odom_from_map[:3, 3] = odom_from_body[:3, 3] - odom_from_map[:3, :3] @ map_from_body[:3, 3]
    return odom_from_map
