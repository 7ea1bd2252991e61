"""Depths stored by DROID-SLAM beside its poses, as depth images of a single camera's recording."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array, Array32, Indices
from fleetmap.recordings.recording import WrappedFrames
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import CameraFrame
from mapserver.plugins.given_trajectories.formats import array_in

_MOST_SIDE = 8192
_EDGE_RATIO = 1.25  # between neighbouring depths: depths between them belong to neither surface
_ASPECT_WITHIN = 0.1  # cropping to multiples of 8 px and rounding of sizes stay well below
_NETWORK_STEP = 8  # px between the network's cells, in whose unit DROID writes intrinsics


def check_depths(file: Path, count: int, camera: CameraCalibration) -> None:
    """Raise RecordingError unless the file holds one image of inverse depths per pose, each of the camera's shape."""
    inverse = array_in(file)
    if (
        inverse.ndim != 3
        or inverse.dtype.kind != "f"
        or not 1 < min(inverse.shape[1:]) <= max(inverse.shape[1:]) <= _MOST_SIDE
    ):
        raise RecordingError(
            f"{file} is of shape {inverse.shape} and type {inverse.dtype}; images of inverse depths (N, height, width) are expected"
        )
    if len(inverse) != count:
        raise RecordingError(f"{file} has {len(inverse)} images for {count} poses; pass those of one run")
    _pinhole(file, camera, inverse.shape[1:])
    for number, image in enumerate(inverse):
        if not (np.isfinite(image).all() and (image >= 0).all()):
            raise RecordingError(
                f"{file}: image {number + 1} has invalid inverse depths: they must be finite and not negative"
            )


def _pinhole(file: Path, camera: CameraCalibration, shape: tuple[int, ...]) -> Array:
    """Return (4,) fx, fy, cx, cy of depth images (height, width): by `intrinsics.npy`, else of the whole picture resized.

    DROID writes them for the network's cells, and depths at that size or eight times it; the scale is chosen by the centre.
    """
    written, (height, width) = file.with_name("intrinsics.npy"), shape
    if written.exists():
        cells = np.array(array_in(written), np.float64)
        if cells.ndim != 2 or cells.shape[1] != 4 or not len(cells) or not (np.isfinite(cells) & (cells > 0)).all():
            raise RecordingError(f"{written} is of shape {cells.shape}; rows of fx, fy, cx, cy above 0 are expected")
        fitting = min((cells[0], _NETWORK_STEP * cells[0]), key=lambda pinhole: abs(pinhole[2] - width / 2))
        if abs(fitting[2] - width / 2) > width / 4 or abs(fitting[3] - height / 2) > height / 4:
            raise RecordingError(
                f"{written} has its centre at {cells[0, 2:].tolist()}, outside the images of {file.name}"
            )
        return np.asarray(fitting)
    per_px = np.array([width / camera.width_px, height / camera.height_px])
    if abs(per_px[0] / per_px[1] - 1) > _ASPECT_WITHIN:
        raise RecordingError(
            f"{file} has images of {width}x{height}, the camera {camera.width_px}x{camera.height_px} px; put the run's intrinsics.npy "
            "beside it, or pass depths of this camera"
        )
    return np.concatenate([camera.focal_px * per_px, (camera.intrinsics_px[2:] + 0.5) * per_px - 0.5])


@dataclass(frozen=True)
class DepthFrames(WrappedFrames):
    """Frames of `source` with depth from the images in `file`, `disps.npy`. Hashes cover only the recorded data.

    rows (F,): number of each frame's image, -1 if absent. scale: metres in the file's unit.
    """

    file: Path
    rows: Indices
    camera: CameraCalibration
    scale: float

    def frame(self, index: int) -> CameraFrame:
        frame, row = self.source.frame(index), int(self.rows[index])
        depth_m = np.zeros((self.camera.height_px, self.camera.width_px), np.float32)
        if row >= 0:
            depth_m = self._depth_m(np.array(self._images[row], np.float32))
        return CameraFrame(frame.stamp_ns, frame.left, depth_m=depth_m)

    def part(self, indices: Indices) -> "DepthFrames":
        return replace(self, source=self.source.part(indices), rows=self.rows[indices])

    def _depth_m(self, inverse: Array32) -> Array32:
        """Return metres at recorded pixels: inverse depth is linear on planes, so it is interpolated between neighbours of one surface."""
        x, y = self._places
        (height, width), ones = inverse.shape, np.ones((2, 2), np.uint8)
        high, low = (each(inverse, ones, anchor=(0, 0)) for each in (cv2.dilate, cv2.erode))
        one_surface = (low > 0) & (high <= _EDGE_RATIO * low)
        known = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
        known[known] = one_surface[y[known].astype(np.int64), x[known].astype(np.int64)]
        between = cv2.remap(inverse, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        with np.errstate(divide="ignore", over="ignore"):
            depth_m = np.asarray(np.float32(self.scale) / between, np.float32)
        return np.where(known & np.isfinite(depth_m), depth_m, np.float32(0))

    @cached_property
    def _images(self) -> AnyArray:
        return array_in(self.file)

    @cached_property
    def _places(self) -> Array32:
        """(2, H, W) for each recorded pixel its position x, y in the images, which have no distortion; -9 if outside."""
        pinhole = _pinhole(self.file, self.camera, self._images.shape[1:])
        size = self.camera.height_px, self.camera.width_px
        v, u = np.indices(size, np.float64)
        rays = self.camera.ray_from_pixel(np.column_stack([u.ravel(), v.ravel()]))
        with np.errstate(divide="ignore", invalid="ignore"):
            found = pinhole[:2] * rays[:, :2] / rays[:, 2:] + pinhole[2:]
        seen = (rays[:, 2] > 0) & np.isfinite(found).all(axis=1)
        return np.where(seen[:, None], found, -9.0).T.reshape(2, *size).astype(np.float32)
