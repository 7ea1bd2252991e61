"""Surfels as files of 3D Gaussians, which splat viewers read: PLY and Niantic's SPZ. Source of PLY's fields: Kerbl et al. 2023."""

import gzip
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError
from fleetmap.geometry import Array
from mapserver.surfels.surfel_map import Surfels

_FIELDS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
_ALL = (*_FIELDS, *(f"rot_{i}" for i in range(4)))
_SH_0 = 0.28209479177387814  # the spherical harmonic of order 0, which colours are divided by
SIGMA_EDGES, THICKNESS, OPACITY = 0.6, 0.1, 0.98  # standard deviation in edges, share of it along the normal
_SPZ_HEAD = struct.Struct("<IIIBBBB")
_SPZ_MAGIC, _SPZ_VERSION = (
    0x5053474E,
    3,
)  # version 2 has rotations in 8 bits, which are up to 8 degrees off near half a turn
_SPZ_COLOUR, _SPZ_LEAST_LOG, _SPZ_STEPS = (
    0.15,
    -10.0,
    16.0,
)  # of a colour's coefficient; of a scale's logarithm: smallest, steps in 1
_SPZ_MOST_BITS, _SPZ_RANGE = 12, 1 << 23  # of a coordinate's fraction; steps each way in 24 bits
_SPZ_TURN_STEPS = 511
_TINY = 1e-6
_TURN = 1.0 / np.sqrt(2.0)  # about x: z of the map becomes y of SPZ


@dataclass(frozen=True, slots=True)
class Splats:
    """N flat Gaussians in `map`: points_map, unit normals (N, 3), sigmas_m (N,) along the disc, greys (N,) of 0 to 255, opacities (N,)."""

    points_map: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigmas_m: Array
    greys: Array
    opacities: Array

    def __len__(self) -> int:
        return len(self.points_map)

    @classmethod
    def of(cls, surfels: Surfels) -> "Splats":
        """Discs as Gaussians, all as opaque."""
        sigmas_m = SIGMA_EDGES * surfels.edges_m.astype(np.float64)
        greys, opacities = surfels.greys.astype(np.float64), np.full(len(surfels), OPACITY)
        return cls(surfels.points_map, surfels.normals, sigmas_m, greys, opacities)

    def coefficients(self) -> Array:
        """(N,) colours as coefficients of the spherical harmonic of order 0."""
        return np.asarray((self.greys / 255.0 - 0.5) / _SH_0)

    def log_scales(self) -> Array:
        """(N, 3) logarithms of the standard deviations in metres, the last one along the normal."""
        logs = np.log(np.maximum(self.sigmas_m, _TINY))[:, None] + np.log([1.0, 1.0, THICKNESS])
        return np.asarray(logs)


def splat_ply(splats: Splats) -> bytes:
    """The PLY file, in `map`: scales are logarithms of metres, opacities logits, rotations (w, x, y, z) turn z to the normal."""
    table = np.zeros(len(splats), [(name, "<f4") for name in _ALL])
    colours, scales = splats.coefficients(), splats.log_scales()
    for i, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = splats.points_map[:, i], splats.normals[:, i]
        table[f"f_dc_{i}"], table[f"scale_{i}"] = colours, scales[:, i]
    opacities = np.clip(splats.opacities, _TINY, 1 - _TINY)
    table["opacity"] = np.log(opacities / (1 - opacities))
    for i, part in enumerate(_quaternions(splats.normals.astype(np.float64)).T):
        table[f"rot_{i}"] = part
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    head += [*(f"property float {name}" for name in _ALL), "end_header", ""]
    return "\n".join(head).encode() + table.tobytes()


def splat_spz(splats: Splats) -> bytes:
    """The SPZ file, in its axes: x of the map, z of the map up, y of the map away from the viewer.

    Coordinates have 12 bits below a metre, fewer on sites that do not fit; UsageError for one that never fits. The same splats give
    the same bytes. Source: the file format of github.com/nianticlabs/spz, version 3.
    """
    points = splats.points_map.astype(np.float64)[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    farthest_m = max(1.0, float(np.abs(points).max(initial=0.0)))
    bits = min(_SPZ_MOST_BITS, int(np.floor(np.log2((_SPZ_RANGE - 1) / farthest_m))))
    if bits < 0:
        raise UsageError(
            f"a surfel is {farthest_m:.0f} m from the map's origin; SPZ holds {_SPZ_RANGE} m, write a PLY file"
        )
    steps = np.round(points * (1 << bits)).astype("<i4")
    places = np.ascontiguousarray(steps[..., None]).view(np.uint8).reshape(-1, 3, 4)[..., :3]
    colours = 255 * (np.repeat(splats.coefficients()[:, None], 3, axis=1) * _SPZ_COLOUR + 0.5)
    scales = (splats.log_scales() - _SPZ_LEAST_LOG) * _SPZ_STEPS
    turns = _smallest_three(_turned(_quaternions(splats.normals.astype(np.float64))))
    columns = [places, *(_bytes(column) for column in (255 * splats.opacities, colours, scales)), turns]
    head = _SPZ_HEAD.pack(_SPZ_MAGIC, _SPZ_VERSION, len(splats), 0, bits, 0, 0)
    return gzip.compress(head + b"".join(np.ascontiguousarray(column).tobytes() for column in columns), mtime=0)


def _bytes(values: Array) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _turned(quaternions: Array) -> Array:
    """(N, 4) w, x, y, z after the turn of -90 degrees about x from the map's axes to SPZ's."""
    w, x, y, z = quaternions.T
    return np.asarray(_TURN * np.stack([w + x, x - w, y + z, z - y], axis=1))


def _smallest_three(quaternions: Array) -> NDArray[np.uint32]:
    """(N,) unit quaternions w, x, y, z in 32 bits: which of x, y, z, w is the largest, and of each other one its sign and 9 bits."""
    parts = np.roll(quaternions, -1, axis=1)
    rows, largest = np.arange(len(parts)), np.abs(parts).argmax(axis=1)
    parts = parts * np.where(parts[rows, largest] < 0, -1.0, 1.0)[:, None]
    sizes = np.round(np.minimum(np.abs(parts) / _TURN, 1.0) * _SPZ_TURN_STEPS).astype(np.uint32)
    codes = np.where(parts < 0, np.uint32(_SPZ_TURN_STEPS + 1), np.uint32(0)) | sizes
    packed = largest.astype(np.uint32)
    for i in range(4):
        packed = np.where(largest == i, packed, packed << np.uint32(10) | codes[:, i])
    return np.asarray(packed.astype("<u4"), np.uint32)


def _quaternions(normals: Array) -> Array:
    """(N, 4) w, x, y, z of the shortest turns from z to unit normals (N, 3)."""
    turns = np.column_stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    turns[normals[:, 2] < -0.99999] = (0.0, 1.0, 0.0, 0.0)
    return np.asarray(turns / np.linalg.norm(turns, axis=1, keepdims=True))
