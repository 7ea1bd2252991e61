"""Camera models: pixels of rays and rays of pixels. To add one: a class here, a line in CAMERA_MODELS, and one in _NAMES for each of its
names in calibration files. Parameters beyond fx, fy, cx and cy are its `distortion`."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from fleetmap import core
from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array

_ITERATIONS = 20


class CameraModel:
    """A lens model.

    kalibr: its name in camchains. ranges: the closed interval of each parameter of its shape, which stand before fx there.
    """

    kalibr = "pinhole"
    ranges: dict[str, tuple[float, float]] = {}  # noqa: RUF012
    distortion_counts: tuple[int, ...]

    def pixel_from_ray(self, intrinsics_px: Array, distortion: Array, rays_cam: Array) -> Array:
        """(N, 2) pixels of rays (N, 3), NaN outside the lens's field of view. intrinsics_px: (4,) fx fy cx cy."""
        rays = np.ascontiguousarray(rays_cam, np.float64)
        return core.pixels_of_rays(rays, np.asarray(intrinsics_px, np.float64), *self.core_lens(distortion))

    def ray_from_pixel(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
        """(N, 3) unit rays of pixels (N, 2), NaN where no ray maps to the pixel."""
        raise NotImplementedError

    def core_lens(self, distortion: Array) -> tuple[Array, float]:
        """The coefficients in the core's order, and the x^2 + y^2 at which a radial-tangential image folds back.

        The core chooses the lens by their number: 8 are radial-tangential, 4 equidistant, 12 a sphere's.
        """
        raise NotImplementedError

    def axis_scale(self, distortion: Array) -> float:
        """Focal length on the optical axis, in fx and fy."""
        return 1.0

    def fault(self, distortion: Array) -> str:
        """The parameter that no lens has, with its range; empty if all are possible."""
        return ""


class RadialTangential(CameraModel):
    """Pinhole with radial-tangential distortion k1 k2 p1 p2 [k3 [k4 k5 k6]]; without distortion if the coefficients are empty.

    The radial factor is (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6); rays beyond its fold have no pixel. Sources:
    Brown 1966; OpenCV's order and its rational model.
    """

    distortion_counts = (0, 4, 5, 8)

    def ray_from_pixel(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
        """Newton's method with a numeric Jacobian; NaN if it does not converge to the pixel."""
        fx, fy, cx, cy = intrinsics_px
        goals = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
        x, y = core.undistort(*self.core_lens(distortion), *goals)
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def core_lens(self, distortion: Array) -> tuple[Array, float]:
        lens = np.pad(np.asarray(distortion, np.float64), (0, 8 - len(distortion)))
        return lens, _radial_limit(*lens.tolist())


@lru_cache(maxsize=16)
def _radial_limit(k1: float, k2: float, _p1: float, _p2: float, k3: float, k4: float, k5: float, k6: float) -> float:
    """Largest r^2 up to which the distorted radius still grows; beyond it the image folds back. The same in every frame."""
    above, below = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
    # d/dr of r above(r^2) / below(r^2), times below^2, as a polynomial in r^2
    slope = above * below + np.poly1d([2.0, 0.0]) * (above.deriv() * below - above * below.deriv())
    roots = np.concatenate([slope.roots, below.roots])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return float(real.min()) if len(real) else np.inf


class Equidistant(CameraModel):
    """Equidistant fisheye k1 k2 k3 k4: the image radius is a polynomial of the angle. Source: Kannala and Brandt 2006, OpenCV's fisheye.

    The direction straight back and angles where the polynomial folds have no pixel.
    """

    distortion_counts = (4,)

    def ray_from_pixel(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
        """Newton's method on the radius; NaN if no angle gives it."""
        fx, fy, cx, cy = intrinsics_px
        x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
        goal = np.hypot(x, y)
        theta = np.minimum(goal, np.pi)
        with np.errstate(divide="ignore", invalid="ignore"):
            for _ in range(_ITERATIONS):
                radius, slope = _radius_and_slope(distortion, theta)
                theta = theta - (radius - goal) / slope
            radius, slope = _radius_and_slope(distortion, theta)
            scale = np.where(goal > 1e-12, np.sin(theta) / goal, 1.0)
        rays = np.stack([x * scale, y * scale, np.cos(theta)], axis=1)
        rays[~((np.abs(radius - goal) < 1e-9) & (theta >= 0) & (theta < np.pi)) | (slope <= 0)] = np.nan
        return rays

    def core_lens(self, distortion: Array) -> tuple[Array, float]:
        return np.array(distortion, np.float64), np.inf


def _radius_and_slope(distortion: Array, theta: Array) -> tuple[Array, Array]:
    k1, k2, k3, k4 = distortion
    t2 = theta * theta
    radius = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return radius, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


class Sphere(CameraModel):
    """Fisheyes by spheres: Kalibr's omni, eucm and ds, each followed by radial-tangential distortion.

    A ray (x, y, z) of length d1 is moved along the axis to w = z + xi d1, and meets the plane at m = (x, y) / (a d2 + b w), where
    d2 = sqrt(beta (x^2 + y^2) + w^2). m is then distorted as the points of a pinhole's plane z = 1. `distortion` is k1 k2 p1 p2 and

        omni           xi        a = xi, b = 1, unmoved           unified model, Mei and Rives 2007
        eucm           alpha beta   a = alpha, b = 1 - alpha, unmoved   Khomutenko, Garcia and Martinet 2016
        double-sphere  xi alpha  a = alpha, b = 1 - alpha         Usenko, Demmel and Cremers 2018

    Rays behind the camera have pixels as long as m grows with their angle to the axis: w > -d2 min(a, b) / max(a, b). The inverse is that
    of the last two papers, for any a and b. `intrinsics_px` are Kalibr's: on the axis the focal length is fx / ((a + b) (1 + xi)).
    """

    def __init__(
        self, kalibr: str, ranges: dict[str, tuple[float, float]], shape: Callable[..., tuple[float, ...]]
    ) -> None:
        """shape: xi, beta, a and b of the parameters."""
        self.kalibr, self.ranges, self._shape = kalibr, ranges, shape
        self.distortion_counts = (PLANE + len(ranges),)

    def ray_from_pixel(self, intrinsics_px: Array, distortion: Array, pixels: Array) -> Array:
        xi, beta, a, b = self._shape(*distortion[PLANE:])
        ahead = _PINHOLE.ray_from_pixel(intrinsics_px, distortion[:PLANE], pixels)
        x, y = (ahead[:, :2] / ahead[:, 2:]).T
        squared = x * x + y * y
        rest = 1 - a * a * beta * squared
        with np.errstate(divide="ignore", invalid="ignore"):
            w = rest / (b + np.sqrt(b * b + (a * a - b * b) * rest))
            scale = (w * xi + np.sqrt(w * w + (1 - xi * xi) * squared)) / (w * w + squared)
        return np.stack([scale * x, scale * y, scale * w - xi], axis=1)

    def core_lens(self, distortion: Array) -> tuple[Array, float]:
        plane, limit = _PINHOLE.core_lens(distortion[:PLANE])
        return np.concatenate([plane, self._shape(*distortion[PLANE:])]), limit

    def axis_scale(self, distortion: Array) -> float:
        xi, _, a, b = self._shape(*distortion[PLANE:])
        return float(1.0 / ((a + b) * (1.0 + xi)))

    def fault(self, distortion: Array) -> str:
        for value, (name, (low, high)) in zip(distortion[PLANE:].tolist(), self.ranges.items(), strict=True):
            if not low <= value <= high:
                return f"{name} of {self.kalibr} is {value:g}, outside of {low:g} to {high:g}"
        return ""


PLANE = 4  # coefficients of a sphere's distortion in the plane, before those of the shape
_PINHOLE, _UNIT, _POSITIVE = RadialTangential(), (0.0, 1.0), (0.0, np.inf)
CAMERA_MODELS: dict[str, CameraModel] = {
    "radial-tangential": _PINHOLE,
    "equidistant": Equidistant(),
    "omni": Sphere("omni", {"xi": _POSITIVE}, lambda xi: (0.0, 1.0, xi, 1.0)),
    "eucm": Sphere("eucm", {"alpha": _UNIT, "beta": _POSITIVE}, lambda a, beta: (0.0, beta, a, 1.0 - a)),
    # Beyond xi = 1 the second sphere turns the image inside out; at -1 the focal length on the axis is infinite.
    "double-sphere": Sphere("ds", {"xi": (-0.99, 1.0), "alpha": _UNIT}, lambda xi, a: (xi, 1.0, a, 1.0 - a)),
}
LENSES = {name: model for name, model in CAMERA_MODELS.items() if isinstance(model, Sphere)}
# Lens names of ROS, Kalibr, EuRoC, OpenCV and OpenVINS; in ROS an empty name means plumb_bob
_NAMES = {
    **dict.fromkeys(("plumb_bob", "radtan", "rational_polynomial", ""), "radial-tangential"),
    **dict.fromkeys(("fisheye", "kannala_brandt"), "equidistant"),
    **{name: name for name in CAMERA_MODELS},
}
_NO_PINHOLES = ("omni", "mei", "sphere", "unified", "eucm")  # even if their coefficients are zero
_NEXT_STEP = "calibrate with one of these, or record rectified images, or pass a calibration with --calibration FILE"


def lens_of(name: str, coefficients: Array, where: str) -> tuple[str, Array]:
    """Translate another program's lens name to a key of CAMERA_MODELS and its distortion; `where` is for error messages.

    Coefficients are in OpenCV's order. Zeros at their end are cut off, so that one lens has one form: ROS writes five or
    eight where four are known. CalibrationError for lenses that are not supported, for other counts and for values that are not finite.
    """
    name, words = name.lower(), f"distortion coefficients {coefficients[:16].tolist()}"
    if not np.isfinite(coefficients).all():
        raise CalibrationError(f"{where}: {words} are not finite; calibrate again")
    if name not in _NAMES and (coefficients.any() or any(word in name for word in _NO_PINHOLES)):
        known = f"known are {', '.join(filter(None, _NAMES))}"
        raise CalibrationError(f"{where}: the lens model {name[:40]!r} is not supported, {known}; {_NEXT_STEP}")
    model = _NAMES.get(name, "radial-tangential")
    counts = CAMERA_MODELS[model].distortion_counts
    for count in counts:
        if len(coefficients) >= count and not coefficients[count:].any():
            return model, coefficients[:count]
    more = "; thin prisms (9 to 12) and tilted sensors (13, 14) are not supported" if len(coefficients) > 8 else ""
    takes = f"{name or 'plumb_bob'}, which takes {' or '.join(map(str, counts))}{more}"
    raise CalibrationError(f"{where}: {len(coefficients)} {words} for {takes}; {_NEXT_STEP}")
