"""Elimination of the landmarks by the Schur complement. Layout: reprojection_kernels.py. Source: Triggs et al. 2000, section 6.1."""

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.numerics.kernel import inline_kernel, kernel

LANDMARK_FLOOR = 1e-9  # relative to the trace: a point seen once by one camera keeps its depth


@kernel
def count_row_blocks(
    slot_ptr: AnyArray,
    slot_obs: AnyArray,
    landmarks: AnyArray,
    keyframes: AnyArray,
    landmark_ptr: AnyArray,
    slots: AnyArray,
    pair_ptr: AnyArray,
    pair_cols: AnyArray,
    row_ptr: AnyArray,
    cols: AnyArray,
) -> None:
    """Fills row_ptr (P + 1,) and, if `cols` is not empty, the columns <= row of the reduced system's blocks, ascending.

    A row couples to every slot that shares a landmark, and to pair_cols[pair_ptr[p]:pair_ptr[p + 1]]. Call once with an
    empty `cols` for the size and once to fill.
    """
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
        a, d, f = (
            info[0] * (1.0 + damping) + floor,
            info[3] * (1.0 + damping) + floor,
            info[5] * (1.0 + damping) + floor,
        )
        b, c, e = info[1], info[2], info[4]
        minor_a, minor_b, minor_c = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1.0 / (a * minor_a + b * minor_b + c * minor_c)
        inverse[n, 0], inverse[n, 1], inverse[n, 2] = minor_a * scale, minor_b * scale, minor_c * scale
        inverse[n, 3], inverse[n, 4], inverse[n, 5] = (
            (a * f - c * c) * scale,
            (b * c - a * e) * scale,
            (a * d - b * b) * scale,
        )


@kernel
def reduce_to_poses(
    positions_m: Array,
    points_map: Array,
    keyframes: AnyArray,
    landmarks: AnyArray,
    landmark_ptr: AnyArray,
    slots: AnyArray,
    slot_keyframes: AnyArray,
    slot_ptr: AnyArray,
    slot_obs: AnyArray,
    obs_info: Array,
    inverse: Array,
    point_rhs: Array,
    row_ptr: AnyArray,
    cols: AnyArray,
    blocks: Array,
    rhs: Array,
) -> None:
    """Subtracts the landmarks' Schur complement from blocks (B, 6, 6) and rhs (P, >= 6), row by row.

    slot_obs[slot_ptr[p]:slot_ptr[p + 1]] are the observations of the keyframe in slot p; row p's blocks are those of
    the columns cols[row_ptr[p]:row_ptr[p + 1]], all <= p.
    """
    place = np.full(len(slot_keyframes), -1, np.int32)
    y = np.empty((3, 3))
    m = np.empty((3, 3))
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
                add_lifted(
                    m[0, 0],
                    m[0, 1],
                    m[0, 2],
                    m[1, 0],
                    m[1, 1],
                    m[1, 2],
                    m[2, 0],
                    m[2, 1],
                    m[2, 2],
                    ax,
                    ay,
                    az,
                    point[0] - there[0],
                    point[1] - there[1],
                    point[2] - there[2],
                    -1.0,
                    blocks[place[q]],
                )


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
def add_lifted(
    m00: float,
    m01: float,
    m02: float,
    m10: float,
    m11: float,
    m12: float,
    m20: float,
    m21: float,
    m22: float,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    sign: float,
    block: Array,
) -> None:
    """block += sign [skew(a); I] M [skew(b); I]^T for a (3, 3) M."""
    # right half first: M skew(b)^T, row r is b x M[r]
    r00, r01, r02 = by * m02 - bz * m01, bz * m00 - bx * m02, bx * m01 - by * m00
    r10, r11, r12 = by * m12 - bz * m11, bz * m10 - bx * m12, bx * m11 - by * m10
    r20, r21, r22 = by * m22 - bz * m21, bz * m20 - bx * m22, bx * m21 - by * m20
    block[0, 0] += sign * (ay * r20 - az * r10)
    block[0, 1] += sign * (ay * r21 - az * r11)
    block[0, 2] += sign * (ay * r22 - az * r12)
    block[1, 0] += sign * (az * r00 - ax * r20)
    block[1, 1] += sign * (az * r01 - ax * r21)
    block[1, 2] += sign * (az * r02 - ax * r22)
    block[2, 0] += sign * (ax * r10 - ay * r00)
    block[2, 1] += sign * (ax * r11 - ay * r01)
    block[2, 2] += sign * (ax * r12 - ay * r02)
    block[0, 3] += sign * (ay * m20 - az * m10)
    block[0, 4] += sign * (ay * m21 - az * m11)
    block[0, 5] += sign * (ay * m22 - az * m12)
    block[1, 3] += sign * (az * m00 - ax * m20)
    block[1, 4] += sign * (az * m01 - ax * m21)
    block[1, 5] += sign * (az * m02 - ax * m22)
    block[2, 3] += sign * (ax * m10 - ay * m00)
    block[2, 4] += sign * (ax * m11 - ay * m01)
    block[2, 5] += sign * (ax * m12 - ay * m02)
    block[3, 0] += sign * r00
    block[3, 1] += sign * r01
    block[3, 2] += sign * r02
    block[4, 0] += sign * r10
    block[4, 1] += sign * r11
    block[4, 2] += sign * r12
    block[5, 0] += sign * r20
    block[5, 1] += sign * r21
    block[5, 2] += sign * r22
    block[3, 3] += sign * m00
    block[3, 4] += sign * m01
    block[3, 5] += sign * m02
    block[4, 3] += sign * m10
    block[4, 4] += sign * m11
    block[4, 5] += sign * m12
    block[5, 3] += sign * m20
    block[5, 4] += sign * m21
    block[5, 5] += sign * m22
