"""TUM RGB-D folders: rgb.txt and depth.txt name stamped images, depth registered to colour at 5000 a metre; groundtruth.txt.

Without a calibration file, folders whose name says freiburg1, 2 or 3 get the colour camera that the data set's authors publish; the
layout itself holds none. Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", and its page of file formats.
"""

from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import se3_inverse
from fleetmap.plugins.datasets import layout
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.image_series import ImageSeries, paired
from fleetmap.recordings.ordering import DEPTH_TOLERANCE_NS, ReadLog, pair_stamps
from fleetmap.recordings.tum import read_truth as read_tum_truth
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import Trajectory

_UNITS_PER_MM = 5
_CAMERAS = {  # fx fy cx cy, k1 k2 p1 p2 k3
    "freiburg1": ([517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    "freiburg2": ([520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    "freiburg3": ([535.4, 539.2, 320.1, 247.6], []),
}


def recognises(path: Path) -> bool:
    """True for a folder with rgb.txt or depth.txt and one of their folders."""
    return any((path / f"{name}.txt").is_file() and (path / name).is_dir() for name in ("rgb", "depth"))


def open_tum_rgbd(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a TUM RGB-D folder. The body is the colour camera unless a calibration file differs. Depth: to one mm."""
    log = ReadLog()
    colour, depth = (_images(path / f"{name}.txt", log) for name in ("rgb", "depth"))
    view = paired(colour, {"depth": depth}, log)
    if len(view.rows) == 0:
        firsts, seconds = pair_stamps(colour.stamps_ns, depth.stamps_ns, 1 << 62)
        nearest_s = np.abs(colour.stamps_ns[firsts] - depth.stamps_ns[seconds]).min() * 1e-9
        raise RecordingError(
            f"{path}: no image of rgb.txt has one of depth.txt within {DEPTH_TOLERANCE_NS * 1e-9:g} s, the nearest is "
            f"{nearest_s:.3f} s apart; take both lists from one recording and one clock"
        )
    if (path / "accelerometer.txt").is_file():
        log.note("accelerometer not used", "it comes without a gyro")
    calibration = calibration_of_options(options, log) or _published(path)
    cam_from_body = se3_inverse(calibration.cameras[0].body_from_cam)

    def read_truth(file: Path) -> Trajectory:
        written = read_tum_truth(file, log)
        frame_from_body = [frame_from_cam @ cam_from_body for frame_from_cam in written.frame_from_body]
        return Trajectory(written.stamps_ns, np.array(frame_from_body).reshape(-1, 4, 4))

    calibration = RigCalibration(calibration.cameras[:1], None, calibration.base_from_body)
    truth = layout.optional_truth(path / "groundtruth.txt", log, read_truth)
    frames = layout.RegisteredFrames(layout.FileReader(path, log.files), (view,), register=_metres)
    return finalize(RecordingParts(path, "tum-rgbd", calibration, frames, ground_truth=truth), log)


def _metres(depth: layout.Depth, _: str) -> layout.Depth:
    """Metres of depth that is registered already, and was read as if its unit were a mm."""
    return depth / np.float32(_UNITS_PER_MM)


def _images(table: Path, log: ReadLog) -> ImageSeries:
    stamps_ns, files = layout.read_image_list(table, log, seconds=True)
    return layout.existing_images(stamps_ns, files, f"{table.stem} images", log)


def _published(path: Path) -> RigCalibration:
    for camera, (intrinsics, distortion) in _CAMERAS.items():
        if camera in path.resolve().name.lower():
            lens = np.array(intrinsics), np.array(distortion)
            return RigCalibration((CameraCalibration("radial-tangential", 640, 480, *lens, np.eye(4)),))
    raise CalibrationError(
        f"{path}: the layout of TUM RGB-D holds no calibration, and the folder's name is none of the data set's "
        f"({', '.join(_CAMERAS)}); pass one with --calibration FILE"
    )


FORMAT = RecordingFormat("a folder with rgb.txt, depth.txt and their images", recognises, open_tum_rgbd, rank=-1)
