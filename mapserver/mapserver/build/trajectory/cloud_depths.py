"""Depth images of a single camera by a cloud of points in the frame of another system's poses, as MASt3R-SLAM writes it.

Before points can be projected, the reading of the poses must be known. The colours tell: by the right one the cloud looks as the pictures.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.rectification import RGBD_BASELINE_M
from fleetmap.sensors.samples import Stamps
from mapserver.build.trajectory.clouds import Cloud, SeenCloud, read_ply, sighting
from mapserver.build.trajectory.formats import PoseRows
from mapserver.build.trajectory.given import CHOICES, OtherTrajectory, asked
from mapserver.build.trajectory.readings import FITS_WITHIN, Judged, PoseReading, pose_at, read_as, readings, undecided

_JUDGED_FRAMES, _JUDGED_POINTS = 12, 300_000
_POINTS_PER_CELL = 2  # of a frame's own, so that few cells of a surface stay empty
_MOST_CELLS = 320 * 240
_LEAST_CELLS = 100


@dataclass(frozen=True)
class Placing:
    """A cloud's file, the poses beside it with the unit of their stamps and the clock of `stamps_of`, and the frames (K,) at poses."""

    file: Path
    rows: PoseRows
    unit: str | None
    clock: Stamps
    frames: NDArray[np.int64]


@dataclass(frozen=True)
class CloudImages:
    """The cloud in `file` as seen from camera poses cam_from_cloud (K, 4, 4), in its unit, of frames (K,), rising; scale: metres in it."""

    file: Path
    frames: NDArray[np.int64]
    cam_from_cloud: Array
    camera: CameraCalibration
    scale: float

    @cached_property
    def shape(self) -> tuple[int, int]:
        """See DepthImages."""
        return _shape(self.camera, len(self._cloud.points) / len(self.frames))

    @property
    def pinhole(self) -> Array:
        """See DepthImages."""
        return _pinhole(self.camera, self.shape)

    def inverse(self, frame: int) -> NDArray[np.float32] | None:
        """See DepthImages."""
        row = int(np.searchsorted(self.frames, frame))
        if row == len(self.frames) or self.frames[row] != frame:
            return None
        return self.seen(row).inverse

    def seen(self, row: int) -> SeenCloud:
        """What the camera of a row sees, in the cloud's unit."""
        return sighting(self._cloud, self.cam_from_cloud[row], self.pinhole, self.shape)

    @cached_property
    def _cloud(self) -> Cloud:
        return read_ply(self.file)


def cloud_images(recording: Recording, placing: Placing, other: OtherTrajectory) -> tuple[CloudImages, str, float]:
    """Depths of the frames by the reading in which the cloud looks as their pictures, and what was found in words.

    Last comes the standard deviation of a depth in pixels of disparity: how far points of a cell differ.
    UsageError where several readings do, or where the cloud has no colours and the options leave any open; RecordingError where none does.
    """
    assert other.scale is not None
    camera, scale = recording.calibration.cameras[0], other.scale
    mounting = camera.body_from_cam.copy()
    mounting[:3, 3] /= scale
    is_camera_body = bool(np.abs(camera.body_from_cam - np.eye(4)).max() < 1e-3)
    candidates = list(readings(placing.rows, [placing.unit], other.said(), is_camera_body))
    cloud = read_ply(placing.file)

    def images(reading: PoseReading) -> CloudImages:
        as_read = read_as(placing.rows, reading, placing.clock)
        stamps = recording.frame_stamps_ns[placing.frames].tolist()
        cloud_from_it = np.array([pose_at(as_read, stamp) for stamp in stamps])
        cloud_from_cam = cloud_from_it @ (np.eye(4) if reading.frame == "camera" else mounting)
        return CloudImages(placing.file, placing.frames, se3_inverse(cloud_from_cam), camera, scale)

    chosen = np.unique(np.linspace(0, len(placing.frames) - 1, _JUDGED_FRAMES).round().astype(int))
    if cloud.grey is None:
        if len(candidates) > 1:
            said = asked(item for item in CHOICES if len({getattr(each, item) for each in candidates}) > 1)
            raise UsageError(
                f"{placing.file} has no colours by which the reading of {other.file} could be found; say {said}"
            )
        best, words = images(candidates[0]), f"depths of {placing.file.name}: {candidates[0]}, as said"
    else:
        pictures = {row: recording.read_frame(int(placing.frames[row])).left for row in chosen.tolist()}
        thin = cloud.thinned(_JUDGED_POINTS)
        judged = [_judged(images(reading), reading, thin, pictures) for reading in candidates]
        judged.sort(key=lambda each: float(each.errors.mean()))
        found, rest = judged[0], judged[1:]
        likeness = 1.0 - float(np.median(found.errors))
        if likeness < FITS_WITHIN:
            raise RecordingError(
                f"{placing.file} belongs to another recording: seen by {found.reading}, which fits {recording.name} best, its colours "
                f"correlate with the pictures by {likeness:.2f} in the median of {len(chosen)} frames, {FITS_WITHIN} is the least; pass "
                "the cloud beside the poses of this recording"
            )
        if same := undecided(found, rest):
            every = [found.reading, *(each.reading for each in same)]
            said = asked(item for item in CHOICES if len({getattr(each, item) for each in every}) > 1)
            raise UsageError(
                f"{placing.file} looks like {recording.name} in {len(every)} readings of {other.file}; say {said}"
            )
        best = images(found.reading)
        words = (
            f"depths of {placing.file.name}: {found.reading}, its colours correlate with the pictures by {likeness:.2f}"
        )
    seen = [best.seen(row) for row in chosen.tolist()]
    variance = sum(each.squares for each in seen) / max(1, sum(each.freedom for each in seen))
    sigma_px = float(np.sqrt(variance)) / scale * float(camera.intrinsics_px[0]) * RGBD_BASELINE_M
    return best, f"{words}, its points of a cell differ by {sigma_px:.2g} px of disparity", sigma_px


def _judged(images: CloudImages, reading: PoseReading, cloud: Cloud, pictures: dict[int, NDArray[np.uint8]]) -> Judged:
    """How little the cloud looks as the picture of each row: 1 less the correlation of brightness over the cells in which it shows."""
    shape, errors = _shape(images.camera, len(cloud.points) / len(images.frames)), []
    pinhole, (height, width) = _pinhole(images.camera, shape), shape
    x, y = np.rint(places(images.camera, pinhole))
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    cell = (y * width + x)[inside].astype(np.int64)
    count = np.bincount(cell, minlength=height * width)
    for row, picture in pictures.items():
        grey = sighting(cloud, images.cam_from_cloud[row], pinhole, shape).grey.ravel()
        shows = np.flatnonzero(np.isfinite(grey) & (count > 0))
        brightness = np.bincount(cell, picture[inside], height * width)[shows] / count[shows]
        told = len(shows) >= _LEAST_CELLS and brightness.std() > 0 and grey[shows].std() > 0
        errors.append(1.0 - max(0.0, float(np.corrcoef(brightness, grey[shows])[0, 1])) if told else 1.0)
    return Judged(reading, images.scale, 0.0, np.array(errors), None, None)


def _shape(camera: CameraCalibration, points: float) -> tuple[int, int]:
    """Height and width of images whose cells so many points of one frame fill."""
    cells = min(_MOST_CELLS, points / _POINTS_PER_CELL)
    height = max(2, round(np.sqrt(cells * camera.height_px / camera.width_px)))
    return height, max(2, round(height * camera.width_px / camera.height_px))


def _pinhole(camera: CameraCalibration, shape: tuple[int, int]) -> Array:
    """(4,) fx, fy, cx, cy of the whole picture, resized."""
    per_px = np.array(shape[::-1]) / [camera.width_px, camera.height_px]
    return np.concatenate([camera.intrinsics_px[:2] * per_px, (camera.intrinsics_px[2:4] + 0.5) * per_px - 0.5])


def places(camera: CameraCalibration, pinhole: Array) -> Array:
    """(2, H, W) for each recorded pixel its place x, y in images of a camera without distortion; -9 for none."""
    size = camera.height_px, camera.width_px
    v, u = np.indices(size, np.float64)
    rays = camera.ray_from_pixel(np.column_stack([u.ravel(), v.ravel()]))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = pinhole[:2] * rays[:, :2] / rays[:, 2:] + pinhole[2:]
    seen = (rays[:, 2] > 0) & np.isfinite(found).all(axis=1)
    return np.asarray(np.where(seen[:, None], found, -9.0).T.reshape(2, *size))
