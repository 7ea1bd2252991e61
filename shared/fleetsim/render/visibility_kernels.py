"""Visible face of each sample: projection, clipping and scan conversion with a 1/z test.

A view is the array `pinhole` = (fx, fy, cx, cy, width, height) of an undistorted image plane in pixels.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import kernel

Float = NDArray[np.float64]
Int32 = NDArray[np.int32]
NEAR_M = 0.05
MOST_CORNERS = 8


@kernel
def is_box_outside(bounds: Float, sign_z: float, cam_from_map: Float, centre_map: Float, limits: Float) -> bool:
    """Whether a box (6,) lies wholly outside one side of the view pyramid (limits: x/z and y/z, low and high)."""
    behind, left, right, above, below = 0, 0, 0, 0, 0
    for corner in range(8):
        x = bounds[0 if corner & 1 == 0 else 3] - centre_map[0]
        y = bounds[1 if corner & 2 == 0 else 4] - centre_map[1]
        z = sign_z * bounds[2 if corner & 4 == 0 else 5] - centre_map[2]
        cam_x = cam_from_map[0, 0] * x + cam_from_map[0, 1] * y + cam_from_map[0, 2] * z
        cam_y = cam_from_map[1, 0] * x + cam_from_map[1, 1] * y + cam_from_map[1, 2] * z
        cam_z = cam_from_map[2, 0] * x + cam_from_map[2, 1] * y + cam_from_map[2, 2] * z
        behind += cam_z < NEAR_M
        left += cam_x < limits[0] * cam_z
        right += cam_x > limits[1] * cam_z
        above += cam_y < limits[2] * cam_z
        below += cam_y > limits[3] * cam_z
    return behind == 8 or left == 8 or right == 8 or above == 8 or below == 8


@kernel
def project_faces(
    quads: Float,
    ranges: Int32,
    bounds: Float,
    cam_from_map: Float,
    centre_map: Float,
    pinhole: Float,
    is_mirrored: bool,
    homographies: Float,
    polygons: Float,
    corner_counts: Int32,
    face_of: Int32,
) -> int:
    """Number of faces that may be seen; fills one row per such face.

    ranges (C, 2) and bounds (C, 6): faces of each chunk and their bounding box. cam_from_map (3, 3): rotation only.
    is_mirrored: the world reflected in the floor, z -> -z. homographies (F, 9): (u', v', 1/z) = H (x/z, y/z, 1), u = u'
    z. polygons (F, 8, 2): clipped outline in pixels. A face can gain one corner at the near plane.
    """
    count = 0
    sign_z = -1.0 if is_mirrored else 1.0
    limits = np.empty(4)
    limits[0] = (-0.5 - pinhole[2]) / pinhole[0]
    limits[1] = (pinhole[4] - 0.5 - pinhole[2]) / pinhole[0]
    limits[2] = (-0.5 - pinhole[3]) / pinhole[1]
    limits[3] = (pinhole[5] - 0.5 - pinhole[3]) / pinhole[1]
    corner = np.empty((4, 3))
    r00, r01, r02 = cam_from_map[0, 0], cam_from_map[0, 1], cam_from_map[0, 2]
    r10, r11, r12 = cam_from_map[1, 0], cam_from_map[1, 1], cam_from_map[1, 2]
    r20, r21, r22 = cam_from_map[2, 0], cam_from_map[2, 1], cam_from_map[2, 2]
    for chunk in range(ranges.shape[0]):
        if is_box_outside(bounds[chunk], sign_z, cam_from_map, centre_map, limits):
            continue
        for f in range(ranges[chunk, 0], ranges[chunk, 1]):
            ox, oy, oz = quads[f, 0] - centre_map[0], quads[f, 1] - centre_map[1], sign_z * quads[f, 2] - centre_map[2]
            ux, uy, uz = quads[f, 3], quads[f, 4], sign_z * quads[f, 5]
            vx, vy, vz = quads[f, 6], quads[f, 7], sign_z * quads[f, 8]
            # The outward normal V x U against the direction to the face; a reflection turns the handedness.
            facing = (vy * uz - vz * uy) * ox + (vz * ux - vx * uz) * oy + (vx * uy - vy * ux) * oz
            if facing * sign_z >= -1e-9:
                continue
            a0, a1, a2 = r00 * ux + r01 * uy + r02 * uz, r10 * ux + r11 * uy + r12 * uz, r20 * ux + r21 * uy + r22 * uz
            b0, b1, b2 = r00 * vx + r01 * vy + r02 * vz, r10 * vx + r11 * vy + r12 * vz, r20 * vx + r21 * vy + r22 * vz
            c0, c1, c2 = r00 * ox + r01 * oy + r02 * oz, r10 * ox + r11 * oy + r12 * oz, r20 * ox + r21 * oy + r22 * oz
            corner[0, 0], corner[0, 1], corner[0, 2] = c0, c1, c2
            corner[1, 0], corner[1, 1], corner[1, 2] = c0 + a0, c1 + a1, c2 + a2
            corner[2, 0], corner[2, 1], corner[2, 2] = c0 + a0 + b0, c1 + a1 + b1, c2 + a2 + b2
            corner[3, 0], corner[3, 1], corner[3, 2] = c0 + b0, c1 + b1, c2 + b2
            behind, left, right, above, below = 0, 0, 0, 0, 0
            for i in range(4):
                z = corner[i, 2]
                behind += z < NEAR_M
                left += corner[i, 0] < limits[0] * z
                right += corner[i, 0] > limits[1] * z
                above += corner[i, 1] < limits[2] * z
                below += corner[i, 1] > limits[3] * z
            if behind == 4 or left == 4 or right == 4 or above == 4 or below == 4:
                continue
            # Rows of the inverse of the matrix [U V O] in camera axes, by cross products.
            x0, x1, x2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
            determinant = a0 * x0 + a1 * x1 + a2 * x2
            if abs(determinant) < 1e-15:
                continue
            scale = 1.0 / determinant
            row = homographies[count]
            row[0], row[1], row[2] = x0 * scale, x1 * scale, x2 * scale
            y0, y1, y2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
            row[3], row[4], row[5] = y0 * scale, y1 * scale, y2 * scale
            z0, z1, z2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            row[6], row[7], row[8] = z0 * scale, z1 * scale, z2 * scale
            corner_counts[count] = clip_near(corner, behind > 0, pinhole, polygons[count])
            face_of[count] = f
            count += 1
    return count


@kernel
def clip_near(corner: Float, needs_clipping: bool, pinhole: Float, polygon: Float) -> int:
    """Number of corners of the part of a quad in front of the near plane; fills `polygon` with its pixels."""
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    if not needs_clipping:
        for i in range(4):
            inverse = 1.0 / corner[i, 2]
            polygon[i, 0] = fx * corner[i, 0] * inverse + cx
            polygon[i, 1] = fy * corner[i, 1] * inverse + cy
        return 4
    count = 0
    for i in range(4):
        j = (i + 1) & 3
        near_i, near_j = corner[i, 2] < NEAR_M, corner[j, 2] < NEAR_M
        if not near_i:
            polygon[count, 0] = fx * corner[i, 0] / corner[i, 2] + cx
            polygon[count, 1] = fy * corner[i, 1] / corner[i, 2] + cy
            count += 1
        if near_i != near_j:
            share = (NEAR_M - corner[i, 2]) / (corner[j, 2] - corner[i, 2])
            polygon[count, 0] = fx * (corner[i, 0] + share * (corner[j, 0] - corner[i, 0])) / NEAR_M + cx
            polygon[count, 1] = fy * (corner[i, 1] + share * (corner[j, 1] - corner[i, 1])) / NEAR_M + cy
            count += 1
    return count


@kernel
def paint_span(
    nearness: NDArray[np.float32], owner: Int32, first: int, last: int, start: float, slope: float, k: int
) -> None:
    """Paints samples first..last of a row where polygon k is nearer than what is there.

    float32 so that it vectorises.
    """
    w0, w1, value = np.float32(start), np.float32(slope), np.int32(k)
    for x in range(first, last):
        w = w0 + w1 * np.float32(x)
        if w > nearness[x]:
            nearness[x] = w
            owner[x] = value


@kernel
def paint_polygons(
    count: int,
    polygons: Float,
    corner_counts: Int32,
    homographies: Float,
    pinhole: Float,
    samples: int,
    shift: Float,
    first_row: int,
    nearness: NDArray[np.float32],
    owner: Int32,
) -> None:
    """Paints `count` convex polygons into `nearness` (1/z) and `owner` (their index), samples x samples per pixel.

    Sample (i, j) lies at pixel ((j + 0.5) / samples - 0.5 + shift x, same for i and y). Ends are inclusive, so
    neighbours leave no crack. Rows above first_row are left out.
    """
    height, width = owner.shape
    low, high = np.empty(height), np.empty(height)
    step = 1.0 / samples
    start_x, start_y = 0.5 * step - 0.5 + shift[0], 0.5 * step - 0.5 + shift[1]
    for k in range(count):
        corners = corner_counts[k]
        y_min, y_max = 1e30, -1e30
        for i in range(corners):
            y = (polygons[k, i, 1] - start_y) * samples
            y_min, y_max = min(y_min, y), max(y_max, y)
        top = max(first_row, math.ceil(max(y_min, -1.0)))
        bottom = min(height - 1, math.floor(min(y_max, height + 1.0)))
        if top > bottom:
            continue
        for row in range(top, bottom + 1):
            low[row], high[row] = 1e30, -1e30
        for i in range(corners):
            j = i + 1 if i + 1 < corners else 0
            px, py = (polygons[k, i, 0] - start_x) * samples, (polygons[k, i, 1] - start_y) * samples
            qx, qy = (polygons[k, j, 0] - start_x) * samples, (polygons[k, j, 1] - start_y) * samples
            if py > qy:
                px, py, qx, qy = qx, qy, px, py
            first, last = max(top, math.ceil(max(py, -1.0))), min(bottom, math.floor(min(qy, height + 1.0)))
            if first > last:
                continue
            if qy <= py:  # a level edge on a sample row
                low[first], high[first] = min(low[first], px, qx), max(high[first], px, qx)
                continue
            slope = (qx - px) / (qy - py)
            for row in range(first, last + 1):
                x = px + (row - py) * slope
                low[row], high[row] = min(low[row], x), max(high[row], x)
        w_x = homographies[k, 6] / pinhole[0] * step
        w_y = homographies[k, 7] / pinhole[1] * step
        w_0 = homographies[k, 8] + homographies[k, 6] * (start_x - pinhole[2]) / pinhole[0]
        w_0 += homographies[k, 7] * (start_y - pinhole[3]) / pinhole[1]
        for row in range(top, bottom + 1):
            if high[row] < -0.5 or low[row] > width:
                continue
            first = max(0, math.ceil(low[row]))
            last = min(width - 1, math.floor(min(high[row], width + 1.0))) + 1
            if first < last:
                paint_span(nearness[row], owner[row], first, last, w_0 + w_y * row, w_x, k)


@kernel
def first_floor_row(owner: Int32, face_of: Int32, numbers: Int32, floor_material: int, samples: int) -> int:
    """First pixel row that shows floor in any eighth pixel, the image's height without one."""
    height, width = owner.shape
    for row in range(0, height, samples):
        for x in range(0, width, 8 * samples):
            k = owner[row, x]
            if k >= 0 and numbers[face_of[k], 0] == floor_material:
                return int(row // samples)
    return int(height // samples)


@kernel
def gather(source: Int32, indices: Int32, target: Int32) -> None:
    """target.flat[i] = source.flat[indices.flat[i]], -1 where the index is negative: the lens' look-up."""
    flat_source, flat_indices, flat_target = source.ravel(), indices.ravel(), target.ravel()
    for i in range(flat_indices.shape[0]):
        flat_target[i] = flat_source[flat_indices[i]] if flat_indices[i] >= 0 else -1
