"""RGB-D folders as 7-Scenes has them: frame-NNNNNN.color, .depth.png in mm, .pose.txt; 30 Hz by the frame number.

Unless a calibration file says otherwise, colour has f = 525 px and depth f = 585 px, both centred in the image, and the
depth camera sits 25 mm to the left: the data set's authors give no transform between the two sensors, so this is the
nominal place of the sensor they used. A calibration file's cam0 is the colour camera, and cam1, where there is one, the
depth camera. The poses were found from depth, so they are the depth camera's.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, se3_inverse, transform_points
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.depth_registration_kernels import nearest_surface
from fleetmap.recordings.folders.image_files import FileFrames, ImageFiles, existing_images, read_image
from fleetmap.recordings.image_series import pair_images
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_depth, decode_frame, decode_grey
from fleetmap.recordings.ordering import ReadLog
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.tum import check_table
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import CameraFrame, Trajectory

_COLOUR_FOCAL_PX, _DEPTH_FOCAL_PX = 525.0, 585.0
# Of a Kinect. On the red kitchen depth's edges lie on colour's edges best with 28 mm and these focal lengths.
_DEPTH_LEFT_OF_COLOUR_M = 0.025
_FRAME_RATE_HZ = 30
Depth = NDArray[np.float32]


def recognises(path: Path) -> bool:
    """Whether `path` holds frame-NNNNNN.color files or their depth images."""
    return path.is_dir() and any(
        next(path.glob(pattern), None) is not None for pattern in ("frame-*.color.*", "frame-*.depth.*")
    )


def open_seven_scenes(path: Path, options: OpenOptions) -> Recording:
    """The recording in a 7-Scenes folder. The body is the colour camera; depth comes registered to colour."""
    log = ReadLog()
    colour, depth = pair_images(_files(path, "color", log), _files(path, "depth", log), log, tolerance_ns=0)
    if len(colour) == 0:
        raise RecordingError(f"{path}: no colour image has its depth image; copy the recording again")
    given = calibration_of_options(options)
    calibration = given.calibration if given else _default_calibration(colour.sources[0], depth.sources[0])
    if options.calibration_file is not None:
        log.files.append(options.calibration_file)
    colour_camera, depth_camera = calibration.cameras[0], calibration.cameras[min(1, len(calibration.cameras) - 1)]
    files = FileFrames(path, log.files, colour, depth=depth)
    parts = RecordingParts(
        path=path,
        format="7scenes",
        calibration=RigCalibration((colour_camera,), None, calibration.base_from_body),
        frame_stamps_ns=colour.stamps_ns,
        frames=RegisteredFrames(files, DepthRegistration(colour_camera, depth_camera)),
        has_depth=True,
        ground_truth=_ground_truth(colour, se3_inverse(depth_camera.body_from_cam), log),
    )
    return finalize(parts, log)


class Registration(Protocol):
    """Makes depth images what frames hold."""

    def registered(self, depth_m: Depth, where: str) -> Depth:
        """(H, W) metres in the colour camera's pixels."""


class DepthRegistration:
    """Brings depth images into the colour camera's pixels."""

    def __init__(self, colour: CameraCalibration, depth: CameraCalibration) -> None:
        self._colour = colour
        self._depth_size = (depth.height_px, depth.width_px)
        colour_from_depth = se3_inverse(colour.body_from_cam) @ depth.body_from_cam
        self._is_same_place = bool(np.linalg.norm(colour_from_depth[:3, 3]) < 1e-6)
        self._colour_from_depth = colour_from_depth
        if self._is_same_place:
            # The depth pixel of every colour pixel, whatever the depth
            rays_colour = colour.ray_from_pixel(_pixels(colour))
            pixels = depth.pixel_from_ray(rays_colour @ colour_from_depth[:3, :3])
            self._map = np.nan_to_num(pixels, nan=-1e4).astype(np.float32).reshape(colour.height_px, colour.width_px, 2)
        else:
            rays = depth.ray_from_pixel(_pixels(depth))
            self._rays_depth = rays / rays[:, 2:]
            self._has_ray = np.isfinite(self._rays_depth).all(axis=1)

    def registered(self, depth_m: Depth, where: str) -> Depth:
        """(H, W) metres along the colour camera's axis, 0 where unknown, of a depth image in the depth camera's pixels.

        From one place the nearest depth pixel is taken. From another place points are projected one by one and the
        nearest surface wins, so that thin gaps stay unknown.
        """
        if depth_m.shape != self._depth_size:
            height, width = self._depth_size
            raise RecordingError(
                f"{where}: the depth image is {depth_m.shape[1]}x{depth_m.shape[0]} px, the calibration says "
                f"{width}x{height}; pass the matching one with --calibration FILE"
            )
        if self._is_same_place:
            return np.asarray(cv2.remap(depth_m, self._map, None, cv2.INTER_NEAREST, borderValue=0.0), np.float32)  # type: ignore[call-overload]
        known = (depth_m.ravel() > 0) & self._has_ray
        points_depth = self._rays_depth[known] * depth_m.ravel()[known, None]
        points_colour = transform_points(self._colour_from_depth, points_depth.astype(np.float64))
        image = np.empty((self._colour.height_px, self._colour.width_px), np.float32)
        nearest_surface(points_colour, self._colour.pixel_from_ray(points_colour), image)
        return image


class RegisteredFrames:
    """A FrameSource that registers the depth images of `files` to colour."""

    def __init__(self, files: FileFrames, registration: Registration) -> None:
        self._files, self._registration = files, registration

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` with its colour image as it was and its depth registered, in whole mm, as PNG."""
        stored = self._files.stored(index)
        assert stored.depth is not None
        depth_mm = self._registered_mm(decode_depth(stored.depth), stored)
        _, png = cv2.imencode(".png", depth_mm.astype(np.uint16))
        return replace(stored, depth=StoredImage("file", png.tobytes(), stored.depth.where))

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded; depth has the resolution of the file, one mm."""
        stored = self._files.stored(index)
        frame = decode_frame(stored)
        assert frame.depth_m is not None
        depth_mm = self._registered_mm(frame.depth_m, stored)
        return replace(frame, depth_m=depth_mm.astype(np.float32) / np.float32(1000.0))

    def part(self, indices: NDArray[np.int64]) -> "RegisteredFrames":
        return RegisteredFrames(self._files.part(indices), self._registration)

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """The files as they are."""
        self._files.hash_into(digest)

    def close(self) -> None:
        """Closes the files."""
        self._files.close()

    def _registered_mm(self, depth_m: Depth, stored: StoredFrame) -> Depth:
        where = stored.depth.where if stored.depth else ""
        return np.round(self._registration.registered(depth_m, where) * 1000)


def _files(path: Path, kind: str, log: ReadLog) -> ImageFiles:
    found = sorted((_number(file), file) for file in path.glob(f"frame-*.{kind}.*"))
    if not found:
        raise RecordingError(f"{path} holds no frame-NNNNNN.{kind} file; copy the recording again")
    numbers = np.array([number for number, _ in found], np.int64)
    stamps_ns = np.round(numbers * (1e9 / _FRAME_RATE_HZ)).astype(np.int64)
    return existing_images(ImageFiles(stamps_ns, tuple(file for _, file in found)), f"{kind} images", log)


def _number(file: Path) -> int:
    digits = file.name.removeprefix("frame-").partition(".")[0]
    if not digits.isdigit():
        raise RecordingError(f"{file}: {digits!r} is no frame number; names are frame-NNNNNN.color.png and so on")
    return int(digits)


def _default_calibration(colour: Path, depth: Path) -> RigCalibration:
    colour_shape = decode_grey(read_image(colour)).shape
    depth_shape = decode_depth(read_image(depth)).shape
    shapes = ((colour_shape, _COLOUR_FOCAL_PX), (depth_shape, _DEPTH_FOCAL_PX))
    colour_camera, depth_camera = (_centred(shape, focal) for shape, focal in shapes)
    colour_from_depth = se3(np.eye(3), np.array([-_DEPTH_LEFT_OF_COLOUR_M, 0.0, 0.0]))
    return RigCalibration((colour_camera, replace(depth_camera, body_from_cam=colour_from_depth)))


def _centred(shape: Sequence[int], focal_px: float) -> CameraCalibration:
    """The data set's figures are for 640x480."""
    height, width = shape
    focal = focal_px * width / 640
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    return CameraCalibration("radial-tangential", width, height, intrinsics, np.zeros(0), np.eye(4))


def _ground_truth(colour: ImageFiles, depth_from_body: Array, log: ReadLog) -> Trajectory | None:
    files = [path.with_name(path.name.partition(".")[0] + ".pose.txt") for path in colour.sources]
    found = [
        (stamp_ns, file) for stamp_ns, file in zip(colour.stamps_ns.tolist(), files, strict=True) if file.is_file()
    ]
    log.files += [file for _, file in found]
    rows = [(stamp_ns, matrix) for stamp_ns, file in found if (matrix := _rigid(file)) is not None]
    if len(rows) < len(found):
        log.note("ground truth: no rigid transform", f"{len(found) - len(rows)} of {len(found)} files left out")
    if not rows:
        return None
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in rows], np.int64)
    return Trajectory(stamps_ns, np.stack([frame_from_depth @ depth_from_body for _, frame_from_depth in rows]))


def _rigid(file: Path) -> Array | None:
    """(4, 4) of a file; None where the tracking of the data set had failed or the file is damaged."""
    check_table(file)
    try:
        matrix = np.array(file.read_text(errors="replace").split(), np.float64).reshape(4, 4)
    except ValueError:
        return None
    is_rotation = np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-2)
    return matrix if is_rotation and np.isfinite(matrix).all() else None


def _pixels(camera: CameraCalibration) -> Array:
    u, v = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    return np.stack([u.ravel(), v.ravel()], axis=1)
