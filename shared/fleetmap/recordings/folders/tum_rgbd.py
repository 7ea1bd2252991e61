"""TUM RGB-D folders: rgb.txt and depth.txt name stamped images, depth registered to colour at 5000 a metre; groundtruth.txt.

Without a calibration file, folders whose name says freiburg1, 2 or 3 get the colour camera that the data set's authors publish; the
layout itself holds none. Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", and its page of file formats.
"""

from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import FileFrames, ImageFiles, existing_images
from fleetmap.recordings.folders.seven_scenes import Depth, RegisteredFrames
from fleetmap.recordings.folders.table_files import check_inside
from fleetmap.recordings.image_series import pair_images
from fleetmap.recordings.ordering import DEPTH_TOLERANCE_NS, ReadLog, pair_stamps
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.tum import parse_stamp_ns, read_text, read_tum
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import Trajectory

_UNITS_PER_MM = 5
_WIDTH_PX, _HEIGHT_PX = 640, 480
_CAMERAS = {  # fx fy cx cy, k1 k2 p1 p2 k3
    "freiburg1": ([517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    "freiburg2": ([520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    "freiburg3": ([535.4, 539.2, 320.1, 247.6], []),
}


def recognises(path: Path) -> bool:
    """Whether `path` holds rgb.txt or depth.txt and one of their folders."""
    return any((path / f"{name}.txt").is_file() and (path / name).is_dir() for name in ("rgb", "depth"))


def open_tum_rgbd(path: Path, options: OpenOptions) -> Recording:
    """The recording in a TUM RGB-D folder. The body is the colour camera, or what a calibration file says; depth is read to one mm."""
    log = ReadLog()
    colour_files, depth_files = (_images(path, name, log) for name in ("rgb", "depth"))
    colour, depth = pair_images(colour_files, depth_files, log, DEPTH_TOLERANCE_NS)
    if len(colour) == 0:
        firsts, seconds = pair_stamps(colour_files.stamps_ns, depth_files.stamps_ns, 1 << 62)
        nearest_s = np.abs(colour_files.stamps_ns[firsts] - depth_files.stamps_ns[seconds]).min() * 1e-9
        raise RecordingError(
            f"{path}: no image of rgb.txt has one of depth.txt within {DEPTH_TOLERANCE_NS * 1e-9:g} s, the nearest is "
            f"{nearest_s:.3f} s apart; take both lists from one recording and one clock"
        )
    if (path / "accelerometer.txt").is_file():
        log.note("accelerometer not used", "there is no gyro beside it")
    given = calibration_of_options(options)
    calibration = given.calibration if given else _published(path)
    if options.calibration_file is not None:
        log.files.append(options.calibration_file)
    parts = RecordingParts(
        path=path,
        format="tum-rgbd",
        calibration=RigCalibration(calibration.cameras[:1], None, calibration.base_from_body),
        frame_stamps_ns=colour.stamps_ns,
        frames=RegisteredFrames(FileFrames(path, log.files, colour, depth=depth), _Scaled()),
        has_depth=True,
        ground_truth=_ground_truth(path / "groundtruth.txt", se3_inverse(calibration.cameras[0].body_from_cam), log),
    )
    return finalize(parts, log)


class _Scaled:
    """Depth that is registered already, in its own unit."""

    def registered(self, depth_m: Depth, _: str) -> Depth:
        """Metres, of what was read as whole mm."""
        return depth_m / np.float32(_UNITS_PER_MM)


def _images(path: Path, name: str, log: ReadLog) -> ImageFiles:
    """The images that a list names; RecordingError for lines of another kind and for files outside the folder."""
    table = path / f"{name}.txt"
    stamps, files = [], []
    for number, line in enumerate(
        read_text(table, "a list of stamps and image files is expected").splitlines(), start=1
    ):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamps.append(parse_stamp_ns(words[0]))
            (file,) = words[1:]
        except ValueError as error:
            raise RecordingError(
                f"{table}, line {number}: {line[:80]!r} is no stamp in seconds and a file name"
            ) from error
        files.append(path / check_inside(file, f"{table}, line {number}"))
    if not files:
        raise RecordingError(f"{table} names no image; copy the recording again")
    log.files.append(table)
    return existing_images(ImageFiles(np.array(stamps, np.int64), tuple(files)), f"{name} images", log)


def _published(path: Path) -> RigCalibration:
    name = path.resolve().name.lower()
    for camera, (intrinsics, distortion) in _CAMERAS.items():
        if camera in name:
            size = _WIDTH_PX, _HEIGHT_PX
            lens = np.array(intrinsics), np.array(distortion)
            return RigCalibration((CameraCalibration("radial-tangential", *size, *lens, np.eye(4)),))
    raise CalibrationError(
        f"{path}: the layout of TUM RGB-D holds no calibration, and the folder's name is none of the data set's "
        f"({', '.join(_CAMERAS)}); pass one with --calibration FILE"
    )


def _ground_truth(file: Path, cam_from_body: Array, log: ReadLog) -> Trajectory | None:
    if not file.is_file():
        return None
    log.files.append(file)
    try:
        written = read_tum(file)
    except RecordingError as error:
        log.note("ground truth not used", str(error))
        return None
    frame_from_body = [frame_from_cam @ cam_from_body for frame_from_cam in written.frame_from_body]
    return Trajectory(written.stamps_ns, np.array(frame_from_body).reshape(-1, 4, 4))
