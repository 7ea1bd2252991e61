"""Every frame's place between adjusted keyframes, and hard zones."""

from itertools import pairwise

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_exp, se3_inverse, so3_exp
from mapserver.survey.finish.frame_adjustment import frame_trajectory
from mapserver.survey.survey_inputs import Zones
from support.worlds.pose_graph_scene import driven

FRAME_NS = 50_000_000


def walk(count: int, seed: int) -> Array:
    """(count, 4, 4) of small random steps."""
    rng = np.random.default_rng(seed)
    start = se3_exp(rng.normal(0, 1, 6))
    return driven([se3_exp(rng.normal([0, 0, 0, 0.2, 0, 0], 0.05)) for _ in range(count - 1)], start)


def test_keyframes_are_where_they_were_adjusted_to() -> None:
    odometry, adjusted = walk(20, 1), walk(4, 2)
    numbers = [2, 5, 11, 17]
    found = frame_trajectory(FRAME_NS * np.arange(20), odometry, numbers, adjusted)
    np.testing.assert_array_equal(found[numbers], adjusted)


@pytest.mark.parametrize("numbers", [[4, 9, 15], [3]])
def test_good_odometry_is_carried_over_as_it_is(numbers: list[int]) -> None:
    """Keyframes moved rigidly: every frame moves with them, also before the first and after the last."""
    odometry, map_from_odom = walk(20, 3), se3_exp(np.array([0.3, -1.0, 2.0, 5, 6, 7]))
    found = frame_trajectory(FRAME_NS * np.arange(20), odometry, numbers, map_from_odom @ odometry[numbers])
    np.testing.assert_allclose(found, map_from_odom @ odometry, atol=1e-9)


def test_a_correction_is_spread_over_time_without_a_jump() -> None:
    """Odometry says 1 m, the keyframes 1.2 m and 0.1 rad of yaw: the share of both grows with time, not with frames."""
    stamps = np.array([0, 1, 2, 6, 10]) * FRAME_NS
    odometry = np.array([se3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.1, 0.2, 0.6, 1.0)])
    end = se3(so3_exp(np.array([0, 0, 0.1])), np.array([1.2, 0, 0]))
    found = frame_trajectory(stamps, odometry, [0, 4], np.array([np.eye(4), end]))
    yaws = [np.arctan2(m[1, 0], m[0, 0]) for m in found]
    assert yaws == pytest.approx([0.0, 0.01, 0.02, 0.06, 0.1], abs=1e-9)
    off = found[:, 0, 3] - odometry[:, 0, 3]
    assert off == pytest.approx([0.0, 0.02, 0.04, 0.12, 0.2], abs=0.01)
    for before, after in pairwise(found):
        step = se3_inverse(before) @ after
        assert rotation_angle_rad(step[:3, :3]) < 0.05


SQUARE = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
# a U, open to the top: its notch (1..3, 1..4) is outside
BENT = np.array([[10, 0], [14, 0], [14, 4], [13, 4], [13, 1], [11, 1], [11, 4], [10, 4.0]])


def test_only_different_zones_exclude_each_other() -> None:
    zones = Zones({"square": SQUARE, "bent": BENT, "both": np.array([[-1, -1], [20, -1], [20, 2], [-1, 2.0]])})
    in_square, in_bent, outside = np.array([2, 3.0]), np.array([10.5, 3.0]), np.array([50, 50.0])
    assert not zones.compatible(in_square, in_bent)
    assert zones.compatible(in_square, in_square)
    assert zones.compatible(in_square, outside)
    assert zones.compatible(np.array([2, 1.0]), np.array([10.5, 1.0]))  # they share the third
    assert Zones().compatible(in_square, in_bent)
