"""Sparsity of a bundle problem: observations sorted by landmark, slots of the free keyframes, block pattern of the reduced system."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import SurveyError
from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle.problem import BundleProblem
from mapserver.survey.bundle.schur_kernels import ObservationTable, count_row_blocks

Indices = NDArray[np.int32]


@dataclass(frozen=True)
class Structure:
    """The fixed part of one problem; M observations sorted by landmark, P keyframes with unknowns, B blocks.

    order (M,): the problem's index of each observation. pixels (M, 3): u, v, disparity. weights (M, 2): 1 / sigma.
    slots (K,): -1 without unknowns. free (P, 6 or 15): which unknowns move. Row p's blocks are row_ptr[p]:row_ptr[p +
    1] with columns `cols` ascending up to p itself.
    """

    order: AnyArray
    table: ObservationTable
    pixels: Array
    weights: Array
    slots: Indices
    slot_keyframes: Indices
    free: NDArray[np.bool_]
    row_ptr: AnyArray
    cols: Indices

    def block_of(self, row: int, col: int) -> int:
        """Index of the block of slots (row, col), col <= row; the pattern must hold it."""
        start, end = int(self.row_ptr[row]), int(self.row_ptr[row + 1])
        return start + int(np.searchsorted(self.cols[start:end], col))


def build_structure(problem: BundleProblem) -> Structure:
    """The structure of `problem`; SurveyError where nothing holds the map in place."""
    _check(problem)
    order = np.argsort(problem.obs_landmark, kind="stable")
    keyframes = np.asarray(problem.obs_keyframe, np.int32)[order]
    landmarks = np.asarray(problem.obs_landmark, np.int32)[order]
    landmark_ptr = np.searchsorted(landmarks, np.arange(len(problem.points_map) + 1))
    observed, sigma = problem.obs_pixels[order], problem.obs_sigma_px[order]
    disparity = observed[:, 0] - observed[:, 2]
    seen = np.isfinite(disparity) & (problem.camera.baseline_m > 0)
    pixels = np.stack([observed[:, 0], observed[:, 1], np.where(seen, disparity, 0.0)], axis=1)
    disparity_weights = np.where(seen, 1.0 / np.where(seen, sigma[:, 1], 1.0), 0.0)
    weights = np.stack([1.0 / sigma[:, 0], disparity_weights], axis=1)
    moves = _free_unknowns(problem)
    slot_keyframes = np.nonzero(moves.any(axis=1))[0].astype(np.int32)
    slots = np.full(len(moves), -1, np.int32)
    slots[slot_keyframes] = np.arange(len(slot_keyframes))
    obs_slots = slots[keyframes]
    by_slot = np.argsort(obs_slots, kind="stable")
    slot_obs = by_slot[int((obs_slots < 0).sum()) :].astype(np.int32)
    slot_ptr = np.searchsorted(obs_slots[slot_obs], np.arange(len(slot_keyframes) + 1))
    table = ObservationTable(slot_ptr, slot_obs, landmarks, keyframes, landmark_ptr, slots)
    row_ptr, cols = _pattern(problem, table)
    return Structure(order, table, pixels, weights, slots, slot_keyframes, moves[slot_keyframes], row_ptr, cols)


def _check(problem: BundleProblem) -> None:
    count, observations = len(problem.map_from_body), len(problem.obs_keyframe)
    assert problem.fixed.shape == (count,)
    assert problem.obs_pixels.shape == (observations, 3)
    assert problem.obs_sigma_px.shape == (observations, 2)
    assert observations == 0 or (problem.obs_keyframe.min() >= 0 and problem.obs_keyframe.max() < count)
    assert observations == 0 or (
        problem.obs_landmark.min() >= 0 and problem.obs_landmark.max() < len(problem.points_map)
    )
    if problem.gauge == "yaw_position" and (problem.inertial is None or not problem.inertial.edges):
        raise SurveyError('gauge "yaw_position" needs inertial edges, there are none; fix a keyframe, use gauge "pose"')
    if problem.gauge == "pose" and not problem.fixed.any() and not problem.priors:
        raise SurveyError(
            f"bundle adjustment of {count} keyframes has none fixed and no prior: fix one, "
            'or use gauge "yaw_position" with inertial terms'
        )


def _free_unknowns(problem: BundleProblem) -> NDArray[np.bool_]:
    """(K, 6 or 15): rotation, translation, velocity, gyro bias, accelerometer bias."""
    count, inertial = len(problem.map_from_body), problem.inertial
    moves = np.zeros((count, 6 if inertial is None else 15), np.bool_)
    if problem.gauge == "pose":
        moves[:, :6] = ~problem.fixed[:, None]
    else:
        held = problem.fixed.copy()
        held[0] |= not held.any()
        moves[:, :2] = True
        moves[:, 2:6] = ~held[:, None]
    if inertial is not None:
        for i, j, _ in inertial.edges:
            moves[[i, j], 6:] = True
        if inertial.fixed is not None:
            moves[inertial.fixed, 6:] = False
    return moves


def _pattern(problem: BundleProblem, table: ObservationTable) -> tuple[AnyArray, Indices]:
    """Row pointers and columns of the reduced system's blocks: slots that share a landmark or a relative term."""
    slots = table.slots
    pairs = np.array([sorted((slots[t.i], slots[t.j])) for t in problem.relative], np.int32).reshape(-1, 2)
    pairs = pairs[pairs[:, 0] >= 0]
    pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
    pair_ptr = np.searchsorted(pairs[:, 1], np.arange(len(table.slot_ptr)))
    if problem.points_held:
        table = table._replace(slot_ptr=np.zeros_like(table.slot_ptr))
    pair_first = np.ascontiguousarray(pairs[:, 0])
    row_ptr, cols = np.zeros(len(table.slot_ptr), np.int64), np.zeros(0, np.int32)
    count_row_blocks(table, pair_ptr, pair_first, row_ptr, cols)
    cols = np.empty(int(row_ptr[-1]), np.int32)
    count_row_blocks(table, pair_ptr, pair_first, row_ptr, cols)
    return row_ptr, cols
