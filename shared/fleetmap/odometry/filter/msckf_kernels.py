"""Inner loops of the right-invariant multi-state constraint filter.

Error convention: true = Exp(error) * estimate, in `odom` axes. For a rotation R, a velocity v and a position p and the
error (r, nu, rho): R = Exp(r) R^, v = Exp(r) v^ + nu, p = Exp(r) p^ + rho (to first order). Source: Barrau and Bonnabel
2017 for the error, Mourikis and Roumeliotis 2007 for the multi-state constraint.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import (
    cholesky_in_place,
    forward_substitute,
    matmul,
    matmul_nt,
    rotate,
    skew,
    solve_spd,
)


@kernel
def _observe(point: Array, cam_from_odom_rotation: Array, cam_position: Array, camera: Array, out: Array) -> bool:
    """u_left, v, disparity of a point, and its camera coordinates in out[3:6]; False behind the camera.

    camera: focal, cx, cy, focal * baseline.
    """
    for a in range(3):
        out[3 + a] = 0.0
        for b in range(3):
            out[3 + a] += cam_from_odom_rotation[a, b] * (point[b] - cam_position[b])
    z = out[5]
    if z < 0.05:
        return False
    out[0] = camera[0] * out[3] / z + camera[1]
    out[1] = camera[0] * out[4] / z + camera[2]
    out[2] = camera[3] / z
    return True


@kernel
def triangulate(
    rotations: Array,
    positions: Array,
    clones: NDArray[np.int64],
    pixels: Array,
    camera: Array,
    weights: Array,
    point: Array,
) -> bool:
    """Least-squares point (in place, odom) from one track; False where it does not settle in front of every camera.

    rotations (M, 3, 3) odom_from_cam, positions (M, 3); clones (n,) which of them saw it; pixels (n, 3) u_left v
    u_right (NaN none). camera: focal, cx, cy, focal * baseline. weights: 1/sigma of pixels and of disparity. `point`
    must hold a start.
    """
    z = np.empty(6)
    for _ in range(8):
        hessian, gradient = np.zeros((3, 3)), np.zeros(3)
        jacobian = np.empty((3, 3))
        for k in range(len(clones)):
            turn = rotations[clones[k]].T
            if not _observe(point, turn, positions[clones[k]], camera, z):
                return False
            inverse = 1.0 / z[5]
            for b in range(3):
                jacobian[0, b] = camera[0] * inverse * (turn[0, b] - z[3] * inverse * turn[2, b]) * weights[0]
                jacobian[1, b] = camera[0] * inverse * (turn[1, b] - z[4] * inverse * turn[2, b]) * weights[0]
                jacobian[2, b] = -camera[3] * inverse * inverse * turn[2, b] * weights[1]
            rows = 3 if pixels[k, 2] == pixels[k, 2] else 2
            for row in range(rows):
                if row < 2:
                    residual = (pixels[k, row] - z[row]) * weights[0]
                else:
                    residual = (pixels[k, 0] - pixels[k, 2] - z[2]) * weights[1]
                huber = 1.0 if abs(residual) < 3.0 else 3.0 / abs(residual)
                for a in range(3):
                    gradient[a] += huber * jacobian[row, a] * residual
                    for b in range(3):
                        hessian[a, b] += huber * jacobian[row, a] * jacobian[row, b]
        trace = hessian[0, 0] + hessian[1, 1] + hessian[2, 2]
        for a in range(3):
            hessian[a, a] += 1e-9 * trace
        if not solve_spd(hessian, gradient):
            return False
        point += gradient
        if np.abs(gradient).max() < 1e-4 * (1.0 + z[5]):
            break
    for k in range(len(clones)):
        if not _observe(point, rotations[clones[k]].T, positions[clones[k]], camera, z):
            return False
    return bool(np.isfinite(point).all())


@kernel
def _chi_square_limit(dof: int, normal_quantile: float) -> float:
    """Quantile of the chi-square distribution. Source: Wilson and Hilferty 1931."""
    k = 2.0 / (9.0 * dof)
    return float(dof * (1.0 - k + normal_quantile * np.sqrt(k)) ** 3)


@kernel
def linearize_track(
    point: Array,
    rotations: Array,
    positions: Array,
    clones: NDArray[np.int64],
    pixels: Array,
    camera: Array,
    weights: Array,
    by_clone: Array,
    by_point: Array,
    residual: Array,
) -> int:
    """Whitened residuals of one track and their derivatives; returns how many rows were filled.

    point (3,) odom; rotations (M, 3, 3) odom_from_cam, positions (M, 3); clones (n,), pixels (n, 3) u_left v u_right
    (NaN none). by_clone (3 n, 6 n) by the errors of the body transforms of this module, rotation then position, in the
    order of `clones`; by_point (3 n, 3); residual (3 n,) measured minus predicted, as 1/sigma in weights (2,) says.
    """
    z = np.empty(6)
    lever = skew(point)
    rows = 0
    for k in range(len(clones)):
        turn = rotations[clones[k]].T
        _observe(point, turn, positions[clones[k]], camera, z)
        inverse = 1.0 / z[5]
        stereo = pixels[k, 2] == pixels[k, 2]
        for row in range(3 if stereo else 2):
            for b in range(3):
                if row < 2:
                    slope = turn[row, b] - z[3 + row] * inverse * turn[2, b]
                    by_point[rows, b] = camera[0] * inverse * slope * weights[0]
                else:
                    by_point[rows, b] = -camera[3] * inverse * inverse * turn[2, b] * weights[1]
            # point as the clone sees it: R^T (p_f - p); with the invariant error its change is R^T (p_f x r - rho)
            for b in range(3):
                total = 0.0
                for c in range(3):
                    total += by_point[rows, c] * lever[c, b]
                by_clone[rows, 6 * k + b] = total
                by_clone[rows, 6 * k + 3 + b] = -by_point[rows, b]
            if row < 2:
                residual[rows] = (pixels[k, row] - z[row]) * weights[0]
            else:
                residual[rows] = (pixels[k, 0] - pixels[k, 2] - z[2]) * weights[1]
            rows += 1
    return rows


@kernel
def add_error_sources(pixels: Array, disparities: Array, weights: Array, columns: Array) -> None:
    """Fills in how errors that outlive one image enter the rows of `linearize_track`.

    pixels (n, 3) u_left v u_right (NaN none), disparities (n,) predicted. weights (2,): 1/sigma of pixels, of
    disparities. columns (3 n, 5) by the rig's disparity offset and depth scale, then by what one track keeps for
    itself: the shares of its way by which it slips along it and across it, and its disparity's offset.
    """
    row = 0
    for k in range(len(pixels)):
        way_u, way_v = pixels[k, 0] - pixels[0, 0], pixels[k, 1] - pixels[0, 1]
        columns[row, 2], columns[row, 3] = way_u * weights[0], -way_v * weights[0]
        columns[row + 1, 2], columns[row + 1, 3] = way_v * weights[0], way_u * weights[0]
        row += 2
        if pixels[k, 2] == pixels[k, 2]:
            columns[row, 0], columns[row, 1], columns[row, 4] = weights[1], disparities[k] * weights[1], weights[1]
            row += 1


@kernel
def _disparities_of(
    point: Array, rotations: Array, positions: Array, seen: NDArray[np.int64], focal_base: float
) -> Array:
    out = np.empty(len(seen))
    for k in range(len(seen)):
        turn, centre = rotations[seen[k]], positions[seen[k]]
        depth = 0.0
        for b in range(3):
            depth += turn[b, 2] * (point[b] - centre[b])
        out[k] = focal_base / depth
    return out


@kernel
def _gather(covariance: Array, index: NDArray[np.int64]) -> Array:
    out = np.empty((len(index), len(index)))
    for a in range(len(index)):
        for b in range(len(index)):
            out[a, b] = covariance[index[a], index[b]]
    return out


@kernel
def _columns_of(seen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where a track's columns lie among the errors: six for each clone, then the rig's two, which come first there."""
    n = len(seen)
    index = np.empty(6 * n + 2, np.int64)
    for k in range(n):
        for a in range(6):
            index[6 * k + a] = 2 + 6 * seen[k] + a
    index[6 * n], index[6 * n + 1] = 0, 1
    return index


@kernel
def share_that_passes(limit: float, mean_square: float) -> float:
    """Of a normal error's variance, what is left among those whose square stays below the limit (truncated normal)."""
    if mean_square * 40.0 < limit:
        return 1.0
    if limit < 1e-3 * mean_square:
        return limit / (3.0 * mean_square)
    edge = math.sqrt(limit / mean_square)
    density = math.exp(-0.5 * edge * edge) / math.sqrt(2.0 * math.pi)
    return 1.0 - 2.0 * edge * density / math.erf(edge / math.sqrt(2.0))


class Clones(NamedTuple):
    """Bodies of M clones: rotations (M, 3, 3) and positions (M, 3) of odom_from_body; body_from_cam (4, 4)."""

    rotations: Array
    positions: Array
    body_from_cam: Array


class Tracks(NamedTuple):
    """T tracks: starts (T + 1,) delimits each one's rows of clones (n,) and pixels (n, 3) u_left v u_right (NaN none).

    first_points (T, 3): where triangulation starts, in the camera of clone anchors (T,).
    """

    starts: NDArray[np.int64]
    clones: NDArray[np.int64]
    pixels: Array
    anchors: NDArray[np.int64]
    first_points: Array


class PixelModel(NamedTuple):
    """camera: focal, cx, cy, focal * baseline; weights (2,): 1/sigma of pixels and of disparity.

    noise (4,): variance that the whitened rows really have, and sigmas of a track's own errors as in `add_error_sources`,
    of which what passes the gate counts (`share_that_passes`). normal_quantile: of the gate's share.
    """

    camera: Array
    weights: Array
    noise: Array
    normal_quantile: float


class NormalEquations(NamedTuple):
    """vector (6 M,) = information (6 M, 2 + 6 M) @ (disparity offset, depth scale, clones' errors) + noise.

    scatter (6 M, 6 M) is the covariance that the noise really has.
    """

    information: Array
    scatter: Array
    vector: Array


@kernel
def accumulate_tracks(
    bodies: Clones,
    tracks: Tracks,
    model: PixelModel,
    clone_covariance: Array,
    moved: Array,
    equations: NormalEquations,
    used: NDArray[np.int8],
) -> None:
    """Adds every track that passes its gate to the normal equations of the clone errors, points projected out.

    clone_covariance (6 M, 6 M) in the error of this module, order rotation then position. moved (6 M,): how far the
    clones given here stand from the prior mean, when an iterated filter relinearises. used (T,) becomes 1 for a track
    that was taken, 0 for one that could not be triangulated and -1 for one that failed its gate.
    Source: Mourikis and Roumeliotis 2007, equations 23 to 26 (null space of the point).
    """
    starts, camera, weights, noise = tracks.starts, model.camera, model.weights, model.noise
    information, scatter, vector = equations.information, equations.scatter, equations.vector
    count = len(bodies.positions)
    rotations, positions = np.empty((count, 3, 3)), np.empty((count, 3))
    for m in range(count):
        rotations[m] = matmul(bodies.rotations[m], bodies.body_from_cam[:3, :3])
        positions[m] = rotate(bodies.rotations[m], bodies.body_from_cam[:3, 3]) + bodies.positions[m]
    for t in range(len(starts) - 1):
        seen = tracks.clones[starts[t] : starts[t + 1]]
        measured = tracks.pixels[starts[t] : starts[t + 1]]
        anchor = tracks.anchors[t]
        point = rotate(rotations[anchor], tracks.first_points[t]) + positions[anchor]
        used[t] = 0
        if not triangulate(rotations, positions, seen, measured, camera, weights, point):
            continue
        n = len(seen)
        by_error, by_point, residual = np.zeros((3 * n, 6 * n + 5)), np.zeros((3 * n, 3)), np.zeros(3 * n)
        rows = linearize_track(
            point, rotations, positions, seen, measured, camera, weights, by_error, by_point, residual
        )
        dof = rows - 3
        if dof < 1:
            continue
        disparities = _disparities_of(point, rotations, positions, seen, camera[3])
        add_error_sources(measured, disparities, weights, by_error[:, 6 * n :])
        _project_out(by_point, by_error, residual, rows)
        by_clone = np.ascontiguousarray(by_error[3:rows, : 6 * n])
        by_state = np.ascontiguousarray(by_error[3:rows, : 6 * n + 2])
        own = np.ascontiguousarray(by_error[3:rows, 6 * n + 2 :])
        own *= noise[1:]
        left = residual[3:rows].copy()
        index = _columns_of(seen)
        for row in range(dof):
            for a in range(6 * n):
                left[row] += by_clone[row, a] * moved[index[a] - 2]
        small = _gather(clone_covariance, index[: 6 * n] - 2)
        innovation = matmul_nt(matmul(by_clone, small), by_clone)
        for a in range(dof):
            innovation[a, a] += 1.0
        whitened = left.copy()
        if not cholesky_in_place(innovation):
            continue
        forward_substitute(innovation, whitened)
        limit = _chi_square_limit(dof, model.normal_quantile)
        if (whitened * whitened).sum() > limit:
            used[t] = -1
            continue
        used[t] = 1
        for k in range(3):
            column = own[:, k].copy()
            forward_substitute(innovation, column)
            own[:, k] *= math.sqrt(share_that_passes(limit, (column * column).sum()))
        gained, carried = matmul(by_clone.T, by_state), matmul(by_clone.T, own)
        for a in range(6 * n):
            to = index[a] - 2
            for row in range(dof):
                vector[to] += by_clone[row, a] * left[row]
            for b in range(6 * n + 2):
                information[to, index[b]] += gained[a, b]
            for b in range(6 * n):
                total = noise[0] * gained[a, b]
                for k in range(3):
                    total += carried[a, k] * carried[b, k]
                scatter[to, index[b] - 2] += total


@kernel
def _project_out(by_point: Array, by_clone: Array, residual: Array, rows: int) -> None:
    """Householder on the three point columns, applied to everything: rows 3.. no longer depend on the point."""
    columns = by_clone.shape[1]
    for k in range(3):
        norm = 0.0
        for i in range(k, rows):
            norm += by_point[i, k] * by_point[i, k]
        norm = np.sqrt(norm)
        if norm < 1e-12:
            continue
        alpha = -norm if by_point[k, k] > 0 else norm
        v = np.zeros(rows)
        v[k] = by_point[k, k] - alpha
        for i in range(k + 1, rows):
            v[i] = by_point[i, k]
        beta = 0.0
        for i in range(k, rows):
            beta += v[i] * v[i]
        beta = 2.0 / beta
        for c in range(k, 3):
            dot = 0.0
            for i in range(k, rows):
                dot += v[i] * by_point[i, c]
            for i in range(k, rows):
                by_point[i, c] -= beta * dot * v[i]
        for c in range(columns):
            dot = 0.0
            for i in range(k, rows):
                dot += v[i] * by_clone[i, c]
            if dot != 0.0:
                for i in range(k, rows):
                    by_clone[i, c] -= beta * dot * v[i]
        dot = 0.0
        for i in range(k, rows):
            dot += v[i] * residual[i]
        for i in range(k, rows):
            residual[i] -= beta * dot * v[i]
