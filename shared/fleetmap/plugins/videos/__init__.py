"""Opens a video of one camera, .mp4 or .mov, with a calibration file. Its stamps are the container's, and marked as uncertain.

PyAV (FFmpeg) decodes it. Luma is taken from the decoder unchanged, so that a frame is the same on every machine. Files may be hostile:
only MP4's demuxer is used, only the file itself is read, tables have no more samples than the file has bytes, and
image sizes have the general limit.
"""

import bisect
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.files import file_head
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.image_series import ImageReader, ImageSeries, SeriesFrames, paired
from fleetmap.recordings.images import StoredImage, grey_image
from fleetmap.recordings.limits import MAX_PIXELS, MAX_VIDEO_TABLE_BYTES
from fleetmap.recordings.ordering import UNCERTAIN_STAMPS, ReadLog
from fleetmap.sensors.samples import Image

_SUFFIXES = (".mp4", ".m4v", ".mov")
_CONVERTED = (".avi", ".mkv", ".webm", ".ts", ".h264", ".264", ".265")
_PLANES = ("yuv4", "yuvj4", "nv12", "nv21", "gray")  # pixel formats whose first plane is luma
_BOX = struct.Struct(">I4s")
_NO_TABLES = (b"mdat", b"free", b"skip", b"wide")
_COUNTS = re.compile(rb"(?:stsz|stz2).{8}(.{4})|trun.{4}(.{4})", re.DOTALL)  # number of samples
_UNEVEN = 1.5  # longest step over the median of a constant rate


def recognises(path: Path) -> bool:
    """True for a file with the name or the first bytes of an MP4 video."""
    return path.is_file() and (path.suffix.lower() in _SUFFIXES or file_head(path, 12)[4:8] == b"ftyp")


def open_video(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a video: one camera, no IMU."""
    log = ReadLog(files=[path])
    calibration = calibration_of_options(options, log)
    if calibration is None:
        raise CalibrationError(f"{path}: a video holds no calibration; pass one with --calibration FILE")
    series, keys = _index(path, log)
    log.issues.append(UNCERTAIN_STAMPS)
    reader = VideoReader(log.files, keys)
    try:
        if rotation := reader.rotation(series.sources[0], int(series.stamps_ns[0])):
            log.note("video turned", f"players turn it by {rotation} degrees; images are used as the sensor gave them")
        frames = SeriesFrames(reader, (paired(series, {}, log),))
        return finalize(RecordingParts(path, "video", calibration, frames, name=path.stem), log)
    except BaseException:
        reader.close()
        raise


class VideoReader(ImageReader):
    """Decodes forward, and seeks to the last key frame before any other requested frame.

    Frames are identified by their presentation time in the video's own unit. keys: times of all key frames.
    """

    def __init__(self, read_files: Sequence[Path], keys: Sequence[int]) -> None:
        super().__init__(read_files)
        self._keys, self._files = keys, ExitStack()
        self._open: tuple[Any, Any] | None = None  # container and stream
        self._decoded: Iterator[Any] = iter(())
        self._last: Any = None

    def rotation(self, source: int, stamp_ns: int) -> int:
        """Degrees by which players rotate the images."""
        return int(self._at(source, stamp_ns).rotation)

    def read(self, source: int, stamp_ns: int) -> StoredImage:
        """Read a frame, decoded: its encoded form depends on other frames."""
        return grey_image(_luma(self._at(source, stamp_ns)), f"{self.read_files[0]} at {stamp_ns}")

    def apart(self) -> "VideoReader":
        return VideoReader(self.read_files, self._keys)

    def close(self) -> None:
        super().close()
        self._files.close()
        self._open, self._last = None, None

    def _at(self, wanted: int, stamp_ns: int) -> Any:
        where = f"{self.read_files[0]}: the frame at {stamp_ns}"
        self.check_open(where)
        if self._last is None or self._last.pts != wanted:
            try:
                self._last = self._decode(wanted)
            except _errors() as error:
                self._last = None
                raise RecordingError(f"{where} cannot be decoded, it is damaged; leave it out with --frames") from error
        if self._last is None:
            raise RecordingError(f"{where} is not in the video's data; leave it out with --frames")
        return self._last

    def _decode(self, wanted: int) -> Any:
        """Decode the frame of that time; None if absent."""
        if self._open is None:
            self._open = self._files.enter_context(_opened(self.read_files[0]))
        container, stream = self._open
        last = -1 if self._last is None else self._last.pts
        if not (last < wanted and bisect.bisect(self._keys, last) == bisect.bisect(self._keys, wanted) > 0):
            container.seek(wanted, stream=stream)
            self._decoded = iter(container.decode(stream))
        found = next((frame for frame in self._decoded if frame.pts is not None and frame.pts >= wanted), None)
        return found if found is not None and found.pts == wanted else None


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Container and stream by MP4's demuxer, which gets bytes and no path that it could follow."""
    try:
        import av
    except ImportError as error:
        install = "pip install '.[video]' in fleetmap's source folder"
        raise RecordingError(f"{path} needs another library: {install}") from error
    with path.open("rb") as file, ExitStack() as opened:
        try:
            _check_tables(path, file)
            container = opened.enter_context(av.open(file, mode="r", format="mp4"))
        except _errors() as error:
            raise _no_video(path) from error
        stream = next(iter(container.streams.video), None)
        codec = stream.codec_context if stream else None
        problem = "its codec is not known" if stream else "it holds no pictures"
        if codec is not None and codec.width * codec.height <= MAX_PIXELS:
            codec.options = {"max_pixels": str(MAX_PIXELS)}
            yield container, stream
            return
        if codec is not None:
            problem = f"pictures of {codec.width}x{codec.height} are larger than the limit of {MAX_PIXELS} pixels"
        raise RecordingError(f"{path} cannot be read as a video: {problem}; {_conversion(path)}")


def _check_tables(path: Path, file: BinaryIO) -> None:
    """RecordingError if tables declare more samples than the file has bytes: FFmpeg allocates about 60 bytes of memory for each.

    Tables are searched by name in everything but the image data, because FFmpeg accepts them anywhere.
    """
    size, at, told = path.stat().st_size, 0, 0
    while at + _BOX.size <= size:
        file.seek(at)
        length, kind = _BOX.unpack(file.read(_BOX.size))
        if length == 1:  # a box of more than 4 GB
            length = int.from_bytes(file.read(8), "big")
        length = min(length if length >= _BOX.size else size, size - at)
        if kind not in _NO_TABLES:
            if length > MAX_VIDEO_TABLE_BYTES:
                limit = f"a table of {length} bytes; the limit is {MAX_VIDEO_TABLE_BYTES}"
                raise RecordingError(f"{path}: {limit}. {_conversion(path)}")
            content = file.read(length)
            told += sum(int.from_bytes(found[1] or found[2], "big") for found in _COUNTS.finditer(content))
            told += size * (b"cmov" in content)  # compressed tables
        at += length
    file.seek(0)
    if told > size:
        raise RecordingError(f"{path}: its tables declare {told} samples in {size} bytes; {_conversion(path)}")


def _conversion(path: Path) -> str:
    command = f"ffmpeg -i {path} -c:v libx264 -crf 12 {path.stem}-new.mp4"
    return f"copy it again, or make one that can be read with `{command}`"


def _no_video(path: Path) -> RecordingError:
    return RecordingError(f"{path} cannot be read as a video (no MP4, cut off or damaged); {_conversion(path)}")


def _errors() -> tuple[type[Exception], ...]:
    """Errors of PyAV for damaged files: FFmpeg's, and Python's for impossible positions in the file."""
    import av

    return (av.error.FFmpegError, OSError, ValueError)


def _index(path: Path, log: ReadLog) -> tuple[ImageSeries, list[int]]:
    """Index the frames by the container's packets, and the times of its key frames; RecordingError if there are none."""
    with _opened(path) as (container, stream):
        try:
            packets = [(p.pts, p.is_keyframe) for p in container.demux(stream) if p.size and not p.is_discard]
            told, unit = stream.frames, stream.time_base
        except _errors() as error:
            raise _no_video(path) from error
    pts = tuple(sorted({time for time, _ in packets if time is not None}))
    if not pts or unit is None:
        raise RecordingError(f"{path} holds no frame; {_conversion(path)}")
    if len(pts) < len(packets):
        log.note("frames without a stamp of their own", f"{len(packets) - len(pts)} of {len(packets)} left out")
    if told > len(packets):
        log.note("the video ends early", f"{len(packets)} of {told} frames are there")
    stamps_ns = np.array([round(time * unit * 1_000_000_000) for time in pts], np.int64)
    steps_ms = np.diff(stamps_ns) * 1e-6
    if len(steps_ms) and steps_ms.max() > _UNEVEN * np.median(steps_ms):
        log.note("variable frame rate", f"steps of {steps_ms.min():.1f} to {steps_ms.max():.1f} ms")
    return ImageSeries(stamps_ns, pts), sorted(time for time, is_key in packets if is_key and time is not None)


def _luma(frame: Any) -> Image:
    """(H, W) uint8."""
    is_plane = frame.format.name.startswith(_PLANES) and frame.format.components[0].bits == 8
    if not is_plane:
        return np.ascontiguousarray(frame.to_ndarray(format="gray"))
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return np.ascontiguousarray(rows[:, : frame.width])


FORMAT = RecordingFormat(
    "an .mp4 video of one camera",
    recognises,
    open_video,
    _SUFFIXES,
    3,
    {_CONVERTED: "`ffmpeg -i {path} -c copy {stem}.mp4` makes a video that can be read"},
)
