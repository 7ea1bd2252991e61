"""Stored images of recordings, and their decoding to grey or metres."""

import os
import re
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array32
from fleetmap.recordings.decoder_messages import with_messages
from fleetmap.recordings.files import what_instead
from fleetmap.recordings.limits import MAX_PIXELS
from fleetmap.recordings.png import PNG_START, is_damaged_png, plain_png_pixels
from fleetmap.sensors.samples import CameraFrame, Image

_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]{0,1000}\n){1,20}(\d{1,10})(?:\s+|#[^\n]{0,1000}\n){1,20}(\d{1,10})[\s#]")
# start of frame; not tables, extensions, arithmetic conditioning
_JPEG_SIZES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}  # segments without a length
_TIFF_KINDS = {1: "B", 3: "H", 4: "I"}  # byte, short, long
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_THREADS = max(os.cpu_count() or 1, 2)  # a survey reads its parts in parallel
_BESIDE = ThreadPoolExecutor(_THREADS, "decoder")  # decodes left images while their partners are decoded
os.register_at_fork(after_in_child=partial(_BESIDE.__init__, _THREADS, "decoder"))  # type: ignore[misc]  # a child has no thread of its parent's


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels from the file's header; None for other formats and for incomplete headers."""
    try:
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data.startswith(PNG_START):
            width, height = struct.unpack_from(">II", data, 16)
            return (width, height) if data[12:16] == b"IHDR" else None
        if data.startswith((b"II*\0", b"MM\0*")):
            return _tiff_size(data)
        if data.startswith(b"BM"):
            (header_bytes,) = struct.unpack_from("<I", data, 14)  # 12: OS/2's first form
            width, height = struct.unpack_from("<HH" if header_bytes == 12 else "<ii", data, 18)
            return abs(width), abs(height)
        found = _PNM.match(data[:4096])
        return None if found is None else (int(found[1]), int(found[2]))
    except struct.error:
        return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at < len(data):
        if data[at] != 0xFF:
            return None
        (marker,) = struct.unpack_from(">B", data, at + 1)
        if marker == 0xFF:  # filling
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            (length,) = struct.unpack_from(">H", data, at + 2)
            if marker in _JPEG_SIZES:
                height, width = struct.unpack_from(">HH", data, at + 5)
                return width, height
            at += 2 + max(2, length)
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Size of the first image; OpenCV reads only that."""
    order = "<" if data[0] == ord("I") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    sizes: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_KINDS:
            (size,) = struct.unpack_from(order + _TIFF_KINDS[kind], data, entry + 8)
            sizes[tag] = max(size, sizes.get(tag, 0))
    return (sizes[_TIFF_WIDTH], sizes[_TIFF_HEIGHT]) if len(sizes) == 2 else None


_BAYER_ORDERS = ("rggb", "bggr", "gbrg", "grbg")
# Pixel type and channels of raw images, by ROS's names
RAW_ENCODINGS: dict[str, tuple[type[np.generic], int]] = {
    **dict.fromkeys(("mono8", "8UC1", *(f"bayer_{order}8" for order in _BAYER_ORDERS)), (np.uint8, 1)),
    **dict.fromkeys(("mono16", "16UC1", *(f"bayer_{order}16" for order in _BAYER_ORDERS)), (np.uint16, 1)),
    "32FC1": (np.float32, 1),
    **dict.fromkeys(("rgb8", "bgr8", "8UC3"), (np.uint8, 3)),
    **dict.fromkeys(("rgba8", "bgra8", "8UC4"), (np.uint8, 4)),
    **dict.fromkeys(("rgb16", "bgr16"), (np.uint16, 3)),
    **dict.fromkeys(("rgba16", "bgra16"), (np.uint16, 4)),
    # Two bytes a pixel, one of them luma; ROS's older and newer names
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), (np.uint8, 2)),
    # A plane of luma, followed by colour
    **dict.fromkeys(("nv12", "nv21", "nv24"), (np.uint8, 1)),
}
_COLOUR_ROWS = {"nv12": (1, 2), "nv21": (1, 2), "nv24": (2, 1)}  # rows of colour per row of luma
_LUMA_AT = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
# OpenCV names a mosaic by the second row, its newer names by the first as ROS does
_GREY_FROM_MOSAIC = {order: getattr(cv2, f"COLOR_Bayer{order.upper()}2GRAY") for order in _BAYER_ORDERS}
_GREY_FROM = {  # others are BGR
    **dict.fromkeys(("rgb8", "rgb16"), cv2.COLOR_RGB2GRAY),
    **dict.fromkeys(("rgba8", "rgba16"), cv2.COLOR_RGBA2GRAY),
}
INVERSE_DEPTH = "32FC1; compressedDepth"  # ROS's name for its quantized inverse depths
_DEPTH_HEAD = struct.Struct("<iff")
# Words in the `format` of a message, and the first bytes, of unsupported image formats
_VIDEO = "; one picture of a video cannot be read alone: record JPEG (`ros2 run image_transport republish ffmpeg compressed`) or raw images"
_OTHER_IMAGE = "; record JPEG, PNG or raw images"
_REMOVE_IT = "remove it from the recording"
_UNREAD_FORMS = {
    "rvl": "depths packed as RVL; set the publisher's parameter compressedDepth.format to png, or record raw depth images",
    **dict.fromkeys(("h264", "h.264", "avc"), "H.264 video" + _VIDEO),
    **dict.fromkeys(("h265", "h.265", "hevc"), "H.265 video" + _VIDEO),
    **{word: f"{word.upper()} video{_VIDEO}" for word in ("vp8", "vp9", "av1", "theora", "mpeg4")},
}
_UNREAD_STARTS = (
    (re.compile(rb"\0\0\0?\x01"), "H.264 or H.265 video" + _VIDEO),
    (re.compile(rb"RIFF....WEBP", re.DOTALL), "a WebP image" + _OTHER_IMAGE),
    (re.compile(rb"....ftyp(?:avi|hei|mif)", re.DOTALL), "an AVIF or HEIC image" + _OTHER_IMAGE),
    (re.compile(rb"\xff\x0a|\0\0\0\x0cJXL "), "a JPEG XL image" + _OTHER_IMAGE),
    (re.compile(rb"\xff\x4f\xff\x51|\0\0\0\x0cjP  "), "a JPEG 2000 image" + _OTHER_IMAGE),
    (re.compile(rb"GIF8"), "a GIF image" + _OTHER_IMAGE),
)
_MOSAIC_SHARE, _LEAST_MOSAIC_PX, _LEAST_MOSAIC_GREY = 0.04, 100, 20.0
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # its exceptions for an image become our errors
# Messages of libjpeg and libpng about lost pixels; damage to colour profiles and comments is accepted
_DAMAGED = re.compile("Corrupt JPEG data|Premature end|libpng error|IDAT")
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Images with sensor noise have hardly any repetitions: run-length coding is faster and, by measurement, smaller.
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
_PNG_END = b"IEND\xaeB`\x82"


@dataclass(frozen=True, slots=True)
class StoredImage:
    """An image as stored in the recording; `where` names it in error messages.

    encoding: "file" for the bytes of an image file (JPEG, PNG, ...), INVERSE_DEPTH for those of a PNG behind the head of
    compressed_depth_image_transport, else a key of RAW_ENCODINGS with rows of step_bytes. form: the `format` of a CompressedImage.
    bits: used lower bits of 16-bit grey images.
    """

    encoding: str
    data: bytes
    where: str = ""
    width_px: int = 0
    height_px: int = 0
    step_bytes: int = 0
    big_endian: bool = False
    form: str = ""
    bits: int = 16

    def error(self, fault: str) -> RecordingError:
        """An error of this image."""
        return RecordingError(f"{self.where}: {fault}")


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """One moment of the rig with its images as stored.

    Depth is registered to left, in mm if whole numbers, else m. others: of the rig's other cameras, None for one without images.
    """

    stamp_ns: int
    left: StoredImage
    right: StoredImage | None = None
    depth: StoredImage | None = None
    others: "tuple[StoredFrame | None, ...]" = ()


def decode_frame(stored: StoredFrame) -> CameraFrame:
    """Decode the images of a frame, files two at a time; RecordingError naming an image of the first view that cannot be decoded. Another
    view with one has no images."""
    is_slow = stored.left.encoding == "file" and (stored.right or stored.depth) is not None
    left = _BESIDE.submit(decode_grey, stored.left) if is_slow else None
    right = None if stored.right is None else decode_grey(stored.right)
    depth = None if stored.depth is None else decode_depth(stored.depth)
    others = tuple(map(_decoded_if_sound, stored.others))
    first = decode_grey(stored.left) if left is None else left.result()
    return CameraFrame(stored.stamp_ns, first, right, depth, others)


def _decoded_if_sound(other: StoredFrame | None) -> CameraFrame | None:
    try:
        return None if other is None else decode_frame(other)
    except RecordingError:
        return None


def decode_grey(stored: StoredImage) -> Image:
    """(H, W) uint8. 16-bit images keep their upper byte, colour becomes grey by the usual luma weights; YUV keeps its luma."""
    pixels = _decode(stored)
    # image_transport compresses a mosaic unchanged, and names it in front of its format
    mosaic = stored.form if stored.encoding == "file" and pixels.ndim == 2 else stored.encoding
    if mosaic.startswith("bayer_") and mosaic[6:10] in _GREY_FROM_MOSAIC:
        pixels = cv2.cvtColor(pixels, _GREY_FROM_MOSAIC[mosaic[6:10]])
    elif stored.encoding in _LUMA_AT:
        pixels = pixels[:, :, _LUMA_AT[stored.encoding]]
    elif pixels.ndim == 3:
        usual = cv2.COLOR_BGRA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        pixels = cv2.cvtColor(pixels, _GREY_FROM.get(stored.encoding, usual))
    if pixels.dtype == np.uint16:
        return np.asarray(np.minimum(pixels >> (stored.bits - 8), 255), np.uint8)
    if pixels.dtype != np.uint8:
        raise stored.error(f"{pixels.dtype} pixels are not a camera image; known are 8 and 16 bits")
    return np.ascontiguousarray(pixels, np.uint8)


def is_wide(stored: StoredImage) -> bool:
    """True for a 16-bit image, by its encoding or the header of a PNG file."""
    if stored.encoding in RAW_ENCODINGS:
        return RAW_ENCODINGS[stored.encoding][0] == np.uint16
    return stored.data[24:25] == b"\x10" and file_kind(stored.data) == "png"


def grey_peak(stored: StoredImage) -> int:
    """Largest value of a 16-bit image; 0 for others, which are not decoded; RecordingError if it cannot be decoded."""
    return int(_decode(stored).max()) if is_wide(stored) else 0


def grey_bits(peak: int) -> int:
    """10 or 12 if the largest value of 16-bit images fits into so many bits; else 16."""
    return next((bits for bits in (10, 12) if 0 < peak < 1 << bits), 16)


def is_mosaic(image: Image) -> bool:
    """True if an image (H, W) shows the pattern of a Bayer mosaic: decoded as grey, or with green taken for another colour.

    Then the mean values of the four pixels of 2x2 blocks differ, by 12 % in a mosaic of a coloured room, by at most 0.5 % in
    images of five real cameras. Exchanged red and blue leave no pattern; grey is then slightly wrong in coloured places.
    """
    if min(image.shape) < _LEAST_MOSAIC_PX:
        return False
    means = [float(image[row::2, column::2].mean()) for row in (0, 1) for column in (0, 1)]
    return max(means) - min(means) > _MOSAIC_SHARE * max(_LEAST_MOSAIC_GREY, sum(means) / 4)


def decode_depth(stored: StoredImage) -> Array32:
    """(H, W) metres, 0 where unknown. Whole numbers are millimetres, 0 and 65535 of them unknown; floats are metres."""
    pixels = _decode(stored)
    if pixels.ndim == 2 and pixels.dtype == np.uint16:
        return np.where(pixels == 65535, 0, pixels).astype(np.float32) / np.float32(1000.0)
    if pixels.ndim == 2 and pixels.dtype == np.float32:
        return np.where(np.isfinite(pixels) & (pixels > 0), pixels, np.float32(0))
    raise stored.error(f"{pixels.dtype} pixels of shape {pixels.shape} are not a depth image; use 16UC1 or 32FC1")


def grey_image(image: Image, where: str = "") -> StoredImage:
    """Store a grey (H, W) uint8 image row by row."""
    height, width = image.shape
    return StoredImage("mono8", np.ascontiguousarray(image).tobytes(), where, width, height, width)


def png_image(image: Image | NDArray[np.uint16]) -> StoredImage:
    """Store a grey (H, W) image as PNG: lossless, at the fastest setting."""
    return StoredImage("file", cv2.imencode(".png", image, _FAST_PNG)[1].tobytes())


def jpeg_image(image: AnyArray, *qualities: int, most_bytes: int = 0) -> StoredImage:
    """Store a uint8 image, grey (H, W) or (H, W, 3), as JPEG, small and lossy: of the first quality with so few bytes, or the last one."""
    data = b""
    for quality in qualities:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= most_bytes:
            break
    return StoredImage("file", data)


def depth_image(depth_m: Array32) -> StoredImage:
    """Store depth in metres (H, W) as 32FC1 row by row, bit for bit."""
    height, width = depth_m.shape
    return StoredImage("32FC1", np.ascontiguousarray(depth_m, "<f4").tobytes(), "", width, height, 4 * width)


def file_kind(data: bytes) -> str:
    """`jpeg`, `png` or `other`, by the first bytes."""
    return "jpeg" if data.startswith(_JPEG_START) else "png" if data.startswith(PNG_START) else "other"


def is_cut(head: bytes, tail: bytes) -> bool:
    """True if a JPEG or PNG file, by its first and last bytes, is truncated. OpenCV silently fills the missing part with grey."""
    end = {"jpeg": _JPEG_END, "png": _PNG_END}.get(file_kind(head))
    return end is not None and end not in tail.rstrip(b"\0")[-64:]


def store_frame(frame: CameraFrame) -> StoredFrame:
    """Store a decoded frame as rows of pixels."""
    right = None if frame.right is None else grey_image(frame.right)
    depth = None if frame.depth_m is None else depth_image(frame.depth_m)
    others = tuple(None if other is None else store_frame(other) for other in frame.others)
    return StoredFrame(frame.stamp_ns, grey_image(frame.left), right, depth, others)


def check_image(stored: StoredImage) -> tuple[int, int]:
    """Check an image without decoding it and return width and height in pixels; RecordingError if it is incomplete."""
    if stored.encoding == INVERSE_DEPTH:
        _inverse_depth_scale(stored)
        return _check_file(replace(stored, data=stored.data[_DEPTH_HEAD.size :]))
    if stored.encoding == "file":
        return _check_file(stored)
    _check_rows(stored)
    return stored.width_px, stored.height_px


def _decode(stored: StoredImage) -> AnyArray:
    if stored.encoding == "file":
        return _decode_file(stored)
    if stored.encoding == INVERSE_DEPTH:
        return _decode_inverse_depth(stored)
    step = _check_rows(stored)
    dtype, channels = RAW_ENCODINGS[stored.encoding]
    wire_type = np.dtype(dtype).newbyteorder(">" if stored.big_endian else "<")
    row_bytes = stored.width_px * channels * wire_type.itemsize
    padded = stored.data[: step * stored.height_px].ljust(step * stored.height_px, b"\0")
    rows = np.frombuffer(padded, np.uint8).reshape(stored.height_px, step)[:, :row_bytes]
    # writable, like all images
    pixels: AnyArray = rows.copy().view(wire_type).astype(dtype, copy=False)
    return pixels if channels == 1 else pixels.reshape(stored.height_px, stored.width_px, channels)


def _check_rows(stored: StoredImage) -> int:
    """Bytes from one row to the next; RecordingError if the data does not fit encoding and size."""
    if stored.encoding not in RAW_ENCODINGS:
        raise stored.error(f"image encoding {stored.encoding!r}; known are {', '.join(RAW_ENCODINGS)}, jpeg, png")
    dtype, channels = RAW_ENCODINGS[stored.encoding]
    row_bytes = stored.width_px * channels * np.dtype(dtype).itemsize
    step = stored.step_bytes or row_bytes
    colour_rows, luma_rows = _COLOUR_ROWS.get(stored.encoding, (0, 1))
    needed = step * (stored.height_px - 1) + row_bytes + step * (stored.height_px * colour_rows // luma_rows)
    if step < row_bytes or len(stored.data) < needed or 0 in (row_bytes, stored.height_px):
        raise stored.error(
            f"{len(stored.data)} bytes for {stored.width_px}x{stored.height_px} {stored.encoding} in rows of {step} bytes; "
            "the message is damaged, or its encoding is another"
        )
    _check_size(stored, stored.width_px, stored.height_px)
    return step if stored.height_px > 1 else row_bytes  # the length of a single row is not defined


def _decode_inverse_depth(stored: StoredImage) -> Array32:
    """(H, W) metres, NaN where unknown. Source: compressed_depth_image_transport, whose 16 bits q mean a / (q - b) m, 0 unknown."""
    a, b = _inverse_depth_scale(stored)
    quantized = _decode_file(replace(stored, data=stored.data[_DEPTH_HEAD.size :]))
    if quantized.dtype != np.uint16 or quantized.ndim != 2:
        found = f"{stored.form!r} with {quantized.dtype} pixels of shape {quantized.shape}"
        raise stored.error(f"{found}; 16 bits and one channel are expected")
    with np.errstate(divide="ignore"):
        depth_m = np.float32(a) / (quantized.astype(np.float32) - np.float32(b))
    return np.where(quantized == 0, np.float32(np.nan), depth_m)


def _inverse_depth_scale(stored: StoredImage) -> tuple[float, float]:
    """a and b of `_decode_inverse_depth`; RecordingError if the header lacks them."""
    if len(stored.data) < _DEPTH_HEAD.size:
        raise stored.error(f"a depth image of {len(stored.data)} bytes; {_REMOVE_IT}")
    _, a, b = _DEPTH_HEAD.unpack_from(stored.data)
    if not (np.isfinite([a, b]).all() and a > 0):
        needs = f"{stored.form!r} needs two numbers that say what its values mean, there are {a:g} and {b:g}"
        raise stored.error(f"{needs}; record raw depth images, or 16UC1")
    return a, b


def _decode_file(stored: StoredImage) -> AnyArray:
    plain = None if is_cut(stored.data, stored.data) else plain_png_pixels(stored.data)
    if plain is not None:
        return plain
    _check_file(stored)
    try:
        pixels, said = with_messages(lambda: cv2.imdecode(np.frombuffer(stored.data, np.uint8), cv2.IMREAD_UNCHANGED))
    except cv2.error:
        pixels, said = None, ""
    kind = file_kind(stored.data)
    if kind != "other" and (pixels is None or _DAMAGED.search(said)):
        damaged = f"the {kind} image of {len(stored.data)} bytes is damaged inside"
        raise stored.error(f"{damaged}; copy the recording again, or remove the image")
    if pixels is None:
        raise _not_an_image(stored)
    return np.asarray(pixels)


def _check_file(stored: StoredImage) -> tuple[int, int]:
    """Width and height in pixels from the file's header; RecordingError if it is truncated or not a supported image."""
    data = stored.data
    if not data:
        raise stored.error(f"the image has no bytes; {_REMOVE_IT}")
    unread = what_instead(data)
    if file_kind(data) == "other" and not unread:  # of a known format that is not supported
        by_name = (what for word, what in _UNREAD_FORMS.items() if word in stored.form.lower())
        by_start = (what for start, what in _UNREAD_STARTS if start.match(data))
        unread = next(chain(by_name, by_start), "")
    if unread:
        raise stored.error(unread)
    if is_cut(data, data):
        raise stored.error(f"the {file_kind(data)} image is cut off after {len(data)} bytes; {_REMOVE_IT}")
    if is_damaged_png(data):
        raise stored.error(f"the png image is damaged; {_REMOVE_IT}")
    size = image_size(data)
    if size is None:
        raise _not_an_image(stored)
    _check_size(stored, *size)
    return size


def _not_an_image(stored: StoredImage) -> RecordingError:
    form = f", their format is {stored.form[:80]!r}" if stored.form else ""
    known = "an image (JPEG, PNG, TIFF, BMP, PNM)"
    return stored.error(f"{len(stored.data)} bytes that cannot be read as {known}{form}; {_REMOVE_IT}")


def _check_size(stored: StoredImage, width_px: int, height_px: int) -> None:
    if width_px * height_px > MAX_PIXELS:
        limit = f"the limit is {MAX_PIXELS // 1_000_000} megapixels"
        raise stored.error(f"an image of {width_px}x{height_px}; {limit}, {_REMOVE_IT}")
