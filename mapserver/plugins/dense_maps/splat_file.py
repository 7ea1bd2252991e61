"""Surfels as PLY files of 3D Gaussians, which splat viewers read. Source of the fields: Kerbl et al. 2023."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from mapserver.plugins.dense_maps.surfel_map import Surfels

_FIELDS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
_ALL = (*_FIELDS, *(f"rot_{i}" for i in range(4)))
_SH_0 = 0.28209479177387814  # the spherical harmonic of order 0; colours are divided by it
SIGMA_EDGES, THICKNESS, OPACITY = 0.6, 0.1, 0.98  # standard deviation in edges, share of it along the normal
_TINY = 1e-6


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
        """Return discs as Gaussians of equal opacity."""
        sigmas_m = SIGMA_EDGES * surfels.edges_m.astype(np.float64)
        greys, opacities = surfels.greys.astype(np.float64), np.full(len(surfels), OPACITY)
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
