"""Rectification of a rig to the camera model of all geometry: a rectified pinhole pair.

After rectification a point at (x, y, z) in `cam0` (rectified axes) is seen at u = f x/z + cx, v = f y/z + cy on the
left and at u - f b/z on the right, same row. An RGB-D frame becomes such a pair with a baseline chosen here, a
single camera has baseline 0.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, Array32, Mask, se3, se3_inverse, so3_exp, so3_log
from fleetmap.sensors import calibration as rigs
from fleetmap.sensors.calibration import CameraCalibration, Polygon, RigCalibration
from fleetmap.sensors.cameras import CAMERA_MODELS
from fleetmap.sensors.samples import CameraFrame, Image

_MAX_ZOOM = 1.5  # beyond it the rigs do not see the same corners
RGBD_BASELINE_M = 0.08  # a depth sensor's triangulation base: turns depth noise into disparity noise


@dataclass(frozen=True, slots=True)
class StereoCamera:
    """The rectified pinhole pair. baseline_m is 0 for a single camera.

    clearance_px (H, W): distance of the left image's pixels from those that show the robot itself, in whole pixels, 255 at most; None if
    it shows nothing of it.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    width_px: int
    height_px: int
    clearance_px: Image | None = field(default=None, repr=False, compare=False)

    @property
    def lens(self) -> Array:
        """(4,) in the core's order: focal, cx, cy, focal * baseline."""
        return np.array([self.focal_px, self.cx_px, self.cy_px, self.focal_px * self.baseline_m])

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.focal_px, 0, self.cx_px], [0, self.focal_px, self.cy_px], [0, 0, 1.0]])

    def pixel_from_point(self, points_cam: Array) -> Array:
        """(N, 3) u_left, v, u_right of points (N, 3); NaN behind the camera."""
        z = np.where(points_cam[:, 2] > 1e-6, points_cam[:, 2], np.nan)
        u = self.focal_px * points_cam[:, 0] / z + self.cx_px
        v = self.focal_px * points_cam[:, 1] / z + self.cy_px
        return np.stack([u, v, u - self.focal_px * self.baseline_m / z], axis=1)

    def point_from_pixel(self, pixels: Array, disparities_px: Array) -> Array:
        """(N, 3) points in `cam0` of left pixels (N, 2) with disparities (N,); not finite if the disparity is 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z = self.focal_px * self.baseline_m / disparities_px
            ahead = (pixels - [self.cx_px, self.cy_px]) * z[:, None] / self.focal_px
            return np.column_stack([ahead, z])


class MountedCamera(NamedTuple):
    """The rectified camera of a view on its body: body_from_cam (4, 4)."""

    camera: StereoCamera
    body_from_cam: Array


class MountedRig(NamedTuple):
    """A calibrated rig with the rectified cameras of its views; imu_minus_cam_s: clock of the IMU against the first one's."""

    calibration: RigCalibration
    mounted: tuple[MountedCamera, ...]
    imu_minus_cam_s: float = 0.0

    @property
    def base_from_body(self) -> Array:
        return self.calibration.base_from_body


@dataclass(frozen=True)
class RectifiedFrame:
    """A CameraFrame rectified to the StereoCamera. disparity_px (H, W) float32 (NaN unknown) only with a depth sensor.

    others: the rig's other views, None without images at this moment.
    """

    stamp_ns: int
    left: Image
    right: Image | None
    disparity_px: Array32 | None
    others: "tuple[OtherView | None, ...]" = ()

    def view(self, number: int) -> "RectifiedFrame | None":
        """The frame of a view of the rig, 0 for this one; None without images."""
        if number == 0:
            return self
        other = self.others[number - 1] if number <= len(self.others) else None
        return None if other is None else other.rectified

    @cached_property
    def half_left(self) -> Image:
        """The left image at half size, smoothed; cached."""
        return _halved(self.left)

    @cached_property
    def half_right(self) -> Image:
        """The right image of a pair at half size."""
        assert self.right is not None
        return _halved(self.right)


def _halved(image: Image) -> Image:
    size = image.shape[1] // 2, image.shape[0] // 2
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True)
class OtherView:
    """A further view of a rig at one moment, rectified when it is needed; stamped on the first view's clock."""

    recorded: CameraFrame
    rectifier: "Rectifier"

    @cached_property
    def rectified(self) -> RectifiedFrame:
        return self.rectifier.rectify(self.recorded)


class Rectifier:
    """Rectifies recorded frames of one rig; holds the look-up tables. What shows the robot itself becomes black, without depth.

    pinhole: the target camera without its baseline, common to the rigs of a site; one that suits the rig
    if omitted. Raises CalibrationError if its focal length is too far from the rig's.
    """

    def __init__(
        self,
        calibration: RigCalibration,
        *,
        has_depth: bool = False,
        pinhole: StereoCamera | None = None,
        numbers: tuple[int, ...] = (),
    ) -> None:
        """numbers: of the cameras in messages, by default as in the calibration."""
        if not calibration.cameras:
            raise CalibrationError("the calibration holds no camera; pass one with --calibration FILE")
        self.calibration = calibration
        view, *others = calibration.views
        cameras = tuple(calibration.cameras[number] for number in view)
        self._numbers = numbers or view
        self._sizes = [(c.height_px, c.width_px) for c in cameras]
        self.has_depth = has_depth or cameras[0].has_depth
        used = cameras[:1] if self.has_depth else cameras
        cam0_from_rect, baseline = np.eye(3), RGBD_BASELINE_M if self.has_depth else 0.0
        if len(used) == 2:
            cam0_from_rect, baseline = _rectifying_rotation(*used, self._numbers)
        cx, cy = np.mean([c.intrinsics_px[2:] for c in used], axis=0)
        focal_px = float(np.mean([c.focal_px.mean() for c in used]))
        self.camera = StereoCamera(focal_px, float(cx), float(cy), baseline, used[0].width_px, used[0].height_px)
        if pinhole is not None:
            if not 1 / _MAX_ZOOM < self.camera.focal_px / pinhole.focal_px < _MAX_ZOOM:
                raise CalibrationError(
                    f"a camera of focal length {self.camera.focal_px:.1f} px cannot be joined to a map made at {pinhole.focal_px:.1f} px; "
                    "survey the site with cameras that are alike, or as a site of its own"
                )
            self.camera = replace(pinhole, baseline_m=baseline)
        self.body_from_cam = cameras[0].body_from_cam @ se3(cam0_from_rect, np.zeros(3))
        self.imu_minus_cam_s = cameras[0].imu_minus_cam_s
        self.others = tuple(self._of_view(calibration, numbers) for numbers in others)
        self._maps, hidden = [], []
        for camera in used:
            cam_from_rect = camera.body_from_cam[:3, :3].T @ self.body_from_cam[:3, :3]
            lens = (tuple(each.ravel().tolist()) for each in (camera.intrinsics_px, camera.distortion, cam_from_rect))
            size_px = camera.width_px, camera.height_px
            tables, shows_robot = _remap_tables(self.camera, camera.model, size_px, *lens, camera.mask)
            self._maps.append(tables)
            hidden.append(shows_robot)
        if hidden[0] is not None and hidden[0].any():
            distances = cv2.distanceTransform((~hidden[0]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            self.camera = replace(self.camera, clearance_px=np.minimum(distances, 255).astype(np.uint8))

    def _of_view(self, calibration: RigCalibration, numbers: tuple[int, ...]) -> "Rectifier":
        """The rectifier of another view: to the same pinhole, if its focal length allows."""
        view = replace(calibration, cameras=tuple(calibration.cameras[number] for number in numbers))
        focal_px = float(np.mean([camera.focal_px.mean() for camera in view.cameras]))
        is_alike = 1 / _MAX_ZOOM < focal_px / self.camera.focal_px < _MAX_ZOOM
        return Rectifier(view, pinhole=self.camera if is_alike else None, numbers=numbers)

    @property
    def mounted(self) -> tuple[MountedCamera, ...]:
        """The cameras of all views."""
        return tuple(MountedCamera(each.camera, each.body_from_cam) for each in (self, *self.others))

    @property
    def rig(self) -> MountedRig:
        return MountedRig(self.calibration, self.mounted, self.imu_minus_cam_s)

    def rectify(self, frame: CameraFrame) -> RectifiedFrame:
        """Rectify a frame, its other views once they are needed; RecordingError for images of other sizes than the calibration's. Another
        view with one has no images."""
        left = self._remap(frame.left, 0, frame.stamp_ns)
        right = self._remap(frame.right, 1, frame.stamp_ns) if frame.right is not None and len(self._maps) > 1 else None
        disparity = None
        if self.has_depth and frame.depth_m is not None:
            self._check_size(frame.depth_m.shape, 0, frame.stamp_ns, "depth image")
            depth = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
            disparity = (self.camera.focal_px * self.camera.baseline_m / depth).astype(np.float32)
            if self._maps[0] is not None:
                disparity = np.append(disparity, np.float32(np.nan))[self._maps[0][1]]
        others = (self._other(*each) for each in zip(frame.others, self.others, strict=False))
        return RectifiedFrame(frame.stamp_ns, left, right, disparity, tuple(others))

    def _other(self, frame: CameraFrame | None, rectifier: "Rectifier") -> OtherView | None:
        sizes_px = rectifier._sizes[0], rectifier._sizes[-1], rectifier._sizes[0]
        if frame is None or any(
            image is not None and image.shape != size_px
            for image, size_px in zip((frame.left, frame.right, frame.depth_m), sizes_px, strict=True)
        ):
            return None
        later_ns = round((rectifier.imu_minus_cam_s - self.imu_minus_cam_s) * 1e9)
        return OtherView(replace(frame, stamp_ns=frame.stamp_ns + later_ns), rectifier)

    def _check_size(self, found: tuple[int, ...], index: int, stamp_ns: int, kind: str = "image") -> None:
        if found != self._sizes[index]:
            (height, width), (rows, columns) = self._sizes[index], found
            raise RecordingError(
                f"cam{self._numbers[index]} {kind} at {stamp_ns} is {columns}x{rows}, the calibration says {width}x{height}; "
                "pass the matching one with --calibration FILE"
            )

    def _remap(self, image: Image, index: int, stamp_ns: int) -> Image:
        self._check_size(image.shape, index, stamp_ns)
        tables = self._maps[index]
        return image if tables is None else tables[0].resample(np.ascontiguousarray(image))


def _rectifying_rotation(
    left: CameraCalibration, right: CameraCalibration, numbers: tuple[int, ...]
) -> tuple[Array, float]:
    """cam0_from_rect (3, 3) and the baseline: x along the baseline, z as near to both optical axes as possible."""
    cam0_from_cam1 = se3_inverse(left.body_from_cam) @ right.body_from_cam
    baseline_cam0 = cam0_from_cam1[:3, 3]
    baseline_m = float(np.linalg.norm(baseline_cam0))
    if baseline_m < rigs.LEAST_BASELINE_M:
        raise CalibrationError(
            f"cam{numbers[0]} and cam{numbers[1]} are {baseline_m * 1000:.3f} mm apart; stereo needs a baseline, check body_from_cam"
        )
    if baseline_cam0[0] < rigs.SIDEWAYS * baseline_m:
        raise CalibrationError(
            f"cam{numbers[1]} lies at {np.round(baseline_cam0, 4).tolist()} m in cam{numbers[0]}'s axes, not to its right; "
            "are left and right swapped?"
        )
    half = so3_exp(0.5 * so3_log(cam0_from_cam1[:3, :3]))
    x_axis = baseline_cam0 / baseline_m
    y_axis = np.cross(half[:, 2], x_axis)
    y_axis /= np.linalg.norm(y_axis)
    return np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)], axis=1), baseline_m


# Tables of some rigs: a build creates the rectifier of a recording for its checks, and again for its survey
@lru_cache(maxsize=16)
def _remap_tables(
    rectified: StereoCamera,
    model: str,
    size_px: tuple[int, int],
    intrinsics_px: tuple[float, ...],
    distortion: tuple[float, ...],
    cam_from_rect: tuple[float, ...],
    mask: tuple[Polygon, ...],
) -> tuple[tuple[core.Remap, NDArray[np.int32]] | None, Mask | None]:
    """Fixed-point look-up tables, and (H, W) the index of the nearest pixel, -1 outside the image; None if the image is already rectified
    (as KITTI's). And the rectified mask."""
    v, u = np.indices((rectified.height_px, rectified.width_px), np.float64)
    x, y = (u - rectified.cx_px) / rectified.focal_px, (v - rectified.cy_px) / rectified.focal_px
    rays = np.stack([x, y, np.ones_like(u)], -1).reshape(-1, 3) @ np.array(cam_from_rect).reshape(3, 3).T
    lens = np.array(intrinsics_px), np.array(distortion)
    pixels = CAMERA_MODELS[model].pixel_from_ray(*lens, rays).reshape(*u.shape, 2)
    hidden = None
    if mask:
        at = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
        inside = np.asarray(((at >= 0) & (at < size_px)).all(axis=2))
        columns, rows = np.moveaxis(np.where(inside[..., None], at, 0), 2, 0)
        hidden = np.logical_and(inside, rigs.hidden_pixels(mask, size_px)[rows, columns])
        pixels = np.where(hidden[..., None], np.nan, pixels)
    same_size = (rectified.width_px, rectified.height_px) == size_px
    if same_size and np.nanmax(np.hypot(pixels[..., 0] - u, pixels[..., 1] - v)) < 0.02 and np.isfinite(pixels).all():
        return None, hidden
    pixels = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    first, second = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
    whole, parts = np.asarray(first, np.int16), np.asarray(second, np.uint16)  # of 1/32 px, x in the lower five bits
    nearest = whole + ((parts[..., None] >> np.array([0, 5], np.uint16)) % 32 >= 16)
    is_inside = ((nearest >= 0) & (nearest < size_px)).all(axis=2)
    indices = np.where(is_inside, nearest @ np.array([1, size_px[0]]), -1).astype(np.int32)
    return (core.Remap(whole, parts, size_px[1], size_px[0]), indices), hidden
