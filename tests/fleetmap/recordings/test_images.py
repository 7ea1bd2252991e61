"""Images that are damaged inside cost their frame, and no sentence of a decoder reaches stderr."""

import io
import struct
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import images, open_recording
from fleetmap.recordings.images import INVERSE_DEPTH, RAW_ENCODINGS, StoredImage, decode_depth, decode_grey
from fleetmap.recordings.png import plain_png_pixels
from fleetmap.recordings.ros2 import messages as ros_messages
from support.recordings.mcap_samples import SAMPLE, foreign_messages, write_foreign
from support.recordings.recording_samples import HEIGHT, WIDTH, grey_png, make_sample, png_of, write_euroc

NOISE = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
PNG, JPEG = (bytes(cv2.imencode(kind, NOISE)[1]) for kind in (".png", ".jpg"))
DEPTH = struct.pack("<iff", 0, 100.0, 1.0) + bytes(cv2.imencode(".png", NOISE.astype(np.uint16) << 5)[1])


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :]


def without_middle(data: bytes) -> bytes:
    return data[: len(data) // 3] + data[len(data) // 2 :]


ROWS = b"".join(b"\0" + bytes(row) for row in NOISE)


@pytest.mark.parametrize(
    "data",
    [
        *(flipped(PNG), without_middle(PNG), without_middle(JPEG), PNG[:100], b"", grey_png(b"", 80, 60)),
        grey_png(zlib.compress(ROWS[:1000]), 80, 60),
        grey_png(zlib.compress(ROWS)[:-4] + b"abcd", 80, 60),
        grey_png(zlib.compress(b"\x09" * len(ROWS)), 80, 60),
    ],
)
def test_damage_is_an_error_in_our_words(data: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match=r"camera: .*(damaged|cut off|no bytes)"):
        decode_grey(StoredImage("file", data, "camera"))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("shape", [(1, 1), (7, 33), (33, 7, 3)])
@pytest.mark.parametrize("filter_of_rows", ["NONE", "SUB", "UP", "AVG", "PAETH"])
@pytest.mark.parametrize("bits", [8, 16])
def test_plain_pngs_have_the_pixels_that_opencv_reads(shape: tuple[int, ...], filter_of_rows: str, bits: int) -> None:
    pixels = np.random.default_rng(1).integers(0, 1 << bits, shape, f"uint{bits}")
    options = [cv2.IMWRITE_PNG_FILTER, getattr(cv2, f"IMWRITE_PNG_FILTER_{filter_of_rows}")]
    found = plain_png_pixels(bytes(cv2.imencode(".png", pixels, options)[1]))
    if (bits, len(shape)) == (16, 3):
        assert found is None
        return
    np.testing.assert_array_equal(found, pixels, strict=True)


def test_pngs_of_other_kinds_and_any_flipped_byte_are_left_to_opencv() -> None:
    small = io.BytesIO()
    grey = PIL.Image.fromarray(NOISE[:9, :9])
    grey.save(small, "png")
    for options in ({"transparency": 7}, {"bits": 4}):
        other = io.BytesIO()
        (grey.convert("P") if "bits" in options else grey).save(other, "png", **options)
        assert plain_png_pixels(other.getvalue()) is None
    data = small.getvalue()
    assert plain_png_pixels(data) is not None
    assert plain_png_pixels(grey_png(zlib.compress(ROWS + b"\0"), 80, 60)) is None
    for at in range(len(data)):
        assert plain_png_pixels(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]) is None, at


HEAD = b"IHDR", struct.pack(">IIBBBBB", 9, 9, 8, 0, 0, 0, 0)
PIXELS, END = (b"IDAT", zlib.compress(bytes(90))), (b"IEND", b"")


def no_columns(*kind: int) -> tuple[tuple[bytes, bytes], ...]:
    return (b"IHDR", struct.pack(">IIBBBBB", 0, 9, *kind, 0, 0, 0)), (b"IDAT", zlib.compress(bytes(9))), END


@pytest.mark.parametrize(
    "chunks",
    [
        *(no_columns(8, 0), no_columns(16, 0), no_columns(8, 2), (HEAD, HEAD, PIXELS, END), (HEAD, PIXELS)),
        *(((b"tEXt", HEAD[1]), PIXELS, END), (HEAD, (b"IDAT", PIXELS[1] + b"more"), END)),
        (HEAD, (b"IDAT", PIXELS[1][:9]), (b"tEXt", b"a\0b"), (b"IDAT", PIXELS[1][9:]), END),
    ],
)
def test_what_is_no_png_is_left_to_opencv(chunks: tuple[tuple[bytes, bytes], ...]) -> None:
    assert plain_png_pixels(png_of(HEAD, (b"IDAT", PIXELS[1][:9]), (b"IDAT", PIXELS[1][9:]), END)) is not None
    assert plain_png_pixels(png_of(*chunks)) is None


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
    both, decode = threading.Barrier(2, timeout=20.0), images.decode_grey
    together = lambda stored: (stored.where == "left" and both.wait(), decode(stored))[1]  # noqa: E731
    monkeypatch.setattr(images, "decode_grey", together)
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


# Bayer mosaics and YUV: OpenCV makes them, the reader gives back the grey that they were made of.

ORDERS = ("rggb", "bggr", "gbrg", "grbg")


def coloured() -> np.ndarray:
    """(H, W, 3) BGR: the sample, a little soft as behind a lens, with a tint as under warm light."""
    grey = cv2.GaussianBlur(SAMPLE.left[0], None, 2.0).astype(np.float64)
    return np.stack([0.5 * grey, 0.8 * grey, 1.0 * grey], -1).round().astype(np.uint8)


def mosaic(colour: np.ndarray, order: str) -> np.ndarray:
    """What a sensor behind such filters measures: its name is the first row's two letters, then the second row's."""
    channel = {"b": 0, "g": 1, "r": 2}
    found = np.empty(colour.shape[:2], np.uint8)
    for at, letter in enumerate(order):
        row, column = divmod(at, 2)
        found[row::2, column::2] = colour[row::2, column::2, channel[letter]]
    return found


def stored(encoding: str, pixels: np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> StoredImage:
    return StoredImage(encoding, pixels.tobytes(), "image", width, height, pixels.strides[0])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("bits", [8, 16])
def test_mosaics_give_the_grey_of_the_colours(order: str, bits: int) -> None:
    pixels = mosaic(coloured(), order)
    wide = pixels if bits == 8 else pixels.astype("<u2") * 256
    wanted = cv2.cvtColor(coloured(), cv2.COLOR_BGR2GRAY).astype(int)
    for other in ORDERS:  # the control: another order is another picture
        off = np.abs(decode_grey(stored(f"bayer_{other}{bits}", wide)) - wanted)[2:-2, 2:-2].mean()
        assert off < 2.0 if other == order else off > 4.0


def test_yuv_gives_its_luma() -> None:
    colour = coloured()
    luma = cv2.cvtColor(colour, cv2.COLOR_BGR2YUV_I420)[:HEIGHT]
    uyvy, yuyv = cv2.cvtColor(colour, cv2.COLOR_BGR2YUV_UYVY), cv2.cvtColor(colour, cv2.COLOR_BGR2YUV_YUYV)
    for encoding, pixels in (("uyvy", uyvy), ("yuv422", uyvy), ("yuyv", yuyv), ("yuv422_yuy2", yuyv)):
        assert np.abs(decode_grey(stored(encoding, pixels)).astype(int) - luma).max() <= 1, encoding
    half, whole = np.full((HEIGHT // 2, WIDTH), 128, np.uint8), np.full((2 * HEIGHT, WIDTH), 128, np.uint8)
    for encoding, rest in (("nv12", half), ("nv21", half), ("nv24", whole)):
        np.testing.assert_array_equal(decode_grey(stored(encoding, np.vstack([luma, rest]))), luma)
        with pytest.raises(RecordingError, match="damaged, or its encoding is another"):
            decode_grey(stored(encoding, luma))


def test_a_wrong_name_is_refused_or_noted(tmp_path: Path) -> None:
    pixels = mosaic(coloured(), "rggb")
    with pytest.raises(RecordingError, match=r"'bayer_rgb8'; known are .*bayer_rggb8"):
        decode_grey(stored("bayer_rgb8", pixels))
    with pytest.raises(RecordingError, match="its encoding is another"):
        decode_grey(StoredImage("bayer_rggb16", pixels.tobytes(), "image", WIDTH, HEIGHT, WIDTH))
    for encoding, is_right in (("bayer_rggb8", True), ("mono8", False), ("bayer_grbg8", False), ("bayer_gbrg8", False)):
        messages = [m for m in foreign_messages() if m[0] != "/cam0/image_raw"]
        for stamp in SAMPLE.stamps_ns.tolist():
            data = ros_messages.encode_image(stamp, "cam0_optical", stored(encoding, pixels))
            messages.append(("/cam0/image_raw", "sensor_msgs/Image", stamp, data))
        with open_recording(write_foreign(tmp_path / f"{encoding}.mcap", messages)) as recording:
            noted = [issue for issue in recording.issues if issue.what == "Bayer pattern"]
        assert (noted == []) == is_right, encoding


def test_every_encoding_is_read_or_refused_whole() -> None:
    for encoding in RAW_ENCODINGS:
        for size in (0, 1, 7, 4 * 8 * 8):
            with pytest.raises(RecordingError):
                decode_grey(StoredImage(encoding, bytes(size), "image", 64, 64, 64 * 8))
