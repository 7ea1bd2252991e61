"""Localization in a version that stays what it is, in a room whose map is known in closed form."""

import numpy as np
import pytest

from fleetmap.bow import decode_vocabulary
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.messages import Status
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import CameraFrame
from mapserver.survey.live.frozen_map import FrozenMap, FrozenVersion
from mapserver.survey.live.live_values import LiveRig, NewKeyframe
from support.recordings.recording_samples import FOCAL
from support.worlds import robot_world

MAP_FROM_ODOM = se3(so3_exp(np.array([0, 0, 0.7])), np.array([2.0, -1.0, 0.3]))  # what it has to find
STEP = np.diag([1e-3**2] * 3 + [5e-3**2] * 3)
EVERY = 5


def frozen() -> FrozenMap:
    version = FrozenVersion(3, robot_world.tiles(), decode_vocabulary(robot_world.vocabulary()), FOCAL)
    rectifier = robot_world.rectifier()
    return FrozenMap(version, LiveRig(rectifier.camera, rectifier.body_from_cam))


def look(number: int, *, upside_down: bool = False) -> RectifiedFrame:
    sample = robot_world.cycle()
    left, right = sample.left[number], sample.right[number]
    if upside_down:
        left, right = np.ascontiguousarray(left[::-1]), np.ascontiguousarray(right[::-1])
    return robot_world.rectifier().rectify(CameraFrame(int(sample.stamps_ns[number]), left, right))


def keyframe(number: int, step: Array = STEP) -> NewKeyframe:
    still = np.zeros(3)
    odom_from_body = se3_inverse(MAP_FROM_ODOM) @ robot_world.truth(number)
    return NewKeyframe(number, odom_from_body, np.eye(3), step if number else None, still, still, still)


def driven(until: int) -> FrozenMap:
    growing = frozen()
    for number in range(0, until, EVERY):
        growing.add(look(number), keyframe(number))
    return growing


def test_it_is_found_after_a_metre_and_kept() -> None:
    growing, told = frozen(), []
    for number in range(0, 60, EVERY):
        growing.add(look(number), keyframe(number))
        told.append(growing.estimate())
    statuses = [each.status for each in told if each is not None]
    begin = statuses.index(Status.TRACKING)
    way_m = np.linalg.norm(robot_world.truth(begin * EVERY)[:3, 3] - robot_world.truth(0)[:3, 3])
    assert way_m > 0.9
    assert all(each is not None and each.map_from_body is None for each in told[:begin])
    assert set(statuses[begin:]) == {Status.TRACKING}
    for number, each in enumerate(told):
        if number >= begin:
            assert each is not None
            assert each.map_from_body is not None
            assert each.cov_rot_trans is not None
            off = each.map_from_body[:3, 3] - robot_world.truth(number * EVERY)[:3, 3]
            assert np.linalg.norm(off) < 0.05
            assert off @ np.linalg.solve(each.cov_rot_trans[3:, 3:], off) < 16.3
    assert growing.parts().labels[-1] == 0


def test_what_sees_another_building_is_never_placed() -> None:
    growing = frozen()
    for number in range(0, 60, EVERY):
        growing.add(look(number, upside_down=True), keyframe(number))
    found = growing.estimate()
    assert found is not None
    assert found.status in (Status.INITIALISING, Status.AMBIGUOUS)
    assert found.map_from_body is None
    assert growing.loops().refused["no fix"] > 5


@pytest.mark.parametrize(("step_m", "status"), [(0.1, Status.DEGRADED), (0.6, Status.LOST)])
def test_a_pose_without_fixes_says_how_little_it_knows(step_m: float, status: Status) -> None:
    growing = driven(40)
    for number in (40, 45, 50):
        growing.add(look(number, upside_down=True), keyframe(number, np.diag([1e-3**2] * 3 + [step_m**2 / 3] * 3)))
    found = growing.estimate()
    assert found is not None
    assert found.status is status
    assert (found.map_from_body is None) is (status is Status.LOST)
    if found.cov_rot_trans is not None:
        assert np.sqrt(np.trace(found.cov_rot_trans[3:, 3:])) == pytest.approx(step_m * np.sqrt(3), rel=0.3)
