"""Inner loops for cameras whose focal length and distortion are unknown too: nine unknowns each, one image, no body.

An unknown camera c: rotation about its own place in camera axes (R <- Exp(rot) R), translation, focal, k1, k2.
"""

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial.so3_kernels import exp_into, matmul3
from fleetmap.numerics.kernel import kernel

CAMERA_UNKNOWNS = 9


@kernel
def evaluate(
    rotations: Array,
    shifts: Array,
    lenses: Array,
    points_map: Array,
    cameras: AnyArray,
    landmarks: AnyArray,
    pixels: Array,
) -> float:
    """Half the sum of squared pixel errors. rotations (C, 3, 3), shifts (C, 3), lenses (C, 3): focal, k1, k2."""
    cost = 0.0
    for n in range(len(cameras)):
        rot, shift, lens, point = (
            rotations[cameras[n]],
            shifts[cameras[n]],
            lenses[cameras[n]],
            points_map[landmarks[n]],
        )
        x = rot[0, 0] * point[0] + rot[0, 1] * point[1] + rot[0, 2] * point[2] + shift[0]
        y = rot[1, 0] * point[0] + rot[1, 1] * point[1] + rot[1, 2] * point[2] + shift[1]
        z = rot[2, 0] * point[0] + rot[2, 1] * point[1] + rot[2, 2] * point[2] + shift[2]
        u, v = -x / z, -y / z
        squared = u * u + v * v
        scale = lens[0] * (1.0 + lens[1] * squared + lens[2] * squared * squared)
        du, dv = scale * u - pixels[n, 0], scale * v - pixels[n, 1]
        cost += 0.5 * (du * du + dv * dv)
    return cost


@kernel
def linearise(
    rotations: Array,
    shifts: Array,
    lenses: Array,
    points_map: Array,
    cameras: AnyArray,
    landmarks: AnyArray,
    pixels: Array,
    point_info: Array,
    point_rhs: Array,
    camera_info: Array,
    camera_rhs: Array,
    couplings: Array,
) -> None:
    """Normal equations; the right-hand sides point downhill.

    Adds to point_info (N, 6), point_rhs (N, 3), camera_info (C, 9, 9), camera_rhs (C, 9); fills couplings (M, 9, 3).
    """
    by_camera, by_point, residual = np.empty((2, 9)), np.empty((2, 3)), np.empty(2)
    for n in range(len(cameras)):
        camera, landmark = cameras[n], landmarks[n]
        _derive(
            rotations[camera],
            shifts[camera],
            lenses[camera],
            points_map[landmark],
            pixels[n],
            by_camera,
            by_point,
            residual,
        )
        for a in range(9):
            camera_rhs[camera, a] -= by_camera[0, a] * residual[0] + by_camera[1, a] * residual[1]
            for b in range(9):
                camera_info[camera, a, b] += by_camera[0, a] * by_camera[0, b] + by_camera[1, a] * by_camera[1, b]
            for b in range(3):
                couplings[n, a, b] = by_camera[0, a] * by_point[0, b] + by_camera[1, a] * by_point[1, b]
        entry = 0
        for a in range(3):
            point_rhs[landmark, a] -= by_point[0, a] * residual[0] + by_point[1, a] * residual[1]
            for b in range(a, 3):
                point_info[landmark, entry] += by_point[0, a] * by_point[0, b] + by_point[1, a] * by_point[1, b]
                entry += 1


@kernel
def _derive(
    rot: Array,
    shift: Array,
    lens: Array,
    point: Array,
    pixel: Array,
    by_camera: Array,
    by_point: Array,
    residual: Array,
) -> None:
    """Residual (2,) of one observation, and its derivatives by the camera (2, 9) and the point (2, 3)."""
    tx = rot[0, 0] * point[0] + rot[0, 1] * point[1] + rot[0, 2] * point[2]
    ty = rot[1, 0] * point[0] + rot[1, 1] * point[1] + rot[1, 2] * point[2]
    tz = rot[2, 0] * point[0] + rot[2, 1] * point[1] + rot[2, 2] * point[2]
    z = tz + shift[2]
    u, v = -(tx + shift[0]) / z, -(ty + shift[1]) / z
    squared = u * u + v * v
    bend = 1.0 + lens[1] * squared + lens[2] * squared * squared
    slope = lens[1] + 2.0 * lens[2] * squared
    residual[0], residual[1] = lens[0] * bend * u - pixel[0], lens[0] * bend * v - pixel[1]
    for row in range(2):
        here = u if row == 0 else v
        by_u = lens[0] * ((bend if row == 0 else 0.0) + 2.0 * slope * here * u)
        by_v = lens[0] * ((bend if row == 1 else 0.0) + 2.0 * slope * here * v)
        px, py = -by_u / z, -by_v / z
        pz = -(by_u * u + by_v * v) / z
        by_camera[row, 0] = ty * pz - tz * py
        by_camera[row, 1] = tz * px - tx * pz
        by_camera[row, 2] = tx * py - ty * px
        by_camera[row, 3], by_camera[row, 4], by_camera[row, 5] = px, py, pz
        by_camera[row, 6] = bend * here
        by_camera[row, 7] = lens[0] * squared * here
        by_camera[row, 8] = lens[0] * squared * squared * here
        for a in range(3):
            by_point[row, a] = px * rot[0, a] + py * rot[1, a] + pz * rot[2, a]


@kernel
def reduce_to_cameras(
    cameras: AnyArray,
    landmark_ptr: AnyArray,
    couplings: Array,
    inverse: Array,
    point_rhs: Array,
    row_ptr: AnyArray,
    cols: AnyArray,
    blocks: Array,
    rhs: Array,
) -> None:
    """Subtracts the landmarks' Schur complement from blocks (B, 9, 9) and rhs (C, 9); observations sorted by landmark."""
    part, v = np.empty((9, 3)), np.empty((3, 3))
    for landmark in range(len(point_rhs)):
        info = inverse[landmark]
        v[0, 0], v[0, 1], v[0, 2] = info[0], info[1], info[2]
        v[1, 0], v[1, 1], v[1, 2] = info[1], info[3], info[4]
        v[2, 0], v[2, 1], v[2, 2] = info[2], info[4], info[5]
        for n in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
            p = cameras[n]
            for a in range(9):
                for b in range(3):
                    part[a, b] = (
                        couplings[n, a, 0] * v[0, b] + couplings[n, a, 1] * v[1, b] + couplings[n, a, 2] * v[2, b]
                    )
                rhs[p, a] -= (
                    part[a, 0] * point_rhs[landmark, 0]
                    + part[a, 1] * point_rhs[landmark, 1]
                    + part[a, 2] * point_rhs[landmark, 2]
                )
            for m in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                q = cameras[m]
                if q > p:
                    continue
                s = row_ptr[p] + np.searchsorted(cols[row_ptr[p] : row_ptr[p + 1]], q)
                for a in range(9):
                    for b in range(9):
                        blocks[s, a, b] -= (
                            part[a, 0] * couplings[m, b, 0]
                            + part[a, 1] * couplings[m, b, 1]
                            + part[a, 2] * couplings[m, b, 2]
                        )


@kernel
def step(
    rotations: Array,
    shifts: Array,
    lenses: Array,
    points_map: Array,
    cameras: AnyArray,
    landmarks: AnyArray,
    couplings: Array,
    inverse: Array,
    point_rhs: Array,
    camera_step: Array,
    moved_rotations: Array,
    moved_shifts: Array,
    moved_lenses: Array,
    moved_points: Array,
) -> None:
    """The state moved by camera_step (C, 9) and what follows from it for the landmarks."""
    turn = np.empty((3, 3))
    for c in range(len(rotations)):
        exp_into(camera_step[c, :3], turn)
        matmul3(turn, rotations[c], moved_rotations[c])
        for a in range(3):
            moved_shifts[c, a] = shifts[c, a] + camera_step[c, 3 + a]
            moved_lenses[c, a] = lenses[c, a] + camera_step[c, 6 + a]
    pull = point_rhs.copy()
    for n in range(len(cameras)):
        for b in range(3):
            for a in range(9):
                pull[landmarks[n], b] -= couplings[n, a, b] * camera_step[cameras[n], a]
    for n in range(len(points_map)):
        v, p = inverse[n], pull[n]
        moved_points[n, 0] = points_map[n, 0] + v[0] * p[0] + v[1] * p[1] + v[2] * p[2]
        moved_points[n, 1] = points_map[n, 1] + v[1] * p[0] + v[3] * p[1] + v[4] * p[2]
        moved_points[n, 2] = points_map[n, 2] + v[2] * p[0] + v[4] * p[1] + v[5] * p[2]
