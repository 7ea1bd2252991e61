"""Faults of a robot's sensors: said within a second, survived without a silent failure, and over soon after they end.

Without pictures: what a stuck camera or a person in the way looks like is shown by tests/benchmarks/robot/bench_faults.py.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.common import estimator_loop
from fleetmap.messages import Cause, Status
from fleetmap.relocalization.map_view import MapView
from fleetsim.motion import LIFT_S
from fleetsim.recorder import Order, Session
from fleetsim.sensors import Fault, FaultPlan
from locclient.localization.estimate import Estimate
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, unpictured

BEGIN_S = 2.5  # on the way, three seconds before the end
WRONG_M = 0.3


@lru_cache(maxsize=1)
def _site() -> tuple[Session, LandmarkField, MapView]:
    """A robot's drive along three metres, and the map of another's."""
    survey = unpictured(Order("clip"))
    field = LandmarkField(survey.world)
    surveyed = EstimatorSession(survey, field=field)
    tiles, vocabulary = estimator_loop.survey_map(surveyed, np.random.default_rng(0), every_m=0.2)
    robot = unpictured(Order("clip", robot="tote-1"))
    return robot, field, MapView(tiles, vocabulary, surveyed.camera.focal_px)


def driven(name: str, duration_s: float) -> tuple[EstimatorSession, list[Estimate]]:
    """The robot's drive with one fault."""
    sound, field, view = _site()
    plan = FaultPlan((Fault(name, BEGIN_S, BEGIN_S + duration_s),))
    times_s = tuple(t for t in sound.frame_times_s if not plan.has("frames-dropped", t))
    spoiled = replace(sound, imu=plan.spoil_imu(sound.imu), wheel=plan.spoil_wheels(sound.wheel), frame_times_s=times_s)
    spoiled.renderer.faults = plan
    session = EstimatorSession(spoiled, field=field)
    return session, estimator_loop.run_localizer(session, view, has_wheels=True)


def said(session: EstimatorSession, estimates: list[Estimate]) -> dict[float, Estimate]:
    """Estimates by seconds since the fault's begin; none of them TRACKING at the wrong place."""
    for estimate, truth in zip(estimates, session.map_from_body, strict=True):
        if estimate.status is Status.TRACKING:
            assert np.linalg.norm(estimate.map_from_body[:3, 3] - truth[:3, 3]) < WRONG_M
    begin = session.session.frame_times_s[0]
    first_ns = session.stamps_ns[0]
    return {(e.stamp_ns - first_ns) * 1e-9 + begin - BEGIN_S: e for e in estimates}


def test_darkness_is_said_with_its_cause_and_ends_with_it() -> None:
    """DEGRADED with the cause `dark` within a second, TRACKING within half a second of the light's return."""
    by_time = said(*driven("camera-dark", 1.2))
    dark = [e for t, e in by_time.items() if 1.0 <= t < 1.2]
    assert dark
    assert all(e.status in (Status.DEGRADED, Status.LOST) and e.cause is Cause.DARK for e in dark)
    assert all(e.status is Status.TRACKING for t, e in by_time.items() if t > 1.7)


@pytest.mark.parametrize(("fault", "duration_s"), [("imu-spike", 0.1), ("wheel-slip", 1.5)])
def test_nonsense_of_one_sensor_is_rejected(fault: str, duration_s: float) -> None:
    """TRACKING throughout."""
    by_time = said(*driven(fault, duration_s))
    assert {e.status for t, e in by_time.items() if t > 0.0} == {Status.TRACKING}


@pytest.mark.parametrize(("fault", "duration_s"), [("imu-gap", 0.4), ("frames-dropped", 1.0)])
def test_a_gap_is_bridged_by_the_other_sensor(fault: str, duration_s: float) -> None:
    """TRACKING or DEGRADED within it, TRACKING within a second of its end."""
    by_time = said(*driven(fault, duration_s))
    assert {e.status for t, e in by_time.items() if t > 0.0} <= {Status.TRACKING, Status.DEGRADED}
    assert all(e.status is Status.TRACKING for t, e in by_time.items() if t > duration_s + 1.0)
    assert any(t > duration_s + 1.0 for t in by_time)


def test_a_robot_that_is_carried_is_lost_when_it_is_lifted() -> None:
    """Within half a second of the first pull, with that cause; on the floor of another place it finds itself. No drive is a lift."""
    _, field, view = _site()
    session = EstimatorSession(unpictured(Order("clip", robot="carried", frames=130)), field=field)
    by_time = said(session, estimator_loop.run_localizer(session, view, has_wheels=True))
    heights_m, times_s = session.map_from_body[:, 2, 3], np.array(list(by_time))
    in_air_s = times_s[heights_m > heights_m[0] + 0.005]
    for time_s, estimate in by_time.items():
        assert not estimate.odometry.is_lifted or in_air_s[0] < time_s < in_air_s[-1] + 0.5
        assert (estimate.status is Status.LOST) == (estimate.cause is Cause.CARRIED)
        if in_air_s[0] + 0.4 < time_s < in_air_s[0] + LIFT_S:
            assert estimate.status is Status.LOST
    assert next(e for t, e in by_time.items() if t > in_air_s[-1] + 0.7).status is Status.TRACKING


def test_a_robot_without_wheels_knows_from_its_drive_what_a_lift_is() -> None:
    run = EstimatorSession(replace(unpictured(Order("faults", robot="kidnapped")), wheel=()))
    heights_m, stamps_s = run.map_from_body[:, 2, 3], np.array(run.stamps_ns) * 1e-9
    in_air_s = stamps_s[heights_m > heights_m[:30].max() + 0.005]
    told_s = [e.stamp_ns * 1e-9 for e in estimator_loop.run_odometry(run) if e.is_lifted]
    assert in_air_s[0] < told_s[0] < in_air_s[0] + 0.4
    assert told_s[-1] < in_air_s[-1] + 0.5
