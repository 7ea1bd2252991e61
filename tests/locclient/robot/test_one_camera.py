"""A robot with one camera in a map that a stereo pair made: by its IMU, by its wheels, and by neither."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.messages import Flag, Status
from fleetmap.sensors.samples import CameraFrame, ImuSamples
from locclient.robot.robot import Outcome
from mapserver.store import MapStore
from support.recordings.recording_samples import calibration
from support.worlds import robot_world

FRAMES = 60


def driven(store: MapStore, *, imu: bool, wheels: float, first: int = 0, frames: int = FRAMES) -> list[Outcome]:
    """What a robot tells of a ride to and fro, by the left camera and these sensors; wheels: factor on their speed, 0 for none."""
    rig = replace(calibration(has_imu=imu), cameras=calibration().cameras[:1])
    robot, outcomes = robot_world.new_robot(store, rig), []
    for number, bundle in list(enumerate(robot_world.bundles(first + frames)))[first:]:
        alone = CameraFrame(bundle.frame.stamp_ns, bundle.frame.left)
        wheel = robot_world.rolled(number, alone.stamp_ns, wheels) if wheels else []
        samples = bundle.imu if imu else ImuSamples.empty()
        outcomes.append(robot.handle(replace(bundle, frame=alone, imu=samples, wheel=wheel)))
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
