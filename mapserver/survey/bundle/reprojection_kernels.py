"""Bundle adjustment's inner loops over image observations.

A pose changes as R <- Exp(rot) R, p <- p + trans, both in map axes, so with q = point - p an observation's derivative by the pose is
[skew(q); I] times (minus) its derivative by the point. Everything an observation says therefore fits into one symmetric (3, 3) information
matrix of the point, kept as six numbers, and the (6, 3) coupling is never stored.
"""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial.so3_kernels import matmul3
from fleetmap.numerics.kernel import inline_kernel, kernel
from fleetmap.numerics.linear_kernels import exp_into
from mapserver.survey.bundle.schur_kernels import Eliminated, ObservationTable, View, add_lifted

MIN_DEPTH_M = 0.02
BEHIND_SIGMAS = 1000.0  # what an observation counts as whose point is behind the camera


class Measured(NamedTuple):
    """Pixels (M, 3): u, v, disparity. weights (M, 2): 1 / sigma of pixel and of disparity, the latter 0 without a right image."""

    pixels: Array
    weights: Array


class ImageNormal(NamedTuple):
    """Normal equations of the images: obs_info (M, 6), point_info (N, 6), point_rhs (N, 3), pose_info (P, 6, 6), pose_rhs (P, 6)."""

    obs_info: Array
    point_info: Array
    point_rhs: Array
    pose_info: Array
    pose_rhs: Array


@inline_kernel
def robust_cost(norm: float, huber: float, cutoff: float) -> float:
    """Cost of a residual of `norm` sigmas: square, then linear from `huber`, then constant from `cutoff`."""
    reach = min(norm, cutoff)
    return 0.5 * reach * reach if reach <= huber else huber * (reach - 0.5 * huber)


@inline_kernel
def robust_weight(norm: float, huber: float, cutoff: float) -> float:
    """Weight of the squared residual that has the same slope as `robust_cost`."""
    if norm > cutoff:
        return 0.0
    return 1.0 if norm <= huber else huber / norm


@kernel
def evaluate(
    view: View, table: ObservationTable, measured: Measured, robust: tuple[float, float], squared: Array
) -> float:
    """The robust cost of all observations; `squared` (M,) receives each one's squared length in sigmas.

    robust: sigmas from which the cost is linear, and constant.
    """
    lens, cam_from_map, positions_m, cam_from_body_m, points_map = view
    keyframes, landmarks, (pixels, weights), (huber, cutoff) = table.keyframes, table.landmarks, measured, robust
    cost = 0.0
    for n in range(len(keyframes)):
        rot, point, position = cam_from_map[keyframes[n]], points_map[landmarks[n]], positions_m[keyframes[n]]
        qx, qy, qz = point[0] - position[0], point[1] - position[1], point[2] - position[2]
        z = rot[2, 0] * qx + rot[2, 1] * qy + rot[2, 2] * qz + cam_from_body_m[2]
        if z < MIN_DEPTH_M:
            squared[n] = BEHIND_SIGMAS * BEHIND_SIGMAS
        else:
            x = rot[0, 0] * qx + rot[0, 1] * qy + rot[0, 2] * qz + cam_from_body_m[0]
            y = rot[1, 0] * qx + rot[1, 1] * qy + rot[1, 2] * qz + cam_from_body_m[1]
            du = (lens[0] * x / z + lens[1] - pixels[n, 0]) * weights[n, 0]
            dv = (lens[0] * y / z + lens[2] - pixels[n, 1]) * weights[n, 0]
            dd = (lens[3] / z - pixels[n, 2]) * weights[n, 1]
            squared[n] = du * du + dv * dv + dd * dd
        cost += robust_cost(np.sqrt(squared[n]), huber, cutoff)
    return cost


@kernel
def linearise(
    view: View, table: ObservationTable, measured: Measured, robust: tuple[float, float], normal: ImageNormal
) -> None:
    """Normal equations at the current values, as for `evaluate`; the right-hand sides point downhill.

    Fills obs_info, point_info and point_rhs; adds to pose_info and pose_rhs.
    """
    lens, cam_from_map, positions_m, cam_from_body_m, points_map = view
    keyframes, landmark_ptr, slots = table.keyframes, table.landmark_ptr, table.slots
    (pixels, weights), (huber, cutoff) = measured, robust
    obs_info, point_info, point_rhs, pose_info, pose_rhs = normal
    row_u, row_v, row_d, slope, info = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    for point_index in range(len(points_map)):
        point = points_map[point_index]
        point_info[point_index] = 0.0
        point_rhs[point_index] = 0.0
        for n in range(landmark_ptr[point_index], landmark_ptr[point_index + 1]):
            rot, position = cam_from_map[keyframes[n]], positions_m[keyframes[n]]
            qx, qy, qz = point[0] - position[0], point[1] - position[1], point[2] - position[2]
            z = rot[2, 0] * qx + rot[2, 1] * qy + rot[2, 2] * qz + cam_from_body_m[2]
            obs_info[n] = 0.0
            if z < MIN_DEPTH_M:
                continue
            x = (rot[0, 0] * qx + rot[0, 1] * qy + rot[0, 2] * qz + cam_from_body_m[0]) / z
            y = (rot[1, 0] * qx + rot[1, 1] * qy + rot[1, 2] * qz + cam_from_body_m[1]) / z
            du = (lens[0] * x + lens[1] - pixels[n, 0]) * weights[n, 0]
            dv = (lens[0] * y + lens[2] - pixels[n, 1]) * weights[n, 0]
            dd = (lens[3] / z - pixels[n, 2]) * weights[n, 1]
            weight = robust_weight(np.sqrt(du * du + dv * dv + dd * dd), huber, cutoff)
            if weight == 0.0:
                continue
            scale, scale_d = lens[0] / z * weights[n, 0], -lens[3] / (z * z) * weights[n, 1]
            for a in range(3):
                row_u[a] = scale * (rot[0, a] - x * rot[2, a])
                row_v[a] = scale * (rot[1, a] - y * rot[2, a])
                row_d[a] = scale_d * rot[2, a]
                slope[a] = weight * (row_u[a] * du + row_v[a] * dv + row_d[a] * dd)
                point_rhs[point_index, a] -= slope[a]
            c = 0
            for a in range(3):
                for b in range(a, 3):
                    info[c] = weight * (row_u[a] * row_u[b] + row_v[a] * row_v[b] + row_d[a] * row_d[b])
                    obs_info[n, c] = info[c]
                    point_info[point_index, c] += info[c]
                    c += 1
            slot = slots[keyframes[n]]
            if slot >= 0:
                _add_pose(info, slope, qx, qy, qz, pose_info[slot], pose_rhs[slot])


@inline_kernel
def _add_pose(info: Array, slope: Array, qx: float, qy: float, qz: float, block: Array, rhs: Array) -> None:
    """Adds [skew(q); I] H [skew(q); I]^T and the pose's share of the slope."""
    rhs[0] += qy * slope[2] - qz * slope[1]
    rhs[1] += qz * slope[0] - qx * slope[2]
    rhs[2] += qx * slope[1] - qy * slope[0]
    rhs[3] += slope[0]
    rhs[4] += slope[1]
    rhs[5] += slope[2]
    rows = (info[0], info[1], info[2]), (info[1], info[3], info[4]), (info[2], info[4], info[5])
    add_lifted(rows, (qx, qy, qz), (qx, qy, qz), 1.0, block)


@kernel
def step_landmarks(view: View, table: ObservationTable, eliminated: Eliminated, pose_step: Array, moved: Array) -> None:
    """Back-substitution: moved (N, 3) are the points after the step that goes with pose_step (P, >= 6).

    No point moves farther than half its distance to the nearest keyframe that sees it, so that one weak point cannot
    jump behind a camera and spoil the step of all others.
    """
    positions_m, points_map, slots = view.positions_m, view.points_map, table.slots
    keyframes, landmark_ptr, (obs_info, inverse, point_rhs) = table.keyframes, table.landmark_ptr, eliminated
    for landmark in range(len(points_map)):
        point, v = points_map[landmark], inverse[landmark]
        sx, sy, sz = point_rhs[landmark, 0], point_rhs[landmark, 1], point_rhs[landmark, 2]
        nearest = np.inf
        for n in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
            position, info, slot = positions_m[keyframes[n]], obs_info[n], slots[keyframes[n]]
            qx, qy, qz = point[0] - position[0], point[1] - position[1], point[2] - position[2]
            nearest = min(nearest, qx * qx + qy * qy + qz * qz)
            if slot < 0:
                continue
            d = pose_step[slot]
            # the point as seen from the keyframe moves by trans - q x rot against the map
            tx = d[3] + d[1] * qz - d[2] * qy
            ty = d[4] + d[2] * qx - d[0] * qz
            tz = d[5] + d[0] * qy - d[1] * qx
            sx += info[0] * tx + info[1] * ty + info[2] * tz
            sy += info[1] * tx + info[3] * ty + info[4] * tz
            sz += info[2] * tx + info[4] * ty + info[5] * tz
        dx = v[0] * sx + v[1] * sy + v[2] * sz
        dy = v[1] * sx + v[3] * sy + v[4] * sz
        dz = v[2] * sx + v[4] * sy + v[5] * sz
        length, limit = np.sqrt(dx * dx + dy * dy + dz * dz), 0.5 * np.sqrt(nearest)
        scale = limit / length if length > limit else 1.0
        moved[landmark, 0] = point[0] + scale * dx
        moved[landmark, 1] = point[1] + scale * dy
        moved[landmark, 2] = point[2] + scale * dz


@kernel
def step_poses(
    rotations: Array, positions_m: Array, slots: AnyArray, step: Array, moved_rotations: Array, moved_m: Array
) -> None:
    """moved = Exp(step[:3]) R and p + step[3:6] for every keyframe with a slot; the others are copied."""
    turn = np.empty((3, 3))
    for k in range(len(slots)):
        if slots[k] < 0:
            moved_rotations[k] = rotations[k]
            moved_m[k] = positions_m[k]
            continue
        d = step[slots[k]]
        exp_into(d[:3], turn)
        matmul3(turn, rotations[k], moved_rotations[k])
        for a in range(3):
            moved_m[k, a] = positions_m[k, a] + d[3 + a]
