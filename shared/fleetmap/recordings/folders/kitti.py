"""KITTI odometry folders: rectified image pairs, calib.txt, poses.txt and times.txt where they are. No IMU."""

from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import FileFrames, ImageFiles, existing_images, read_image
from fleetmap.recordings.folders.table_files import natural_key, read_table_text
from fleetmap.recordings.image_series import pair_images
from fleetmap.recordings.images import decode_grey
from fleetmap.recordings.ordering import ReadLog, check_seconds
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration, check_camera
from fleetmap.sensors.samples import Stamps, Trajectory

# Folder names and the rows of calib.txt that describe them
_PAIRS = (("image_l", "image_r", 0, 1), ("image_0", "image_1", 0, 1), ("image_2", "image_3", 2, 3))
_PERIOD_NS = 100_000_000


def recognises(path: Path) -> bool:
    """Whether `path` holds a KITTI image folder."""
    return any((path / left).is_dir() or (path / right).is_dir() for left, right, _, _ in _PAIRS)


def open_kitti(path: Path, options: OpenOptions) -> Recording:
    """The recording in a KITTI folder. The body is the camera that poses.txt is about (KITTI's rectified camera 0)."""
    log = ReadLog()
    left_name, right_name, left_row, right_row = next(
        pair for pair in _PAIRS if (path / pair[0]).is_dir() or (path / pair[1]).is_dir()
    )
    for name in (left_name, right_name):
        if not (path / name).is_dir():
            raise RecordingError(
                f"{path / name} is missing, the other camera's folder is there; copy the recording again"
            )
    stamps_of_number = _stamps(path, log)
    left, right = (_images(path / name, stamps_of_number, log) for name in (left_name, right_name))
    given, file = calibration_of_options(options), options.calibration_file or path / "calib.txt"
    calibration = given.calibration if given else _calibration(file, left.sources[0], left_row, right_row)
    log.files.append(file)
    left, right = pair_images(left, right, log, tolerance_ns=0)
    parts = RecordingParts(
        path=path,
        format="kitti",
        calibration=calibration,
        frame_stamps_ns=left.stamps_ns,
        frames=FileFrames(path, log.files, left, right),
        has_right=True,
        ground_truth=_ground_truth(path, stamps_of_number, log),
    )
    return finalize(parts, log)


def _stamps(path: Path, log: ReadLog) -> Stamps | None:
    """Stamps by image number from times.txt, None without one."""
    file = path / "times.txt"
    if not file.is_file():
        return None
    log.files.append(file)
    seconds = _table(file, (1,))[:, 0]
    check_seconds(float(np.abs(seconds).max(initial=0.0)), str(file))
    return np.round(seconds * 1e9).astype(np.int64)


def _stamp(number: int, stamps_of_number: Stamps | None, path: Path) -> int:
    if stamps_of_number is None:
        return number * _PERIOD_NS
    if number >= len(stamps_of_number):
        raise RecordingError(f"{path} has no line in times.txt, which ends with number {len(stamps_of_number) - 1}")
    return int(stamps_of_number[number])


def _images(folder: Path, stamps_of_number: Stamps | None, log: ReadLog) -> ImageFiles:
    paths = sorted((p for p in folder.iterdir() if p.is_file() and p.stem.isdigit()), key=lambda p: natural_key(p.name))
    if not paths:
        raise RecordingError(f"{folder} holds no numbered image such as 000000.png; copy the recording again")
    stamps_ns = np.array([_stamp(int(p.stem), stamps_of_number, p) for p in paths], np.int64)
    return existing_images(ImageFiles(stamps_ns, tuple(paths)), folder.name, log)


def _calibration(file: Path, first_image: Path, left_row: int, right_row: int) -> RigCalibration:
    if not file.is_file():
        raise CalibrationError(f"{file} is missing; add it or pass a calibration with --calibration FILE")
    rows = _projections(file)
    height, width = decode_grey(read_image(first_image)).shape
    cameras = []
    for row in (left_row, right_row):
        if row not in rows:
            raise CalibrationError(
                f"{file} has no P{row}; it describes {', '.join(f'P{r}' for r in rows) or 'no camera'}"
            )
        matrix = rows[row][:, :3]
        if np.linalg.det(matrix) == 0:
            raise CalibrationError(f"{file}: P{row} is {rows[row].tolist()}, which is no projection of a camera")
        body_from_cam = se3(np.eye(3), np.asarray(-np.linalg.solve(matrix, rows[row][:, 3]), np.float64))
        intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        camera = CameraCalibration("radial-tangential", width, height, intrinsics, np.zeros(0), body_from_cam)
        cameras.append(check_camera(camera, f"{file}: P{row}"))
    return RigCalibration(tuple(cameras))


def _projections(file: Path) -> dict[int, Array]:
    """The 3x4 matrices by number, of lines with or without `P0:` before twelve numbers."""
    rows: dict[int, Array] = {}
    for line in read_table_text(file).splitlines():
        label, colon, numbers = line.partition(":") if ":" in line else ("", "", line)
        try:
            values = [float(word) for word in numbers.split()]
        except ValueError:
            raise CalibrationError(f"{file}: {line[:60]!r} are not twelve numbers") from None
        if len(values) != 12 or (colon and not (label.startswith("P") and label[1:].isdigit())):
            continue
        rows[int(label[1:]) if colon else len(rows)] = np.array(values).reshape(3, 4)
    return rows


def _ground_truth(path: Path, stamps_of_number: Stamps | None, log: ReadLog) -> Trajectory | None:
    file = path / "poses.txt"
    if not file.is_file():
        return None
    log.files.append(file)
    try:
        rows = _table(file, (12, 16))
    except RecordingError as error:
        log.note("ground truth not used", str(error))
        return None
    if stamps_of_number is not None and len(stamps_of_number) != len(rows):
        log.note("ground truth not used", f"poses.txt has {len(rows)} rows, times.txt {len(stamps_of_number)}")
        return None
    stamps_ns = np.arange(len(rows)) * _PERIOD_NS if stamps_of_number is None else stamps_of_number
    frame_from_body = np.tile(np.eye(4), (len(rows), 1, 1))
    frame_from_body[:, :3] = rows[:, :12].reshape(-1, 3, 4)
    return Trajectory(stamps_ns.astype(np.int64), frame_from_body)


def _table(file: Path, widths: tuple[int, ...]) -> Array:
    rows: list[list[float]] = []
    for number, line in enumerate(read_table_text(file).splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if words and len(row) not in ((len(rows[0]),) if rows else widths):
            expected = " or ".join(str(width) for width in widths)
            raise RecordingError(
                f"{file}, line {number}: {line[:60]!r} are not {expected} numbers; copy the recording again"
            )
        rows += [row] if words else []
    table = np.array(rows) if rows else np.zeros((0, 0))
    if table.shape[1] not in widths or not np.isfinite(table).all():
        raise RecordingError(
            f"{file} has {table.shape[1]} columns, {' or '.join(map(str, widths))} finite numbers are expected"
        )
    return table
