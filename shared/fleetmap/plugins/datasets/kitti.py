"""KITTI folders, without an IMU. Odometry: rectified image pairs, calib.txt, poses.txt and times.txt if present. Raw: image_00 to image_03,
each with its images in data and their timestamps.txt; calib_cam_to_cam.txt is there or in the folder above.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.log_lines import printable
from fleetmap.plugins.datasets import layout
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.files import lines_of, natural_key
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, paired
from fleetmap.recordings.images import check_image
from fleetmap.recordings.ordering import ReadLog, check_seconds
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration, check_camera, intrinsics_of
from fleetmap.sensors.cameras import lens_of
from fleetmap.sensors.samples import Stamps, Trajectory

# Folder names and the rows of calib.txt that describe them
_PAIRS = (("image_l", "image_r", 0, 1), ("image_0", "image_1", 0, 1), ("image_2", "image_3", 2, 3))
_PERIOD_NS = 100_000_000
_MOST_NUMBER = 10**10  # three decades
_RAW_CAMERAS = ("image_00", "image_01", "image_02", "image_03")


def recognises(path: Path) -> bool:
    """True for a folder with a KITTI image folder."""
    return any((path / left).is_dir() or (path / right).is_dir() for left, right, _, _ in _PAIRS)


def open_kitti_raw(path: Path, options: OpenOptions) -> Recording:
    """Open the drive in a folder of KITTI's raw data, rectified or not, all of its cameras. The body is camera 0."""
    log = ReadLog()
    present = [name for name in _RAW_CAMERAS if (path / name / "data").is_dir()]
    cameras = [_images(path / name / "data", _raw_stamps(path / name / "timestamps.txt", log), log) for name in present]
    if (calibration := calibration_of_options(options, log)) is None:
        files = [folder / "calib_cam_to_cam.txt" for folder in (path, path.resolve().parent)]
        file = next((each for each in files if each.is_file()), files[0])
        calibration = RigCalibration(
            tuple(
                _raw_camera(file, name[-2:], images.sources[0]) for name, images in zip(present, cameras, strict=True)
            )
        )
        log.files.append(file)
    return finalize(RecordingParts(path, "kitti-raw", *layout.rig_frames(path, log, cameras, calibration)), log)


def _raw_stamps(file: Path, log: ReadLog) -> Stamps:
    """Stamps of lines such as `2011-09-26 13:02:25.964389445`."""
    stamps = []
    for where, line in lines_of(layout.read_table(file), file):
        try:
            stamps.append(int(np.datetime64(line.strip().replace(" ", "T"), "ns").astype(np.int64)))
        except ValueError:
            raise RecordingError(f"{where}: {line[:60]!r} is not a date and a time") from None
    log.files.append(file)
    return np.array(stamps, np.int64)


def _raw_camera(file: Path, number: str, image: Path) -> CameraCalibration:
    """A camera, by the size of an image: of rectified ones by P_rect, else by K and D, and R and T, which lead from camera 0 to it."""
    rows = _rows(file)
    size_px = check_image(layout.read_image(image))
    if np.array_equal(_numbers(file, rows, f"S_rect_{number}", 2), size_px):
        return _projected(file, rows, f"P_rect_{number}", size_px)
    matrix, turn = (_numbers(file, rows, f"{name}_{number}", 9).reshape(3, 3) for name in "KR")
    body_from_cam = se3_inverse(se3(turn, _numbers(file, rows, f"T_{number}", 3)))
    model, distortion = lens_of("radtan", _numbers(file, rows, f"D_{number}", 5), f"{file}: D_{number}")
    camera = CameraCalibration(model, *size_px, intrinsics_of(matrix), distortion, body_from_cam)
    return check_camera(camera, f"{file}: camera {number}")


def _rows(file: Path) -> dict[str, Array]:
    """The numbers in each line of a calibration, NaN for other words, by its label; those of lines without one are P0, P1 and so on."""
    if not file.is_file():
        raise CalibrationError(f"{file} is missing; add it or pass a calibration with --calibration FILE")
    rows: dict[str, Array] = {}
    for _, line in lines_of(layout.read_table(file), file):
        is_labelled = ":" in line
        label, words = line.split(":", 1) if is_labelled else (f"P{len(rows)}", line)
        rows[label] = np.array([layout.number_or_nan(word) for word in words.split()])
        if not is_labelled:
            _numbers(file, rows, label, 12)  # any other line would count as a camera, and shift those after it
    return rows


def _numbers(file: Path, rows: Mapping[str, Array], name: str, count: int) -> Array:
    """The finite numbers (count,) of a line."""
    if name not in rows:
        raise CalibrationError(f"{file} has no {name}; it describes {printable(', '.join(rows))[:200] or 'no camera'}")
    if len(rows[name]) != count or not np.isfinite(rows[name]).all():
        raise CalibrationError(f"{file}: {name} are not {count} numbers; copy the file again")
    return rows[name]


def open_kitti(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a KITTI folder. The body is the camera of poses.txt (KITTI's rectified camera 0)."""
    log = ReadLog()
    left_name, right_name, left_row, right_row = next(
        pair for pair in _PAIRS if (path / pair[0]).is_dir() or (path / pair[1]).is_dir()
    )
    times_file, stamps_of_number = path / "times.txt", None
    if times_file.is_file():
        log.files.append(times_file)
        seconds = layout.read_numbers(times_file, (1,))[:, 0]
        check_seconds(float(np.abs(seconds).max()), str(times_file))
        stamps_of_number = np.round(seconds * 1e9).astype(np.int64)
    left, right = (_images(path / name, stamps_of_number, log) for name in (left_name, right_name))
    if (calibration := calibration_of_options(options, log)) is None:
        file = path / "calib.txt"
        size_px = check_image(layout.read_image(left.sources[0]))
        names = (f"P{row}" for row in (left_row, right_row))
        calibration = RigCalibration(tuple(_projected(file, _rows(file), name, size_px) for name in names))
        log.files.append(file)
    view = paired(left, {"right": right}, log)
    truth = layout.optional_truth(path / "poses.txt", log, lambda file: _ground_truth(file, stamps_of_number, log))
    frames = SeriesFrames(layout.FileReader(path, log.files), (view,))
    return finalize(RecordingParts(path, "kitti", calibration, frames, ground_truth=truth), log)


def _images(folder: Path, stamps_of_number: Stamps | None, log: ReadLog) -> ImageSeries:
    if not folder.is_dir():
        raise RecordingError(f"{folder} is missing, the other camera's folder is there; copy the recording again")
    paths = sorted(
        (p for p in folder.iterdir() if p.is_file() and p.stem.isdecimal()), key=lambda p: natural_key(p.name)
    )
    if not paths:
        raise RecordingError(f"{folder} holds no numbered image such as 000000.png; copy the recording again")
    numbers = np.array([int(path.stem) for path in paths], object)  # of any size
    most = _MOST_NUMBER if stamps_of_number is None else len(stamps_of_number) - 1
    for path in [path for path, number in zip(paths, numbers, strict=True) if number > most]:
        if stamps_of_number is not None:
            raise RecordingError(f"{path} has no line in times.txt, which ends with number {most}")
        raise RecordingError(
            f"{path}: invalid frame number {path.stem}; count from 0, and write the seconds to times.txt"
        )
    of_folder = numbers.astype(np.int64)
    stamps_ns = of_folder * _PERIOD_NS if stamps_of_number is None else stamps_of_number[of_folder]
    return layout.existing_images(stamps_ns, paths, folder.name, log)


def _projected(file: Path, rows: Mapping[str, Array], name: str, size_px: tuple[int, int]) -> CameraCalibration:
    """The camera of rectified images, by the line with its projection (3, 4) from the rectified camera 0."""
    where, projection = f"{file}: {name}", _numbers(file, rows, name, 12).reshape(3, 4)
    matrix = projection[:, :3]
    if np.linalg.det(matrix) == 0:
        raise CalibrationError(f"{where} is {projection.tolist()}, which is not a camera's projection")
    body_from_cam = se3(np.eye(3), np.asarray(-np.linalg.solve(matrix, projection[:, 3]), np.float64))
    camera = CameraCalibration("radial-tangential", *size_px, intrinsics_of(matrix), np.zeros(0), body_from_cam)
    return check_camera(camera, where)


def _ground_truth(file: Path, stamps_of_number: Stamps | None, log: ReadLog) -> Trajectory:
    rows = layout.read_numbers(file, (12, 16), log)
    stamps_ns = np.arange(len(rows)) * _PERIOD_NS if stamps_of_number is None else stamps_of_number
    if len(stamps_ns) != len(rows):
        raise RecordingError(f"poses.txt has {len(rows)} rows, times.txt {len(stamps_ns)}")
    frame_from_body = np.tile(np.eye(4), (len(rows), 1, 1))
    frame_from_body[:, :3] = rows[:, :12].reshape(-1, 3, 4)
    return Trajectory(stamps_ns.astype(np.int64), frame_from_body)


FORMAT = RecordingFormat("a folder with image_l or image_0 and calib.txt", recognises, open_kitti, rank=-4)
RAW_FORMAT = RecordingFormat(
    "a folder with image_00/data and calib_cam_to_cam.txt",
    lambda path: (path / "image_00/data").is_dir(),
    open_kitti_raw,
    rank=-3,
)
