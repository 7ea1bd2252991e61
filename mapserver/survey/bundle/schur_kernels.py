"""Elimination of the landmarks by the Schur complement. Layout: reprojection_kernels.py. Source: Triggs et al. 2000, section 6.1."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.numerics.kernel import inline_kernel, kernel

Indices = NDArray[np.int32]
Vector = tuple[float, float, float]
Rows = tuple[Vector, Vector, Vector]
Pattern = tuple[AnyArray, AnyArray, AnyArray]  # keyframes of the slots, row_ptr and cols of the blocks
LANDMARK_FLOOR = 1e-9  # relative to the trace: a point seen once by one camera keeps its depth


class View(NamedTuple):
    """A state as the images show it: rotations cam_from_map (K, 3, 3), positions_m (K, 3) of the body, points_map (N, 3).

    lens: focal, cx, cy, focal times baseline. cam_from_body_m (3,): the body's origin in the camera.
    """

    lens: Array
    cam_from_map: Array
    positions_m: Array
    cam_from_body_m: Array
    points_map: Array


class ObservationTable(NamedTuple):
    """M observations sorted by landmark; landmark_ptr (N + 1,) delimits each landmark's.

    slot_obs[slot_ptr[p]:slot_ptr[p + 1]] are those of the keyframe in slot p; slots (K,) of the keyframes, -1 for held ones.
    """

    slot_ptr: AnyArray
    slot_obs: Indices
    landmarks: Indices
    keyframes: Indices
    landmark_ptr: AnyArray
    slots: Indices


class Eliminated(NamedTuple):
    """Normal equations of the landmarks: obs_info (M, 6) of observations, inverse (N, 6) and point_rhs (N, 3) of landmarks."""

    obs_info: Array
    inverse: Array
    point_rhs: Array


@kernel
def count_row_blocks(
    table: ObservationTable, pair_ptr: AnyArray, pair_cols: AnyArray, row_ptr: AnyArray, cols: AnyArray
) -> None:
    """Fills row_ptr (P + 1,) and, if `cols` is not empty, the columns <= row of the reduced system's blocks, ascending.

    A row couples to every slot that shares a landmark, and to pair_cols[pair_ptr[p]:pair_ptr[p + 1]]. Call once with an
    empty `cols` for the size and once to fill.
    """
    slot_ptr, slot_obs, landmarks, keyframes, landmark_ptr, slots = table
    count = len(slot_ptr) - 1
    seen = np.full(count, -1, np.int32)
    found = np.empty(count, np.int32)
    row_ptr[0] = 0
    for p in range(count):
        seen[p] = p
        found[0] = p
        size = 1
        for entry in range(slot_ptr[p], slot_ptr[p + 1]):
            landmark = landmarks[slot_obs[entry]]
            for n in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                q = slots[keyframes[n]]
                if 0 <= q < p and seen[q] != p:
                    seen[q] = p
                    found[size] = q
                    size += 1
        for entry in range(pair_ptr[p], pair_ptr[p + 1]):
            q = pair_cols[entry]
            if 0 <= q < p and seen[q] != p:
                seen[q] = p
                found[size] = q
                size += 1
        row_ptr[p + 1] = row_ptr[p] + size
        if len(cols) > 0:
            cols[row_ptr[p] : row_ptr[p + 1]] = np.sort(found[:size])


@kernel
def invert_landmarks(point_info: Array, damping: float, inverse: Array) -> None:
    """Inverses (N, 6) of the damped point blocks; zero where a landmark has no observation with weight."""
    for n in range(len(point_info)):
        info = point_info[n]
        trace = info[0] + info[3] + info[5]
        if not trace > 0.0:
            inverse[n] = 0.0
            continue
        floor = LANDMARK_FLOOR * trace
        a, d = info[0] * (1.0 + damping) + floor, info[3] * (1.0 + damping) + floor
        f = info[5] * (1.0 + damping) + floor
        b, c, e = info[1], info[2], info[4]
        minor_a, minor_b, minor_c = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1.0 / (a * minor_a + b * minor_b + c * minor_c)
        inverse[n, 0], inverse[n, 1], inverse[n, 2] = minor_a * scale, minor_b * scale, minor_c * scale
        inverse[n, 3], inverse[n, 4] = (a * f - c * c) * scale, (b * c - a * e) * scale
        inverse[n, 5] = (a * d - b * b) * scale


@kernel
def reduce_to_poses(
    view: View, table: ObservationTable, eliminated: Eliminated, pattern: Pattern, blocks: Array, rhs: Array
) -> None:
    """Subtracts the landmarks' Schur complement from blocks (B, 6, 6) and rhs (P, >= 6), row by row.

    slot_obs[slot_ptr[p]:slot_ptr[p + 1]] are the observations of the keyframe in slot p; row p's blocks are those of
    the columns cols[row_ptr[p]:row_ptr[p + 1]], all <= p.
    """
    slot_ptr, slot_obs, landmarks, keyframes, landmark_ptr, slots = table
    (obs_info, inverse, point_rhs), (slot_keyframes, row_ptr, cols) = eliminated, pattern
    positions_m, points_map = view.positions_m, view.points_map
    place = np.full(len(slot_keyframes), -1, np.int32)
    y, m = np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(slot_keyframes)):
        for s in range(row_ptr[p], row_ptr[p + 1]):
            place[cols[s]] = s
        position = positions_m[slot_keyframes[p]]
        for entry in range(slot_ptr[p], slot_ptr[p + 1]):
            k = slot_obs[entry]
            info, landmark = obs_info[k], landmarks[k]
            if info[0] + info[3] + info[5] == 0.0:
                continue
            v, point, pull = inverse[landmark], points_map[landmark], point_rhs[landmark]
            _symmetric_product(info, v, y)
            ax, ay, az = point[0] - position[0], point[1] - position[1], point[2] - position[2]
            fx = y[0, 0] * pull[0] + y[0, 1] * pull[1] + y[0, 2] * pull[2]
            fy = y[1, 0] * pull[0] + y[1, 1] * pull[1] + y[1, 2] * pull[2]
            fz = y[2, 0] * pull[0] + y[2, 1] * pull[1] + y[2, 2] * pull[2]
            rhs[p, 0] += ay * fz - az * fy
            rhs[p, 1] += az * fx - ax * fz
            rhs[p, 2] += ax * fy - ay * fx
            rhs[p, 3] += fx
            rhs[p, 4] += fy
            rhs[p, 5] += fz
            for n in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                q = slots[keyframes[n]]
                if q < 0 or q > p:
                    continue
                other, there = obs_info[n], positions_m[keyframes[n]]
                for a in range(3):
                    m[a, 0] = y[a, 0] * other[0] + y[a, 1] * other[1] + y[a, 2] * other[2]
                    m[a, 1] = y[a, 0] * other[1] + y[a, 1] * other[3] + y[a, 2] * other[4]
                    m[a, 2] = y[a, 0] * other[2] + y[a, 1] * other[4] + y[a, 2] * other[5]
                rows = (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
                apart = point[0] - there[0], point[1] - there[1], point[2] - there[2]
                add_lifted(rows, (ax, ay, az), apart, -1.0, blocks[place[q]])


@inline_kernel
def _symmetric_product(left: Array, right: Array, out: Array) -> None:
    """out (3, 3) = product of two symmetric matrices kept as six numbers."""
    for c in range(3):
        r0 = right[0] if c == 0 else (right[1] if c == 1 else right[2])
        r1 = right[1] if c == 0 else (right[3] if c == 1 else right[4])
        r2 = right[2] if c == 0 else (right[4] if c == 1 else right[5])
        out[0, c] = left[0] * r0 + left[1] * r1 + left[2] * r2
        out[1, c] = left[1] * r0 + left[3] * r1 + left[4] * r2
        out[2, c] = left[2] * r0 + left[4] * r1 + left[5] * r2


@inline_kernel
def add_lifted(m: Rows, a: Vector, b: Vector, sign: float, block: Array) -> None:
    """block += sign [skew(a); I] M [skew(b); I]^T for a (3, 3) M."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = m
    (ax, ay, az), (bx, by, bz) = a, b
    # right half first: M skew(b)^T, row r is b x M[r]
    turned = (
        (by * m02 - bz * m01, bz * m00 - bx * m02, bx * m01 - by * m00),
        (by * m12 - bz * m11, bz * m10 - bx * m12, bx * m11 - by * m10),
        (by * m22 - bz * m21, bz * m20 - bx * m22, bx * m21 - by * m20),
    )
    for c in range(3):
        for first, right in ((0, turned), (3, m)):
            block[0, first + c] += sign * (ay * right[2][c] - az * right[1][c])
            block[1, first + c] += sign * (az * right[0][c] - ax * right[2][c])
            block[2, first + c] += sign * (ax * right[1][c] - ay * right[0][c])
            for row in range(3):
                block[3 + row, first + c] += sign * right[row][c]
