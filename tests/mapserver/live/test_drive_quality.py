"""What a survey under way lacks, fed with drives whose faults are known."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.live_survey import COVERAGE_CELL_M, LiveFinding
from fleetmap.sensors.calibration import ImuNoise
from mapserver.live.drive_quality import DriveDoctor, covered_cells, missing_directions
from mapserver.survey.live.live_values import LiveRig, NewKeyframe
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, stereo_frame

NOISE = ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)
RIG = LiveRig(CAMERA, BODY_FROM_CAM, NOISE)
FRAME_NS, EVERY, SECONDS = 50_000_000, 4, 11
IMU = noisy_imu(np.random.default_rng(1), SECONDS + 1.0, NOISE, np.zeros(3), np.zeros(3))


def examined(*, swapped: bool = False, seconds: int = SECONDS) -> dict[str, LiveFinding]:
    """The doctor's findings of a drive through a painted room, by name."""
    doctor, still = DriveDoctor(RIG), np.zeros(3)
    since, waiting = 0, list[int]()
    for number in range(1, seconds * 1_000_000_000 // FRAME_NS):
        stamp_ns = number * FRAME_NS
        waiting.append(stamp_ns)
        if number % EVERY:
            continue
        frame = stereo_frame(stamp_ns)
        if swapped:
            frame = replace(frame, left=frame.right, right=frame.left)
        news = NewKeyframe(
            number, np.eye(4), np.eye(3), np.eye(6), still, still, still, True, IMU.between(since, stamp_ns)
        )
        doctor.take(frame, news, waiting)
        since, waiting = stamp_ns, []
    return {finding.name: finding for finding in doctor.findings}


@pytest.fixture(scope="module")
def good() -> dict[str, LiveFinding]:
    return examined()


def test_a_good_drive_has_no_failure(good: dict[str, LiveFinding]) -> None:
    assert {"left and right", "epipolar error"} <= set(good), sorted(good)
    assert [finding for finding in good.values() if finding.verdict == "fail"] == []
    assert {finding.at_s for finding in good.values()} == {10.2}  # with the first keyframe after the ten seconds


def test_nothing_is_said_of_less_than_ten_seconds() -> None:
    assert examined(seconds=4) == {}


def test_exchanged_cameras_are_found_and_stand_first() -> None:
    found = examined(swapped=True)
    assert next(iter(found.values())).verdict == "fail"
    assert found["left and right"].verdict == "fail"
    assert "left and right are swapped" in found["left and right"].words


def looking(positions_m: Array, yaw_rad: float) -> Array:
    """(K, 4, 4) cameras at positions (K, 2), whose optical axis is level and points along yaw."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turn = so3_exp(np.array([0.0, 0.0, yaw_rad])) @ forward
    return np.array([se3(turn, np.array([x, y, 1.0])) for x, y in positions_m.tolist()])


AISLE = np.column_stack([np.arange(0.5, 20.0, 0.5), np.full(39, 2.0)])


def test_an_aisle_driven_one_way_misses_the_other() -> None:
    east, west = looking(AISLE, 0.0), looking(AISLE, np.pi)
    missing = missing_directions(east)
    assert {each.heading for each in missing} == {"W"}
    assert sum(each.places for each in missing) == len(AISLE)
    for each in missing:
        assert each.y_m == pytest.approx(2.0)
        assert abs(each.x_m % COVERAGE_CELL_M - COVERAGE_CELL_M / 2) < 1.0
    assert missing_directions(np.concatenate([east, west])) == []


def test_only_what_was_driven_one_way_is_named() -> None:
    both = AISLE[:19]
    missing = missing_directions(np.concatenate([looking(AISLE, 0.0), looking(both, np.pi)]))
    assert {each.heading for each in missing} == {"W"}
    assert min(each.x_m for each in missing) > both[-1, 0]
    assert missing_directions(np.zeros((0, 4, 4))) == []


def test_a_square_is_covered_by_ten_landmarks() -> None:
    points = np.concatenate([np.full((10, 3), 1.0), np.full((9, 3), -1.0), np.full((30, 3), 6.0)])
    assert covered_cells(points, 10).tolist() == [[0, 0, 10], [1, 1, 30]]
    assert covered_cells(points, 1).tolist() == [[1, 1, 30]]
    assert covered_cells(points[:0], 10).shape == (0, 3)
