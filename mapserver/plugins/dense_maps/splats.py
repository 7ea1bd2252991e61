"""Surfels as 3D Gaussians: PLY files, which splat viewers read (source of the fields: Kerbl et al. 2023), and as those viewers render them,
with the derivatives of a loss by their colours, sizes and opacities."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, Array32, Indices, se3_inverse
from fleetmap.sensors.calibration import CameraCalibration
from mapserver.plugins.dense_maps.surfel_map import Surfels

_FIELDS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
_ALL = (*_FIELDS, *(f"rot_{i}" for i in range(4)))
_SH_0 = 0.28209479177387814  # the spherical harmonic of order 0; colours are divided by it
SIGMA_EDGES, THICKNESS, OPAQUE = 0.6, 0.1, 0.98  # standard deviation in edges, share of it along the normal
_TINY = 1e-6


@dataclass(frozen=True, slots=True)
class Splats:
    """N flat Gaussians in `map`: points_map, unit normals (N, 3), sigmas_m (N,) along the disc, greys (N,) of 0 to 255, opacities (N,)."""

    points_map: Array32
    normals: Array32
    sigmas_m: Array
    greys: Array
    opacities: Array

    def __len__(self) -> int:
        return len(self.points_map)

    @classmethod
    def of(cls, surfels: Surfels) -> "Splats":
        """Return discs as Gaussians of equal opacity."""
        sigmas_m = SIGMA_EDGES * surfels.edges_m.astype(np.float64)
        greys, opacities = surfels.greys.astype(np.float64), np.full(len(surfels), OPAQUE)
        return cls(surfels.points_map, surfels.normals, sigmas_m, greys, opacities)


def splat_ply(splats: Splats) -> bytes:
    """Return the PLY file, in `map`: scales are logarithms of metres, opacities logits, rotations (w, x, y, z) turn z to the normal."""
    table = np.zeros(len(splats), [(name, "<f4") for name in _ALL])
    colours = (splats.greys / 255.0 - 0.5) / _SH_0
    scales = np.log(np.maximum(splats.sigmas_m, _TINY))[:, None] + np.log([1.0, 1.0, THICKNESS])
    for i, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = splats.points_map[:, i], splats.normals[:, i]
        table[f"f_dc_{i}"], table[f"scale_{i}"] = colours, scales[:, i]
    opacities = np.clip(splats.opacities, _TINY, 1 - _TINY)
    table["opacity"] = np.log(opacities / (1 - opacities))
    normals = splats.normals.astype(np.float64)
    # Quaternions (N, 4) w, x, y, z of the shortest rotations from z to the normals
    turns = np.column_stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    turns[normals[:, 2] < -0.99999] = (0.0, 1.0, 0.0, 0.0)
    for i, part in enumerate((turns / np.linalg.norm(turns, axis=1, keepdims=True)).T):
        table[f"rot_{i}"] = part
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    head += [*(f"property float {name}" for name in _ALL), "end_header", ""]
    return "\n".join(head).encode() + table.tobytes()


LEAST_ALPHA = core.SPLAT_LEAST_ALPHA
BLUR_PX2 = 0.3  # variance of a pixel, as in the viewers
NEAR_M, FAR_M = 0.1, 40.0
_OPACITIES, _GREYS, _SIGMAS_M = (0.01, 0.985), (0.0, 255.0), (1e-3, 1.0)  # the least and the most
_BEYOND = 1.3  # in half widths of the picture: limit of the position used to linearise the projection
GREY, SIZE, OPACITY = range(3)


@dataclass(frozen=True, slots=True)
class Drawn:
    """A picture (H, W), 0 to 1 on black, the share of light that passes all splats (H, W), and the backward pass.

    backward: from the derivatives (H, W) of a loss by the picture to the numbers (M,) of the drawn splats and the derivatives (M, 3)
    of the loss by their parameters, in the order of `parameters_of`.
    """

    picture: Array
    through: Array
    backward: Callable[[Array], tuple[Indices, Array]]


def parameters_of(splats: Splats) -> Array:
    """Return (N, 3) grey of 0 to 1, logarithm of the standard deviation in metres, logit of the opacity."""
    opacities = np.clip(splats.opacities, *_OPACITIES)
    sigmas_m = np.clip(splats.sigmas_m, *_SIGMAS_M)
    return np.column_stack([splats.greys / 255.0, np.log(sigmas_m), np.log(opacities / (1 - opacities))])


def with_parameters(splats: Splats, parameters: Array) -> Splats:
    """Return the same splats with these parameters (N, 3)."""
    opacities = 1.0 / (1.0 + np.exp(-parameters[:, OPACITY]))
    return replace(splats, greys=255.0 * parameters[:, GREY], sigmas_m=np.exp(parameters[:, SIZE]), opacities=opacities)


_PLACES = np.zeros((2, 3), np.float32)
LEAST, MOST = parameters_of(Splats(_PLACES, _PLACES, *map(np.array, (_SIGMAS_M, _GREYS, _OPACITIES))))
"""The smallest and the largest parameters (3,)."""


def draw(splats: Splats, parameters: Array, camera: CameraCalibration, map_from_cam: Array) -> Drawn:
    """Render splats, of which only positions and normals are used, with parameters (N, 3), by a camera without distortion, on the CPU.

    Both sides of a splat are visible. A splat smaller than a pixel is more transparent in proportion.
    """
    numbers, pixels, shapes = _projected(splats, camera, se3_inverse(map_from_cam))
    chosen = parameters[numbers]
    own = shapes * np.exp(2 * chosen[:, SIZE])[:, None]
    blurred = own + BLUR_PX2 * np.array([1.0, 0.0, 1.0])
    opacities = 1.0 / (1.0 + np.exp(-chosen[:, OPACITY]))
    peaks = np.sqrt(np.maximum(_determinant(own), 0.0) / _determinant(blurred)) * opacities
    reaches_px = np.sqrt(2 * np.log(np.maximum(peaks / LEAST_ALPHA, 1.0)))[:, None] * np.sqrt(blurred[:, [0, 2]])
    size_px = np.array([camera.width_px, camera.height_px])
    is_inside = ((pixels + reaches_px >= 0) & (pixels - reaches_px <= size_px - 1)).all(axis=1)
    is_seen = (peaks >= LEAST_ALPHA) & is_inside
    conics = blurred[is_seen][:, [2, 1, 0]] * (1.0, -1.0, 1.0) / _determinant(blurred[is_seen])[:, None]
    reaches_px = np.ascontiguousarray(reaches_px[is_seen])
    gaussians = pixels[is_seen], np.ascontiguousarray(conics), reaches_px, peaks[is_seen], chosen[is_seen, GREY]
    numbers, opacities = numbers[is_seen], opacities[is_seen]
    through, picture = core.blend(gaussians, camera.width_px, camera.height_px)

    def backward(slopes: Array) -> tuple[Indices, Array]:
        return numbers, core.blend_backward(gaussians, opacities, BLUR_PX2, np.ascontiguousarray(slopes), picture)

    return Drawn(picture, through, backward)


def _determinant(shapes: Array) -> Array:
    return np.asarray(shapes[:, 0] * shapes[:, 2] - shapes[:, 1] ** 2)


def _projected(splats: Splats, camera: CameraCalibration, cam_from_map: Array) -> tuple[Indices, Array, Array]:
    """Return M splats in a picture, near to far: numbers, pixels (M, 2), and xx, xy, yy (M, 3) of their covariances for a sigma of 1 m.

    By EWA splatting: a Gaussian through the projection's derivative at its middle. Source: Zwicker et al. 2001.
    """
    points = splats.points_map @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    fx, fy, cx, cy = camera.intrinsics_px
    reach = _BEYOND * np.array([max(cx, camera.width_px - cx) / fx, max(cy, camera.height_px - cy) / fy])
    depths = points[:, 2]
    is_before = (depths > NEAR_M) & (depths < FAR_M) & (np.abs(points[:, :2]) < reach * depths[:, None]).all(axis=1)
    numbers = np.flatnonzero(is_before)
    numbers = numbers[np.argsort(depths[numbers], kind="stable")]
    x, y, z = points[numbers].T
    normals = splats.normals[numbers] @ cam_from_map[:3, :3].T
    across, down = fx / z, fy / z  # the derivative's rows: across (1, 0, -x / z) and down (0, 1, -y / z)
    along_u, along_v = across * (normals[:, 0] - normals[:, 2] * x / z), down * (normals[:, 1] - normals[:, 2] * y / z)
    flattened = 1.0 - THICKNESS**2
    shapes = np.column_stack(
        [
            across**2 * (1 + (x / z) ** 2) - flattened * along_u**2,
            across * down * x * y / z**2 - flattened * along_u * along_v,
            down**2 * (1 + (y / z) ** 2) - flattened * along_v**2,
        ]
    )
    return numbers, np.column_stack([fx * x / z + cx, fy * y / z + cy]), shapes
