"""Samples of a replay: every IMU sample once and in time; backwards, rising stamps and no IMU."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.sources.replay_source import ReplaySource
from support.recordings.recording_samples import FRAME_NS, make_sample, write_mcap

LEAD_NS = 10_000_000
SAMPLE = make_sample(8)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return open_recording(write_mcap(tmp_path_factory.mktemp("recording"), SAMPLE))


def source(recording: Recording, frames: str = ":", *, reverse: bool = False) -> ReplaySource:
    return ReplaySource.of(recording, FrameSelection.parse(frames), reverse=reverse)


@pytest.mark.parametrize("frames", [":", "1::3", "4:"])
@pytest.mark.parametrize("offset_s", [0.0, 0.0123, -0.2])
def test_every_imu_sample_comes_once_and_in_time(recording: Recording, frames: str, offset_s: float) -> None:
    """`imu_minus_cam_s` moves the moment on the IMU's clock at which a frame was taken."""
    cameras = tuple(replace(camera, imu_minus_cam_s=offset_s) for camera in recording.calibration.cameras)
    moved = replace(recording, calibration=replace(recording.calibration, cameras=cameras))
    played = source(moved, frames)
    parts = list(played.imu_before_each())
    assert len(parts) == len(played)
    fed: list[int] = []
    for number, part in enumerate(parts):
        fed += part.stamps_ns.tolist()
        taken_ns = played.recorded_stamp_ns(number) + round(offset_s * 1e9)
        expected = [int(s) for s in SAMPLE.imu_stamps_ns if s < taken_ns + LEAD_NS]
        assert fed == expected
        assert len(part.gyro_radps) == len(part.accel_mps2) == len(part)


def test_forwards_the_stamps_are_the_recorded_ones(recording: Recording) -> None:
    played = source(recording, "1::3")
    frames = [played.frame(k) for k in range(len(played))]
    assert [f.stamp_ns for f in frames] == SAMPLE.stamps_ns[1::3].tolist()
    for frame, image in zip(frames, SAMPLE.left[1::3], strict=True):
        np.testing.assert_array_equal(frame.left, image)
    assert played.calibration.imu is not None


def test_backwards_the_pictures_turn_and_the_stamps_rise(recording: Recording) -> None:
    played = source(recording, "1::3", reverse=True)
    frames = [played.frame(k) for k in range(len(played))]
    assert np.diff([f.stamp_ns for f in frames]).tolist() == [3 * FRAME_NS] * 2
    for number, (frame, image) in enumerate(zip(frames, SAMPLE.left[1::3][::-1], strict=True)):
        np.testing.assert_array_equal(frame.left, image)
        assert played.recorded_stamp_ns(number) == SAMPLE.stamps_ns[1::3][::-1][number]
        truth = played.truth_map_from_body(number)
        assert truth is not None
        np.testing.assert_allclose(truth, SAMPLE.world_from_body[1::3][::-1][number], atol=1e-9)
    assert played.calibration.imu is None, "its samples would say the opposite of what happens"
    assert [len(samples) for samples in played.imu_before_each()] == [0, 0, 0]


def test_no_frame_is_a_usage_error(recording: Recording) -> None:
    with pytest.raises(UsageError, match="90"):
        source(recording, "90:")
