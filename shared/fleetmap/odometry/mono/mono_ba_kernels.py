"""Bundle adjustment of a small window of one camera's views: dense, for some ten views and some hundred points."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import exp_so3, matmul, solve_spd

_NEAR = 1e-3


@kernel
def project(
    rotation: Array, position: Array, point: Array, camera: Array, pixel: Array, by_view: Array, by_point: Array
) -> bool:
    """Pixel (2,) of a point with derivatives (2, 6) by the view and (2, 3) by the point; False behind the camera.

    rotation (3, 3) map_from_cam, position (3,). The view is perturbed as R <- Exp(rot) R, p <- p + trans, both in map axes.
    """
    away = point - position
    y = np.zeros(3)
    for a in range(3):
        for b in range(3):
            y[a] += rotation[b, a] * away[b]
    if y[2] < _NEAR:
        return False
    inverse = 1.0 / y[2]
    for row in range(2):
        pixel[row] = camera[0] * y[row] * inverse + camera[1 + row]
        for b in range(3):
            by_point[row, b] = camera[0] * inverse * (rotation[b, row] - y[row] * inverse * rotation[b, 2])
    for row in range(2):
        j0, j1, j2 = by_point[row, 0], by_point[row, 1], by_point[row, 2]
        by_view[row, 0] = j1 * away[2] - j2 * away[1]
        by_view[row, 1] = j2 * away[0] - j0 * away[2]
        by_view[row, 2] = j0 * away[1] - j1 * away[0]
        by_view[row, 3], by_view[row, 4], by_view[row, 5] = -j0, -j1, -j2
    return True


@kernel
def window_cost(
    rotations: Array,
    positions: Array,
    points: Array,
    starts: NDArray[np.int64],
    views: NDArray[np.int64],
    pixels: Array,
    camera: Array,
    sigma_px: float,
    width: float,
    squared: Array,
) -> float:
    """Half the robust (Huber, `width` sigmas) sum of squares; squared (M,) sigmas of each observation, huge behind a camera."""
    seen, by_view, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    cost = 0.0
    for n in range(len(points)):
        for m in range(starts[n], starts[n + 1]):
            if not project(rotations[views[m]], positions[views[m]], points[n], camera, seen, by_view, by_point):
                squared[m] = 1e6
            else:
                squared[m] = ((pixels[m, 0] - seen[0]) ** 2 + (pixels[m, 1] - seen[1]) ** 2) / sigma_px**2
            off = np.sqrt(squared[m])
            cost += 0.5 * squared[m] if off < width else width * (off - 0.5 * width)
    return cost


@kernel
def adjust_window(
    rotations: Array,
    positions: Array,
    held: NDArray[np.bool_],
    points: Array,
    starts: NDArray[np.int64],
    views: NDArray[np.int64],
    pixels: Array,
    camera: Array,
    sigma_px: float,
    width: float,
    iterations: int,
    squared: Array,
) -> float:
    """Moves views and points (in place) to the nearest optimum by Levenberg-Marquardt; returns the cost of `window_cost`.

    rotations (V, 3, 3) map_from_cam, positions (V, 3), held (V,); starts (N + 1,) delimits each point's rows of views (M,) and
    pixels (M, 2); camera: focal, cx, cy. The Schur complement over the points is solved dense. Source: Triggs et al. 2000.
    """
    slots, count = np.full(len(held), -1, np.int64), 0
    for k in range(len(held)):
        if not held[k]:
            slots[k] = count
            count += 1
    cost = window_cost(rotations, positions, points, starts, views, pixels, camera, sigma_px, width, squared)
    damping = 1e-4
    seen, by_view, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    total = len(views)
    for _ in range(iterations):
        cross = np.zeros((total, 6, 3))
        hessian, gradient = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
        point_hessian, point_gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for n in range(len(points)):
            for m in range(starts[n], starts[n + 1]):
                v = views[m]
                if not project(rotations[v], positions[v], points[n], camera, seen, by_view, by_point):
                    continue
                weight = 1.0 / sigma_px**2
                off = np.sqrt(squared[m])
                if off > width:
                    weight *= width / off
                at = 6 * slots[v]
                for row in range(2):
                    residual = pixels[m, row] - seen[row]
                    for a in range(3):
                        point_gradient[n, a] += weight * by_point[row, a] * residual
                        for b in range(3):
                            point_hessian[n, a, b] += weight * by_point[row, a] * by_point[row, b]
                    if slots[v] < 0:
                        continue
                    for a in range(6):
                        gradient[at + a] += weight * by_view[row, a] * residual
                        for b in range(6):
                            hessian[at + a, at + b] += weight * by_view[row, a] * by_view[row, b]
                        for b in range(3):
                            cross[m, a, b] += weight * by_view[row, a] * by_point[row, b]
        improved = False
        for _attempt in range(8):
            step, shifts, solved = _solve(
                hessian, gradient, point_hessian, point_gradient, cross, starts, views, slots, damping
            )
            if solved:
                new_rotations, new_positions = rotations.copy(), positions.copy()
                for k in range(len(held)):
                    if slots[k] >= 0:
                        at = 6 * slots[k]
                        new_rotations[k] = matmul(exp_so3(step[at : at + 3]), rotations[k])
                        new_positions[k] = positions[k] + step[at + 3 : at + 6]
                new_points = points + shifts
                new_cost = window_cost(
                    new_rotations, new_positions, new_points, starts, views, pixels, camera, sigma_px, width, squared
                )
                if new_cost < cost:
                    improved = True
                    break
            damping *= 10.0
        if not improved:
            break
        rotations[:], positions[:], points[:] = new_rotations, new_positions, new_points
        small = cost - new_cost < 1e-5 * cost
        cost = new_cost
        damping = max(damping * 0.1, 1e-9)
        if small:
            break
    return window_cost(rotations, positions, points, starts, views, pixels, camera, sigma_px, width, squared)


@kernel
def _solve(
    hessian: Array,
    gradient: Array,
    point_hessian: Array,
    point_gradient: Array,
    cross: Array,
    starts: NDArray[np.int64],
    views: NDArray[np.int64],
    slots: NDArray[np.int64],
    damping: float,
) -> tuple[Array, Array, bool]:
    """The damped step of views (6 F,) and points (N, 3), points eliminated first."""
    size, count = len(gradient), len(point_gradient)
    reduced, right = hessian.copy(), gradient.copy()
    for a in range(size):
        reduced[a, a] += damping * hessian[a, a] + 1e-9
    inverses, shifts = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for n in range(count):
        _invert_damped(point_hessian[n], damping, inverses[n])
        for m in range(starts[n], starts[n + 1]):
            p = 6 * slots[views[m]]
            if p < 0:
                continue
            carried = matmul(cross[m], inverses[n])
            for a in range(6):
                for b in range(3):
                    right[p + a] -= carried[a, b] * point_gradient[n, b]
            for other in range(starts[n], starts[n + 1]):
                q = 6 * slots[views[other]]
                if q < 0:
                    continue
                for a in range(6):
                    for b in range(6):
                        for c in range(3):
                            reduced[p + a, q + b] -= carried[a, c] * cross[other, b, c]
    solved = True
    if size > 0:
        solved = solve_spd(reduced, right)
    for n in range(count):
        pull = point_gradient[n].copy()
        for m in range(starts[n], starts[n + 1]):
            p = 6 * slots[views[m]]
            if p >= 0:
                for b in range(3):
                    for a in range(6):
                        pull[b] -= cross[m, a, b] * right[p + a]
        for a in range(3):
            for b in range(3):
                shifts[n, a] += inverses[n, a, b] * pull[b]
    return right, shifts, solved


@kernel
def _invert_damped(matrix: Array, damping: float, out: Array) -> None:
    """Inverse (3, 3) of a symmetric matrix whose diagonal is raised by `damping` of itself; zero where that is singular."""
    a, b, c = matrix[0, 0] * (1 + damping) + 1e-12, matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1] * (1 + damping) + 1e-12, matrix[1, 2], matrix[2, 2] * (1 + damping) + 1e-12
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    if not determinant > 0.0:
        return
    out[0, 0] = (d * f - e * e) / determinant
    out[0, 1] = out[1, 0] = (c * e - b * f) / determinant
    out[0, 2] = out[2, 0] = (b * e - c * d) / determinant
    out[1, 1] = (a * f - c * c) / determinant
    out[1, 2] = out[2, 1] = (b * c - a * e) / determinant
    out[2, 2] = (a * d - b * b) / determinant
