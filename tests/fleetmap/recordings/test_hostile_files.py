"""Files that are made to take a machine down: refused by what their headers say, within the project's own errors.

Rows 25, 26 and 27 of docs/security.md.
"""

import contextlib
import hashlib
import struct
import time
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from fleetmap.config import load_toml
from fleetmap.errors import CalibrationError, RecordingError, UsageError
from fleetmap.recordings import OpenOptions, limits, open_recording
from fleetmap.recordings.calibration_files import calibration_files, parse_calibration, read_yaml
from fleetmap.recordings.files import hash_file
from fleetmap.recordings.images import StoredImage, decode_grey, image_size
from fleetmap.recordings.limits import MAX_CALIBRATION_BYTES, MAX_MESSAGE_BYTES, MAX_PIXELS, unpack
from fleetmap.recordings.mcap.reader import MAGIC
from fleetmap.recordings.ros2.messages import encode_image
from mapserver.config import MapserverConfig
from support.plugins import needs_plugin
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import foreign_messages, write_foreign
from support.recordings.recording_samples import grey_png
from support.storage.memory_limit import memory_at_most

BOMB_BYTES = 256 << 20
MEMORY = 200 << 20  # that the process may take more


@cache
def zstd_bomb() -> bytes:
    """A frame that does not say how much it unpacks to."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    return packer.compress(bytes(BOMB_BYTES)) + packer.flush()


@cache
def lz4_bomb() -> bytes:
    return bytes(lz4.frame.compress(bytes(BOMB_BYTES)))


BOMBS = {"zstd": zstd_bomb, "lz4": lz4_bomb}


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


FOOTER = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC


def chunk(compression: str, packed: bytes, uncompressed_size: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, uncompressed_size, 0) + struct.pack("<I", len(compression)) + compression.encode()
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def with_bomb(tmp_path: Path, bomb: bytes) -> Path:
    """A sound recording with `bomb` put in before its first record."""
    sound = write_foreign(tmp_path / "sound.mcap", foreign_messages()).read_bytes()
    path = tmp_path / "bomb.mcap"
    path.write_bytes(sound[: len(MAGIC)] + bomb + sound[len(MAGIC) :])
    return path


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("stated", [BOMB_BYTES, 100])
def test_a_chunk_unpacks_to_no_more_than_its_limit(tmp_path: Path, kind: str, stated: int) -> None:
    packed = BOMBS[kind]()
    assert len(packed) < BOMB_BYTES >> 7
    with memory_at_most(MEMORY), open_recording(with_bomb(tmp_path, chunk(kind, packed, stated))) as recording:
        assert len(recording) == 4, "what is sound behind it is read"
        issues = recording.issues
    what = "too large" if stated > MAX_MESSAGE_BYTES else "damaged chunks"
    assert any(what in issue.what for issue in issues)


def test_a_chunk_of_the_largest_size_is_read() -> None:
    data = bytes(MAX_MESSAGE_BYTES)
    assert unpack("zstd", zstandard.compress(data, 1)) == data
    assert unpack("lz4", lz4.frame.compress(data)) == data


def test_a_frame_that_lies_about_its_size_gets_no_memory() -> None:
    said = zstandard.ZstdCompressionParameters.from_level(1, window_log=20)
    lying = bytearray(zstandard.ZstdCompressor(compression_params=said).compress(bytes(200_000)))
    assert lying[4] & 0xC0, "the frame states its content's size behind the head"
    lying[6:10] = struct.pack("<I", 0xFFFFFFF0)
    with memory_at_most(MEMORY):
        with contextlib.suppress(ValueError):
            assert len(unpack("zstd", bytes(lying))) == 200_000
        with pytest.raises(ValueError, match="unpack to more than 100"):
            unpack("zstd", zstandard.compress(bytes(1 << 20)), 100)


def test_many_chunks_that_each_obey_do_not_add_up(tmp_path: Path) -> None:
    """IMU messages of zeros: each chunk is within its limit, all of them together would fill the memory."""
    schema = record(3, struct.pack("<H", 1) + b"".join(_text(t) for t in ("sensor_msgs/msg/Imu", "ros2msg", "")))
    channel = record(4, struct.pack("<HH", 1, 1) + _text("/imu") + _text("cdr") + struct.pack("<I", 0))
    message = record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(1 << 20))
    content = message * 60
    packed = zstandard.compress(content, 1)
    path = tmp_path / "many.mcap"
    path.write_bytes(MAGIC + schema + channel + 40 * chunk("zstd", packed, len(content)) + FOOTER)
    assert path.stat().st_size < 1_000_000
    refused = pytest.raises(RecordingError, match=r"many\.mcap: \d+ bytes unpack to more than")
    with memory_at_most(MEMORY + (128 << 20)), refused:
        open_recording(path)


SQLITE = pytest.param("sqlite", marks=needs_plugin("rosbag2-sqlite"))
ROS1 = pytest.param("ros1", marks=needs_plugin("rosbag1"))


@pytest.mark.parametrize("kind", ["chunks", "chunks without messages", "messages", SQLITE, ROS1])
def test_what_is_unpacked_adds_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Black pictures of a megabyte, each within its limit: 8 MiB of them took minutes."""
    monkeypatch.setattr(limits, "UNPACKED_BYTES", 1 << 20)
    black = StoredImage("mono8", bytes(1 << 20), "", 1024, 1024, 1024)
    images = [("/cam0/image_raw", "sensor_msgs/Image", t, encode_image(t, "c", black)) for t in range(1, 200)]
    path = tmp_path / "black"
    if kind == "chunks":
        write_foreign(path, images, compression=CompressionType.ZSTD)
    elif kind == "chunks without messages":
        content = record(0x7F, bytes(1 << 20))
        path.write_bytes(MAGIC + 200 * chunk("zstd", zstandard.compress(content), len(content)) + FOOTER)
    elif kind == "ros1":
        write_rosbag1(path, images, Writer.CompressionFormat.BZ2)
    else:
        storage = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
        write_rosbag2(path, images, CompressionMode.MESSAGE, storage)
    with pytest.raises(RecordingError, match=r"black.*: \d+ bytes unpack to more than \d+ bytes; leave the file out"):
        open_recording(path)


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def test_records_are_measured_before_they_are_read(tmp_path: Path) -> None:
    """A sparse file: 3 GB of zeros that take no disk."""
    for opcode, size in ((9, MAX_MESSAGE_BYTES + (65 << 10)), (5, 1 << 30), (6, 1 << 30), (12, 1 << 30)):
        sound = write_foreign(tmp_path / "sound.mcap", foreign_messages()).read_bytes()
        path = tmp_path / f"sparse-{opcode}.mcap"
        with path.open("wb") as file:
            file.write(MAGIC + struct.pack("<BQ", opcode, size))
            file.seek(size, 1)
            file.write(sound[len(MAGIC) :])
        with memory_at_most(MEMORY), open_recording(path) as recording:
            assert len(recording) == 4
        assert any("1 left out" in issue.detail for issue in recording.issues if "too large" in issue.what)


@pytest.mark.parametrize("length", [1 << 40, 1 << 63, (1 << 64) - 1])
def test_lengths_inside_of_records_are_not_believed(tmp_path: Path, length: int) -> None:
    lying = struct.pack("<Q", length) + b"0123456789"
    bad_chunk = record(6, struct.pack("<QQQII", 0, 0, 100, 0, 0) + lying)
    bad_attachment = record(9, struct.pack("<QQ", 0, 0) + _text("name") + _text("text/plain") + lying)
    with open_recording(with_bomb(tmp_path, bad_chunk + bad_attachment)) as recording:
        assert len(recording) == 4
        assert {"damaged chunks (checksum or compression)", "a damaged record"} <= {i.what for i in recording.issues}


@needs_plugin("mcap")
def test_an_index_that_points_at_the_whole_file_is_not_read_at_once(tmp_path: Path) -> None:
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as file:
        file.write(MAGIC + b"\xff" * 9)
        file.seek(1 << 30, 1)
        file.write(record(2, struct.pack("<QQI", 8, 0, 0)) + MAGIC)
    with memory_at_most(MEMORY), pytest.raises(RecordingError, match="no message that can be read"):
        open_recording(path)


# ------------------------------------------------------------------------------------------------------------- calibration


def aliases(levels: int) -> str:
    return "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, levels + 1))


def test_a_calibration_that_names_a_device_does_not_read_it_for_ever(tmp_path: Path) -> None:
    (tmp_path / "cams.yaml").write_text("notes: {mask: /dev/zero}\n")
    with pytest.raises(RecordingError, match="/dev/zero is no file"):
        for file in calibration_files(tmp_path / "cams.yaml"):
            hash_file(file, hashlib.sha256())


def test_nine_levels_of_aliases_are_refused_at_once() -> None:
    text = aliases(9) + "cam0: {camera_model: pinhole, resolution: [4, 4], intrinsics: *a9}\n"
    assert len(text) < 700
    begun = time.process_time()
    with pytest.raises(CalibrationError, match="aliases") as caught:
        parse_calibration(text, "file")
    assert time.process_time() - begun < 0.1
    assert len(str(caught.value)) < 200


HOSTILE_YAML: dict[str, Any] = {
    "a day that is none": "date: 2026-02-30",
    "a tag": "cam0: !!int x",
    "a tag of Python": "cam0: !!python/object/apply:os.system [true]",
    "itself": "cam0: &a [*a]",
    "nesting": "cam0: " + "[" * 100_000,
    "nesting that ends": "cam0: " + "[" * 3000 + "]" * 3000,
    "a number of 5000 digits": "cam0: " + "9" * 5000,
    "a sexagesimal": "cam0: 1" + ":1" * 200_000,
    "keys that are numbers": "1: 2",
    "keys of a camera that are numbers": "cam0: {1: 2}",
    "a camera with a superscript": "cam0: {}\ncam²: {}",
    "keys that are lists": "? [1]\n: 2",
    "a merge of nothing": "<<: 3",
    "a number beyond floats": "cam0: {camera_model: pinhole, resolution: [1"
    + "0" * 400
    + ", 4], intrinsics: [1, 1, 1, 1]}",
    "many words": "cam0: {camera_model: pinhole, resolution: [" + "x, " * 100_000 + "], intrinsics: [1, 1, 1, 1]}",
    "many keys": "cam0: {" + "".join(f"k{n}: 1, " for n in range(50_000)) + "}",
    "a model of a kilobyte": "cam0: {camera_model: " + "x" * 900 + ", resolution: [4, 4]}",
    "a file of two megabytes": "#" * (2 << 20),
    "bytes that are no text": b"cam0: \xff\xfe",
    "no mapping": "[" + "1," * 200_000 + "]",
}


@pytest.mark.parametrize("what", HOSTILE_YAML)
def test_hostile_calibrations_get_a_short_error_of_ours(tmp_path: Path, what: str) -> None:
    content = HOSTILE_YAML[what]
    path = tmp_path / "camchain.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    recording = write_foreign(tmp_path / "sound.mcap", foreign_messages())
    begun = time.process_time()
    with pytest.raises(CalibrationError) as caught:
        open_recording(recording, OpenOptions(calibration_file=path))
    assert time.process_time() - begun < 2.0
    assert len(str(caught.value)) < 600 + len(str(path))


def test_no_more_of_a_file_is_read_than_a_calibration_may_have(tmp_path: Path) -> None:
    path = tmp_path / "sparse.yaml"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with memory_at_most(MEMORY), pytest.raises(CalibrationError, match=str(MAX_CALIBRATION_BYTES)):
        read_yaml(path)


@pytest.mark.parametrize(
    "content",
    [
        *(b"site = '\xff'", b"x = 2026-02-30", b" " * (2 << 20)),
        *(b"x = " + b"[" * 100_000, b"x = " + b"[" * 5000 + b"]" * 5000),
    ],
)
def test_hostile_settings_get_an_error_of_ours(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mapserver.toml"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=r"mapserver\.toml") as caught:
        load_toml(path, MapserverConfig)
    assert len(str(caught.value)) < 800


# ------------------------------------------------------------------------------------------------------------------ images


def encoded(suffix: str, width: int, height: int) -> bytes:
    return cv2.imencode(suffix, np.zeros((height, width), np.uint8))[1].tobytes()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm"])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (321, 123), (3000, 7)])
def test_the_header_says_what_opencv_decodes(suffix: str, width: int, height: int) -> None:
    data = encoded(suffix, width, height)
    assert image_size(data) == (width, height)
    assert decode_grey(StoredImage("file", data)).shape == (height, width)
    for cut in range(0, min(len(data), 60)):
        assert image_size(data[:cut]) in (None, (width, height))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm"])
def test_a_picture_of_3600_megapixels_is_not_decoded(suffix: str) -> None:
    data = bytearray(encoded(suffix, 321, 123))
    if suffix == ".png":
        data = bytearray(grey_png(zlib.compress(bytes(100_000), 1), 60_000, 60_000))
    elif suffix == ".jpg":
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", 60_000, 60_000)
    elif suffix == ".bmp":
        data[18:26] = struct.pack("<ii", 60_000, -60_000)
    elif suffix == ".pgm":
        data = bytearray(bytes(data).replace(b"321 123", b"60000 60000"))
    else:
        (at,) = struct.unpack_from("<I", data, 4)
        (count,) = struct.unpack_from("<H", data, at)
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            if struct.unpack_from("<H", data, entry)[0] in (256, 257):
                struct.pack_into("<HII", data, entry + 2, 4, 1, 60_000)
    assert len(data) < 60_000
    with memory_at_most(MEMORY), pytest.raises(RecordingError, match="60000x60000; the limit is 64 megapixels"):
        decode_grey(StoredImage("file", bytes(data)))


def test_formats_that_nobody_measures_are_refused() -> None:
    webp = encoded(".webp", 4, 4)
    assert cv2.imdecode(np.frombuffer(webp, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (4, 4)
    with pytest.raises(RecordingError, match="a WebP image; record JPEG, PNG or raw images"):
        decode_grey(StoredImage("file", webp))


def test_raw_images_claim_no_more_than_they_bring() -> None:
    with memory_at_most(MEMORY):
        assert decode_grey(StoredImage("mono8", bytes(16), "image", 4, 1, 0xFFFFFFFF)).shape == (1, 4)
        for height, step in ((2, 0xFFFFFFFF), (0xFFFFFFFF, 4)):
            with pytest.raises(RecordingError, match="damaged"):
                decode_grey(StoredImage("mono8", bytes(16), "image", 4, height, step))
    with pytest.raises(RecordingError, match="limit"):
        decode_grey(StoredImage("mono8", bytes(MAX_PIXELS + 8), "image", 8, MAX_PIXELS // 8 + 1, 8))
