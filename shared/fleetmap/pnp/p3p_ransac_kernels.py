"""Inner loops of RANSAC with a three-point pose solver (P3P)."""

import math

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

_NEAR = 1e-9
_PIXEL_NEAR = 0.05


@kernel
def real_roots(a: float, b: float, c: float, d: float, e: float, roots: Array) -> int:
    """Number of real roots of a x^4 + b x^3 + c x^2 + d x + e, which go into roots (4,); double ones may be missed by rounding.

    Source: Ferrari's method by the largest root of the resolvent cubic, then Newton's.
    """
    if abs(a) < 1e-12 * (abs(b) + abs(c) + abs(d) + abs(e)):
        return 0
    b, c, d, e = b / a, c / a, d / a, e / a
    shift = 0.25 * b
    p = c - 6.0 * shift * shift
    q = d - 2.0 * c * shift + 8.0 * shift**3
    r = e - d * shift + c * shift * shift - 3.0 * shift**4
    # 8 m^3 + 8 p m^2 + (2 p^2 - 8 r) m - q^2 = 0, whose largest root is not negative
    b2, b1, b0 = p, 0.25 * p * p - r, -0.125 * q * q
    third = b2 / 3.0
    s, t = b1 / 3.0 - third * third, third**3 - 0.5 * third * b1 + 0.5 * b0
    discriminant = s**3 + t * t
    if discriminant > 0.0:
        side = math.sqrt(discriminant)
        m = np.cbrt(-t + side) + np.cbrt(-t - side) - third
    else:
        angle = math.acos(min(max(-t / math.sqrt(max(-(s**3), 1e-300)), -1.0), 1.0))
        m = 2.0 * math.sqrt(max(-s, 0.0)) * math.cos(angle / 3.0) - third
    count = 0
    if m <= 1e-14 * (abs(p) + math.sqrt(abs(r))):
        inner = p * p - 4.0 * r
        if inner < 0.0:
            return 0
        for sign in (-1.0, 1.0):
            squared = 0.5 * (-p + sign * math.sqrt(inner))
            if squared >= 0.0:
                roots[count], roots[count + 1] = math.sqrt(squared) - shift, -math.sqrt(squared) - shift
                count += 2
    else:
        half = math.sqrt(2.0 * m)
        for sign in (-1.0, 1.0):
            inner = -(2.0 * p + 2.0 * m + sign * 2.0 * q / half)
            if inner >= 0.0:
                side = math.sqrt(inner)
                roots[count], roots[count + 1] = 0.5 * (sign * half + side) - shift, 0.5 * (sign * half - side) - shift
                count += 2
    for k in range(count):
        for _ in range(2):
            x = roots[k]
            slope = ((4.0 * x + 3.0 * b) * x + 2.0 * c) * x + d
            if slope != 0.0:
                roots[k] = x - ((((x + b) * x + c) * x + d) * x + e) / slope
    return count


@kernel
def _frame(points: Array, axes: Array) -> bool:
    """Axes (3, 3), in columns, that three points (3, 3), in rows, stand for; False where they lie in a line."""
    x0, x1, x2 = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    y0, y1, y2 = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    x, z = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2), math.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    y = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    if not z > 1e-4 * x * y:
        return False
    x0, x1, x2, z0, z1, z2 = x0 / x, x1 / x, x2 / x, z0 / z, z1 / z, z2 / z
    axes[0, 0], axes[1, 0], axes[2, 0] = x0, x1, x2
    axes[0, 1], axes[1, 1], axes[2, 1] = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    axes[0, 2], axes[1, 2], axes[2, 2] = z0, z1, z2
    return True


@kernel
def three_point(points: Array, rays: Array, rotations: Array, translations: Array) -> int:
    """Number of cameras that see three points (3, 3) along unit rays (3, 3) of theirs: up to four cam_from_source.

    They go into rotations (4, 3, 3) and translations (4, 3). Source: Grunert 1841, as in Haralick et al. 1994.
    """
    source, seen, axes = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    if not _frame(points, source):
        return 0
    squares, cosines = np.zeros(3), np.zeros(3)  # across from the first point, the second, the third
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for a in range(3):
            squares[k] += (points[i, a] - points[j, a]) ** 2
            cosines[k] += rays[i, a] * rays[j, a]
    ca, cb, cg = cosines[0], cosines[1], cosines[2]
    aa, cc = squares[0] / squares[1], squares[2] / squares[1]
    d, s = aa - cc, aa + cc
    roots = np.empty(4)
    found = real_roots(
        (d - 1.0) ** 2 - 4.0 * cc * ca * ca,
        4.0 * (d * (1.0 - d) * cb - (1.0 - s) * ca * cg + 2.0 * cc * ca * ca * cb),
        2.0 * (d * d - 1.0 + 2.0 * d * d * cb * cb + 2.0 * (1.0 - cc) * ca * ca - 4.0 * s * ca * cb * cg + 2.0 * (1.0 - aa) * cg * cg),
        4.0 * (-d * (1.0 + d) * cb + 2.0 * aa * cg * cg * cb - (1.0 - s) * ca * cg),
        (1.0 + d) ** 2 - 4.0 * aa * cg * cg,
        roots,
    )  # fmt: skip
    count = 0
    for k in range(found):
        v = roots[k]
        below = 2.0 * (cg - v * ca)
        if v <= 0.0 or abs(below) < _NEAR:
            continue
        u = ((d - 1.0) * v * v - 2.0 * d * cb * v + 1.0 + d) / below
        spread = 1.0 + v * v - 2.0 * v * cb
        if u <= 0.0 or spread < _NEAR:
            continue
        first = math.sqrt(squares[1] / spread)
        for a in range(3):
            seen[0, a], seen[1, a], seen[2, a] = first * rays[0, a], first * u * rays[1, a], first * v * rays[2, a]
        if not _frame(seen, axes):
            continue
        for a in range(3):
            translations[count, a] = seen[0, a]
            for b in range(3):
                total = 0.0
                for c in range(3):
                    total += axes[a, c] * source[b, c]
                rotations[count, a, b] = total
            for b in range(3):
                translations[count, a] -= rotations[count, a, b] * points[0, b]
        count += 1
    return count


@kernel
def votes(
    rotation: Array, translation: Array, points: Array, pixels: Array, camera: Array, threshold_px: float, least: int
) -> int:
    """How many points (N, 3) a camera sees within the threshold of their pixels (N, 2); 0 where it cannot be more than `least`."""
    count, size = 0, len(points)
    for n in range(size):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if depth > _PIXEL_NEAR:
            u = camera[0] * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]) / depth
            v = camera[0] * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]) / depth
            u, v = u + camera[1] - pixels[n, 0], v + camera[2] - pixels[n, 1]
            if u * u + v * v < threshold_px * threshold_px:
                count += 1
        if count + size - 1 - n <= least:
            return 0
    return count


@kernel
def search(
    points: Array,
    pixels: Array,
    camera: Array,
    threshold_px: float,
    draws: Array,
    confidence: float,
    rotation: Array,
    translation: Array,
) -> int:
    """Votes of the best cam_from_source, which goes into rotation (3, 3) and translation (3,); 0 where none was found.

    points (N, 3) source, pixels (N, 2), N >= 3. draws (I, 3) in [0, 1): which three propose; fewer are tried once the best camera
    is the best of all with that confidence. Source: Fischler and Bolles 1981.
    """
    size, best = len(points), 0
    rays = np.empty((size, 3))
    for n in range(size):
        x, y = (pixels[n, 0] - camera[1]) / camera[0], (pixels[n, 1] - camera[2]) / camera[0]
        length = math.sqrt(x * x + y * y + 1.0)
        rays[n, 0], rays[n, 1], rays[n, 2] = x / length, y / length, 1.0 / length
    three, along = np.empty((3, 3)), np.empty((3, 3))
    rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
    needed = float(len(draws))
    tried = 0
    while tried < needed:
        i, j, k = int(draws[tried, 0] * size), int(draws[tried, 1] * (size - 1)), int(draws[tried, 2] * (size - 2))
        tried += 1
        if j >= i:
            j += 1
        if k >= min(i, j):
            k += 1
        if k >= max(i, j):
            k += 1
        for a in range(3):
            three[0, a], three[1, a], three[2, a] = points[i, a], points[j, a], points[k, a]
            along[0, a], along[1, a], along[2, a] = rays[i, a], rays[j, a], rays[k, a]
        for m in range(three_point(three, along, rotations, translations)):
            count = votes(rotations[m], translations[m], points, pixels, camera, threshold_px, best)
            if count > best:
                best = count
                rotation[:, :], translation[:] = rotations[m], translations[m]
                miss = 1.0 - (best / size) ** 3
                if miss <= 0.0:
                    return best
                needed = min(needed, math.log(1.0 - confidence) / math.log(miss))
    return best
