"""Images as recordings store them, and their decoding to grey or metres."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray
from fleetmap.recordings.image_header import image_size
from fleetmap.sensors.samples import CameraFrame, Image

RAW_ENCODINGS = {
    "mono8": (np.uint8, 1),
    "8UC1": (np.uint8, 1),
    "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1),
    "32FC1": (np.float32, 1),
    "rgb8": (np.uint8, 3),
    "bgr8": (np.uint8, 3),
    "8UC3": (np.uint8, 3),
    "rgba8": (np.uint8, 4),
    "bgra8": (np.uint8, 4),
}
_GREY_FROM = {
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
}
MAX_PIXELS = 64_000_000  # the largest sensors of machine vision have 150, those of robots 5
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Images with sensor noise have no repetitions worth a search: run-length coding is faster and, measured, smaller.
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


@dataclass(frozen=True, slots=True)
class StoredImage:
    """An image as it lies in the recording; `where` names it in error messages.

    encoding: "file" for the bytes of an image file (JPEG, PNG, ...), else a key of RAW_ENCODINGS with rows of
    step_bytes.
    """

    encoding: str
    data: bytes
    where: str = ""
    width_px: int = 0
    height_px: int = 0
    step_bytes: int = 0
    big_endian: bool = False


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """One moment of the rig with its images as they were stored.

    Depth is registered to left, in mm if whole numbers, else m.
    """

    stamp_ns: int
    left: StoredImage
    right: StoredImage | None = None
    depth: StoredImage | None = None


def decode_frame(stored: StoredFrame) -> CameraFrame:
    """The frame with its images decoded; RecordingError naming the image that cannot be."""
    right = None if stored.right is None else decode_grey(stored.right)
    depth = None if stored.depth is None else decode_depth(stored.depth)
    return CameraFrame(stored.stamp_ns, decode_grey(stored.left), right, depth)


def decode_grey(stored: StoredImage) -> Image:
    """(H, W) uint8. 16-bit images keep their upper byte, colour becomes grey by the usual luma weights."""
    pixels = _decode(stored)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, _GREY_FROM.get(stored.encoding, _grey_code(pixels)))
    if pixels.dtype == np.uint16:
        return np.asarray(pixels >> 8, np.uint8)
    if pixels.dtype != np.uint8:
        raise RecordingError(f"{stored.where}: {pixels.dtype} pixels are no camera image; known are 8 and 16 bits")
    return np.ascontiguousarray(pixels, np.uint8)


def decode_depth(stored: StoredImage) -> NDArray[np.float32]:
    """(H, W) metres, 0 where unknown. Whole numbers are millimetres, 0 and 65535 of them unknown; floats are metres."""
    pixels = _decode(stored)
    if pixels.ndim == 2 and pixels.dtype == np.uint16:
        return np.where(pixels == 65535, 0, pixels).astype(np.float32) / np.float32(1000.0)
    if pixels.ndim == 2 and pixels.dtype == np.float32:
        return np.where(np.isfinite(pixels) & (pixels > 0), pixels, np.float32(0))
    raise RecordingError(
        f"{stored.where}: {pixels.dtype} pixels of shape {pixels.shape} are no depth image; use 16UC1 or 32FC1"
    )


def grey_image(image: Image, where: str = "") -> StoredImage:
    """A grey (H, W) uint8 image, stored row by row."""
    height, width = image.shape
    return StoredImage("mono8", np.ascontiguousarray(image).tobytes(), where, width, height, width)


def png_image(image: Image, where: str = "") -> StoredImage:
    """A grey (H, W) uint8 image as PNG: without loss, and as fast as that goes."""
    _, data = cv2.imencode(".png", image, _FAST_PNG)
    return StoredImage("file", data.tobytes(), where)


def jpeg_image(image: Image, quality: int = 95, where: str = "") -> StoredImage:
    """A grey (H, W) uint8 image as JPEG: small, with loss."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return StoredImage("file", data.tobytes(), where)


def depth_image(depth_m: NDArray[np.float32], where: str = "") -> StoredImage:
    """Depth in metres (H, W), stored as 32FC1 row by row, bit for bit."""
    height, width = depth_m.shape
    return StoredImage("32FC1", np.ascontiguousarray(depth_m, "<f4").tobytes(), where, width, height, 4 * width)


def file_kind(data: bytes) -> str:
    """`jpeg`, `png` or `other`, by the first bytes."""
    if data.startswith(_JPEG_START):
        return "jpeg"
    return "png" if data.startswith(_PNG_START) else "other"


def store_frame(frame: CameraFrame) -> StoredFrame:
    """A decoded frame as rows of pixels."""
    right = None if frame.right is None else grey_image(frame.right)
    depth = None if frame.depth_m is None else depth_image(frame.depth_m)
    return StoredFrame(frame.stamp_ns, grey_image(frame.left), right, depth)


def _grey_code(pixels: AnyArray) -> int:
    return cv2.COLOR_BGRA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_BGR2GRAY


def _decode(stored: StoredImage) -> AnyArray:
    if stored.encoding == "file":
        return _decode_file(stored)
    if stored.encoding not in RAW_ENCODINGS:
        raise RecordingError(
            f"{stored.where}: image encoding {stored.encoding!r}; known are {', '.join(RAW_ENCODINGS)}, jpeg, png"
        )
    dtype, channels = RAW_ENCODINGS[stored.encoding]
    wire_type = np.dtype(dtype).newbyteorder(">" if stored.big_endian else "<")
    row_bytes = stored.width_px * channels * wire_type.itemsize
    step = stored.step_bytes or row_bytes
    needed = step * (stored.height_px - 1) + row_bytes
    if step < row_bytes or len(stored.data) < needed or 0 in (row_bytes, stored.height_px):
        raise RecordingError(
            f"{stored.where}: {len(stored.data)} bytes for {stored.width_px}x{stored.height_px} {stored.encoding} in "
            f"rows of {step} bytes; the message is damaged"
        )
    _check_size(stored.width_px, stored.height_px, stored.where)
    if stored.height_px == 1:
        step = row_bytes  # nothing says how long the only row is
    padded = stored.data[: step * stored.height_px].ljust(step * stored.height_px, b"\0")
    rows = np.frombuffer(padded, np.uint8).reshape(stored.height_px, step)[:, :row_bytes]
    pixels: AnyArray = (
        rows.copy().view(wire_type).astype(dtype, copy=False)
    )  # writable, as all images: one kind for kernels
    return pixels if channels == 1 else pixels.reshape(stored.height_px, stored.width_px, channels)


def _decode_file(stored: StoredImage) -> AnyArray:
    data = stored.data
    if not data:
        raise RecordingError(f"{stored.where}: the image has no bytes; remove it from the recording")
    # OpenCV fills the missing part of a cut image with grey and says nothing
    kind, tail = file_kind(data), data.rstrip(b"\0")[-64:]
    if (kind == "jpeg" and _JPEG_END not in tail) or (kind == "png" and _PNG_END not in tail):
        raise RecordingError(
            f"{stored.where}: the {kind} image is cut off after {len(data)} bytes; remove it from the recording"
        )
    size = image_size(data)
    if size is not None:
        _check_size(*size, stored.where)
    pixels = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise RecordingError(
            f"{stored.where}: {len(data)} bytes that cannot be read as an image (JPEG, PNG, TIFF, BMP, PNM); "
            "remove it from the recording"
        )
    return np.asarray(pixels)


def _check_size(width_px: int, height_px: int, where: str) -> None:
    if width_px * height_px > MAX_PIXELS:
        raise RecordingError(
            f"{where}: an image of {width_px}x{height_px}; the limit is {MAX_PIXELS // 1_000_000} megapixels, "
            "remove it from the recording"
        )
