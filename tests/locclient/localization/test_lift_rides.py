"""Rides in lifts: a robot comes out on the right floor, or says that it does not know; never on a wrong one."""

from typing import Any

import numpy as np
import pytest

from fleetmap.messages import Cause, Status
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, WheelSample
from locclient.localization.pose_tracker import ONE_OF_FLOORS
from locclient.localization.priors.ride_gauge import Ride, RideGauge
from locclient.robot.failure_monitor import FailureMonitor
from support.worlds.lift_world import LiftWorld, RideResult, ride

ALIKE = {"floors": 2, "likeness": 0.97}
OTHER = {"floors": 3, "likeness": 0.0}
BLIND = {"has_imu": False}  # to the lift's motion
WHOLE = {"has_stock": True, "track": {"is_whole_site_mapped": True}}


def world_of(seed: int, **how: Any) -> LiftWorld:
    """A robot that knows its place on the lowest floor, by a dock where the floors look alike."""
    world = LiftWorld(seed=seed, **how)
    world.stand(0.2, sees=True)
    if world.likeness:
        world.told(floor="")
    return world


def rides(seeds: range, **how: Any) -> list[RideResult]:
    """Rides without a silent failure; in each the robot names the floors of the lift."""
    worlds = [world_of(seed, **how) for seed in seeds]
    results = [ride(world, 1 + seed % (world.floors - 1)) for seed, world in zip(seeds, worlds, strict=True)]
    assert not any(world.wrong for world in worlds)
    assert all("" in result.floors_named and len(result.floors_named) > 1 for result in results)
    return results


@pytest.mark.parametrize("how", [ALIKE, OTHER, OTHER | BLIND, ALIKE | WHOLE | BLIND])
def test_it_comes_out_on_the_right_floor(how: dict[str, Any]) -> None:
    results = rides(range(2), **how)
    assert all(result.found_m is not None and result.found_m < 3.5 for result in results)
    assert how.get("has_imu") is False or not sum(result.claimed_while_riding for result in results)


@pytest.mark.parametrize("how", [ALIKE, ALIKE | WHOLE, OTHER, OTHER | BLIND, ALIKE | WHOLE | BLIND])
def test_forty_rides(how: dict[str, Any]) -> None:
    """Seeds that nothing was developed with."""
    results = rides(range(1000, 1040), **how)
    found = [result for result in results if result.found_s is not None and result.found_m is not None]
    assert sum(result.found_s <= 5.0 or result.found_m <= 3.0 for result in found) >= 38


def test_without_an_accelerometer_equal_floors_stay_both() -> None:
    assert all(result.found_s is None for result in rides(range(2), **ALIKE, has_imu=False))


def test_a_slow_lift_is_a_ride_of_unknown_height() -> None:
    """So slow that its speed may not be told from a drifting accelerometer's."""
    world = world_of(3, **ALIKE)
    assert ride(world, 1, fastest_mps=0.15, accel_mps2=0.2).found_s is None
    assert not world.wrong


def test_a_stay_without_a_ride_keeps_the_place() -> None:
    world = world_of(4, **ALIKE)
    said = [*world.drive(9.5), *world.stand(12.0), *world.drive(-4.0)]
    assert not any(e.status is Status.AMBIGUOUS or e.cause is Cause.RIDING for e in said)
    assert world.is_right(said[-1])


def test_two_rides_without_a_look_between_add_up() -> None:
    world = world_of(5, floors=3, likeness=0.97)
    said = [*world.board_and_ride(1), *world.stand(4.0), *world.ride(2), *world.stand(3.0)]
    assert [h.floor for h in said[-1].hypotheses] == ["floor-2"]
    assert said[-1].status is Status.AMBIGUOUS, "until the pictures say so"
    assert said[-1].map_from_body is None
    assert world.is_right(world.drive(-6.0)[-1])
    assert not world.wrong


@pytest.mark.parametrize("drawn_on", [(), (1, 2)])
@pytest.mark.parametrize("fastest_mps", [1.6, 0.4, 0.15])
@pytest.mark.parametrize("rolls_at", [None, 6])
def test_a_lift_that_is_in_no_map_ends_the_pose(
    drawn_on: tuple[int, ...], fastest_mps: float, rolls_at: int | None
) -> None:
    """Also one that the other floors alone have, and of a robot that makes room in it while it moves."""
    world = world_of(6, floors=3, likeness=0.97)
    for number in {0, 1, 2} - {*drawn_on}:
        world.redraw(number, {})
    said = [*world.stand(2.0, sees=True), *world.drive(9.5), *world.stand(2.0)]
    for number, estimate in enumerate(world.ride(2, fastest_mps=fastest_mps, accel_mps2=0.5)):
        said += [estimate, *([world.step(0.1, np.zeros(20), sees=False)] if number == rolls_at else [])]
    said += [*world.stand(1.0), *world.drive(-6.0)]
    assert not world.wrong
    assert Cause.CARRIED in {e.cause for e in said}


def test_a_robot_in_a_lift_that_is_in_no_map_takes_no_place_seen_before() -> None:
    """It wakes up there, and sees the same at the end of the ride."""
    world = LiftWorld(seed=7, **ALIKE)
    for number in (0, 1):
        world.redraw(number, {})
    world.stand(2.0, sees=True)
    list(world.ride(1))
    said = [*world.stand(2.0, sees=True), *world.drive(-6.0)]
    assert not world.wrong
    assert {h.floor for h in said[-1].hypotheses} == {"", "floor-1"}


def test_a_robot_that_finds_its_place_in_a_ride_does_not_take_it() -> None:
    """It starts in the cabin; what it saw before the ride is of another floor."""
    world = LiftWorld(seed=7, **ALIKE)
    world.plan_from_body[0, 3] = 9.5
    said = [*world.stand(4.0, sees=True), *world.ride(1), *world.stand(2.0, sees=True), *world.drive(-6.0)]
    assert not world.wrong
    assert {h.floor for h in said[-1].hypotheses} == {"", "floor-1"}


def test_a_lift_that_shakes_the_robot_loses_no_floor() -> None:
    """The odometry says that it is lifted, in the moment in which the cabin starts."""
    world = world_of(8, **ALIKE)
    world.board()
    world.odometry.lifts = True
    said = [*world.ride(1), *world.stand(2.0)]
    assert {e.cause for e in said} == {Cause.RIDING}
    assert world.is_right(world.drive(-6.0)[-1])
    assert not world.wrong


def test_a_dock_that_names_no_floor_is_one_of_any() -> None:
    """After a ride of unknown height: it is not taken for a dock of the floor where the robot was."""
    world = world_of(10, **ALIKE, has_imu=False)
    world.board_and_ride(1)
    world.drive(-3.0, sees=False)
    world.told()
    world.drive(-4.0)
    assert not world.wrong


def test_a_robot_that_stands_in_a_building_says_what_it_waits_for() -> None:
    """Pictures of one viewpoint have the same misses: they do not exclude the other floors, however many there are."""
    world = LiftWorld(seed=17, **OTHER)
    said = world.stand(20.0, sees=True)
    assert {e.status for e in said} == {Status.INITIALISING}
    assert {e.refused for e in said if e.fix is not None} == {ONE_OF_FLOORS}
    out = world.drive(2.0)[-1]
    assert world.is_right(out) and not out.refused


def test_a_ride_ends_for_a_robot_that_waits_for_its_place() -> None:
    """A knock that the gauge takes for a ride must not stop the search for ever."""
    gauge = RideGauge(ImuNoise())
    found = [fed(gauge, k, 9.81 + (0.5 if k > 30 else 0.0)) for k in range(2200)]
    assert 0 < sum(one.is_moving for one in found) < 2000
    assert np.isinf(found[-1].sigma_m)


def test_a_ride_is_no_failure() -> None:
    world, monitor = world_of(9, **ALIKE), FailureMonitor()
    said = [*world.board_and_ride(1, fastest_mps=0.3), *world.stand(2.0)]
    assert [monitor.handle(e, 0.0) for e in said] == [None] * len(said)
    assert next(e.cause for e in said if e.status is Status.AMBIGUOUS) is Cause.RIDING


def test_a_robot_that_comes_back_into_the_lift_keeps_its_floor_open() -> None:
    """No picture has told the floor: it has not come back to the floor where it first went in."""
    world = world_of(11, **ALIKE)
    world.board_and_ride(1)
    world.stand(2.0)
    world.drive(-5.0, sees=False)
    said = [*world.drive(5.0, sees=False), *world.stand(4.0)]
    assert [h.floor for h in said[-1].hypotheses] == ["floor-1"]
    world.drive(-6.0)
    assert not world.wrong


def test_a_change_of_the_building_in_a_ride_ends_the_ride() -> None:
    """What rises after it is not the whole rise."""
    world = world_of(12, floors=3, likeness=0.97)
    world.board()
    for number, _ in enumerate(world.ride(2)):
        if number == 20:
            world.localizer.handle_building(dict(world.localizer._lift.building))
    world.stand(2.0)
    said = world.drive(-6.0)
    assert not world.wrong
    assert "floor-2" in {h.floor for h in said[-1].hypotheses} or world.is_right(said[-1])


def test_a_lift_that_one_floor_alone_has_leads_to_any() -> None:
    world = world_of(13, **ALIKE)
    world.redraw(1, {})
    world.board_and_ride(1)
    world.stand(2.0)
    world.drive(-6.0)
    assert not world.wrong


def test_of_two_lifts_side_by_side_it_may_ride_either() -> None:
    """The other one, which serves fewer floors, is within reach of the pose after the ride."""
    world = world_of(14, floors=3, likeness=0.97, has_imu=False)
    for number in range(3):
        ((ring,),) = world.localizer._lift.building[world.keys[number]].lifts["A"]
        beside = {"0": ((ring + 2.1 * world.map_from_plan[number][:2, 1],),)} if number < 2 else {}
        world.redraw(number, {"A": ((ring,),)} | beside)
    world.board()
    said = [*world.ride(2), *world.stand(2.0)]
    assert {h.floor for h in said[-1].hypotheses} == {"", "floor-1", "floor-2"}


def test_an_operator_without_a_floor_names_none_after_a_ride() -> None:
    world = world_of(15, **ALIKE, has_imu=False)
    world.board_and_ride(1)
    world.drive(-3.0, sees=False)
    world.told(0.2, level=0, is_revisable=True)  # as RViz shows it, on the floor before
    world.drive(-4.0)
    assert not world.wrong


def test_a_pose_on_a_floor_that_is_gone_is_not_taken() -> None:
    world = LiftWorld(floors=2, likeness=0.0, seed=16)
    world.stand(0.2)
    for floor, found in (("gone", ""), ("floor-1", "floor-1")):
        world.told(floor=floor)
        assert world.step(0.0, sees=False).floor == found
    world.localizer.handle_building({"": world.localizer._lift.building[""]})
    assert world.step(0.0, sees=False).floor == ""


# --- the gauge ------------------------------------------------------------------------------------------------------


def fed(gauge: RideGauge, k: int, force: Any, *, has_imu: bool = True, has_wheels: bool = True) -> Ride:
    """A tenth of a second of a robot that stands, with this upward force measured."""
    stamps = np.arange(20 * k, 20 * k + 20) * 5_000_000 + 1
    if has_imu:
        gauge.handle_imu(ImuSamples(stamps, np.zeros((20, 3)), np.outer(force * np.ones(20), [0.0, 0.0, 1.0])))
    if has_wheels:
        gauge.handle_wheel([WheelSample(int(stamps[-1]), np.zeros(3), 0.0, 0.01, 0.01)])
    return gauge.advance(int(stamps[-1]), 0.1)


def gauged(accel_mps2: np.ndarray[Any, Any], seed: int, noise: ImuNoise, *, gap: bool = False) -> Ride:
    """The rise after 4 s at rest, this acceleration at 200 Hz, and 2 s at rest."""
    rng, gauge = np.random.default_rng(seed), RideGauge(noise)
    accel = np.concatenate([np.zeros(800), accel_mps2, np.zeros(400)])
    walk = noise.accel_walk_mps3_rthz * np.sqrt(0.005) * rng.normal(size=len(accel))
    force = 9.81 + rng.normal(0.0, 0.2) + accel + np.cumsum(walk) + 0.03 * rng.normal(size=len(accel))
    parts = enumerate(force[: len(force) // 20 * 20].reshape(-1, 20))
    return [fed(gauge, k, part, has_imu=not (gap and 45 <= k < 48)) for k, part in parts][-1]


@pytest.mark.parametrize("noise", [ImuNoise(), ImuNoise(accel_noise_mps2_rthz=2e-3, accel_walk_mps3_rthz=3e-4)])
@pytest.mark.parametrize(("rise_m", "fastest_mps"), [(3.5, 1.0), (-3.5, 1.0), (14.0, 1.6)])
def test_the_rise_is_within_its_sigma(noise: ImuNoise, rise_m: float, fastest_mps: float) -> None:
    pulse = np.full(round(200 * fastest_mps), np.sign(rise_m))
    accel = np.concatenate([pulse, np.zeros(round(200 * (abs(rise_m) / fastest_mps - fastest_mps))), -pulse])
    off = [(found.rise_m - rise_m) / found.sigma_m for found in (gauged(accel, seed, noise) for seed in range(10))]
    assert np.abs(off).max() < 3.0
    assert not gauged(accel, 0, noise).is_moving
    assert gauged(accel, 0, noise).sigma_m < 0.5


def test_without_samples_the_rise_is_unknown() -> None:
    assert np.isinf(gauged(np.repeat([1.0, 0.0, -1.0], (200, 500, 200)), 0, ImuNoise(), gap=True).sigma_m)
    gauge = RideGauge(ImuNoise())  # without wheels: it may drive
    found = [fed(gauge, k, 11.0, has_wheels=False) for k in range(40)][-1]
    assert not found.is_moving
    assert np.isinf(found.sigma_m)
    assert np.isinf(RideGauge(None).advance(1, 0.1).sigma_m)
