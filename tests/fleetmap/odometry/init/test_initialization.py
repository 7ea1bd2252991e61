"""How the filter begins, on analytic motion and at rest. Starts under an even acceleration, which an IMU alone takes for a tilt."""

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_exp, se3_inverse, so3_exp
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.filter.msckf import InitialState
from fleetmap.odometry.init.imu_alignment import dynamic_initialization, static_initialization
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, Trajectory, WheelSample
from support.worlds.inertial_motion import analytic_motion
from support.worlds.point_world import NOISE, noisy_imu
from support.worlds.textured_room import FRAME_NS, IMU, driven, mounted, pair

SETTINGS = OdometrySettings()
START, FILTER = SETTINGS.start, SETTINGS.filter
GYRO_BIAS = np.array([0.02, -0.015, 0.01])
DOWN = np.array([0.0, 0.0, -1.0])


def at_rest(rng: np.random.Generator, odom_from_body: Array, accel_bias: Array) -> ImuSamples:
    count = 400  # two seconds
    force = odom_from_body.T @ np.array([0, 0, 9.81]) + accel_bias
    gyro, accel = GYRO_BIAS + 0.005 * rng.normal(size=(count, 3)), force + 0.05 * rng.normal(size=(count, 3))
    return ImuSamples(np.arange(count) * 5_000_000, gyro, accel)


def test_shaken_all_the_time_there_is_no_start() -> None:
    imu = at_rest(np.random.default_rng(4), np.eye(3), np.zeros(3))
    wave = np.sin(np.arange(len(imu)) / 9.0)[:, None] * np.array([0.3, 0.0, 0.0])
    shaken = ImuSamples(imu.stamps_ns, imu.gyro_radps + wave, imu.accel_mps2)
    assert static_initialization(shaken, int(imu.stamps_ns[-1]), SETTINGS) is None


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.4, -0.2, 1.0], [np.pi / 2, 0.0, 0.0], [3.0, 0.3, 0.0]])
def test_rest_tells_gravity_and_gyro_bias(tilt: list[float]) -> None:
    rotation = so3_exp(np.array(tilt))
    imu = at_rest(np.random.default_rng(1), rotation, np.zeros(3))
    start = static_initialization(imu, int(imu.stamps_ns[-1]), SETTINGS)
    assert angle_deg(start.state.rotation.T @ DOWN, rotation.T @ DOWN) < 0.1
    np.testing.assert_allclose(start.state.gyro_bias_radps, GYRO_BIAS, atol=1.5e-3)
    assert (start.state.velocity_mps == 0).all()
    assert start.stamp_ns <= imu.stamps_ns[-1]
    np.linalg.cholesky(start.covariance + 1e-15 * np.eye(15))


def test_learning_the_accelerometer_bias_sets_the_tilt_right() -> None:
    """At rest bias and tilt cannot be told apart; the covariance must know, so that a measured bias corrects the tilt."""
    rotation, accel_bias = so3_exp(np.array([0.3, -0.2, 0.5])), np.array([0.1, -0.08, 0.05])
    imu = at_rest(np.random.default_rng(2), rotation, accel_bias)
    start = static_initialization(imu, int(imu.stamps_ns[-1]), SETTINGS)
    before = angle_deg(start.state.rotation.T @ DOWN, rotation.T @ DOWN)
    assert before > 0.4
    by_bias = start.covariance[:3, 12:15] @ np.linalg.inv(start.covariance[12:15, 12:15])
    rotation_found = so3_exp(by_bias @ (accel_bias - start.state.accel_bias_mps2)) @ start.state.rotation
    assert angle_deg(rotation_found.T @ DOWN, rotation.T @ DOWN) < 0.05


def test_the_latest_steady_window_counts() -> None:
    """Rest for two seconds, then motion: the start lies at the end of the rest."""
    rng = np.random.default_rng(3)
    rest = at_rest(rng, np.eye(3), np.zeros(3))
    moving = noisy_imu(rng, 1.5, NOISE, GYRO_BIAS, np.zeros(3))
    stamps_ns = np.append(rest.stamps_ns, rest.stamps_ns[-1] + 5_000_000 + moving.stamps_ns)
    felt = [rest.gyro_radps, moving.gyro_radps], [rest.accel_mps2, moving.accel_mps2]
    both = ImuSamples(stamps_ns, *map(np.vstack, felt))
    start = static_initialization(both, int(both.stamps_ns[-1]), SETTINGS)
    assert 1.7e9 < start.stamp_ns < 2.1e9


@pytest.mark.parametrize("turn_radps", [0.0, 0.12])
def test_what_is_left_beside_a_gap_is_no_rest(turn_radps: float) -> None:
    """Of a turn, a few even samples after a gap would be a bias. A rest before it, and one that nothing follows, is not the present."""
    rest = at_rest(np.random.default_rng(5), np.eye(3), np.zeros(3))
    stamps_ns, turned = (
        rest.stamps_ns,
        rest.gyro_radps + (rest.stamps_ns >= 1_700_000_000)[:, None] * [0, 0, turn_radps],
    )
    kept = (stamps_ns < 1_000_000_000) | ((stamps_ns >= 1_700_000_000) & (stamps_ns < 1_850_000_000))
    imu = ImuSamples(stamps_ns[kept], turned[kept], rest.accel_mps2[kept])
    assert static_initialization(imu, 1_850_000_000, SETTINGS) is None
    assert static_initialization(rest.between(0, 1_000_000_000), 1_500_000_000, SETTINGS) is None


def test_a_resting_imu_that_loses_samples_each_second_starts() -> None:
    rest = at_rest(np.random.default_rng(6), np.eye(3), np.zeros(3))
    kept = (rest.stamps_ns // 10**6 + 300) % 1000 >= 60
    imu = ImuSamples(rest.stamps_ns[kept], rest.gyro_radps[kept], rest.accel_mps2[kept])
    start = static_initialization(imu, int(imu.stamps_ns[-1]), SETTINGS)
    np.testing.assert_allclose(start.state.gyro_bias_radps, GYRO_BIAS, atol=1.5e-3)


def test_motion_is_not_rest() -> None:
    imu = noisy_imu(np.random.default_rng(4), 2.0, NOISE, np.zeros(3), np.zeros(3))
    assert static_initialization(imu, int(imu.stamps_ns[-1]), SETTINGS) is None
    assert static_initialization(ImuSamples.empty(), 10**9, SETTINGS) is None


def seen_motion(rng: np.random.Generator, sigma_rad: float, sigma_m: float) -> tuple[Trajectory, Array]:
    """Visual odometry of 20 frames in a frame of its own, tilted and shifted; and old_from_map."""
    old_from_map = se3_exp(np.array([0.5, -0.8, 0.3, 1.0, 2.0, 3.0]))
    times_s = 0.2 + 0.1 * np.arange(20)
    noise = [se3_exp(np.r_[sigma_rad * rng.normal(size=3), sigma_m * rng.normal(size=3)]) for _ in times_s]
    bodies = [old_from_map @ analytic_motion(t).map_from_body @ n for t, n in zip(times_s, noise, strict=True)]
    return Trajectory(np.round(times_s * 1e9).astype(np.int64), np.array(bodies)), old_from_map


def odom_from_old(start: InitialState, vision: Trajectory) -> Array:
    odom_from_body = se3(start.state.rotation, start.state.position_m)
    return np.asarray(odom_from_body @ se3_inverse(vision.frame_from_body[-1]))


@pytest.mark.parametrize("accel_bias", [np.zeros(3), np.array([0.06, -0.04, 0.05])], ids=["unbiased", "biased"])
def test_motion_tells_gravity_velocity_and_biases(accel_bias: Array) -> None:
    rng = np.random.default_rng(5)
    imu = noisy_imu(rng, 2.5, NOISE, GYRO_BIAS, accel_bias)
    vision, old_from_map = seen_motion(rng, 3e-4, 1e-3)
    start = dynamic_initialization(vision, imu, NOISE, SETTINGS)
    truth = analytic_motion(2.1)
    assert start.stamp_ns == 2_100_000_000
    rotation = truth.map_from_body[:3, :3]
    assert angle_deg(start.state.rotation.T @ DOWN, rotation.T @ DOWN) < (0.45 if accel_bias.any() else 0.3)
    velocity_body = start.state.rotation.T @ start.state.velocity_mps
    np.testing.assert_allclose(velocity_body, rotation.T @ truth.velocity_map_mps, atol=0.02)
    np.testing.assert_allclose(start.state.gyro_bias_radps, GYRO_BIAS, atol=4e-3)
    # earlier transforms move along: the new frame is the old one, turned so that gravity points down
    odom_from_map = odom_from_old(start, vision) @ old_from_map
    np.testing.assert_allclose(odom_from_map[:3, :3] @ DOWN, DOWN, atol=0.008)


def test_its_covariance_covers_its_error() -> None:
    """Tilt and velocity of 16 starts from shaky vision: mean normalised errors per dof, for a covariance meant wide."""
    tilts, speeds = [], []
    truth = analytic_motion(2.1)
    for seed in range(16):
        rng = np.random.default_rng(seed)
        imu = noisy_imu(rng, 2.5, NOISE, GYRO_BIAS, 0.04 * rng.normal(size=3))
        vision, old_from_map = seen_motion(rng, 1e-3, 8e-3)
        start = dynamic_initialization(vision, imu, NOISE, SETTINGS)
        tilt = np.cross(DOWN, odom_from_old(start, vision)[:3, :3] @ old_from_map[:3, :3] @ DOWN)[:2]
        tilts.append(tilt @ np.linalg.solve(start.covariance[:2, :2], tilt) / 2)
        # to first order the velocity error in body axes is the invariant one turned into them
        rotation = start.state.rotation
        off = truth.map_from_body[:3, :3].T @ truth.velocity_map_mps - rotation.T @ start.state.velocity_mps
        speeds.append(off @ np.linalg.solve(rotation.T @ start.covariance[3:6, 3:6] @ rotation, off) / 3)
    assert 0.02 < np.mean(tilts) < 2.0
    assert 0.02 < np.mean(speeds) < 2.0


def test_gravity_of_the_wrong_size_is_refused() -> None:
    """An accelerometer that reads four fifths of the truth does not start the filter."""
    rng = np.random.default_rng(6)
    imu = noisy_imu(rng, 2.5, NOISE, GYRO_BIAS, np.zeros(3))
    vision, _ = seen_motion(rng, 0.0, 0.0)
    weak = ImuSamples(imu.stamps_ns, imu.gyro_radps, 0.8 * imu.accel_mps2)
    assert dynamic_initialization(vision, weak, NOISE, SETTINGS) is None


def test_pictures_that_turned_away_give_no_gyro_bias() -> None:
    """Vision that slips by tens of degrees looks like a gyro with a bias that none has; the filter would believe it."""
    rng = np.random.default_rng(7)
    imu = noisy_imu(rng, 2.5, NOISE, GYRO_BIAS, np.zeros(3))
    vision, _ = seen_motion(rng, 3e-4, 1e-3)
    turned = vision.frame_from_body.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ np.array([so3_exp(np.array([0.0, 0.0, 0.03 * k])) for k in range(20)])
    slipped = Trajectory(vision.stamps_ns, turned)
    assert dynamic_initialization(slipped, imu, NOISE, SETTINGS) is None


SPEEDING_UP_MPS2 = 0.8  # as a tote robot drives off
IMU_NS, FRAMES = 5_000_000, 28
TURN_NS, TURN_RADPS = 100_000_000, 3.0


def frame(number: int, speed_mps: float, speeding_up_mps2: float) -> RectifiedFrame:
    """Of a body on its way along x."""
    time_s = number * FRAME_NS * 1e-9
    way_m = speed_mps * time_s + 0.5 * speeding_up_mps2 * time_s**2
    return pair(number * FRAME_NS, se3(np.eye(3), np.array([-2.0 + way_m, 0.2, 0.1])))


def started(
    *, wheels: bool, imu_from_ns: int, speed_mps: float = 0.0, speeding_up_mps2: float = SPEEDING_UP_MPS2
) -> list[OdometryEstimate]:
    """Estimates of a robot that speeds up evenly; its IMU, and its wheels, speak from imu_from_ns on."""
    rng = np.random.default_rng(2)
    stamps_ns = np.arange(imu_from_ns, (FRAMES + 1) * FRAME_NS, IMU_NS)
    gyro = rng.normal(0, 2e-4 * np.sqrt(200), (len(stamps_ns), 3))
    accel = np.array([speeding_up_mps2, 0.0, 9.81]) + rng.normal(0, 2e-3 * np.sqrt(200), (len(stamps_ns), 3))
    waiting = list(range(-(-imu_from_ns // 20_000_000) * 20_000_000, 10**10, 20_000_000)) if wheels else []

    def roll(odometry: Odometry, frame: RectifiedFrame) -> None:
        while waiting and waiting[0] <= frame.stamp_ns:
            stamp_ns = waiting.pop(0)
            speed = np.array([speed_mps + speeding_up_mps2 * stamp_ns * 1e-9, 0.0, 0.0])
            odometry.handle_wheel([WheelSample(stamp_ns, speed, 0.0, 0.02, 0.02)])

    frames = (frame(number, speed_mps, speeding_up_mps2) for number in range(1, FRAMES + 1))
    return driven(Odometry(mounted(IMU), OdometrySettings()), frames, ImuSamples(stamps_ns, gyro, accel), roll)


@pytest.mark.parametrize(("imu_from_ns", "speed_mps"), [(0, 0.0), (-1_000_000_000, 1.0)])
def test_pictures_tell_it_from_a_tilt(imu_from_ns: int, speed_mps: float) -> None:
    inertial = [e for e in started(wheels=False, imu_from_ns=imu_from_ns, speed_mps=speed_mps)[1:] if e.inertial]
    assert len(inertial) > 3
    ups = np.clip([e.odom_from_body[2, 2] for e in inertial], -1.0, 1.0)
    assert np.degrees(np.arccos(ups.min())) < 1.0  # 3.5 and more where the acceleration is taken for a tilt


def test_wheels_tell_it_before_the_first_picture() -> None:
    assert not started(wheels=True, imu_from_ns=-1_000_000_000)[0].inertial


@pytest.mark.parametrize(("wheels", "imu_from_ns"), [(False, 0), (False, -1_000_000_000), (True, -1_000_000_000)])
def test_the_speed_of_an_even_drive_is_known_at_once(wheels: bool, imu_from_ns: int) -> None:
    """By pictures where they were there, else by wheels; else the filter would take what measures it for outliers."""
    found = started(wheels=wheels, imu_from_ns=imu_from_ns, speed_mps=2.0, speeding_up_mps2=0.0)[1:]
    (a, first), *_, (b, last) = [(n, estimate) for n, estimate in enumerate(found) if estimate.inertial]
    way_m = np.linalg.norm(last.odom_from_body[:3, 3] - first.odom_from_body[:3, 3])
    assert np.linalg.norm(first.velocity_odom_mps) == pytest.approx(2.0, abs=0.1)
    assert way_m == pytest.approx(2.0 * (b - a) * FRAME_NS * 1e-9, abs=0.04)


def test_the_gyro_leads_the_eye_through_a_turn_at_the_start() -> None:
    """Before gravity is known, too: a turn that begins is nothing like the motion before, and flow follows the wrong points."""
    stamps_ns = np.arange(0, 10 * TURN_NS, IMU_NS)
    gyro = np.where((stamps_ns >= 2 * TURN_NS)[:, None], [0.0, 0.0, TURN_RADPS], 0.0)
    samples = ImuSamples(stamps_ns, gyro, np.tile([0.0, 0.0, 9.81], (len(stamps_ns), 1)))
    yaws = [TURN_RADPS * max(number - 2, 0) * TURN_NS * 1e-9 for number in range(1, 9)]
    truths = [so3_exp(np.array([0.0, 0.0, yaw])) for yaw in yaws]
    frames = (pair(n * TURN_NS, se3(turn, np.array([0.3, 0.2, 0.1]))) for n, turn in enumerate(truths, start=1))
    said = driven(Odometry(mounted(IMU), OdometrySettings()), frames, samples)
    assert not any(e.inertial for e in said)
    turns = [said[0].odom_from_body[:3, :3].T @ e.odom_from_body[:3, :3] for e in said]
    off_rad = [rotation_angle_rad(turn.T @ truth) for turn, truth in zip(turns, truths, strict=True)]
    assert np.degrees(max(off_rad)) < 2.0  # more than 5 without the gyro
