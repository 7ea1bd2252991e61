"""The odometry without pictures, in the simulator: honest covariance, standing, wheels that slip, faults of the IMU."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.common import consistency, estimator_loop
from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_exp, se3_inverse
from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate
from fleetmap.odometry.settings import FilterSettings, OdometrySettings
from fleetsim.sensors import Fault
from support.estimator.simulated_run import EstimatorSession

WITHOUT_WHEELS = OdometrySettings(filter=FilterSettings(use_wheels=False))


@pytest.fixture(scope="module")
def site() -> consistency.Site:
    return consistency.Site()


def speed_error_mps(
    session: EstimatorSession, estimates: list[OdometryEstimate], start_s: float, end_s: float
) -> float:
    """The largest error of the estimated speed between two times."""
    times = np.array(session.session.frame_times_s[: len(estimates)])
    true = np.linalg.norm(session.session.motion.velocity_body(times), axis=1)
    off = np.abs(true - [np.linalg.norm(e.velocity_odom_mps) for e in estimates])
    return float(off[(times >= start_s) & (times < end_s)].max())


@pytest.mark.parametrize("inertial", [True, False], ids=["stereo-inertial", "stereo"])
def test_errors_are_as_large_as_they_are_said_to_be(site: consistency.Site, inertial: bool) -> None:
    """Mean normalised error squared per dof over 2 runs of 11 s; the bench narrows it down over 100."""
    runs = [consistency.run(site.session(seed), inertial, 165)[0] for seed in range(2000, 2002)]
    assert 0.25 < np.mean([r.rotation_nees for r in runs]) < 2.5
    assert 0.25 < np.mean([r.position_nees for r in runs]) < 2.5
    assert np.mean([r.final_m / r.way_m for r in runs]) < 0.01


def test_a_standing_robot_stays_and_does_not_become_too_sure(site: consistency.Site) -> None:
    """12 s at rest: velocity is zero, the place holds, and the drive after it is as consistent as any."""
    session = site.session(2010, "tote-1", rest_s=12.0)
    estimates = estimator_loop.run_odometry(session, 175)
    first = next(k for k, e in enumerate(estimates) if e.inertial) + 15
    places = np.array([e.odom_from_body[:3, 3] for e in estimates[first:]])
    assert np.linalg.norm(places - places[0], axis=1).max() < 0.003
    assert max(np.linalg.norm(e.velocity_odom_mps) for e in estimates[first:]) < 0.01
    sigma_m = np.sqrt(np.trace(estimates[-1].cov_rot_trans[3:, 3:]))
    assert np.linalg.norm(places[-1] - places[0]) < 3 * sigma_m
    turned = rotation_angle_rad(estimates[first].odom_from_body[:3, :3].T @ estimates[-1].odom_from_body[:3, :3])
    assert turned < 3 * np.sqrt(np.trace(estimates[-1].cov_rot_trans[:3, :3]))
    assert turned < 2e-3


def test_slipping_wheels_are_refused_and_others_help(site: consistency.Site) -> None:
    """Wheels that turn 1.6 times too fast for three seconds: the speed hardly differs from that without wheels."""
    slipping = site.session(2020, "tote-1", faults=(Fault("wheel-slip", 3.0, 6.0),))
    estimates = estimator_loop.run_odometry(slipping, 92)
    assert speed_error_mps(slipping, estimates, 3.0, 6.0) < 0.1  # the wheels are off by 0.6 of about 1.5 m/s
    with_wheels, without = [], []
    for seed in (2021, 2022):
        session = site.session(seed)
        with_wheels.append(consistency.run(session, True, 75)[0].position_rms_m)
        without.append(consistency.run(session, True, 75, WITHOUT_WHEELS)[0].position_rms_m)
    assert np.mean(with_wheels) < 1.1 * np.mean(without)


@pytest.mark.parametrize("fault", ["imu-spike", "imu-gap", "frames-dropped"])
def test_a_short_fault_leaves_the_speed_alone(site: consistency.Site, fault: str) -> None:
    session = site.session(2030, "tote-1", faults=(Fault(fault, 6.0, 6.4),))
    estimates = estimator_loop.run_odometry(session, 136, settings=WITHOUT_WHEELS)
    assert speed_error_mps(session, estimates, 6.0, 9.0) < 0.15
    assert consistency.figures(session, estimates, inertial=True).position_rms_m < 0.1


@pytest.mark.parametrize("settings", [OdometrySettings(), WITHOUT_WHEELS], ids=["wheels", "no wheels"])
@pytest.mark.parametrize("is_frozen", [False, True], ids=["silent", "frozen"])
def test_an_imu_that_falls_silent_again_and_again_leaves_an_honest_motion(
    site: consistency.Site, settings: OdometrySettings, is_frozen: bool
) -> None:
    """Half of the time without samples, or with the gyro's last one, straight on and in a turn: each step is exact, up to the last."""
    starts_s = [] if is_frozen else np.arange(6.0, 12.0)
    gaps = tuple(Fault("imu-gap", start_s, start_s + 0.5) for start_s in starts_s)
    session = site.session(2032, "tote-1", faults=gaps)
    if is_frozen:
        session = consistency.with_frozen_gyro(session, np.arange(6.0, 12.0), 0.5)
    estimates = estimator_loop.run_odometry(session, 182, settings=settings)
    first = next(k for k, e in enumerate(estimates) if e.inertial) + 1
    steps = np.array([e.previous_from_body for e in estimates[first:]])
    truth = se3_inverse(session.map_from_body[first - 1 : 181]) @ session.map_from_body[first:182]
    off_m = np.linalg.norm((se3_inverse(truth) @ steps)[:, :3, 3], axis=1)
    assert sum(e.is_bridged for e in estimates) > 45
    assert off_m.max() < 0.013
    assert consistency.figures(session, estimates, inertial=True).position_nees < 4


def test_over_a_gap_of_the_imu_a_corrected_estimate_is_no_speed(site: consistency.Site) -> None:
    """An update moved the last frame by half a metre; what comes next is as the pictures moved, not half a metre more in each frame."""
    session = site.session(2031, "tote-1")
    odometry = estimator_loop.odometry_of(session, WITHOUT_WHEELS)
    last = 100
    odometry.handle_imu(session.session.imu.between(0, session.stamps_ns[last]))
    for frame in range(last + 1):
        estimate = odometry.handle_stereo(estimator_loop.blank(session, frame))
    assert estimate.inertial
    mode: Any = odometry._mode
    before = mode._seen
    off = se3(np.eye(3), mode.window.filter.state.rotation.T @ np.full(3, 0.5))
    mode.window.filter.predict_random_walk(off, 1e-6, 1e-6)
    mode.window.filter.remove_clone(last)
    mode.window.filter.add_clone(last, np.zeros(3))
    mode.predict(session.stamps_ns[last + 1] + int(session.session.nominal.cameras[0].imu_minus_cam_s * 1e9))
    predicted = mode.cam_from_earlier(last)
    np.testing.assert_allclose(predicted[:3, 3], before[:3, 3], atol=0.03)


def test_stamps_20_ms_too_early_are_found_out_and_cost_nothing(site: consistency.Site) -> None:
    """The same run with true and with shifted stamps: the offset is known within 2 ms, the errors are alike."""
    undisturbed, estimates = consistency.run(site.session(2050, "tote-1"), True, 150)
    assert abs(estimates[-1].imu_minus_cam_s) < 0.002
    shifted, estimates = consistency.run(site.session(2050, "tote-1", camera_delay_s=0.02), True, 150)
    assert abs(estimates[-1].imu_minus_cam_s - 0.02) < 0.002
    assert shifted.position_rms_m < 1.2 * undisturbed.position_rms_m
    assert max(shifted.rotation_nees, shifted.position_nees) < 4


@pytest.mark.parametrize("inertial", [True, False], ids=["stereo-inertial", "stereo"])
def test_a_fifth_of_the_frames_may_be_lost(site: consistency.Site, inertial: bool) -> None:
    """Mean normalised error squared per dof over 2 runs of 10 s, as without losses; the way ends where it should."""
    runs = [consistency.run(site.session(seed, lost_share=0.2), inertial, 120)[0] for seed in range(2060, 2062)]
    assert 0.2 < np.mean([r.rotation_nees for r in runs]) < 2.5
    assert 0.2 < np.mean([r.position_nees for r in runs]) < 2.5
    assert np.mean([r.final_m / r.way_m for r in runs]) < 0.015


def test_the_imu_of_another_run_is_dropped(site: consistency.Site) -> None:
    """The gyro turns where the pictures do not: the estimates go on without it, and say so."""
    session, other = site.session(2040, "tote-1"), site.session(2041, "tote-2")
    foreign = consistency.with_imu_of(session, other, from_s=3.0)
    estimates = estimator_loop.run_odometry(foreign, 170, settings=WITHOUT_WHEELS)
    assert any(e.inertial for e in estimates)
    assert not estimates[-1].inertial


# A frame without jumps in a simulated bend; tests/locclient/daemon/test_publishers.py has gravity and frames that change.


def steps_of(frame_from_body: Array) -> Array:
    return se3_inverse(frame_from_body[:-1]) @ frame_from_body[1:]


def test_without_a_motion_estimates_follow_each_other_as_they_are() -> None:
    step, frame = se3_exp(np.array([0.0, 0.0, 0.02, 1.0, 0.0, 0.0])), ContinuousFrame()
    for truth in (np.linalg.matrix_power(step, k) for k in range(5)):
        said = SimpleNamespace(odom_from_body=truth, previous_from_body=None, new_odom_from_old_odom=None)
        np.testing.assert_array_equal(frame.handle(said), truth)


@pytest.fixture(scope="module")
def bend() -> tuple[list[OdometryEstimate], Array]:
    """Twelve seconds straight on and into a first bend, in which tilt and accelerometer bias come apart."""
    session = consistency.Site().session(2001)
    return estimator_loop.run_odometry(session, 200), session.map_from_body[:200]


def test_no_frame_of_a_bend_jumps(bend: tuple[list[OdometryEstimate], Array]) -> None:
    """Seen: a robot's `odom` 9 cm up and down from frame to frame, while each motion was known to millimetres."""
    estimates, truth = bend
    first = next(k for k, e in enumerate(estimates) if e.inertial)
    frame = ContinuousFrame()
    found = np.array([frame.handle(e) for e in estimates])[first:]
    off = se3_inverse(steps_of(truth[first:])) @ steps_of(found)
    apart = se3_inverse(steps_of(truth[first:])) @ steps_of(np.array([e.odom_from_body for e in estimates[first:]]))
    assert np.linalg.norm(apart[:, :3, 3], axis=1).max() > 0.03  # else this shows nothing
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.01
