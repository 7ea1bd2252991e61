"""RGB-D folders in the layout of 7-Scenes: frame-NNNNNN.color, .depth.png in mm, .pose.txt; 30 Hz by the frame number.

Unless a calibration file says otherwise, colour has f = 525 px and depth f = 585 px, both centred in the image, and the
depth camera sits 25 mm to the left: the data set's authors publish no transform between the two sensors, so this is the
nominal position in their sensor. A calibration file's cam0 is the colour camera, and cam1, if present, the
depth camera. The poses were computed from depth, so they are the depth camera's.
"""

from pathlib import Path

import cv2
import numpy as np

from fleetmap import core
from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.plugins.datasets import layout
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.image_series import ImageSeries, paired
from fleetmap.recordings.images import decode_depth, decode_grey
from fleetmap.recordings.ordering import ReadLog
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.cameras import CAMERA_MODELS
from fleetmap.sensors.samples import Trajectory

_COLOUR_FOCAL_PX, _DEPTH_FOCAL_PX = 525.0, 585.0  # of images that are 640 px wide
# Of a Kinect. In the red kitchen sequence, edges in depth and colour align best with 28 mm and these focal lengths.
_DEPTH_LEFT_OF_COLOUR_M = 0.025
_FRAME_RATE_HZ = 30


def recognises(path: Path) -> bool:
    """True for a folder with frame-NNNNNN.color files or their depth images."""
    return path.is_dir() and any(any(path.glob(f"frame-*.{kind}.*")) for kind in ("color", "depth"))


def open_seven_scenes(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a 7-Scenes folder. The body is the colour camera; depth is returned registered to colour."""
    log = ReadLog()
    view = paired(_files(path, "color", log), {"depth": _files(path, "depth", log)}, log)
    colour, depth = (view.images[field] for field in ("left", "depth"))
    if len(colour) == 0:
        raise RecordingError(f"{path}: no colour image has its depth image; copy the recording again")
    given = calibration_of_options(options, log)
    calibration = given or _default_calibration(colour.sources[0], depth.sources[0])
    colour_camera, depth_camera = calibration.cameras[0], calibration.cameras[min(1, len(calibration.cameras) - 1)]
    register = DepthRegistration(colour_camera, depth_camera).registered
    calibration = RigCalibration((colour_camera,), None, calibration.base_from_body)
    truth = _ground_truth(colour, se3_inverse(depth_camera.body_from_cam), log)
    frames = layout.RegisteredFrames(layout.FileReader(path, log.files), (view,), register=register)
    return finalize(RecordingParts(path, "7scenes", calibration, frames, ground_truth=truth), log)


class DepthRegistration:
    """Reprojects depth images of one camera into another one's pixels."""

    def __init__(self, colour: CameraCalibration, depth: CameraCalibration) -> None:
        self._colour = colour
        self._depth_size = (depth.height_px, depth.width_px)
        self._colour_from_depth = colour_from_depth = se3_inverse(colour.body_from_cam) @ depth.body_from_cam
        self._is_same_place = bool(np.linalg.norm(colour_from_depth[:3, 3]) < 1e-6)
        if self._is_same_place:
            # The depth pixel of every colour pixel, for any depth
            rays_colour = colour.ray_from_pixel(_pixels(colour))
            pixels = depth.pixel_from_ray(rays_colour @ colour_from_depth[:3, :3])
            self._map = np.nan_to_num(pixels, nan=-1e4).astype(np.float32).reshape(colour.height_px, colour.width_px, 2)
        else:
            rays = depth.ray_from_pixel(_pixels(depth))
            self._rays_depth = rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)
            self._lens = CAMERA_MODELS[colour.model].core_lens(colour.distortion)

    def registered(self, depth_m: layout.Depth, where: str) -> layout.Depth:
        """(H, W) metres along the colour camera's axis, 0 where unknown, of a depth image in the depth camera's pixels.

        With a common centre the nearest depth pixel is taken. Otherwise points are projected one by one and the
        nearest surface wins, so that thin gaps stay unknown.
        """
        if depth_m.shape != self._depth_size:
            sizes = "the depth image is {1}x{0} px, the calibration says {3}x{2}".format(
                *depth_m.shape, *self._depth_size
            )
            raise RecordingError(f"{where}: {sizes}; pass the matching one with --calibration FILE")
        if self._is_same_place:
            return np.asarray(cv2.remap(depth_m, self._map, None, cv2.INTER_NEAREST, borderValue=0.0), np.float32)  # type: ignore[call-overload]
        colour, motion = self._colour, self._colour_from_depth
        intrinsics = np.array(colour.intrinsics_px, np.float64)
        return core.register_depth(
            depth_m, self._rays_depth, motion, intrinsics, *self._lens, colour.width_px, colour.height_px
        )


def _files(path: Path, kind: str, log: ReadLog) -> ImageSeries:
    found = sorted((_number(file), file) for file in path.glob(f"frame-*.{kind}.*"))
    if not found:
        raise RecordingError(f"{path} holds no frame-NNNNNN.{kind} file; copy the recording again")
    numbers = np.array([number for number, _ in found], np.int64)
    stamps_ns = np.round(numbers * (1e9 / _FRAME_RATE_HZ)).astype(np.int64)
    return layout.existing_images(stamps_ns, [file for _, file in found], f"{kind} images", log)


def _number(file: Path) -> int:
    digits = file.name.removeprefix("frame-").partition(".")[0]
    if not digits.isdecimal() or len(digits) > 10:
        raise RecordingError(f"{file}: invalid frame number {digits!r}; names are frame-NNNNNN.color.png and so on")
    return int(digits)


def _default_calibration(colour: Path, depth: Path) -> RigCalibration:
    colour_from_depth = se3(np.eye(3), np.array([-_DEPTH_LEFT_OF_COLOUR_M, 0.0, 0.0]))
    colour_camera = _centred(decode_grey(layout.read_image(colour)).shape, _COLOUR_FOCAL_PX, np.eye(4))
    depth_camera = _centred(decode_depth(layout.read_image(depth)).shape, _DEPTH_FOCAL_PX, colour_from_depth)
    return RigCalibration((colour_camera, depth_camera))


def _centred(shape: tuple[int, ...], focal_px: float, body_from_cam: Array) -> CameraCalibration:
    height, width = shape
    focal = focal_px * width / 640
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    return CameraCalibration("radial-tangential", width, height, intrinsics, np.zeros(0), body_from_cam)


def _ground_truth(colour: ImageSeries, depth_from_body: Array, log: ReadLog) -> Trajectory | None:
    files = [image.with_name(image.name.partition(".")[0] + ".pose.txt") for image in colour.sources]
    stamped = [(stamp_ns, file) for stamp_ns, file in zip(colour.stamps_ns, files, strict=True) if file.is_file()]
    log.files += [file for _, file in stamped]
    rigid = [(stamp_ns, matrix) for stamp_ns, file in stamped if (matrix := _rigid(file)) is not None]
    if lost := len(stamped) - len(rigid):
        log.note("ground truth: no rigid transform", f"{lost} of {len(stamped)} files left out")
    if not rigid:
        return None
    return Trajectory(np.array([ns for ns, _ in rigid]), np.stack([matrix @ depth_from_body for _, matrix in rigid]))


def _rigid(file: Path) -> Array | None:
    """(4, 4) pose in a file; None if the data set's tracking had failed or the file is damaged."""
    try:
        matrix = np.array(layout.read_table(file).split(), np.float64).reshape(4, 4)
    except (ValueError, RecordingError):
        return None
    is_rotation = np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-2)
    return matrix if is_rotation and np.isfinite(matrix).all() else None


def _pixels(camera: CameraCalibration) -> Array:
    rows, columns = np.indices((camera.height_px, camera.width_px), np.float64)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


FORMAT = RecordingFormat("a folder with frame-NNNNNN.color.* and .depth.png", recognises, open_seven_scenes, rank=-2)
