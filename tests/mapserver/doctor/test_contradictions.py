"""Signs, axes and scales that everything else contradicts are found by name, from one good ride and a change of it."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.sensor_subset import reduced
from fleetmap.sensors.samples import CameraFrame, ImuSamples, SensorSet, WheelSample
from mapserver.doctor import Verdict, camera_motion
from mapserver.doctor.calibration import MeasuredCalibration
from mapserver.doctor.images import fine_structure, fixed_pattern
from support.plugins import needs_plugin
from support.recordings.bag_samples import write_rosbag1
from support.recordings.calibration_faults import baseline
from support.recordings.painted_room import standing_first, write_ride
from support.recordings.spoiled_recording import changed, imu, without_imu

run_checks = importlib.import_module("mapserver.doctor.run_checks")
Change = Callable[[Recording], Recording]


@pytest.fixture(scope="module")
def ride(tmp_path_factory) -> Recording:
    """Four seconds along a wall and back, on wheels, with an IMU."""
    path = tmp_path_factory.mktemp("ride") / "ride.mcap"
    write_ride(path, standing_first(4.0, 2.4), 4.0, SensorSet.STEREO_INERTIAL)
    return open_recording(path)


@pytest.fixture
def _quick(monkeypatch, seen: dict[object, object]) -> None:
    """Without the odometry and the adjustment of the calibration, and with what was seen in the same images before."""
    monkeypatch.setattr(run_checks, "_by_odometry", lambda *_: (None, None))
    monkeypatch.setattr(run_checks, "measure_calibration", lambda *_: MeasuredCalibration([], None))
    for module, name in ((camera_motion, "motion_between"), (run_checks, "match_stereo")):
        monkeypatch.setattr(module, name, remembered(getattr(module, name), seen))


@pytest.fixture(scope="module")
def seen() -> dict[object, object]:
    return {}


def remembered(look: Callable[..., object], seen: dict[object, object]) -> Callable[..., object]:
    def remember(*given: object) -> object:
        pair = getattr(given[0], "right", None) is not None
        key = (look.__name__, pair, *(getattr(each, "stamp_ns", each) for each in given))
        if key not in seen:
            seen[key] = look(*given)
        return seen[key]

    return remember


def wheels(speed: float = 1.0, yaw: float = 1.0) -> Change:
    def changed(s: WheelSample) -> WheelSample:
        return replace(s, velocity_base_mps=speed * s.velocity_base_mps, yaw_rate_radps=yaw * s.yaw_rate_radps)

    return lambda r: replace(r, wheel=tuple(map(changed, r.wheel)))


def without_wheels(recording: Recording) -> Recording:
    return replace(recording, wheel=())


def longer(times: float, *before: Change) -> Change:
    """The baseline is said to be so many times longer than it is."""

    def change(recording: Recording) -> Recording:
        for each in before:
            recording = each(recording)
        return baseline(100.0 * (times - 1.0)).recording(recording)

    return change


def rocking(recording: Recording) -> Recording:
    """Two drives along one way share their turns, not what the ground does to them."""
    gyro = recording.imu.gyro_radps
    return replace(recording, imu=replace(recording.imu, gyro_radps=np.where([0, 1, 0], np.roll(gyro, 100, 0), gyro)))


X, Y, Z = (np.diag(1.0 - 2.0 * np.eye(3)[axis]) for axis in range(3))
YAW = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CYCLE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
CASES = {
    "good": (lambda r: r, {}),
    "good without wheels": (without_wheels, {}),
    "good without IMU": (without_imu, {}),
    "accelerometer negated": (imu(-1.0), {"accelerometer axes": "has the wrong sign:"}),
    "its x negated": (imu(X), {"accelerometer axes": "wrong sign on its x axis"}),
    "its y negated": (imu(Y), {"accelerometer axes": "wrong sign on its y axis"}),
    "its z negated": (imu(Z), {"accelerometer axes": "wrong sign on its z axis"}),
    "its axes exchanged": (imu(CYCLE), {"accelerometer axes": "x is z, y is x, z is y"}),
    "accelerometer in g": (imu(1 / 9.80665), {"gravity magnitude": "it is in g"}),
    "gyro negated": (imu(1.0, -1.0), {"gyro axes": "has the wrong sign:"}),
    "its yaw negated": (imu(1.0, Z), {"gyro axes": "wrong sign on its z axis"}),
    "gyro exchanged": (imu(1.0, CYCLE), {"gyro axes": "x is z, y is x, z is y"}),
    "gyro in degrees": (imu(1.0, 180 / np.pi), {"gyro scale": "degrees per second"}),
    "IMU turned by 90 degrees": (imu(YAW, YAW), {"accelerometer axes": "x is -y", "gyro axes": "x is -y"}),
    "IMU of another drive": (rocking, {"gyro axes": "% of what the gyro turns about the body's y axis"}),
    "wheels backwards": (wheels(-1.0), {"wheels": "backwards"}),
    "wheels backwards without IMU": (lambda r: wheels(-1.0)(without_imu(r)), {"wheels": "backwards"}),
    "wheels at rest": (wheels(0.0, 0.0), {"wheels": "rest while the images move"}),
    "wheels in mm/s": (wheels(1000.0), {"wheels": "they are in mm/s"}),
    "wheels in mm/s without IMU": (lambda r: wheels(1000.0)(without_imu(r)), {"wheels": "they are in mm/s"}),
    "wheels half as fast": (wheels(0.5), {"wheels": "times as fast as the images move; check"}),
    "yaw in degrees": (wheels(1.0, 180 / np.pi), {"wheels": "yaw rate is in degrees per second"}),
    "yaw negated": (wheels(1.0, -1.0), {"wheels": "yaw rate is -1 times"}),
    "baseline doubled": (longer(2.0), {"metric scale": "0.5 m by the wheels and 0.5"}),
    "baseline a tenth without wheels": (longer(0.1, without_wheels), {"metric scale": "m by the accelerometer"}),
    "baseline ten times without IMU": (longer(10.0, without_imu), {"metric scale": "0.1 m by the wheels"}),
    "baseline in mm, alone": (longer(100.0, without_imu, without_wheels), {"metric scale": "a baseline of 20 m"}),
    "a hundredth of it, alone": (longer(0.01, without_imu, without_wheels), {"metric scale": "baseline of 0.002 m"}),
}


@pytest.mark.usefixtures("_quick")
@pytest.mark.parametrize("case", CASES)
def test_what_everything_contradicts_is_named(ride: Recording, case: str) -> None:
    change, faults = CASES[case]
    findings = run_checks.run_checks(change(ride)).findings
    failed = {f.name: f.sentence for f in findings if f.verdict is Verdict.FAIL}
    assert failed.keys() == faults.keys(), failed
    for name, words in faults.items():
        assert words in failed[name]


def negated(message: Any) -> None:
    vector = message.linear_acceleration
    vector.x, vector.y, vector.z = -vector.x, -vector.y, -vector.z


def rotated(message: Any) -> None:
    message.data = message.data[::-1].copy()  # grey rows without padding


ROTATED = "images of both cameras are rotated by 180 degrees: switch the driver's"


@needs_plugin("rosbag1")
@pytest.mark.parametrize(
    ("kind", "change", "name", "says"),
    [
        ("sensor_msgs/Imu", negated, "accelerometer axes", "has the wrong sign:"),
        ("sensor_msgs/Image", rotated, "left and right", ROTATED),
    ],
)
def test_a_ros_1_bag_with_a_fault_is_named_alike(
    ride: Recording, tmp_path: Path, monkeypatch, kind: str, change: Callable[[Any], None], name: str, says: str
) -> None:
    """The messages of the ride, changed and written by rosbags; its CameraInfo has five coefficients."""
    monkeypatch.setattr(run_checks, "measure_calibration", lambda *_: MeasuredCalibration([], None))
    messages, store = [], get_typestore(Stores.ROS2_JAZZY)
    with ride.path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            data, full = message.data, schema.name
            if full.replace("/msg/", "/") == kind:
                value = store.deserialize_cdr(data, full)
                change(value)
                data = bytes(store.serialize_cdr(value, full))
            messages.append((channel.topic, full.replace("/msg/", "/"), message.log_time, data))
    with open_recording(write_rosbag1(tmp_path / "ride.bag", messages)) as bag:
        assert (len(bag), len(bag.imu), bag.issues) == (len(ride), len(ride.imu), ())
        found = {f.name: f for f in run_checks.run_checks(bag).findings}
    assert found[name].verdict is Verdict.FAIL
    assert says in found[name].sentence


@pytest.mark.parametrize(
    ("factor", "has_wheels", "says"),
    [
        (1.0, True, ""),
        (10.0, True, "0.0998 m by the wheels; check the unit of the depth images and the wheels"),
        (0.1, True, "in no steady ratio; check the unit of the depth images"),
        (1000.0, False, "a median depth of 2817 m"),
        (0.001, False, "a median depth of 0.002817 m"),
    ],
)
def test_depths_in_another_unit(tmp_path_factory, factor: float, has_wheels: bool, says: str) -> None:
    """Whose fault it is nothing tells where wheels and depths alone know metres: no wheels are left out for it."""
    path = tmp_path_factory.mktemp("rgbd") / "ride.mcap"
    write_ride(path, standing_first(4.0, 2.4), 4.0, SensorSet.RGBD)
    with open_recording(path) as good:
        wheels = good.wheel if has_wheels else ()
        scaled = changed(good, lambda frame: replace(frame, depth_m=frame.depth_m * np.float32(factor)))
        found = run_checks.run_checks(replace(scaled, wheel=wheels))
    failed = {f.name: f.sentence for f in found.findings if f.verdict is Verdict.FAIL}
    assert (says in failed["metric scale"]) if says else not failed
    assert "wheels" not in failed


@pytest.mark.parametrize(("brightness", "verdict"), [(0, Verdict.OK), (90, Verdict.FAIL)])
def test_dots_of_a_projector_that_moves_with_the_camera(ride: Recording, brightness: int, verdict: Verdict) -> None:
    """And nothing is found in the same pictures without them."""
    rng = np.random.default_rng(0)
    dots = np.zeros((240, 320), np.uint8)
    dots[rng.integers(0, 240, 800), rng.integers(0, 320, 800)] = brightness
    dots = cv2.dilate(dots, np.ones((2, 2)))
    images = [cv2.add(ride.read_frame(index).left, dots) for index in range(22, 72, 4)]
    assert fixed_pattern([fine_structure(image) for image in images]).verdict is verdict
    assert fixed_pattern([fine_structure(image) for image in images[:1] * 12]).verdict is Verdict.NOT_JUDGED


@pytest.mark.usefixtures("_quick")
def test_one_camera_turns_and_shows_no_metres(ride: Recording) -> None:
    findings = {f.name: f for f in run_checks.run_checks(reduced(ride, SensorSet.MONO_INERTIAL)).findings}
    assert findings["gyro axes"].verdict is not Verdict.NOT_JUDGED
    metric = [findings[name].verdict for name in ("wheels", "metric scale", "accelerometer axes")]
    assert metric == [Verdict.OK, Verdict.NOT_JUDGED, Verdict.NOT_JUDGED]  # of the wheels, the yaw rate


@pytest.mark.usefixtures("_quick")
def test_an_imu_too_slow_for_velocities_is_what_is_lacking(ride: Recording) -> None:
    slow = ImuSamples(
        *(samples[::12].copy() for samples in (ride.imu.stamps_ns, ride.imu.gyro_radps, ride.imu.accel_mps2))
    )
    (axes,) = (f for f in run_checks.run_checks(replace(ride, imu=slow)).findings if f.name == "accelerometer axes")
    assert (axes.verdict, "17 samples a second" in axes.sentence) == (Verdict.NOT_JUDGED, True)


@pytest.mark.usefixtures("_quick")
def test_images_that_repeat_are_told_from_rest(ride: Recording) -> None:
    """The ride begins with a second at rest, in the same image; every third image that is the one before is a fault."""

    def repeating(frame: CameraFrame) -> CameraFrame:
        index = int(np.searchsorted(ride.frame_stamps_ns, frame.stamp_ns))
        return replace(ride.read_frame(index - (index % 3 == 2)), stamp_ns=frame.stamp_ns)

    findings = run_checks.run_checks(changed(ride, repeating)).findings
    failed = {f.name for f in findings if f.verdict is Verdict.FAIL}
    assert "repeated images" in failed
    assert "wheels" not in failed
