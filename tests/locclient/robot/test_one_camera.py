"""A robot with one camera in a map that a stereo pair made: by its IMU, by its wheels, and by neither."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse, se3_log
from fleetmap.messages import Status
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample
from locclient.localization.estimate import Estimate
from locclient.robot.robot import Robot
from mapserver.store import MapStore
from support.recordings.recording_samples import calibration
from support.worlds import robot_world
from support.worlds.robot_world import SETTINGS, TRIAL

FRAMES = 60


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> MapStore:
    made = MapStore.open(tmp_path_factory.mktemp("one") / "store", create=True)
    robot_world.save(made)
    return made


def driven(store: MapStore, *, imu: bool, wheels: bool) -> list[Estimate]:
    """The estimates of a ride to and fro, by the left camera and these sensors."""
    whole = calibration()
    rig = replace(whole, cameras=whole.cameras[:1], imu=whole.imu if imu else None)
    robot = Robot(rig, Rectifier(rig), SETTINGS, TRIAL, lambda: 0.0)
    robot.use(robot_world.loaded(store))
    estimates, last_ns = list[Estimate](), 0
    for number, bundle in enumerate(robot_world.bundles(FRAMES)):
        assert bundle.frame is not None
        rolled = list[WheelSample]()
        if wheels and number:
            moved = se3_log(
                rig.base_from_body
                @ se3_inverse(robot_world.truth(number - 1))
                @ robot_world.truth(number)
                @ se3_inverse(rig.base_from_body)
            )
            rate = moved / ((bundle.frame.stamp_ns - last_ns) * 1e-9)
            stamps = np.linspace(last_ns, bundle.frame.stamp_ns, 6, dtype=np.int64)[1:]
            rolled = [WheelSample(int(stamp_ns), rate[3:], float(rate[2]), 0.01, 0.01) for stamp_ns in stamps]
        last_ns = bundle.frame.stamp_ns
        alone = replace(
            bundle,
            frame=CameraFrame(last_ns, bundle.frame.left),
            imu=bundle.imu if imu else ImuSamples.empty(),
            wheel=rolled,
        )
        outcome = robot.handle(alone)
        assert outcome is not None
        estimates.append(outcome.estimate)
    return estimates


@pytest.mark.parametrize(
    ("imu", "wheels", "least_share"), [(True, False, 0.95), (False, True, 0.95), (False, False, 0.0)]
)
def test_it_is_localized_and_never_wrong(store: MapStore, imu: bool, wheels: bool, least_share: float) -> None:
    estimates = driven(store, imu=imu, wheels=wheels)
    known = {n: e for n, e in enumerate(estimates) if e.status is Status.TRACKING}
    assert len(known) >= least_share * FRAMES
    for number, estimate in known.items():
        assert estimate.map_from_body is not None
        assert np.linalg.norm((estimate.map_from_body - robot_world.truth(number))[:3, 3]) < 0.1
