"""Messages of drivers, and frames of a rig from images one by one; without ROS."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.geometry import se3, so3_exp
from fleetmap.recordings import Topics
from fleetmap.recordings.images import (
    StoredFrame,
    decode_frame,
    decode_grey,
    depth_image,
    grey_image,
    png_image,
    store_frame,
)
from fleetmap.recordings.ros2.messages import (
    encode_compressed_image,
    encode_image,
    encode_imu,
    encode_odometry,
    encode_prior,
)
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.intake import Intake
from locclient.plugins.ros2_node.sensor_messages import RigFrames, SensorMessages
from support.recordings.recording_samples import calibration
from support.recordings.rig_samples import simulated
from support.worlds.robot_world import turned

TOPICS = Topics(left="/rig/left/image_raw", right="/rig/right/image_raw", imu="/rig/imu")
LEFT = np.arange(48, dtype=np.uint8).reshape(6, 8)
RIGHT = LEFT[:, ::-1].copy()


def intake() -> Intake:
    return Intake(frames=10, imu_minus_cam_s=0.0, has_imu=True, imu_wait_s=0.0)


def put(sensors: SensorMessages, queue: Intake, topic: str, message: bytes, *, is_compressed: bool = False) -> None:
    (take,) = (take for topics, _, take in sensors.topics if topic in topics)
    take(queue, is_compressed, message)


def test_messages_of_drivers_become_moments() -> None:
    sensors, queue = SensorMessages(TOPICS, calibration()), intake()
    for number in range(4):
        stamp_ns = 10**9 + number * 50_000_000
        put(sensors, queue, TOPICS.right, encode_image(stamp_ns + 1_000_000, "r", grey_image(RIGHT)))
        left = encode_compressed_image(stamp_ns, "l", png_image(LEFT), "png")
        put(sensors, queue, TOPICS.left + "/compressed", left, is_compressed=True)
        put(sensors, queue, TOPICS.imu, encode_imu(stamp_ns, "imu", np.array([1.0, 2, 3]), np.array([0, 0, 9.8])))
        wheel = WheelSample(stamp_ns, np.ones(3), 0.1, 0.1, 0.1)
        put(sensors, queue, "/odom", encode_odometry(wheel, "odom", "base"))
    put(sensors, queue, "/prior", encode_prior(PositionPrior(10**9, np.eye(4), np.eye(6)), "map"))
    with pytest.raises(RecordingError, match="in the frame 'odom' is not used; give it in 'map'"):
        put(sensors, queue, "/prior", encode_prior(PositionPrior(10**9, np.eye(4), np.eye(6)), "odom"))
    with pytest.raises(ValueError, match="CDR"):
        put(sensors, queue, TOPICS.imu, b"nonsense")
    moments = [queue.take(1.0) for _ in range(4)]
    assert [moment.frame.stamp_ns for moment in moments] == [10**9 + n * 50_000_000 for n in range(4)]
    decoded = decode_frame(moments[0].frame)  # type: ignore[arg-type]
    np.testing.assert_array_equal(decoded.left, LEFT)
    np.testing.assert_array_equal(decoded.right, RIGHT)
    np.testing.assert_allclose(moments[1].imu.gyro_radps, [[1.0, 2.0, 3.0]])
    assert [len(moment.wheel) for moment in moments] == [1, 1, 1, 1] and len(moments[0].priors) == 1


def test_pairs_are_by_stamp_and_cameras_that_are_not_triggered_together_are_named() -> None:
    rig, image, ms = RigFrames(calibration()), grey_image(LEFT), 1_000_000
    assert rig.add(0, 0, image) == rig.add(0, 50 * ms, image) == []
    assert [frame.stamp_ns for frame in rig.add(1, 51 * ms, image)] == [50 * ms]
    for number in range(60, 72):  # the left camera's are sent again, by 0.3 s late and more
        assert rig.add(1, number * 50 * ms, image) == []
    assert all(len(rig.add(0, number * 50 * ms, image)) == 1 for number in range(60, 72))
    for number in range(100, 140):  # of the right camera alone
        assert rig.add(1, number * 50 * ms, image) == []
    with pytest.raises(RecordingError, match=r"no partner within 5 ms: are both triggered together\?"):
        for number in range(140, 150):
            assert rig.add(0, (number * 50 + 20) * ms, image) == rig.add(1, number * 50 * ms, image) == []


@pytest.mark.parametrize("has_depth", [False, True])
def test_one_camera_needs_no_right_image(has_depth: bool) -> None:
    queue, depth_m = intake(), np.full((6, 8), 1.5, np.float32)
    sensors = SensorMessages(TOPICS, replace(calibration(), cameras=calibration().cameras[:1]), has_depth=has_depth)
    for topic, image in ((TOPICS.left, grey_image(LEFT)), (TOPICS.depth, depth_image(depth_m))):
        if topic == TOPICS.left or has_depth:
            put(sensors, queue, topic, encode_image(50, "cam0", image))
    assert all(TOPICS.right not in topics for topics, _, _ in sensors.topics)
    queue.put_imu(ImuSamples(np.array([10**9]), np.zeros((1, 3)), np.zeros((1, 3))))
    frame = decode_frame(queue.take(1.0).frame)  # type: ignore[arg-type]
    np.testing.assert_array_equal(frame.left, LEFT)
    assert frame.right is None
    np.testing.assert_array_equal(frame.depth_m, depth_m if has_depth else None)


PERIOD_NS, LATE_NS = 50_000_000, 3_000_000
IMAGE = grey_image(np.full((4, 4), 9, np.uint8))


def rig() -> RigCalibration:
    front = calibration().cameras
    return RigCalibration(front + turned(front))


def driven(
    frames: RigFrames, indices: range, *numbers: int, late_ns: int = LATE_NS, later_ns: int = 0
) -> list[StoredFrame]:
    """Return the frames that the images of these cameras complete, the rear pair's a little later, its right one's even later."""
    stamps_ns = {n: 10**9 + late_ns * (n > 1) + later_ns * (n > 2) for n in numbers or (0, 1, 2, 3)}
    return [done for k in indices for n, ns in stamps_ns.items() for done in frames.add(n, ns + k * PERIOD_NS, IMAGE)]


def black_in_front(frames: list[StoredFrame]) -> list[StoredFrame]:
    return [frame for frame in frames if not decode_grey(frame.left).any()]


def test_each_frame_has_the_rear_pairs_images_although_they_come_later() -> None:
    frames = RigFrames(rig())
    done = driven(frames, range(6))
    assert [frame.stamp_ns for frame in done] == [1_000_000_000 + k * PERIOD_NS for k in range(6)]
    later = [None if f.others[0] is None else f.others[0].stamp_ns - f.stamp_ns for f in done]
    assert later == [None, *[LATE_NS] * 5]  # of the first nobody knew that another view sends


def test_a_rear_pair_that_is_dead_delays_one_frame_and_comes_back() -> None:
    frames = RigFrames(rig())
    driven(frames, range(3))
    assert [len(driven(frames, range(k, k + 1), 0, 1)) for k in range(3, 7)] == [0, 2, 1, 1]
    assert driven(frames, range(7, 9))[-1].others[0] is not None


def test_while_the_pair_in_front_is_dead_the_rear_pair_carries_on() -> None:
    frames = RigFrames(rig())
    driven(frames, range(3))
    # It is dead for who hears nothing of it for half a second.
    done = driven(frames, range(3, 20), 2, 3)
    black = black_in_front(done)
    assert len(black) == 20 - 13 and all(frame.others[0] is not None for frame in black)
    back = driven(frames, range(20, 24))
    assert not black_in_front(back)
    stamps = [frame.stamp_ns for frame in (*done, *back)]
    assert stamps == sorted(set(stamps))


def test_a_front_that_never_sends_does_not_keep_the_rear_from_it() -> None:
    frames = RigFrames(rig())
    done = driven(frames, range(20), 2, 3)
    assert len(done) == 20 - 11 and black_in_front(done) == done
    assert all(frame.others[0] is not None for frame in done)


def test_of_two_views_beside_a_dead_one_the_first_gives_the_stamps() -> None:
    """Side cameras 3 and 6 ms after each other: a frame a period, with both, not two."""
    front, rear = rig().cameras[:2], rig().cameras[2]
    side = replace(rear, body_from_cam=se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3)) @ rear.body_from_cam)
    frames = RigFrames(RigCalibration((*front, rear, side)))
    driven(frames, range(3), later_ns=LATE_NS)
    done = driven(frames, range(3, 24), 2, 3, later_ns=LATE_NS)
    black = black_in_front(done)
    assert len(black) == 24 - 13
    assert all(each is not None for frame in black[1:] for each in frame.others)
    done += driven(frames, range(24, 28), 0, 1, 3, later_ns=LATE_NS)  # now the first of them dies
    stamps = [frame.stamp_ns for frame in done]
    assert stamps == sorted(set(stamps))
    assert done[-1].others[0] is None and done[-1].others[1] is not None


def test_a_rear_pair_with_another_clock_does_not_blind_the_front() -> None:
    """An hour ahead, it belongs to no frame; the frames of the front are what they are."""
    done = driven(RigFrames(rig()), range(40), late_ns=3600 * 10**9)
    assert [frame.stamp_ns for frame in done] == [1_000_000_000 + k * PERIOD_NS for k in range(40)]
    assert not black_in_front(done) and not any(frame.others[0] for frame in done)


def test_images_of_half_the_rate_belong_to_every_second_frame_and_delay_no_other() -> None:
    frames = RigFrames(rig())
    counts, done = [], list[StoredFrame]()
    for k in range(12):
        found = [driven(frames, range(k, k + 1), 0, 1), driven(frames, range(k, k + 1), 2, 3) if k % 2 else []]
        counts.append([len(each) for each in found])
        done += [frame for each in found for frame in each]
    assert [frame.others[0] is not None for frame in done[4:]] == [k % 2 == 1 for k in range(4, 12)]
    assert counts[4:] == [[1, 0], [0, 1]] * 4


def test_a_clock_that_is_set_back_begins_anew() -> None:
    frames = RigFrames(rig())
    driven(frames, range(100, 110))
    done = driven(frames, range(10))
    assert [frame.others[0] is not None for frame in done[-8:]] == [True] * 8


def test_a_live_source_takes_the_depth_of_another_camera() -> None:
    rig, frames = simulated("front-depth")
    queue = Intake(frames=9, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
    topics, stored = Topics(cam2_depth="/back/aligned_depth"), store_frame(frames[0])
    (back,) = stored.others
    sensors, decoded = SensorMessages(topics, rig), list[CameraFrame]()
    sent = {topics.cam2: back.left, topics.cam2_depth: back.depth, topics.left: stored.left, topics.right: stored.right}
    for k in range(4):
        for topic, image in sent.items():
            put(sensors, queue, topic, encode_image(stored.stamp_ns + k * PERIOD_NS, "cam", image))
        decoded.append(decode_frame(queue.take(1.0).frame))  # type: ignore[arg-type]
    for each in decoded:
        (other,) = each.others
        assert other.right is each.depth_m is None
        np.testing.assert_array_equal(other.depth_m, frames[0].others[0].depth_m)
