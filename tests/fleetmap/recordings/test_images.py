"""Bayer mosaics and YUV: OpenCV makes them, the reader gives back the grey that they were made of."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import open_recording
from fleetmap.recordings.images import RAW_ENCODINGS, StoredImage, decode_grey
from fleetmap.recordings.ros2 import messages as ros_messages
from support.recordings.mcap_samples import SAMPLE, foreign_messages, write_foreign
from support.recordings.recording_samples import HEIGHT, WIDTH

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
    colour = coloured()
    pixels = mosaic(colour, order)
    wide = pixels if bits == 8 else pixels.astype("<u2") * 256
    wanted = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    found = decode_grey(stored(f"bayer_{order}{bits}", wide))
    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(found[inner].astype(int) - wanted[inner]).mean() < 2.0
    for other in set(ORDERS) - {order}:  # the control: another order is another picture
        assert np.abs(decode_grey(stored(f"bayer_{other}{bits}", wide))[inner].astype(int) - wanted[inner]).mean() > 4.0


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
