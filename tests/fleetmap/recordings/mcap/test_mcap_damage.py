"""MCAP files cut off and with flipped bits: read as far as they are whole, the loss said, nothing invented."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Trajectory
from support.plugins import needs_plugin
from support.recordings.mcap_samples import foreign_messages, write_foreign
from support.recordings.recording_samples import calibration, make_sample

SAMPLE = make_sample(16)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """2.5 MB in three chunks, the sensors interleaved in the order of time."""
    path = tmp_path_factory.mktemp("mcap") / "whole.mcap"
    with McapRecordingWriter(path, calibration()) as writer:
        imu, since = ImuSamples(SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2), 0
        for i, stamp in enumerate(SAMPLE.stamps_ns.tolist()):
            writer.write_imu(imu.between(since, stamp))
            writer.write_ground_truth(Trajectory(SAMPLE.stamps_ns[i : i + 1], SAMPLE.world_from_body[i][None]))
            writer.write_frame(CameraFrame(stamp, SAMPLE.left[i], SAMPLE.right[i]))
            since = stamp
    return path.read_bytes()


def assert_nothing_is_invented(recording: Recording) -> None:
    """Everything that is there equals what was written at that stamp."""
    for index, stamp_ns in enumerate(recording.frame_stamps_ns):
        (at,) = np.flatnonzero(stamp_ns == SAMPLE.stamps_ns)
        frame = recording.read_frame(index)
        np.testing.assert_array_equal([frame.left, frame.right], [SAMPLE.left[at], SAMPLE.right[at]])
    places = np.searchsorted(SAMPLE.imu_stamps_ns, recording.imu.stamps_ns)
    np.testing.assert_array_equal(recording.imu.stamps_ns, SAMPLE.imu_stamps_ns[places])
    np.testing.assert_array_equal(recording.imu.gyro_radps, SAMPLE.gyro_radps[places])
    if recording.ground_truth is not None:
        places = np.searchsorted(SAMPLE.stamps_ns, recording.ground_truth.stamps_ns)
        np.testing.assert_array_equal(recording.ground_truth.stamps_ns, SAMPLE.stamps_ns[places])
        wanted = np.stack(SAMPLE.world_from_body)[places]
        np.testing.assert_allclose(recording.ground_truth.frame_from_body, wanted, atol=1e-12)


def write_bytes(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("share", [0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.99, 0.9999])
def test_cut_off(whole: bytes, tmp_path: Path, share: float) -> None:
    with open_recording(write_bytes(tmp_path, whole[: int(share * len(whole))])) as recording:
        whole_frames = int(share * 0.95 * len(SAMPLE.left)) - 1
        assert len(recording) >= whole_frames, "most of what is whole is used, also of the last chunk"
        assert_nothing_is_invented(recording)
        assert "the file" in recording.issues[0].what


def test_a_tail_of_zeros_as_a_power_loss_leaves_it(whole: bytes, tmp_path: Path) -> None:
    cut = len(whole) // 2
    with open_recording(write_bytes(tmp_path, whole[:cut] + bytes(len(whole) - cut))) as recording:
        assert_nothing_is_invented(recording)
        assert recording.issues


@needs_plugin("mcap")
def test_single_flipped_bits_anywhere(whole: bytes, tmp_path: Path) -> None:
    """Whatever bit is flipped: either what is read is what was written, or the error is a RecordingError."""
    rng = np.random.default_rng(11)
    complete, refused = 0, 0
    for position in [*rng.integers(0, len(whole), 15).tolist(), *rng.integers(0, 4000, 15).tolist()]:
        data = bytearray(whole)
        data[position] ^= 1 << int(rng.integers(8))
        try:
            with open_recording(write_bytes(tmp_path, bytes(data))) as recording:
                assert_nothing_is_invented(recording)
                complete += len(recording) == len(SAMPLE.left)
        except RecordingError:
            refused += 1
    assert refused < 20
    assert complete > 0


@pytest.mark.parametrize("offset", [6, 20_000], ids=["in the length of its record", "in its content"])
@pytest.mark.parametrize("chunk", [0, 1])
def test_a_bad_chunk_costs_itself_alone(whole: bytes, tmp_path: Path, chunk: int, offset: int) -> None:
    """The channels of all messages are described in the first one, and again in the index, by which the next chunk is found."""
    data = bytearray(whole)
    data[_chunk_positions(whole)[chunk] + offset] ^= 0x40
    with open_recording(write_bytes(tmp_path, bytes(data))) as recording:
        assert 5 <= len(recording) < len(SAMPLE.left)
        assert recording.frame_stamps_ns[0] == SAMPLE.stamps_ns[0] or chunk == 0
        assert recording.frame_stamps_ns[-1] == SAMPLE.stamps_ns[-1]
        told = [f"{issue.what}: {issue.detail}" for issue in recording.issues]
        assert told and not any("a damaged record" in words for words in told)
        assert offset == 6 or any(words.startswith("damaged chunks") and ": 1 with" in words for words in told)
        assert_nothing_is_invented(recording)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
@pytest.mark.parametrize("use_chunking", [True, False])
def test_cut_files_of_other_writers(tmp_path: Path, compression: CompressionType, use_chunking: bool) -> None:
    options: dict[str, Any] = {"compression": compression, "use_chunking": use_chunking, "chunk_size": 150_000}
    messages = sorted(foreign_messages(), key=lambda message: message[2])
    path = write_foreign(tmp_path / "damaged.mcap", messages, **options)
    path.write_bytes(path.read_bytes()[: int(0.8 * path.stat().st_size)])
    with open_recording(path) as recording:
        assert len(recording) >= 1
        assert recording.issues


def _chunk_positions(data: bytes) -> list[int]:
    at, found = 8, []
    while at < len(data) - 9 and data[at] != 15:
        if data[at] == 6:
            found.append(at)
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return found
