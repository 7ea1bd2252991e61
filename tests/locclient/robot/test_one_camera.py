"""A robot with one camera in a map that a stereo pair made: by its IMU, by its wheels, and by neither."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse, se3_log
from fleetmap.messages import Flag, Status
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample
from locclient.robot.robot import Outcome, Robot
from mapserver.store import MapStore
from support.recordings.recording_samples import calibration
from support.worlds import robot_world
from support.worlds.robot_world import SETTINGS, TRIAL

FRAMES = 60


def driven(store: MapStore, *, imu: bool, wheels: float, first: int = 0, frames: int = FRAMES) -> list[Outcome]:
    """What a robot tells of a ride to and fro, by the left camera and these sensors; wheels: factor on their speed, 0 for none."""
    whole = calibration()
    rig = replace(whole, cameras=whole.cameras[:1], imu=whole.imu if imu else None)
    robot = Robot(Rectifier(rig), SETTINGS, TRIAL, lambda: 0.0)
    robot.use(robot_world.loaded(store))
    outcomes, last_ns = list[Outcome](), 0
    for number, bundle in list(enumerate(robot_world.bundles(first + frames)))[first:]:
        rolled = list[WheelSample]()
        if wheels and last_ns:
            moved = se3_log(
                rig.base_from_body
                @ se3_inverse(robot_world.truth(number - 1))
                @ robot_world.truth(number)
                @ se3_inverse(rig.base_from_body)
            )
            rate = wheels * moved / ((bundle.frame.stamp_ns - last_ns) * 1e-9)
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
        outcomes.append(outcome)
    return outcomes


def wrong(outcomes: list[Outcome], first: int = 0) -> list[float]:
    """How far off each frame is that is TRACKING, of those that are more than 0.1 m off."""
    known = [(n, o.estimate) for n, o in enumerate(outcomes, first) if o.estimate.status is Status.TRACKING]
    off_m = [float(np.linalg.norm((e.map_from_body - robot_world.truth(n))[:3, 3])) for n, e in known]
    return [off for off in off_m if off > 0.1]


@pytest.mark.parametrize(
    ("imu", "wheels", "first", "least_share"),
    [(True, 0, 0, 0.95), (True, 0, 7, 0.8), (False, 1, 0, 0.95), (False, 1, 7, 0.95), (False, 0, 0, 0.0)],
)
def test_it_is_localized_and_never_wrong(
    store: MapStore, imu: bool, wheels: float, first: int, least_share: float
) -> None:
    outcomes = driven(store, imu=imu, wheels=wheels, first=first)
    assert sum(o.estimate.status is Status.TRACKING for o in outcomes) >= least_share * FRAMES
    assert not wrong(outcomes, first)


def test_wheels_that_count_backwards_are_named_and_left_out(store: MapStore) -> None:
    outcomes = driven(store, imu=False, wheels=-1, first=20, frames=100)
    assert "wheels drive backwards" in outcomes[-1].left_out[Flag.WHEELS_REFUSED]
    assert sum(off_m > 0.3 for off_m in wrong(outcomes, first=20)) <= 5  # half a second, until the images have shown it
