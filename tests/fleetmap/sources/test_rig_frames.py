"""Frames of a rig from images that arrive one by one."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import se3, so3_exp
from fleetmap.recordings.images import StoredFrame, decode_grey, grey_image
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sources.ros2 import RigFrames
from support.recordings.recording_samples import calibration

PERIOD_NS, LATE_NS = 50_000_000, 3_000_000
IMAGE = grey_image(np.full((4, 4), 9, np.uint8))


def rig() -> RigCalibration:
    front, turned = calibration().cameras, se3(so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    rear = (replace(camera, body_from_cam=turned @ camera.body_from_cam) for camera in front)
    return RigCalibration((*front, *rear))


def sent(frames: RigFrames, index: int, numbers: tuple[int, ...]) -> list[StoredFrame]:
    """Return the frames that the images of these cameras complete, whose rear pair is stamped a little later."""
    stamp_ns = 1_000_000_000 + index * PERIOD_NS
    return [done for n in numbers for done in frames.add(n, stamp_ns + LATE_NS * (n > 1), IMAGE)]


def test_each_frame_has_the_rear_pairs_images_although_they_come_later() -> None:
    frames = RigFrames(rig())
    done = [frame for k in range(6) for frame in sent(frames, k, (0, 1, 2, 3))]
    assert [frame.stamp_ns for frame in done] == [1_000_000_000 + k * PERIOD_NS for k in range(6)]
    later = [None if f.others[0] is None else f.others[0].stamp_ns - f.stamp_ns for f in done]
    assert later == [None, *[LATE_NS] * 5]  # of the first nobody knew that another view sends


def test_a_rear_pair_that_is_dead_delays_one_frame_and_comes_back() -> None:
    frames = RigFrames(rig())
    for k in range(3):
        sent(frames, k, (0, 1, 2, 3))
    counts = [len(sent(frames, k, (0, 1))) for k in range(3, 7)]
    assert counts == [0, 2, 1, 1]
    done = sent(frames, 7, (0, 1, 2, 3)) + sent(frames, 8, (0, 1, 2, 3))
    assert done[-1].others[0] is not None


def test_while_the_pair_in_front_is_dead_the_rear_pair_carries_on() -> None:
    frames = RigFrames(rig())
    for k in range(3):
        sent(frames, k, (0, 1, 2, 3))
    # It is dead for who hears nothing of it for half a second.
    done = [frame for k in range(3, 20) for frame in sent(frames, k, (2, 3))]
    black = [frame for frame in done if not decode_grey(frame.left).any()]
    assert len(black) == 20 - 12 and all(frame.others[0] is not None for frame in black)
    back = [frame for k in range(20, 24) for frame in sent(frames, k, (0, 1, 2, 3))]
    assert all(decode_grey(frame.left).any() for frame in back)
    stamps = [frame.stamp_ns for frame in (*done, *back)]
    assert stamps == sorted(set(stamps))
