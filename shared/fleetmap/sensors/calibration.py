"""Calibration of a robot's sensors: lenses, mounting, noise. Values only; `recordings` reads the files."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array, Mask, se3_inverse
from fleetmap.sensors.cameras import CAMERA_MODELS

_SUB_PX = 4  # bits of a pixel's fraction
SAME_WAY_COSINE = 0.7  # of 45 degrees: half of a usual lens's image is common to both cameras
LEAST_BASELINE_M = 1e-3  # less is none
SIDEWAYS = 0.7  # least share of a baseline along the images' rows
Polygon = tuple[tuple[float, float], ...]  # corners (u, v) in pixels as recorded


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """One camera.

    model: a key of CAMERA_MODELS. intrinsics_px: fx fy cx cy, as the model defines them. body_from_cam (4, 4).
    imu_minus_cam_s: stamp of the IMU clock minus stamp of the camera clock at one moment (Kalibr's timeshift_cam_imu). line_delay_s: from
    one row to the next of a rolling shutter, 0 for a global one; reported, not corrected. mask: parts of the image that show the robot
    itself, inside an odd number of polygons. has_depth: a view of its own with depth registered to it, beside the rig's first view.
    """

    model: str
    width_px: int
    height_px: int
    intrinsics_px: Array
    distortion: Array
    body_from_cam: Array
    imu_minus_cam_s: float = 0.0
    line_delay_s: float = 0.0
    mask: tuple[Polygon, ...] = ()
    has_depth: bool = False

    def __post_init__(self) -> None:
        # Values from files are numpy scalars, which encoders do not support.
        _set_numbers(self, int, "width_px", "height_px")
        _set_numbers(self, float, "imu_minus_cam_s", "line_delay_s")

    @property
    def focal_px(self) -> Array:
        """(2,) focal lengths along x and y on the optical axis."""
        return self.intrinsics_px[:2] * CAMERA_MODELS[self.model].axis_scale(self.distortion)

    def pixel_from_ray(self, rays_cam: Array) -> Array:
        """(N, 2) pixels of rays (N, 3)."""
        return CAMERA_MODELS[self.model].pixel_from_ray(self.intrinsics_px, self.distortion, rays_cam)

    def ray_from_pixel(self, pixels: Array) -> Array:
        """(N, 3) unit rays of pixels (N, 2)."""
        return CAMERA_MODELS[self.model].ray_from_pixel(self.intrinsics_px, self.distortion, pixels)


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise densities of the IMU; the defaults are the ADIS16448's data sheet, doubled."""

    gyro_noise_radps_rthz: float = 3.4e-4
    gyro_walk_radps2_rthz: float = 4.0e-5
    accel_noise_mps2_rthz: float = 4.0e-3
    accel_walk_mps3_rthz: float = 6.0e-3

    def __post_init__(self) -> None:
        _set_numbers(self, float, *self.__slots__)


NO_BASE = (
    "the mounting of the body on the base, whose speed they measure, is unknown; add base_from_body (4x4 rows) to the calibration file, "
    "or, without such a file, record /tf_static with base_link"
)


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """All sensors of one robot. Of a pair the left camera first (see `views`); `imu` is None for a rig without one.

    assumed: names of values without a source, of `imu` and `base_from_body`.
    """

    cameras: tuple[CameraCalibration, ...]
    imu: ImuNoise | None = None
    base_from_body: Array = field(default_factory=lambda: np.eye(4))
    assumed: tuple[str, ...] = ()

    @property
    def views(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the cameras of each view: a depth camera, a stereo pair, or a single camera.

        A pair is two cameras that look the same way from places side by side, whatever their numbers: of several the two with the most
        in common, then those with the lowest numbers.
        """
        views, numbers = list[tuple[int, ...]](), list(range(len(self.cameras)))
        while numbers:
            first, *numbers = numbers
            shares = {number: self._common_share(first, number) for number in numbers}
            alike = [number for number in numbers if shares[number] > 0]
            # The next number belongs to it wherever it lies: rectification says what is wrong with its place
            beside = [n for n in alike if self._is_beside(first, n)] or [n for n in alike if n == numbers[0]]
            other = max(beside, key=lambda number: shares[number], default=None)
            views.append((first,) if other is None else (first, other))
            numbers = [number for number in numbers if number != other]
        return tuple(views)

    def _common_share(self, first: int, other: int) -> float:
        """Share of their images, to a tenth, that two cameras have in common; 0 unless they look the same way, without depth."""
        cameras = self.cameras[first], self.cameras[other]
        axes = [camera.body_from_cam[:3, 2] for camera in cameras]
        cosine = float(axes[0] @ axes[1])
        if cosine <= SAME_WAY_COSINE or any(camera.has_depth for camera in cameras):
            return 0.0
        narrow, wide = sorted(float(camera.focal_px.mean()) / camera.width_px for camera in cameras)
        return round(cosine * narrow / wide, 1)

    def _is_beside(self, first: int, other: int) -> bool:
        """True if one camera lies to the left or right of the other, not above it, before it or in its place."""
        left_from_other = se3_inverse(self.cameras[first].body_from_cam) @ self.cameras[other].body_from_cam
        distance_m = float(np.linalg.norm(left_from_other[:3, 3]))
        return distance_m > LEAST_BASELINE_M and abs(left_from_other[0, 3]) > SIDEWAYS * distance_m

    @property
    def wheels_fault(self) -> str:
        """Reason why wheels cannot be used, with advice; empty if they can."""
        return NO_BASE if "base_from_body" in self.assumed else ""


def hidden_pixels(mask: tuple[Polygon, ...], size_px: tuple[int, int]) -> Mask:
    """(H, W) True inside a mask's polygons or on their edges, for an image of a width and a height."""
    outlines = [np.rint(np.array(polygon) * 2**_SUB_PX).astype(np.int32) for polygon in mask]
    return np.asarray(cv2.fillPoly(np.zeros(size_px[::-1], np.uint8), outlines, (1,), shift=_SUB_PX), bool)


def _set_numbers(record: object, kind: type[int] | type[float], *names: str) -> None:
    for name in names:
        object.__setattr__(record, name, kind(getattr(record, name)))


def intrinsics_of(matrix: Array) -> Array:
    """(4,) fx fy cx cy of a camera matrix (3, 3)."""
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]]


def check_camera(camera: CameraCalibration, name: str) -> CameraCalibration:
    """Return `camera`; raise CalibrationError naming the first invalid value."""
    if camera.model not in CAMERA_MODELS:
        raise CalibrationError(f"{name}: unknown camera model {camera.model!r}; known are {', '.join(CAMERA_MODELS)}")
    counts = CAMERA_MODELS[camera.model].distortion_counts
    if len(camera.distortion) not in counts:
        raise CalibrationError(
            f"{name}: {len(camera.distortion)} distortion coefficients for model {camera.model}, which takes {counts}"
        )
    if fault := CAMERA_MODELS[camera.model].fault(camera.distortion):
        raise CalibrationError(f"{name}: {fault}; are its parameters in Kalibr's order? Or calibrate again")
    fx, fy, cx, cy = (float(v) for v in camera.intrinsics_px)
    if not (fx > 0 and fy > 0):
        raise CalibrationError(f"{name}: focal lengths fx={fx} fy={fy} must be positive pixels")
    if not (0 < cx < camera.width_px and 0 < cy < camera.height_px):
        raise CalibrationError(
            f"{name}: principal point ({cx}, {cy}) lies outside the {camera.width_px}x{camera.height_px} image; "
            "is the calibration for another resolution?"
        )
    rotation = camera.body_from_cam[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise CalibrationError(f"{name}: the rotation of body_from_cam is not orthonormal: {rotation.tolist()}")
    return camera
