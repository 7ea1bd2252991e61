"""How fast a robot is, docks as the truth that it meets, and sensors that all others contradict: left out until they agree again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import rotation_angle_rad, se3, so3_exp
from fleetmap.messages import Cause, Flag, Status
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization.estimate import Estimate
from locclient.robot.motion_checks import DockCheck, SpeedGauge, WheelAgreement, imu_refused
from locclient.robot.robot import Outcome
from mapserver.store import MapStore
from support.fleet.estimates import estimate
from support.recordings.recording_samples import calibration
from support.worlds import robot_world


def rolling(stamp_ns: int, mps: float) -> WheelSample:
    return WheelSample(stamp_ns, np.array([mps, 0.0, 0.0]), 0.0, 0.01, 0.01)


def speeds(mps: float, *, wheel: bool = False, **about: object) -> list[float | None]:
    """Frames at 10 Hz of a robot at a speed along x."""
    gauge = SpeedGauge()
    found = []
    for n in range(40):
        odometry = replace(estimate(0.1 * n).odometry, **about)  # type: ignore[arg-type]
        wheels = [rolling(odometry.stamp_ns, mps)] * (wheel and n < 20)
        found.append(gauge.handle(wheels, odometry, se3(np.eye(3), np.array([0.1 * n * mps, 0.0, 0.0]))))
    return found


def test_wheels_say_it_as_long_as_they_speak() -> None:
    found = speeds(0.4, wheel=True, velocity_odom_mps=np.array([2.0, 0.0, 0.0]))
    assert found[:25] == pytest.approx([0.4] * 25)
    assert found[25:] == [2.0] * 15, "half a second after the last sample"


def test_without_an_imu_the_cameras_motion_says_it() -> None:
    """The odometry's velocity is then zero, however fast the robot is."""
    still = {"inertial": False, "velocity_odom_mps": np.zeros(3)}
    assert speeds(0.7, **still)[6:] == pytest.approx([0.7] * 34)
    assert speeds(0.0, **still)[6:] == pytest.approx([0.0] * 34)
    assert speeds(0.7, **still)[:5] == [None] * 5


def test_what_nobody_knows_is_none() -> None:
    lost = {"inertial": False, "velocity_odom_mps": np.zeros(3)}
    assert set(speeds(0.7, status=OdometryStatus.DEGRADED, **lost)) == {None}
    assert set(speeds(0.7, scale_known=False)) == {None}


BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.3, 0.0, 1.0]))


def dock(stamp_s: float, x_m: float, y_m: float = 0.0, sigma_m: float = 0.05) -> PositionPrior:
    """Says where the base is; knows no heading."""
    covariance = np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    return PositionPrior(round(stamp_s * 1e9), se3(np.eye(3), np.array([x_m, y_m, 0.0])), covariance)


def at(stamp_s: float, x_m: float, status: Status = Status.TRACKING, speed_mps: float = 0.0) -> Estimate:
    said = estimate(stamp_s, status, x_m=x_m, known=status is not Status.LOST)
    return replace(said, odometry=replace(said.odometry, velocity_odom_mps=np.array([speed_mps, 0.0, 0.0])))


def seen(watch: DockCheck, said: Estimate, *docks: PositionPrior) -> float | None:
    return watch.handle(docks, said, said.odometry.odom_from_body)


def arrived(watch: DockCheck, stamp_s: float, x_m: float, *docks: PositionPrior) -> float | None:
    """What two frames at a place bring, the second with what docks say."""
    seen(watch, at(stamp_s - 0.1, x_m))
    return seen(watch, at(stamp_s, x_m), *docks)


def test_the_error_is_that_of_the_base() -> None:
    """The body stands at x = 2 and the base beside it, as the calibration says."""
    watch = DockCheck(BASE_FROM_BODY)
    # map_from_base = map_from_body @ inverse(base_from_body): the base's origin is 0.3 m along the body's y.
    assert arrived(watch, 1.0, 2.0, dock(1.0, 2.0, 0.3)) == pytest.approx(0.0, abs=1e-9)
    assert arrived(DockCheck(BASE_FROM_BODY), 1.0, 2.0, dock(1.0, 2.3, 0.7)) == pytest.approx(0.5)


def test_a_dock_of_another_floor_says_nothing_here() -> None:
    elsewhere = replace(dock(1.0, 2.3, 0.7), floor="hall-2")
    assert arrived(DockCheck(BASE_FROM_BODY), 1.0, 2.0, elsewhere) is None


def test_an_arrival_counts_once_and_the_next_one_again() -> None:
    watch = DockCheck(np.eye(4))
    assert arrived(watch, 1.0, 0.0, dock(1.0, 0.1)) == pytest.approx(0.1)
    assert arrived(watch, 2.0, 0.0, dock(2.0, 0.1)) is None
    assert arrived(watch, 3.0, 0.5, dock(3.0, 0.6)) is None, "it has hardly moved"
    assert arrived(watch, 4.0, 2.5) is None
    assert arrived(watch, 5.0, 0.0, dock(5.0, 0.2)) == pytest.approx(0.2)


def test_zones_and_operators_are_no_docks() -> None:
    watch = DockCheck(np.eye(4))
    assert arrived(watch, 1.0, 0.0, dock(1.0, 0.6, sigma_m=1.0)) is None
    unknown = replace(dock(1.1, 0.6), cov_rot_trans=np.full((6, 6), np.inf))
    assert arrived(watch, 1.1, 0.0, unknown) is None
    assert arrived(watch, 1.2, 0.0, dock(1.2, 0.6)) == pytest.approx(0.6), "they were no arrival either"


@pytest.mark.parametrize("before", [Status.LOST, Status.DEGRADED, Status.AMBIGUOUS, Status.INITIALISING])
def test_who_had_claimed_nothing_was_not_wrong(before: Status) -> None:
    """A robot that is told its place by the dock agrees with it afterwards."""
    watch = DockCheck(np.eye(4))
    seen(watch, at(0.9, 0.0, before))
    assert seen(watch, at(1.0, 0.0), dock(1.0, 0.5)) is None


def test_a_word_that_is_old_is_not_compared_while_the_robot_drives() -> None:
    for speed_mps, expected in ((0.0, pytest.approx(0.1)), (1.0, None)):
        watch = DockCheck(np.eye(4))
        seen(watch, at(0.9, 0.0, speed_mps=speed_mps))
        assert seen(watch, at(1.0, 0.0, speed_mps=speed_mps), dock(0.9, 0.1)) == expected


def drive(
    agreement: WheelAgreement, mps: float, wheel_mps: float, metres: float, first: int = 0, **changes: Any
) -> bool:
    """Frames at 10 Hz, with changes of the odometry's estimates; whether the wheels are refused at their end."""
    for n in range(first, first + round(metres / (0.1 * max(mps, wheel_mps)))):
        moved = se3(np.eye(3), np.array([0.1 * mps, 0.0, 0.0]))
        odometry = replace(estimate(0.1 * n).odometry, previous_from_body=moved, **changes)
        agreement.handle([rolling(odometry.stamp_ns, wheel_mps)], odometry)
    return agreement.is_refused


@pytest.mark.parametrize(
    ("factor", "metres", "is_refused"),
    [
        (1.0, 30.0, False),
        (1.2, 30.0, False),
        (-1.0, 5.0, True),
        (0.5, 5.0, True),
        (1000.0, 50000.0, True),
        (0.0, 5.0, False),  # of a robot that is carried the wheels rest, too, and not for as long
        (0.0, 20.0, True),
    ],
)
def test_wheels_that_contradict_are_refused(factor: float, metres: float, *, is_refused: bool) -> None:
    assert drive(WheelAgreement(np.eye(4)), 1.5, 1.5 * factor, metres) is is_refused


def test_wheels_that_agree_again_are_used_again() -> None:
    agreement = WheelAgreement(np.eye(4))
    assert drive(agreement, 1.0, -1.0, 5.0)
    assert drive(agreement, 1.0, 1.0, 4.0, first=50)
    assert not drive(agreement, 1.0, 1.0, 4.0, first=90)


@pytest.mark.parametrize("changes", [{"inlier_share": 0.1}, {"after_gap": True}])
def test_images_that_cannot_be_followed_accuse_no_wheels(changes: dict[str, Any]) -> None:
    """A starved processor leaves images metres apart; then it is the odometry that is wrong."""
    assert not drive(WheelAgreement(np.eye(4)), 1.5, -1.5, 30.0, **changes)


def test_an_imu_that_is_left_out_is_named_with_its_clock() -> None:
    assert "turns otherwise" in imu_refused(None)["imu_refused"]
    assert "about 0.10 s late" in imu_refused(0.101)["imu_refused"]
    assert "about 0.20 s early" in imu_refused(-0.198)["imu_refused"]


FRAMES = 100


def driven(store: MapStore, *, views: int = 1, imu: float | None = 1, wheels: float | None = 1) -> list[Outcome]:
    """Two laps of a robot in its map. imu, wheels: -1 for samples as of a body that looks back, None without them. views: 2 for a rig whose
    second pair looks back and shows nothing."""
    rig = calibration(has_imu=imu is not None)
    cameras = rig.cameras + robot_world.turned(rig.cameras)
    robot = robot_world.new_robot(store, replace(rig, cameras=cameras[: 2 * views]))
    outcomes, turn = [], np.array([imu or 1, imu or 1, 1])
    for number, bundle in enumerate(robot_world.bundles(FRAMES)):
        samples = ImuSamples(bundle.imu.stamps_ns, bundle.imu.gyro_radps * turn, bundle.imu.accel_mps2 * turn)
        frame = replace(bundle.frame, others=(None,) * (views - 1))
        wheel = [] if wheels is None else robot_world.rolled(number, frame.stamp_ns, wheels)
        imu_samples = ImuSamples.empty() if imu is None else samples
        outcomes.append(robot.handle(replace(bundle, frame=frame, imu=imu_samples, wheel=wheel)))
    return outcomes


@pytest.mark.parametrize(
    ("imu", "wheels", "against"),
    [(-1, -1, "wheels and accelerometer"), (-1, None, "accelerometer"), (None, -1, "wheels")],
)
def test_a_robot_whose_front_and_rear_topics_are_exchanged_does_not_know_its_place(
    store: MapStore, imu: int | None, wheels: int | None, against: str
) -> None:
    outcomes = driven(store, views=2, imu=imu, wheels=wheels)
    told = next(n for n, outcome in enumerate(outcomes) if Flag.IMAGES_REFUSED in outcome.left_out)
    assert told < FRAMES / 2
    assert all(o.estimate.status is Status.LOST and o.estimate.map_from_body is None for o in outcomes[told + 1 :])
    last = outcomes[-1]
    assert list(last.left_out) == [Flag.IMAGES_REFUSED]
    text = last.left_out[Flag.IMAGES_REFUSED]
    assert f"by 180 degrees against {against}:" in text
    assert "the topics of cam0 and cam1 are exchanged with those of cam2 and cam3" in text
    assert last.estimate.calibration.text == text
    assert [o.failure.failure.cause for o in outcomes if o.failure is not None] == [Cause.CALIBRATION]


@pytest.mark.parametrize(
    ("views", "imu", "wheels", "flag", "words"),
    [
        (1, 1, -1, Flag.WHEELS_REFUSED, "wheels drive backwards"),
        (2, 1, -1, Flag.WHEELS_REFUSED, "wheels drive backwards"),
        (1, 1, 1000, Flag.WHEELS_REFUSED, "they are in mm/s"),
        (2, -1, 1, Flag.ACCELEROMETER_REFUSED, "the images contradict it"),
    ],
)
def test_one_sensor_that_all_others_contradict_costs_itself(
    store: MapStore, views: int, imu: int, wheels: float, flag: Flag, words: str
) -> None:
    outcomes = driven(store, views=views, imu=imu, wheels=wheels)
    assert words in outcomes[-1].left_out[flag]
    assert Flag.IMAGES_REFUSED not in {flag for o in outcomes for flag in o.left_out}
    for number, outcome in enumerate(outcomes):
        known = outcome.estimate.map_from_body
        if outcome.estimate.status is Status.TRACKING:
            assert np.linalg.norm(known[:3, 3] - robot_world.truth(number)[:3, 3]) < 0.1
    assert np.mean([o.estimate.status is Status.TRACKING for o in outcomes[20:]]) > 0.9


@pytest.mark.parametrize("is_left", [True, False])
def test_an_image_that_is_exchanged_with_one_of_another_view_is_named(store: MapStore, is_left: bool) -> None:
    """The rear pair sees the room upside down."""
    rig, outcomes = calibration(), []
    robot = robot_world.new_robot(store, replace(rig, cameras=rig.cameras + robot_world.turned(rig.cameras)))
    for bundle in robot_world.bundles(30):
        seen = bundle.frame
        left, right = (np.ascontiguousarray(image[::-1]) for image in (seen.left, seen.right))
        rear = replace(seen, left=seen.left, right=right) if is_left else replace(seen, left=left, right=seen.right)
        seen = replace(seen, left=left, others=(rear,)) if is_left else replace(seen, right=right, others=(rear,))
        outcomes.append(robot.handle(replace(bundle, frame=seen)))
    assert Status.TRACKING not in {outcome.estimate.status for outcome in outcomes}
    assert "is exchanged with one of another view" in outcomes[-1].estimate.calibration.text
    assert outcomes[-1].estimate.cause is Cause.CALIBRATION


def test_while_a_gyro_contradicts_the_images_nobody_knows_which_of_them_is_right(store: MapStore) -> None:
    """Its sign is reversed in the middle of a turn: one frame may be the images' fault, two are DEGRADED at once."""
    robot, outcomes = robot_world.new_robot(store), []
    for number, bundle in enumerate(robot_world.bundles(60)):
        sign = 1.0 if number < 35 else -1.0
        outcomes.append(robot.handle(replace(bundle, imu=replace(bundle.imu, gyro_radps=sign * bundle.imu.gyro_radps))))
    off_rad = [
        rotation_angle_rad(o.estimate.map_from_body[:3, :3].T @ robot_world.truth(n)[:3, :3])
        for n, o in enumerate(outcomes)
        if o.estimate.status is Status.TRACKING
    ]
    assert max(off_rad) < 0.07
    assert {o.estimate.status for o in outcomes[25:35]} == {Status.TRACKING}
    assert any(Flag.IMU_REFUSED in o.left_out for o in outcomes)
