"""The light that a sample receives: filtered texture times dirt times baked light, and the polished floor's reflection.

Nothing here calls the maths library (square roots apart) or reorders sums, so the same bits come out on every machine.
Helpers and caller share this file because numba's cache does not see changes in other files.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import inline_kernel, uncounted_inner_kernel, uncounted_kernel

Float = NDArray[np.float64]
Int32 = NDArray[np.int32]
Bytes = NDArray[np.uint8]
# A multiple of every texture size, less half a texel: keeps coordinates positive, so that truncation is floor.
_WRAP = 1048575.5
_GLOSS = 9.0  # footprint area of a reflection: the polish is not perfect
_JOINT_M = 4.4
_MOST_SAMPLES = 16  # of a pixel


class Surfaces(NamedTuple):
    """All that is painted: columns of faces as in `Faces` with their light at this moment, textures as in `Atlas`.

    groups (3,): strengths of the lamp groups. decals (rows, columns): texture * 4 + quarter turns of each cell of the
    floor, -1 for none. floor (2,): numbers of the coarse concrete and the dirt texture.
    """

    quads: Float
    values: Float
    numbers: Int32
    light: NDArray[np.float32]
    groups: Float
    texels: Bytes
    table: Int32
    decals: Int32
    floor: Int32


class Visible(NamedTuple):
    """Visible polygons: owner (H S, W S) is the one of each sample; homographies and face of each."""

    owner: Int32
    homographies: Float
    face_of: Int32


class Instant(NamedTuple):
    """One instant of an exposure: samples per pixel side, shift of the samples (2,) in pixels, weight in the picture.

    most_taps, reflectance as in `Look`. wants_truth: whether depth and faces are filled.
    """

    samples: int
    shift: Float
    weight: float
    most_taps: int
    reflectance: float
    wants_truth: bool


class Canvas(NamedTuple):
    """A picture in the making (H, W): radiance, depth along the optical axis, face of each pixel (-1 for nothing).

    seen, hits, sum_x, sum_y (16,): room for the polygons of one pixel.
    """

    radiance: Float
    depth_m: NDArray[np.float32]
    faces: Int32
    seen: Int32
    hits: Int32
    sum_x: Float
    sum_y: Float

    @classmethod
    def empty(cls, height: int, width: int) -> "Canvas":
        """One that shows nothing yet."""
        seen, hits = np.empty(_MOST_SAMPLES, np.int32), np.empty(_MOST_SAMPLES, np.int32)
        sum_x, sum_y = np.empty(_MOST_SAMPLES), np.empty(_MOST_SAMPLES)
        depth_m, faces = np.zeros((height, width), np.float32), np.full((height, width), -1, np.int32)
        return cls(np.zeros((height, width)), depth_m, faces, seen, hits, sum_x, sum_y)


@inline_kernel
def bilinear(
    texels: Bytes, offset: np.uint64, log_width: np.uint64, log_height: np.uint64, x: float, y: float
) -> float:
    """Bilinear look-up with wrap-around; x, y in texels of the level that starts at `offset`."""
    x += _WRAP
    y += _WRAP
    # By way of signed numbers: without AVX-512 a processor has no conversion to unsigned ones.
    whole_x, whole_y = np.int64(x), np.int64(y)
    column, row = np.uint64(whole_x), np.uint64(whole_y)
    share_x, share_y = x - np.float64(whole_x), y - np.float64(whole_y)
    one = np.uint64(1)
    mask_x, mask_y = (one << log_width) - one, (one << log_height) - one
    x0, x1 = column & mask_x, (column + one) & mask_x
    y0, y1 = offset + ((row & mask_y) << log_width), offset + (((row + one) & mask_y) << log_width)
    upper, lower = np.float64(np.int32(texels[y0 + x0])), np.float64(np.int32(texels[y1 + x0]))
    upper += (np.float64(np.int32(texels[y0 + x1])) - upper) * share_x
    lower += (np.float64(np.int32(texels[y1 + x1])) - lower) * share_x
    return upper + (lower - upper) * share_y


@uncounted_inner_kernel
def sample(
    surfaces: Surfaces,
    texture: int,
    x: float,
    y: float,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    most_taps: int,
    area: float,
    is_trilinear: bool,
) -> float:
    """Texture at (x, y) filtered over the pixel's footprint (ax, ay), (bx, by), all in texels of level 0.

    Up to `most_taps` taps along the footprint's long axis, each from the nearest level; with one tap two levels are
    blended. area: factor on the footprint's area.
    """
    texels, table = surfaces.texels, surfaces.table
    longer, shorter = ax * ax + ay * ay, bx * bx + by * by
    if longer < shorter:
        ax, ay = bx, by
        longer, shorter = shorter, longer
    taps = 1
    extent = longer
    if longer > 1.0 and most_taps > 1 and longer > 2.9 * shorter:
        taps = 2
        if most_taps > 2 and longer > 6.3 * max(shorter, 1.0):
            taps = 3
            if most_taps > 3 and longer > 12.0 * max(shorter, 1.0):
                taps = 4
        extent = max(shorter, longer * (0.25 if taps == 2 else (1.0 / 9.0 if taps == 3 else 0.0625)))
    extent *= 0.8 * area
    level = 0
    scale = 1.0
    while extent >= 4.0 and level < 10:
        extent *= 0.25
        level += 1
        scale *= 0.5
    one_tap_blend = taps == 1 and is_trilinear
    if not one_tap_blend and extent > 2.0:
        level += 1
        scale *= 0.5
    full_width, full_height = table[texture, 0], table[texture, 1]
    log_width, log_height = np.uint64(max(full_width - level, 0)), np.uint64(max(full_height - level, 0))
    scale_x, scale_y = scale, scale
    if level > full_width:
        scale_x = 1.0 / (1 << full_width)
    if level > full_height:
        scale_y = 1.0 / (1 << full_height)
    offset = np.uint64(table[texture, 2 + level])
    if taps > 1:
        share = 1.0 / taps
        ax *= share
        ay *= share
        x -= 0.5 * (taps - 1) * ax
        y -= 0.5 * (taps - 1) * ay
        total = 0.0
        for _ in range(taps):
            total += bilinear(texels, offset, log_width, log_height, x * scale_x, y * scale_y)
            x += ax
            y += ay
        return total * share
    value = bilinear(texels, offset, log_width, log_height, x * scale_x, y * scale_y)
    if one_tap_blend and extent > 1.05:
        coarse_width, coarse_height = (
            np.uint64(max(full_width - level - 1, 0)),
            np.uint64(max(full_height - level - 1, 0)),
        )
        if coarse_width < log_width:
            scale_x *= 0.5
        if coarse_height < log_height:
            scale_y *= 0.5
        offset = np.uint64(table[texture, 3 + level])
        coarse = bilinear(texels, offset, coarse_width, coarse_height, x * scale_x, y * scale_y)
        value += (extent - 1.0) * (1.0 / 3.0) * (coarse - value)
    return value


@uncounted_inner_kernel
def joint_factor(distance_m: float, width_texels: float) -> float:
    """Darkening by a saw-cut joint 12 mm wide at distance_m from its centre, filtered over the footprint."""
    blur_m = max(width_texels, 1.0) * 0.0025
    cover = min(1.0, max(0.0, (0.006 + 0.5 * blur_m - distance_m) / blur_m))
    return 1.0 - 0.6 * cover * min(1.0, 0.012 / blur_m)


@uncounted_inner_kernel
def floor_pattern(
    surfaces: Surfaces, x: float, y: float, ax: float, ay: float, bx: float, by: float, most_taps: int, area: float
) -> float:
    """Factor of the concrete's grey at texel (x, y): a coarse second tiling, decals in cells of 1.28 m, joints."""
    shrink = 0.155  # the second tiling is 6.5 times larger and turned by 31 degrees
    cosine, sine = 0.857 * shrink, 0.515 * shrink
    cx, cy, cax, cay = x * cosine - y * sine, x * sine + y * cosine, ax * shrink, ay * shrink
    coarse = sample(surfaces, surfaces.floor[0], cx, cy, cax, cay, bx * shrink, by * shrink, 1, area, False)
    factor = coarse * (1.0 / 128.0)
    decals = surfaces.decals
    column, row = int(x * (1.0 / 512.0)), int(y * (1.0 / 512.0))
    decal = decals[row & (decals.shape[0] - 1), column & (decals.shape[1] - 1)]
    if decal >= 0:
        px, py = 0.5 * (x - column * 512.0), 0.5 * (y - row * 512.0)
        qax, qay, qbx, qby = 0.5 * ax, 0.5 * ay, 0.5 * bx, 0.5 * by
        if decal & 1:
            px, py = py, 256.0 - px
            qax, qay, qbx, qby = qay, -qax, qby, -qbx
        if decal & 2:
            px, py = 256.0 - px, 256.0 - py
        factor *= sample(surfaces, decal >> 2, px, py, qax, qay, qbx, qby, most_taps, area, True) * (1.0 / 128.0)
    x_m, y_m = x * 0.0025, y * 0.0025
    off_x = abs(x_m - _JOINT_M * math.floor(x_m * (1.0 / _JOINT_M) + 0.5))
    off_y = abs(y_m - _JOINT_M * math.floor(y_m * (1.0 / _JOINT_M) + 0.5))
    if off_x < 0.3:
        factor *= joint_factor(off_x, abs(ax) + abs(bx))
    if off_y < 0.3:
        factor *= joint_factor(off_y, abs(ay) + abs(by))
    return factor


@uncounted_inner_kernel
def shade(
    surfaces: Surfaces,
    visible: Visible,
    k: int,
    xn: float,
    yn: float,
    per_px_x: float,
    per_px_y: float,
    most_taps: int,
    area: float,
) -> tuple[float, float, float, float]:
    """Radiance of visible polygon k along the ray (xn, yn, 1), and u, v, 1/z there.

    per_px_x, per_px_y: how far xn and yn move per pixel. area: as in `sample`.
    """
    f, homographies = visible.face_of[k], visible.homographies
    values, numbers, light = surfaces.values, surfaces.numbers, surfaces.light
    # Each entry by itself: a row of the array would be a counted reference, which costs more than the arithmetic.
    h0, h1, h2 = homographies[k, 0], homographies[k, 1], homographies[k, 2]
    h3, h4, h5 = homographies[k, 3], homographies[k, 4], homographies[k, 5]
    h6, h7, h8 = homographies[k, 6], homographies[k, 7], homographies[k, 8]
    w = h6 * xn + h7 * yn + h8
    z = 1.0 / w
    u = (h0 * xn + h1 * yn + h2) * z
    v = (h3 * xn + h4 * yn + h5) * z
    material = numbers[f, 0]
    if material == 2:
        return values[f, 5] * surfaces.groups[numbers[f, 2]], u, v, w
    along_u, along_v = values[f, 0], values[f, 1]
    step_x, step_y = per_px_x * z, per_px_y * z
    ax, ay = (h0 - u * h6) * step_x * along_u, (h3 - v * h6) * step_x * along_v
    bx, by = (h1 - u * h7) * step_y * along_u, (h4 - v * h7) * step_y * along_v
    x, y = u * along_u, v * along_v
    is_floor = material == 1
    if is_floor:
        x += values[f, 3]
        y += values[f, 4]
    grey = sample(surfaces, numbers[f, 1], x, y, ax, ay, bx, by, most_taps, area, True)
    if is_floor:
        grey *= floor_pattern(surfaces, x, y, ax, ay, bx, by, most_taps, area)
    elif area == 1.0:  # a reflection is too blurred to show the dirt
        dirt_x, dirt_y = x + values[f, 3], y + values[f, 4]
        grey *= sample(surfaces, surfaces.floor[1], dirt_x, dirt_y, ax, ay, bx, by, 1, area, False) * (1.0 / 128.0)
    columns, rows = numbers[f, 4], numbers[f, 5]
    p, q = min(max(u, 0.0), 1.0) * (columns - 1), min(max(v, 0.0), 1.0) * (rows - 1)
    i, j = min(int(p), columns - 2), min(int(q), rows - 2)
    p -= i
    q -= j
    first = np.uint64(numbers[f, 3] + j * columns + i)
    stride, one = np.uint64(columns), np.uint64(1)
    upper = light[first] * (1.0 - p) + light[first + one] * p
    lower = light[first + stride] * (1.0 - p) + light[first + stride + one] * p
    received = upper * (1.0 - q) + lower * q
    return grey * (1.0 / 255.0) * values[f, 2] * received, u, v, w


@uncounted_kernel
def shade_image(
    surfaces: Surfaces,
    visible: Visible,
    mirror: Visible,
    instant: Instant,
    pinhole: Float,
    rays: NDArray[np.float32],
    camera_height_m: float,
    shadows: Float,
    canvas: Canvas,
) -> None:
    """Adds an instant's weighted picture to the canvas.

    Samples of one polygon in a pixel are shaded once, at their mean place. mirror: the world reflected in the floor,
    one sample per pixel of the pinhole. rays (H, W, 4): a lens' xn, yn and their change per pixel, empty for a pinhole.
    shadows (M, 3): x, y, 1 / radius^2 of soft contact shadows on the floor.
    """
    samples, shift, weight, most_taps, reflectance, wants_truth = instant
    radiance, depth_m, faces, seen, hits, sum_x, sum_y = canvas
    owner, face_of, mirror_owner = visible.owner, visible.face_of, mirror.owner
    quads, numbers, floor = surfaces.quads, surfaces.numbers, surfaces.floor
    texels, table = surfaces.texels, surfaces.table
    height, width = radiance.shape
    mirror_height, mirror_width = mirror_owner.shape
    has_lens = rays.shape[0] > 0
    per_px_x, per_px_y = 1.0 / pinhole[0], 1.0 / pinhole[1]
    wide_x, wide_y = per_px_x, per_px_y
    step = 1.0 / samples
    for y in range(height):
        for x in range(width):
            first = owner[y * samples, x * samples]
            count = 1
            seen[0], hits[0] = first, samples * samples
            sum_x[0] = 0.5 * (samples - 1) * hits[0]
            sum_y[0] = sum_x[0]
            is_uniform = True
            for i in range(samples):
                for j in range(samples):
                    is_uniform &= owner[y * samples + i, x * samples + j] == first
            if not is_uniform:
                count = 0
                for i in range(samples):
                    for j in range(samples):
                        k = owner[y * samples + i, x * samples + j]
                        n = 0
                        while n < count and seen[n] != k:
                            n += 1
                        if n == count:
                            seen[n], hits[n], sum_x[n], sum_y[n] = k, 0, 0.0, 0.0
                            count += 1
                        hits[n] += 1
                        sum_x[n] += j
                        sum_y[n] += i
            total = 0.0
            for n in range(count):
                k = seen[n]
                if k < 0:
                    continue
                f = face_of[k]
                off_x = (sum_x[n] / hits[n] + 0.5) * step - 0.5
                off_y = (sum_y[n] / hits[n] + 0.5) * step - 0.5
                if has_lens:
                    per_px_x, per_px_y = np.float64(rays[y, x, 2]), np.float64(rays[y, x, 3])
                    xn = np.float64(rays[y, x, 0]) + off_x * per_px_x + shift[0] * wide_x
                    yn = np.float64(rays[y, x, 1]) + off_y * per_px_y + shift[1] * wide_y
                else:
                    xn = (x + off_x + shift[0] - pinhole[2]) * per_px_x
                    yn = (y + off_y + shift[1] - pinhole[3]) * per_px_y
                value, u, v, w = shade(surfaces, visible, k, xn, yn, per_px_x, per_px_y, most_taps, 1.0)
                if numbers[f, 0] == 1:
                    x_map, y_map = quads[f, 0] + u * quads[f, 3], quads[f, 1] + v * quads[f, 7]
                    for s in range(shadows.shape[0]):
                        dx, dy = x_map - shadows[s, 0], y_map - shadows[s, 1]
                        inside = 1.0 - (dx * dx + dy * dy) * shadows[s, 2]
                        if inside > 0.0:
                            value *= 1.0 - 0.55 * inside * inside
                    if reflectance > 0.0:
                        # Schlick's Fresnel term; the cosine of incidence is height over distance.
                        lack = 1.0 - min(camera_height_m * w / math.sqrt(1.0 + xn * xn + yn * yn), 1.0)
                        fresnel = reflectance + (1.0 - reflectance) * lack * lack * lack * lack * lack
                        # A wavy floor: the mirrored pixel moves by a slope read from the coarse tiling.
                        offset, nine = np.uint64(table[floor[0], 2]), np.uint64(9)
                        slope_x = bilinear(texels, offset, nine, nine, x_map * 25.0, y_map * 25.0) - 128.0
                        slope_y = bilinear(texels, offset, nine, nine, y_map * 25.0 + 77.0, x_map * 25.0) - 128.0
                        px = xn * pinhole[0] + pinhole[2] + 0.03 * slope_x
                        py = yn * pinhole[1] + pinhole[3] + 0.10 * slope_y
                        row = min(max(math.floor(py + 0.5), 0), mirror_height - 1)
                        column = min(max(math.floor(px + 0.5), 0), mirror_width - 1)
                        m = mirror_owner[row, column]
                        if m >= 0:
                            mx, my = (px - pinhole[2]) * wide_x, (py - pinhole[3]) * wide_y
                            mirrored, _, _, _ = shade(surfaces, mirror, m, mx, my, per_px_x, per_px_y, 1, _GLOSS)
                            value += fresnel * 0.75 * min(mirrored, 4.0)
                total += value * hits[n]
                if wants_truth and n == 0:
                    depth_m[y, x] = 1.0 / w
                    faces[y, x] = f
            if wants_truth and seen[0] < 0:
                depth_m[y, x] = 0.0
                faces[y, x] = -1
            radiance[y, x] += weight * total * step * step
