"""Common parts of folder formats: lists of image files, tables of samples, and the recording built from them."""

import contextlib
import hashlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings import images as image_files
from fleetmap.recordings.files import hash_file, lines_of, read_text, what_instead
from fleetmap.recordings.image_series import ImageReader, ImageSeries, SeriesFrames, rig_views
from fleetmap.recordings.images import StoredFrame, StoredImage, file_kind
from fleetmap.recordings.limits import MAX_IMAGE_BYTES
from fleetmap.recordings.ordering import LAST_NS, ReadLog, clean_imu, trajectory_of_rows, usual_size, wrong_unit
from fleetmap.recordings.png import is_damaged_png
from fleetmap.recordings.tum import parse_stamp_ns
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Stamps, Trajectory

_HEAD_BYTES, _TAIL_BYTES = 4096, 8192
Depth = NDArray[np.float32]
_IMU_NAMES = {
    "gyro": ("w_", "wx", "wy", "wz", "gyr", "gx", "gy", "gz", "omega", "ang"),
    "accel": ("a_", "ax", "ay", "az", "acc", "lin"),
}


class FileReader(ImageReader):
    """Reads image files below `root`; read_files: all other files that were read."""

    def __init__(self, root: Path, read_files: Sequence[Path]) -> None:
        super().__init__(read_files)
        self._root = root

    def read(self, source: Path, stamp_ns: int) -> StoredImage:
        return read_image(source)

    def apart(self) -> "FileReader":
        return self

    def hash_into(self, digest: "hashlib._Hash", images: list[Path]) -> None:
        """Hash names, sizes and bytes of all files read, in the order of their names."""
        named = {}
        for path in (*self.read_files, *images):
            is_inside = path.is_relative_to(self._root)
            named[path.relative_to(self._root).as_posix() if is_inside else f"outside/{path.name}"] = path
        for name in sorted(named):
            digest.update(f"{name}\0{named[name].stat().st_size}\0".encode())
            hash_file(named[name], digest)


def rig_frames(
    root: Path, log: ReadLog, cameras: Sequence[ImageSeries], calibration: RigCalibration
) -> tuple[RigCalibration, SeriesFrames]:
    """The calibration in the order of a rig, and the frames of all cameras (see `rig_views`); CalibrationError for more cameras than
    described."""
    described = len(calibration.cameras)
    if described < len(cameras):
        raise CalibrationError(
            f"{root}: {len(cameras)} cameras are recorded, the calibration describes {described}; "
            "pass one that has all with --calibration FILE"
        )
    named = {number: (f"camera {number}", series) for number, series in enumerate(cameras)}
    ordered, paired = rig_views(calibration, named, log)
    return ordered, SeriesFrames(FileReader(root, log.files), paired)


@dataclass
class RegisteredFrames(SeriesFrames):
    """Frames with depth that is stored unregistered, and returned to one mm.

    register: reprojects depth in metres, named for messages, into the pixels of the left image: (H, W) metres, 0 where unknown.
    """

    register: Callable[[Depth, str], Depth] = field(kw_only=True)

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` with its images as stored; depth as PNG in whole mm."""
        stored = super().stored(index)
        depth: Any = stored.depth
        depth_mm = self._registered_mm(image_files.decode_depth(depth), depth.where)
        _, png = cv2.imencode(".png", depth_mm.astype(np.uint16))
        return replace(stored, depth=StoredImage("file", png.tobytes(), depth.where))

    def frame(self, index: int) -> CameraFrame:
        stored: Any = super().stored(index)
        frame = image_files.decode_frame(stored)
        depth_m: Any = frame.depth_m
        depth_mm = self._registered_mm(depth_m, stored.depth.where)
        return replace(frame, depth_m=depth_mm.astype(np.float32) / np.float32(1000.0))

    def _registered_mm(self, depth_m: Depth, where: str) -> Depth:
        return np.round(self.register(depth_m, where) * 1000)


def read_image(path: Path) -> StoredImage:
    """Read an image file without decoding it; RecordingError if it is unreadable or too large."""
    try:
        if (size := path.stat().st_size) > MAX_IMAGE_BYTES:
            limit = f"images of at most {MAX_IMAGE_BYTES >> 20} MiB are read"
            raise RecordingError(f"{path} has {size} bytes; {limit}, remove it")
        return StoredImage("file", path.read_bytes(), str(path))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); copy the recording again") from error


def existing_images(stamps_ns: Stamps, paths: Sequence[Path], what: str, log: ReadLog) -> ImageSeries:
    """Select the images with increasing stamps that exist, are whole and have the most frequent size; the others are noted in `log`.

    RecordingError if none is left.
    """
    series = ImageSeries(stamps_ns, tuple(paths)).forward(what, log)
    folders = [folder for folder in {path.parent for path in series.sources} if folder.is_dir()]
    file_bytes: dict[str, int] = {}
    for entry in (entry for folder in folders for entry in os.scandir(folder)):
        with contextlib.suppress(OSError):  # a link to a missing file
            file_bytes[entry.path] = entry.stat().st_size
    left_out: dict[str, list[str]] = {}
    kept, sizes_px = [], []
    for index, path in enumerate(series.sources):
        size = file_bytes.get(str(path))
        fault, size_px = ("missing", None) if size is None else _fault_and_size(path, size)
        if fault:
            left_out.setdefault(fault, []).append(path.name)
            log.damaged_ns += [] if fault == "missing" else [int(series.stamps_ns[index])]
        else:
            kept.append(index)
            sizes_px.append(size_px)
    for fault, names in left_out.items():
        log.note(f"{what}: images {fault}", f"{len(names)} of {len(series)}, the first is {names[0]}")
    if not kept:
        faults = "; ".join(f"{len(names)} {fault}, the first is {names[0]}" for fault, names in left_out.items())
        none = f"none of the {len(series)} images is there and readable ({faults})"
        raise RecordingError(f"{what}: {none}; copy the recording again")
    return series.take(np.array(kept, np.int64)[usual_size(sizes_px, what, log)])


def _fault_and_size(path: Path, file_bytes: int) -> tuple[str, tuple[int, int] | None]:
    """Reason why a file is not a whole image, empty if it is one; and its width and height, None if unknown."""
    if not file_bytes:
        return "without a byte", None
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            file.seek(max(0, file_bytes - _TAIL_BYTES))
            tail = file.read(_TAIL_BYTES)
            file.seek(0)
            is_checked = file_kind(head) == "png" and file_bytes <= MAX_IMAGE_BYTES
            is_damaged = is_checked and is_damaged_png(file.read(file_bytes))
    except OSError as error:
        return f"that cannot be read ({error.strerror})", None
    if fault := what_instead(head):
        return f"that are {fault}", None
    if is_damaged or image_files.is_cut(head, tail):
        return "cut off" if image_files.is_cut(head, tail) else "damaged inside", None
    size_px = image_files.image_size(head)
    if size_px is None and file_kind(head) == "other" and not head.startswith((b"II*\0", b"MM\0*")):
        return "of no format that is read", None  # the header of a TIFF file may be at its end
    return "", size_px


# ------------------------------------------------------------------------------------------------------------------ tables


def read_table(path: Path) -> str:
    """Read the text of a table; invalid bytes are replaced, so that damage costs lines and not the file."""
    return read_text(path, "the recording is incomplete, copy it again", errors="replace")


def read_image_list(path: Path, log: ReadLog, *, seconds: bool = False) -> tuple[Stamps, list[Path]]:
    """Read stamps (N,), in ns or decimal seconds, and image files from the first two columns of a list.

    RecordingError for an invalid line other than a header, and for files outside the list's folder.
    """
    stamps, files = [], []
    for where, line in lines_of(read_table(path), path):
        columns = re.split(r"[,;\t]", line) if re.search(r"[,;\t]", line) else line.split()
        stamp, name, *_ = [*(column.strip(' \t"') for column in columns), ""]
        if where.endswith("line 1") and name and not stamp[:1].isdecimal() and not seconds:
            continue  # names of columns
        try:
            stamp_ns = parse_stamp_ns(stamp) if seconds else _whole_ns(stamp, where)
            if not name or stamp_ns > LAST_NS:
                raise ValueError("the line is too short" if not name else "the stamp is too large")
        except ValueError as error:
            unit = "seconds" if seconds else "ns"
            raise RecordingError(f"{where}: {line[:60]!r} is not a stamp in {unit} and a file name: {error}") from error
        if ".." in Path(name).parts or Path(name).is_absolute():
            raise RecordingError(f"{where}: {name[:80]!r} is not inside the folder; name images below it")
        stamps.append(stamp_ns)
        files.append(path.parent / name)
    if not files:
        raise RecordingError(f"{path} names no image; copy the recording again")
    log.files.append(path)
    return np.array(stamps, np.int64), files


def _whole_ns(word: str, where: str) -> int:
    """RecordingError for a number with a decimal point or exponent, naming its likely unit; ValueError for other text."""
    if word.isdecimal():
        return int(word)
    value = number_or_nan(word)
    if word.lstrip("+-").isdecimal() or not np.isfinite(value):
        raise ValueError(f"stamp {word[:40]!r}")
    names = {1e17: "nanoseconds that a program rounded", 1e14: "microseconds", 1e11: "milliseconds", 0.0: "seconds"}
    unit = next(name for least, name in names.items() if abs(value) >= least)
    raise wrong_unit(f"{where}:", unit, f"{word[:40]} is not a whole number", "write all digits of the nanoseconds")


def number_or_nan(word: str) -> float:
    """The number in a word; NaN if it is none."""
    try:
        return float(word)
    except ValueError:
        return np.nan


def read_stamped_rows(path: Path, columns: int, log: ReadLog) -> tuple[Stamps, Array]:
    """Read stamps (N,) in ns and values (N, columns) of a text table, separated by commas or blanks; # begins a comment.

    Invalid lines (such as the last one of a truncated file) are noted in `log`; RecordingError if no line is valid, and for
    stamps with decimals.
    """
    text = read_table(path).replace(",", " ").replace(";", " ")
    first, _, rest = text.lstrip().partition("\n")
    if first[:1].isalpha() and re.match(r"\s*\d", rest):  # names of columns
        text = rest
    stamps_ns, rows, bad = list[int](), list[list[float]](), 0
    for _, line in lines_of(text, path):
        first, *words = line.partition("#")[0].split()
        try:
            stamp_ns, values = int(first), [float(word) for word in words[:columns]]
        except ValueError:
            stamp_ns, values = 0, []
        if len(values) == columns and abs(stamp_ns) <= LAST_NS:
            stamps_ns.append(stamp_ns)
            rows.append(values)
        else:
            bad += 1
    if not rows:
        first = next((line for line in text.splitlines() if line.partition("#")[0].strip()), "")
        with contextlib.suppress(ValueError):  # no likely unit
            _whole_ns(first.split()[0] if first else "", str(path))
        there = f"its first is {first[:80]!r}" if first else "it is empty"
        raise RecordingError(
            f"{path} holds no row of a stamp in ns and {columns} numbers, {there}; the recording is incomplete, copy it again"
        )
    if bad:
        fault = f"{bad} of {bad + len(rows)} lines lack a stamp and {columns} numbers"
        log.note(f"{path.name}: unreadable lines", fault)
    log.files.append(path)
    return np.array(stamps_ns, np.int64), np.array(rows)


def read_imu(path: Path, log: ReadLog) -> ImuSamples:
    """Read a table of stamps, gyro rad/s and accelerometer m/s^2; no samples if the file is absent.

    The column order may differ from EuRoC's if the first line names the columns.
    """
    if not path.is_file():
        return ImuSamples.empty()
    stamps_ns, rows = read_stamped_rows(path, 6, log)
    found: dict[str, int] = {}
    header = read_table(path).lstrip().partition("\n")[0].lower()
    for number, name in enumerate(re.split(r"[,;\t]", header)[1:7]):
        word = re.sub(r"[\[(].*", "", name).strip()
        kind = next((kind for kind, starts in _IMU_NAMES.items() if word.startswith(starts)), "")
        if kind and word[-1:] in "xyz":
            found[kind + word[-1]] = number
    order = [found.get(kind + axis, -1) for kind in _IMU_NAMES for axis in "xyz"]
    rows = rows if -1 in order else rows[:, order]
    return clean_imu(stamps_ns, rows[:, :3], rows[:, 3:], log)


def read_ground_truth(path: Path, log: ReadLog) -> Trajectory | None:
    """Read a trajectory from a table of stamps and x y z qw qx qy qz; None if the file is absent or no row is usable."""
    return trajectory_of_rows(*read_stamped_rows(path, 7, log), log) if path.is_file() else None


def optional_truth(file: Path, log: ReadLog, read: Callable[[Path], Trajectory]) -> Trajectory | None:
    """Read the optional ground truth beside a recording; a file that cannot be read is noted and ignored."""
    if not file.is_file():
        return None
    log.files.append(file)
    try:
        return read(file)
    except RecordingError as error:
        log.note("ground truth not used", str(error))
        return None


def read_numbers(path: Path, widths: Sequence[int], log: ReadLog | None = None) -> Array:
    """Read a text table of finite numbers (N, width), with one of the widths; RecordingError for anything else, or where a log is given,
    a note and a row of NaN."""
    rows: list[list[float]] = []
    expected = " or ".join(str(width) for width in widths)
    bad = list[str]()
    for where, line in lines_of(read_table(path), path):
        row = [number_or_nan(word) for word in line.partition("#")[0].replace(",", " ").split()]
        if len(row) not in widths or not np.isfinite(row).all():
            bad.append(f"{where}: {line[:60]!r} are not {expected} finite numbers; copy the recording again")
            row = []
        else:
            widths = (len(row),)
        rows.append(row)
    if bad and (log is None or not any(rows)):
        raise RecordingError(bad[0])
    if log is not None and bad:
        log.note(f"{path.name}: unreadable lines", f"{len(bad)} left out; {bad[0]}")
    if not rows:
        wanted = f"lines of {expected} finite numbers are expected"
        raise RecordingError(f"{path} is empty; {wanted}, copy the recording again")
    return np.array([row or [np.nan] * widths[0] for row in rows])
