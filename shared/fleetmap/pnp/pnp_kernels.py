"""Inner loops of PnP: least squares, and the search for a translation with a known rotation."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import cholesky_in_place, exp_so3, solve_spd


@kernel
def linearize(
    rotation: Array,
    translation: Array,
    points: Array,
    pixels: Array,
    weights: Array,
    camera: Array,
    width: float,
    hessian: Array,
    gradient: Array,
    squared: Array,
) -> float:
    """Robust cost, normal equations (6, 6), (6,) and squared normalised residuals (N,) of a camera.

    cam_from_source = (rotation, translation).     points (N, 3) in the source frame; pixels (N, 3) u_left v u_right
    (NaN none); weights (N, 2) 1/sigma of u and v, of the disparity. camera: focal, cx, cy, focal * baseline. The step
    is rotation first, applied from the left in camera axes. Robust by the redescending weight of Geman and McClure,
    `width` in sigmas: gross outliers have no weight.
    """
    cost = 0.0
    hessian[:, :] = 0.0
    gradient[:] = 0.0
    j = np.empty((3, 6))
    r = np.empty(3)
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0]
        y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1]
        z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2]
        squared[n] = 1e12
        if z < 0.05:
            cost += 0.5 * width * width
            continue
        i = 1.0 / z
        stereo = pixels[n, 2] == pixels[n, 2] and camera[3] > 0.0
        w, wd = weights[n, 0], weights[n, 1] if stereo else 0.0
        r[0] = (camera[0] * x * i + camera[1] - pixels[n, 0]) * w
        r[1] = (camera[0] * y * i + camera[2] - pixels[n, 1]) * w
        r[2] = (camera[3] * i - (pixels[n, 0] - pixels[n, 2])) * wd if stereo else 0.0
        for a in range(3):
            if a == 0:
                g0, g1, g2 = camera[0] * i * w, 0.0, -camera[0] * x * i * i * w
            elif a == 1:
                g0, g1, g2 = 0.0, camera[0] * i * w, -camera[0] * y * i * i * w
            else:
                g0, g1, g2 = 0.0, 0.0, -camera[3] * i * i * wd
            j[a, 0], j[a, 1], j[a, 2] = g2 * y - g1 * z, g0 * z - g2 * x, g1 * x - g0 * y
            j[a, 3], j[a, 4], j[a, 5] = g0, g1, g2
        e2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        squared[n] = e2
        damped = width * width / (width * width + e2)
        robust = damped * damped
        cost += 0.5 * e2 * damped
        for a in range(6):
            gradient[a] -= robust * (j[0, a] * r[0] + j[1, a] * r[1] + j[2, a] * r[2])
            for b in range(6):
                hessian[a, b] += robust * (j[0, a] * j[0, b] + j[1, a] * j[1, b] + j[2, a] * j[2, b])
    return cost


@kernel
def refine(
    rotation: Array,
    translation: Array,
    points: Array,
    pixels: Array,
    weights: Array,
    camera: Array,
    width: float,
    prior: Array,
    iterations: int,
    hessian: Array,
    squared: Array,
) -> bool:
    """Levenberg-Marquardt from a start, in place; leaves the last Hessian and squared residuals.

    False where it is singular.
    prior (6, 6): information that holds the start (zeros for none).
    """
    gradient, step = np.empty(6), np.empty(6)
    trial_hessian = np.empty((6, 6))
    moved = np.zeros(6)
    damping = 1e-4
    cost = linearize(rotation, translation, points, pixels, weights, camera, width, hessian, gradient, squared)
    for a in range(6):
        for b in range(6):
            cost += 0.5 * moved[a] * prior[a, b] * moved[b]
    for _ in range(iterations):
        accepted = False
        for _ in range(5):
            for a in range(6):
                step[a] = gradient[a]
                for b in range(6):
                    trial_hessian[a, b] = hessian[a, b] + prior[a, b]
                    step[a] -= prior[a, b] * moved[b]
                trial_hessian[a, a] += damping * hessian[a, a] + 1e-9
            if not solve_spd(trial_hessian, step):
                return False
            turn = exp_so3(step[:3])
            new_rotation, new_translation = np.empty((3, 3)), np.empty(3)
            for a in range(3):
                new_translation[a] = step[3 + a]
                for b in range(3):
                    new_translation[a] += turn[a, b] * translation[b]
                    new_rotation[a, b] = (
                        turn[a, 0] * rotation[0, b] + turn[a, 1] * rotation[1, b] + turn[a, 2] * rotation[2, b]
                    )
            new_moved = moved + step
            new_cost = linearize(
                new_rotation, new_translation, points, pixels, weights, camera, width, trial_hessian, gradient, squared
            )
            for a in range(6):
                for b in range(6):
                    new_cost += 0.5 * new_moved[a] * prior[a, b] * new_moved[b]
            if new_cost <= cost:
                accepted = True
                break
            damping *= 10.0
            linearize(rotation, translation, points, pixels, weights, camera, width, hessian, gradient, squared)
        if not accepted:
            break
        gain = cost - new_cost
        rotation[:, :] = new_rotation
        translation[:] = new_translation
        hessian[:, :] = trial_hessian
        moved = new_moved
        cost = new_cost
        damping = max(0.1 * damping, 1e-9)
        if gain < 1e-6 * (cost + 1e-9):
            break
    linearize(rotation, translation, points, pixels, weights, camera, width, hessian, gradient, squared)
    check = hessian + prior
    return bool(cholesky_in_place(check))


@kernel
def refine_twice(
    rotation: Array,
    translation: Array,
    points: Array,
    pixels: Array,
    weights: Array,
    camera: Array,
    width: float,
    gate_squared: float,
    prior: Array,
    iterations: tuple[int, int],
    hessian: Array,
    squared: Array,
) -> bool:
    """`refine`, and once more on the inliers alone, so that no outlier biases the result; squared residuals are of all points."""
    if not refine(
        rotation, translation, points, pixels, weights, camera, width, prior, iterations[0], hessian, squared
    ):
        return False
    inliers = squared < gate_squared
    count = int(inliers.sum())
    if count < 4:
        return True
    kept, again = (points[inliers], pixels[inliers], weights[inliers]), np.empty(count)
    if not refine(
        rotation, translation, kept[0], kept[1], kept[2], camera, width, prior, iterations[1], hessian, again
    ):
        return False
    linearize(rotation, translation, points, pixels, weights, camera, width, np.empty((6, 6)), np.empty(6), squared)
    return True


@kernel
def search_translation(
    rotation: Array, points: Array, seen_points: Array, pixels: Array, camera: Array, threshold_px: float, best: Array
) -> int:
    """Best translation (3,) for a known rotation, and its inlier count.

    Each correspondence with depth in both views proposes one. points (N, 3) source, seen_points (N, 3) the same in
    the camera by its own stereo (NaN none), pixels (N, 2) in the camera.
    """
    count, best_score = len(points), 0
    turned = np.empty((count, 3))
    for n in range(count):
        for a in range(3):
            turned[n, a] = rotation[a, 0] * points[n, 0] + rotation[a, 1] * points[n, 1] + rotation[a, 2] * points[n, 2]
    for k in range(count):
        if np.isnan(seen_points[k, 2]):
            continue
        own, seen = turned[k], seen_points[k]
        tx, ty, tz = seen[0] - own[0], seen[1] - own[1], seen[2] - own[2]
        score = 0
        for n in range(count):
            z = turned[n, 2] + tz
            if z < 0.05:
                continue
            du = camera[0] * (turned[n, 0] + tx) / z + camera[1] - pixels[n, 0]
            dv = camera[0] * (turned[n, 1] + ty) / z + camera[2] - pixels[n, 1]
            if du * du + dv * dv < threshold_px * threshold_px:
                score += 1
        if score > best_score:
            best_score = score
            best[0], best[1], best[2] = tx, ty, tz
    return best_score
