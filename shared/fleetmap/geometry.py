"""Rotations, rigid transforms and alignments on numpy arrays.

A transform is a (4, 4) float64 matrix named `target_from_source`. Tangent vectors are rotation first:
(rx, ry, rz, tx, ty, tz), radians and metres. Quaternions are `quat_wxyz`, unit, w >= 0.
"""

from collections.abc import Iterable
from math import atan2, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
AnyArray = NDArray[Any]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Rings = tuple[Array, ...]
"""A polygon, the outline first, then holes: (V, 2) corners in metres, the first not repeated; inside by the even-odd rule over them."""

_MOST_AT_ONCE = 1 << 22  # points times corners
_IDENTITY = np.eye(4)
_SKEWS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1).reshape(3, 9)  # of the axes


def length(vector: Array) -> float:
    """np.linalg.norm of a vector, bit-identical, in a tenth of its time."""
    flat = vector.ravel()
    return sqrt(flat.dot(flat))


def skew(vector: Array) -> Array:
    """(3, 3) matrix S with S @ x = vector x x (cross product)."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotvec_rad: Array) -> Array:
    """(3, 3) rotation of a rotation vector (3,). Source: Rodrigues' formula, series below 1e-6 rad."""
    angle = length(rotvec_rad)
    cross = skew(rotvec_rad)
    if angle < 1e-6:
        return np.eye(3) + cross + 0.5 * cross @ cross
    turned = np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross
    return np.asarray(turned)


def so3_exps(rotvecs_rad: Array) -> Array:
    """(N, 3, 3) of rotation vectors (N, 3), by Rodrigues' formula; vectorised: a loop of `so3_exp` takes a fifth of a frame's time."""
    angles = np.linalg.norm(rotvecs_rad, axis=1)[:, None, None]
    cross = (rotvecs_rad @ _SKEWS).reshape(-1, 3, 3)
    sine, half_sine = np.sinc(angles / np.pi), np.sinc(0.5 * angles / np.pi)  # sin x / x
    return np.asarray(np.eye(3) + sine * cross + 0.5 * half_sine**2 * cross @ cross)


def so3_log(rotation: Array) -> Array:
    """Rotation vector (3,) of a rotation (3, 3), angle in [0, pi]. Goes through the quaternion, stable near pi."""
    quat = quat_wxyz_from_rotation(rotation)
    sine = length(quat[1:])
    if sine < 1e-10:
        return 2.0 * quat[1:]
    return np.asarray(2.0 * np.arctan2(sine, quat[0]) / sine * quat[1:])


def so3_left_jacobian(rotvec_rad: Array) -> Array:
    """(3, 3) left Jacobian of SO(3): d Exp(r) = J dr, applied from the left.

    Source: Barfoot, State Estimation for Robotics, 7.77.
    """
    angle = float(np.linalg.norm(rotvec_rad))
    cross = skew(rotvec_rad)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * cross + cross @ cross / 6.0
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def se3(rotation: Array, translation_m: Array) -> Array:
    """(4, 4) rigid transform of a rotation (3, 3) and a translation (3,)."""
    target_from_source = _IDENTITY.copy()
    target_from_source[:3, :3] = rotation
    target_from_source[:3, 3] = translation_m
    return target_from_source


def se3_inverse(target_from_source: Array) -> Array:
    """source_from_target; also for stacks (..., 4, 4)."""
    source_from_target = target_from_source.swapaxes(-1, -2).copy()
    rotation = target_from_source[..., :3, :3].swapaxes(-1, -2)
    source_from_target[..., :3, 3:] = -(rotation @ target_from_source[..., :3, 3:])
    source_from_target[..., 3, :3] = 0.0
    return source_from_target


def se3_exp(rot_trans: Array) -> Array:
    """(4, 4) transform of a tangent vector (6,), rotation first."""
    rotvec = np.asarray(rot_trans[:3], dtype=np.float64)
    return se3(so3_exp(rotvec), so3_left_jacobian(rotvec) @ rot_trans[3:])


def se3_log(target_from_source: Array) -> Array:
    """Tangent vector (6,), rotation first, of a transform (4, 4)."""
    rotvec = so3_log(target_from_source[:3, :3])
    return np.concatenate([rotvec, np.linalg.solve(so3_left_jacobian(rotvec), target_from_source[:3, 3])])


def se3_adjoint(target_from_source: Array) -> Array:
    """(6, 6), rotation first: a left perturbation in source axes, in target axes."""
    rotation = target_from_source[:3, :3]
    adjoint = turn_both(rotation)
    adjoint[3:, :3] = skew(target_from_source[:3, 3]) @ rotation
    return adjoint


def transport_cov(cov_rot_trans: Array, lever_m: Array) -> Array:
    """(6, 6) about a point of the same rigid body at lever_m (3,) from that of `cov_rot_trans`: uncertainty of rotation also moves it."""
    adjoint = np.eye(6)
    adjoint[3:, :3] = -skew(lever_m)
    return np.asarray(adjoint @ cov_rot_trans @ adjoint.T)


def turned_cov(cov_rot_trans: Array, rotation: Array) -> Array:
    """Covariances (..., 6, 6) in axes turned by a rotation (3, 3)."""
    turn = turn_both(rotation)
    return np.asarray(turn @ cov_rot_trans @ turn.T)


def turn_both(rotation: Array) -> Array:
    """(6, 6) matrix that turns both halves of a tangent vector by a rotation (3, 3)."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rotation
    return turn


def rotation_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """(3, 3) rotation of a quaternion (4,), normalised here."""
    w, x, y, z = np.asarray(quat_wxyz, dtype=np.float64) / np.linalg.norm(quat_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_wxyz_from_rotation(rotation: Array) -> Array:
    """Unit quaternion (4,) with w >= 0. Source: Shepperd 1978 (largest component first)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()  # indexing the array is ten times slower
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    rows = (
        (squares[0], zy - yz, xz - zx, yx - xy),
        (zy - yz, squares[1], xy + yx, xz + zx),
        (xz - zx, xy + yx, squares[2], yz + zy),
        (yx - xy, xz + zx, yz + zy, squares[3]),
    )
    quat = np.array(rows[squares.index(max(squares))])
    quat /= length(quat)
    return np.asarray(-quat if quat[0] < 0 else quat)


def transform_points(target_from_source: Array, points_source: Array) -> Array:
    """points_target (N, 3) of points_source (N, 3)."""
    return np.asarray(points_source @ target_from_source[:3, :3].T + target_from_source[:3, 3])


def interpolate_se3(frame_from_a: Array, frame_from_b: Array, fraction: float) -> Array:
    """The transform `fraction` of the way from a to b, at constant twist."""
    return np.asarray(frame_from_a @ se3_exp(fraction * se3_log(se3_inverse(frame_from_a) @ frame_from_b)))


def align_points(points_target: Array, points_source: Array, *, with_scale: bool = False) -> tuple[Array, float]:
    """Least-squares `target_from_source` (4, 4) and scale for paired points (N, 3).

    points_target ~ scale * R @ points_source + t; scale is 1 unless asked for. The returned matrix holds R and t
    without the scale. Source: Umeyama 1991.
    """
    assert points_target.shape == points_source.shape
    assert points_target.ndim == 2
    mean_target, mean_source = points_target.mean(0), points_source.mean(0)
    target, source = points_target - mean_target, points_source - mean_source
    u, singular, vt = np.linalg.svd(target.T @ source)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float((singular * np.diag(sign)).sum() / max((source**2).sum(), 1e-300)) if with_scale else 1.0
    return se3(rotation, mean_target - scale * rotation @ mean_source), scale


def rotation_angle_rad(rotation: Array) -> float:
    """Angle in [0, pi] of a rotation (3, 3), by its sine and cosine."""
    return atan2(length(rotation - rotation.T) / sqrt(8.0), 0.5 * (rotation.trace() - 1.0))


def rotation_between_vectors(source: Array, target: Array) -> Array:
    """The smallest rotation (3, 3) that turns direction `source` (3,) into direction `target` (3,)."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return so3_exp(np.pi * axis / np.linalg.norm(axis))
    return so3_exp(np.arctan2(sine, cosine) * axis / sine)


def inside_rings(points: Array, rings: Iterable[Array]) -> Mask:
    """(N,) True for points (N, 2) inside, by the even-odd rule over all rings: (V, 2) corners, the first not repeated at the end."""
    inside = np.zeros(len(points), bool)
    x, y = points[:, :1], points[:, 1:]
    for ring in rings:
        (x0, y0), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
        crosses = (y0 > y) != (y1 > y)
        left = x < x0 + (y - y0) / np.where(y1 == y0, 1.0, y1 - y0) * (x1 - x0)
        inside ^= (np.count_nonzero(crosses & left, axis=1) % 2).astype(bool)
    return inside


def inside_any(points: AnyArray, polygons: Iterable[Rings]) -> Mask:
    """(N,) True for points (N, 2) or (N, 3) inside one polygon or more, at any height; each has its own holes."""
    flat, inside = points[:, :2].astype(np.float64), np.zeros(len(points), bool)
    for rings in polygons:
        corners = np.concatenate(rings)
        near = np.flatnonzero(((flat >= corners.min(axis=0)) & (flat <= corners.max(axis=0))).all(axis=1))
        for rows in np.array_split(near, 1 + len(near) * len(corners) // _MOST_AT_ONCE):
            inside[rows] |= inside_rings(flat[rows], rings)
    return inside


def midpoints(rays_a: Array, rays_b: Array, apart: Array) -> tuple[Array, Array]:
    """Points (N, 3) midway between unit rays (N, 3) from two centres that are `apart` (3,) or (N, 3), as seen from the first one.

    NaN where the rays are parallel, or meet behind a centre. And the cosines (N,) of the angles between them.
    """
    cosines = (rays_a * rays_b).sum(axis=1)
    a, b = (rays_a * apart).sum(axis=1), (rays_b * apart).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = 1.0 - cosines**2
        along_a, along_b = (a - cosines * b) / determinant, (cosines * a - b) / determinant
        points = 0.5 * (along_a[:, None] * rays_a + apart + along_b[:, None] * rays_b)
    points[~((along_a > 0) & (along_b > 0) & (determinant > 1e-10))] = np.nan
    return points, cosines
