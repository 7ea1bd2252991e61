"""Frames may drop and are counted, inertial samples never do, and a frame waits for its own."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import RecordingError, UsageError
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, WheelSample
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import ReplaySource
from support.recordings.recording_samples import FRAME_NS, make_sample, write_mcap

MS = 1_000_000


def frame(stamp_ms: int) -> CameraFrame:
    return CameraFrame(stamp_ms * MS, np.zeros((2, 2), np.uint8))


def imu(*stamps_ms: int, gyro: float = 0.0) -> ImuSamples:
    count = len(stamps_ms)
    return ImuSamples(MS * np.array(stamps_ms, np.int64), np.full((count, 3), gyro), np.ones((count, 3)))


def intake(frames: int = 2, wait_s: float = 0.0, offset_s: float = 0.0) -> Intake:
    return Intake(frames=frames, imu_minus_cam_s=offset_s, has_imu=True, imu_wait_s=wait_s)


def test_the_oldest_frames_drop_and_no_inertial_sample_does() -> None:
    queue = intake()
    for stamp_ms in range(0, 100, 10):
        queue.put_imu(imu(*range(stamp_ms, stamp_ms + 10)))
        queue.put_frame(frame(stamp_ms))
    first, second = queue.take(0), queue.take(0)
    assert (first.frame.stamp_ns, second.frame.stamp_ns) == (80 * MS, 90 * MS)
    assert (queue.counts.frames, queue.counts.frames_dropped) == (10, 8)
    stamps = np.concatenate([first.imu.stamps_ns, second.imu.stamps_ns])
    np.testing.assert_array_equal(stamps, MS * np.arange(100))
    assert queue.take(0).frame is None


def test_what_cannot_be_is_refused_and_counted() -> None:
    queue = intake(frames=5)
    for stamp_ms in (10, 10, 5):
        queue.put_frame(frame(stamp_ms))
    for samples in (imu(1, 2, 2, 3), imu(1), imu(4, gyro=float("nan")), imu(5, gyro=1e9)):
        queue.put_imu(samples)
    assert queue.counts.frames_disordered == 2
    assert (queue.counts.imu_samples, queue.counts.imu_refused) == (3, 4)
    np.testing.assert_array_equal(queue.take(0).imu.stamps_ns, MS * np.array([1, 2, 3]))


def test_a_frame_waits_for_its_inertial_samples_but_not_for_ever() -> None:
    queue = intake(wait_s=5.0, offset_s=0.02)
    queue.put_frame(frame(100))
    late = threading.Timer(0.05, lambda: queue.put_imu(imu(90, 119, 121)))
    late.start()
    moment = queue.take(1.0)
    late.join()
    np.testing.assert_array_equal(moment.imu.stamps_ns, MS * np.array([90, 119, 121]))
    assert queue.counts.imu_late == 0
    hasty = intake(wait_s=0.01)
    hasty.put_frame(frame(100))
    assert hasty.take(1.0).frame is not None
    assert hasty.counts.imu_late == 1


def test_what_comes_before_a_frame_goes_with_it() -> None:
    queue = intake()
    for stamp_ms in (10, 30):
        queue.put_wheel(WheelSample(stamp_ms * MS, np.zeros(3), 0.0, 0.1, 0.1))
        queue.put_prior(PositionPrior(stamp_ms * MS, np.eye(4), np.eye(6)))
    queue.put_frame(frame(20))
    queue.put_frame(frame(40))
    for stamp_ms in (10, 30):
        moment = queue.take(0)
        assert [sample.stamp_ns for sample in moment.wheel] == [stamp_ms * MS]
        assert [prior.stamp_ns for prior in moment.priors] == [stamp_ms * MS]


def test_without_frames_memory_stays_bounded() -> None:
    queue = intake()
    for second in range(0, 200, 10):
        queue.put_imu(imu(*range(1000 * second, 1000 * second + 10_000, 10)))
    assert queue.counts.imu_stale > 13_000
    queue.put_frame(frame(200_000))
    assert len(queue.take(0).imu) <= 6001


@pytest.mark.parametrize("stamps_ms", [[1], [1, 51, 101, 601]], ids=["alone", "after lost ones"])
def test_the_end_is_told_once_all_is_taken(stamps_ms: list[int]) -> None:
    queue = intake(frames=9)
    for stamp_ms in stamps_ms:
        queue.put_frame(frame(stamp_ms))
    queue.finish()
    for _ in stamps_ms:
        assert not queue.exhausted
        assert queue.take(10.0).frame is not None
    assert queue.exhausted
    assert queue.take(10.0).frame is None


def test_a_clock_that_was_set_back_is_an_error_and_not_waited_for() -> None:
    """Stamps that go on from an hour before would be refused for an hour."""
    hour_ms = 3_600_000
    queue = intake(frames=30)
    for stamp_ms in (hour_ms - 50, hour_ms, 0, hour_ms + 50, *range(0, 450, 50)):  # one bad stamp is one frame
        queue.put_frame(frame(stamp_ms))
    assert queue.take(0).frame.stamp_ns == (hour_ms - 50) * MS
    queue.put_frame(frame(550))
    with pytest.raises(RecordingError, match=r"images: the stamps went back by 3600\.1 s.*clock was set; start again"):
        queue.take(0)


AHEAD_MS = [130, 300, 900, 1600, 9900, 10_100, 18_000_000, (2**63 - 1) / MS, -300, -1600, -18_000_000, -(2**63) / MS]


@pytest.mark.parametrize("ahead_ms", AHEAD_MS)
@pytest.mark.parametrize("at", [0, 1, 2, 7, 38])
def test_one_wrong_stamp_costs_itself(ahead_ms: float, at: int) -> None:
    """Of every sensor, and nothing later. As one of the first two, or no further ahead than after a lost value, it costs two more."""
    queue, stamps = intake(frames=99), [10**9 + n * 50 * MS for n in range(40)]
    wrong_ns = max(min(stamps[at] + int(ahead_ms * MS), 2**63 - 1), -(2**63))
    for stamp_ns in [*stamps[:at], wrong_ns, *stamps[at + 1 :]]:
        queue.put_imu(ImuSamples(np.array([stamp_ns]), np.zeros((1, 3)), np.ones((1, 3))))
        queue.put_wheel(WheelSample(stamp_ns, np.zeros(3), 0.0, 0.1, 0.1))
        queue.put_frame(CameraFrame(stamp_ns, np.zeros((2, 2), np.uint8)))
    bundles = [bundle for _ in stamps if (bundle := queue.take(0)).frame is not None]
    images = [bundle.frame.stamp_ns for bundle in bundles]
    inertial = np.concatenate([bundle.imu.stamps_ns for bundle in bundles]).tolist()
    wheels = [sample.stamp_ns for bundle in bundles for sample in bundle.wheel]
    del stamps[at]
    for taken in (images, inertial, wheels):
        assert taken == sorted(taken)
        assert len(set(stamps) - set(taken)) <= (2 if at < 2 or ahead_ms == 130 else 0)
        assert set(taken) - set(stamps) <= ({wrong_ns} if at < 2 or ahead_ms == 130 else set())


def test_a_pause_and_a_clock_set_forward_cost_nothing() -> None:
    queue, stamps_ms = intake(frames=9), [0, 50, 100, 3000, 3050, 3100, 36_000_000, 36_000_050, 36_000_100]
    for stamp_ms in stamps_ms:
        queue.put_imu(imu(stamp_ms))
        queue.put_frame(frame(stamp_ms))
    assert [queue.take(0).frame.stamp_ns // MS for _ in stamps_ms] == stamps_ms
    assert (queue.counts.frames_disordered, queue.counts.imu_refused) == (0, 0)


# Samples of a replay: every IMU sample once and in time; backwards, rising stamps and no IMU.

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
    parts = [before.imu for before in played.samples_before_each()]
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
        truth = recording.ground_truth.at(played.recorded_stamp_ns(number))
        np.testing.assert_allclose(truth, SAMPLE.world_from_body[1::3][::-1][number], atol=1e-9)
    assert played.calibration.imu is None, "its samples would say the opposite of what happens"
    assert [len(before.imu) for before in played.samples_before_each()] == [0, 0, 0]


def test_no_frame_is_a_usage_error(recording: Recording) -> None:
    with pytest.raises(UsageError, match="90"):
        source(recording, "90:")
