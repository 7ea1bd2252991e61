"""Videos that PyAV's encoder writes, and ones that are cut, without stamps, too large or none at all."""

import pickle
import struct
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, Recording, open_recording
from fleetmap.sensors.samples import SensorSet
from mapserver.doctor.run_checks import run_checks
from support.recordings.recording_samples import HEIGHT, WIDTH, kalibr_text, make_sample, write_video
from support.storage.memory_limit import memory_at_most

SAMPLE = make_sample(12)


@pytest.fixture
def rig(tmp_path: Path) -> OpenOptions:
    (tmp_path / "rig.yaml").write_text(kalibr_text().partition("cam1:")[0])
    return OpenOptions(tmp_path / "rig.yaml")


def movie(path: Path, steps: Sequence[int] = (50,) * 11, **options: str) -> Path:
    """The sample's left images at ms steps."""
    return write_video(path, SAMPLE.left, [0, *np.cumsum(steps).tolist()], **options)


def notes(recording: Recording) -> dict[str, str]:
    return {issue.what: issue.detail for issue in recording.issues}


def test_frames_are_those_that_were_encoded_in_any_order(tmp_path: Path, rig: OpenOptions) -> None:
    with open_recording(movie(tmp_path / "drive.mp4"), rig) as recording:
        assert (recording.format, recording.name, recording.sensor_set) == ("video", "drive", SensorSet.MONO)
        assert recording.frame_stamps_ns.tolist() == [50_000_000 * n for n in range(12)]
        assert set(notes(recording)) == {"stamps uncertain"}
        for index in (0, 1, 2, 9, 4, 4, 11, 0, 5, 6):
            np.testing.assert_array_equal(recording.read_frame(index).left, SAMPLE.left[index])
        part = pickle.loads(pickle.dumps(recording.part(np.array([10, 3]))))
        with part:
            np.testing.assert_array_equal(part.read_frame(1).left, SAMPLE.left[3])
    with pytest.raises(RecordingError, match="after the recording was closed"):
        recording.read_frame(3)


def test_frames_that_depend_on_later_ones(tmp_path: Path, rig: OpenOptions) -> None:
    """B frames: the order of decoding is another one than that of showing."""
    path = write_video(tmp_path / "a.mp4", SAMPLE.left, list(range(0, 600, 50)), bf="2", g="5", crf="10", qp="")
    with open_recording(path, rig) as recording:
        assert recording.frame_stamps_ns.tolist() == [50_000_000 * n for n in range(12)]
        forward = [recording.read_frame(n).left for n in range(12)]
        for index in (11, 5, 4, 6, 0, 10, 3):
            np.testing.assert_array_equal(recording.read_frame(index).left, forward[index])
            error = np.abs(forward[index].astype(int) - SAMPLE.left[index]).mean()
            others = [np.abs(forward[index].astype(int) - SAMPLE.left[n]).mean() for n in range(12) if n != index]
            assert error < min(others)


def test_the_doctor_says_that_the_stamps_are_uncertain(tmp_path: Path, rig: OpenOptions) -> None:
    with open_recording(movie(tmp_path / "a.mp4"), rig) as recording:
        findings = {finding.name: finding for finding in run_checks(recording).findings}
    assert findings["stamps uncertain"].verdict == "warn"
    assert "not set by the exposure" in findings["stamps uncertain"].sentence
    assert "lost data" not in findings


def test_a_variable_rate_keeps_its_stamps_and_is_named(tmp_path: Path, rig: OpenOptions) -> None:
    steps = [50, 50, 120, 50, 30, 50, 50, 200, 50, 50, 50]
    with open_recording(movie(tmp_path / "a.mp4", steps), rig) as recording:
        assert np.diff(recording.frame_stamps_ns).tolist() == [1_000_000 * step for step in steps]
        assert notes(recording)["variable frame rate"] == "steps of 30.0 to 200.0 ms"
        np.testing.assert_array_equal(recording.read_frame(8).left, SAMPLE.left[8])


def test_a_calibration_must_be_given(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="a video holds no calibration; pass one with --calibration FILE"):
        open_recording(movie(tmp_path / "a.mp4"))


def test_a_cut_video_is_read_as_far_as_it_goes_or_named(tmp_path: Path, rig: OpenOptions) -> None:
    sound = movie(tmp_path / "a.mp4").read_bytes()
    cut = tmp_path / "cut.mp4"
    for share in (0.0, 0.01, 0.5, 0.95):  # the index is at the end
        cut.write_bytes(sound[: int(share * len(sound))])
        with pytest.raises(RecordingError, match=r"cut\.mp4 cannot be read as a video .*`ffmpeg -i .*cut\.mp4"):
            open_recording(cut, rig)
    front = movie(tmp_path / "front.mp4", movflags="faststart").read_bytes()
    cut.write_bytes(front[: int(0.6 * len(front))])
    with open_recording(cut, rig) as recording:
        assert 0 < len(recording) < 12 or "the video ends early" in notes(recording)
        np.testing.assert_array_equal(recording.read_frame(2).left, SAMPLE.left[2])
        with pytest.raises(RecordingError, match=r"cut\.mp4: the frame at \d+ (cannot be decoded|is not in)"):
            for index in range(12):
                recording.read_frame(index)


def test_files_that_are_no_video(tmp_path: Path, rig: OpenOptions) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n/etc/passwd\n")
    for name in ("text.mp4", "list.mp4"):
        with pytest.raises(RecordingError, match=rf"{name} cannot be read as a video"):
            open_recording(tmp_path / name, rig)
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 16000, 0, Fraction(1, 16000)
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(RecordingError, match="it holds no pictures"):
        open_recording(tmp_path / "sound.mp4", rig)


def test_other_videos_are_told_how_to_become_one(tmp_path: Path, rig: OpenOptions) -> None:
    for name in ("a.avi", "a.mkv", "a.h264"):
        (tmp_path / name).write_bytes(bytes(100))
        says = rf"`ffmpeg -i .*{name} -c copy .*a\.mp4` makes a video that can be read"
        with pytest.raises(RecordingError, match=says):
            open_recording(tmp_path / name, rig)


def test_pictures_beyond_the_limit_are_not_decoded(
    tmp_path: Path, rig: OpenOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = movie(tmp_path / "a.mp4")
    monkeypatch.setattr("fleetmap.plugins.videos.MAX_PIXELS", WIDTH * HEIGHT - 1)
    with pytest.raises(RecordingError, match=f"pictures of {WIDTH}x{HEIGHT} are larger than the limit"):
        open_recording(path, rig)


def test_tables_tell_of_no_more_samples_than_there_are_bytes(tmp_path: Path, rig: OpenOptions) -> None:
    data = bytearray(movie(tmp_path / "a.mp4").read_bytes())
    count = struct.pack(">I", 20_000_000)
    for table, at, value in ((b"stsz", 8, struct.pack(">I", 1) + count), (b"stsc", 16, count), (b"stts", 12, count)):
        start = data.index(table) + at
        data[start : start + len(value)] = value
    path = tmp_path / "liar.mp4"
    path.write_bytes(data)
    with memory_at_most(400 << 20):
        with pytest.raises(RecordingError, match=r"its tables declare 20000000 samples in \d+ bytes"):
            open_recording(path, rig)
        # The control
        with pytest.raises((MemoryError, av.error.FFmpegError, AssertionError)), av.open(str(path)) as opened:
            assert opened.streams.video[0].frames < 20_000_000
    data = bytearray(movie(tmp_path / "b.mp4").read_bytes())
    data[data.index(b"udta") : data.index(b"udta") + 4] = b"cmov"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="its tables declare"):
        open_recording(path, rig)


def test_without_the_library_the_message_names_the_extra(
    tmp_path: Path, rig: OpenOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = movie(tmp_path / "a.mp4")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RecordingError, match=r"pip install .\.\[video\]"):
        open_recording(path, rig)
