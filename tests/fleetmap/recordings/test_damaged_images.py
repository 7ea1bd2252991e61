"""Images that are damaged inside cost their frame, and no sentence of a decoder reaches stderr."""

import struct
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import images, open_recording
from fleetmap.recordings.images import INVERSE_DEPTH, StoredImage, decode_depth, decode_grey
from support.recordings.recording_samples import make_sample, write_euroc

NOISE = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
PNG, JPEG = (bytes(cv2.imencode(kind, NOISE)[1]) for kind in (".png", ".jpg"))
DEPTH = struct.pack("<iff", 0, 100.0, 1.0) + bytes(cv2.imencode(".png", NOISE.astype(np.uint16) << 5)[1])


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :]


def without_middle(data: bytes) -> bytes:
    return data[: len(data) // 3] + data[len(data) // 2 :]


def png_of(stream: bytes) -> bytes:
    """A PNG of 80x60 whose checksums are right, whatever its stream of pixels is."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 80, 60, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", stream) + chunk(b"IEND", b"")


ROWS = b"".join(b"\0" + bytes(row) for row in NOISE)


@pytest.mark.parametrize(
    "data",
    [
        flipped(PNG),
        without_middle(PNG),
        without_middle(JPEG),
        png_of(zlib.compress(ROWS[:1000])),
        png_of(zlib.compress(ROWS)[:-4] + b"abcd"),
        png_of(zlib.compress(b"\x09" * len(ROWS))),
        png_of(b""),
        PNG[:100],
        b"",
    ],
)
def test_damage_is_an_error_in_our_words(data: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match=r"camera: .*(damaged|cut off|no bytes)"):
        decode_grey(StoredImage("file", data, "camera"))
    assert capfd.readouterr().err == ""


def test_packed_depth_too(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match="damaged"):
        decode_depth(StoredImage(INVERSE_DEPTH, flipped(DEPTH), "depth"))
    assert capfd.readouterr().err == ""


def test_threads_that_decode_at_once_accuse_no_good_image(capfd: pytest.CaptureFixture[str]) -> None:
    """What a decoder prints is the process's own: it must be laid to the image that it is about."""
    large = np.tile(NOISE, (8, 8))
    png, jpeg = (bytes(cv2.imencode(kind, large)[1]) for kind in (".png", ".jpg"))
    pictures = [png, without_middle(jpeg), jpeg, without_middle(jpeg)] * 10

    def is_good(data: bytes) -> bool:
        try:
            return decode_grey(StoredImage("file", data, "camera")).shape == large.shape
        except RecordingError:
            return False

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(is_good, pictures)) == [True, False, True, False] * 10
    assert capfd.readouterr().err == ""


def test_readers_do_not_wait_for_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are in the middle of their left image at once."""
    both = threading.Barrier(2, timeout=20.0)
    decode = images.decode_grey
    monkeypatch.setattr(
        images, "decode_grey", lambda stored: (stored.where == "left" and both.wait(), decode(stored))[1]
    )
    pair = images.StoredFrame(0, StoredImage("file", PNG, "left"), StoredImage("file", PNG, "right"))
    with ThreadPoolExecutor(2) as pool:
        assert len([frame.right for frame in pool.map(images.decode_frame, [pair, pair])]) == 2


@pytest.mark.parametrize("spoil", [without_middle, lambda _: JPEG])
def test_one_damaged_picture_costs_its_frame(tmp_path: Path, spoil: Callable[[bytes], bytes]) -> None:
    """The second: of another size than the calibration says."""
    folder = write_euroc(tmp_path / "r", make_sample(6), image_type="jpg")
    file = folder / "mav0/cam1/data/image3.jpg"
    with open_recording(folder) as recording:
        all_ns = recording.frame_stamps_ns
        file.write_bytes(spoil(file.read_bytes()))
        sound, indices = recording.readable(np.arange(1, 6))
        np.testing.assert_array_equal(sound.frame_stamps_ns, np.delete(all_ns, 3))
        np.testing.assert_array_equal(indices, [1, 2, 3, 4])
        assert sound.read_frame(3).stamp_ns == all_ns[4]
        assert sound.part(indices).read_frame(2).stamp_ns == all_ns[4]
        assert [issue.what for issue in sound.issues] == ["images damaged"]
        assert "1 of 5 frames left out" in sound.issues[0].detail
        np.testing.assert_array_equal(sound.damaged_ns, all_ns[[3]])
        for number in (1, 2):
            other = file.with_name(f"image{number}.jpg")
            other.write_bytes(spoil(other.read_bytes()))
        with pytest.raises(RecordingError, match=r"3 of 5 frames cannot be read; the first: .*cam1"):
            recording.readable(np.arange(1, 6))
