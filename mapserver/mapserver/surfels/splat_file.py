"""Surfels as a PLY file of 3D Gaussians, which splat viewers read. Source of the fields: Kerbl et al. 2023."""

import numpy as np

from fleetmap.geometry import Array
from mapserver.surfels.surfel_map import Surfels

_FIELDS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
_ALL = (*_FIELDS, *(f"rot_{i}" for i in range(4)))
_SH_0 = 0.28209479177387814  # the spherical harmonic of order 0, which colours are divided by
_SIGMA_EDGES, _THICKNESS, _OPACITY = 0.6, 0.1, 0.98  # standard deviation in edges, share of it along the normal


def splat_ply(surfels: Surfels) -> bytes:
    """The file: discs as flat Gaussians in `map`, metres; scales are logarithms, opacity a logit, rotations (w, x, y, z) turn z to it."""
    table = np.zeros(len(surfels), [(name, "<f4") for name in _ALL])
    for i, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = surfels.points_map[:, i], surfels.normals[:, i]
        table[f"f_dc_{i}"] = (surfels.greys / 255.0 - 0.5) / _SH_0
        table[f"scale_{i}"] = np.log(_SIGMA_EDGES * surfels.edges_m * (_THICKNESS if i == 2 else 1.0))
    table["opacity"] = np.log(_OPACITY / (1 - _OPACITY))
    for i, part in enumerate(_quaternions(surfels.normals.astype(np.float64)).T):
        table[f"rot_{i}"] = part
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(surfels)}"]
    head += [*(f"property float {name}" for name in _ALL), "end_header", ""]
    return "\n".join(head).encode() + table.tobytes()


def _quaternions(normals: Array) -> Array:
    """(N, 4) w, x, y, z of the shortest turns from z to unit normals (N, 3)."""
    turns = np.column_stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    turns[normals[:, 2] < -0.99999] = (0.0, 1.0, 0.0, 0.0)
    return np.asarray(turns / np.linalg.norm(turns, axis=1, keepdims=True))
