"""A second opinion on a problem of bundle adjustment in the large, every observation counted.

Nothing is shared with the project's solver: the projection is written from the format's definition (Agarwal et al. 2010) with
rotation vectors as unknowns, the derivatives are differences, the matrices scipy's.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array
from scipy.spatial.transform import Rotation

Numbers = NDArray[np.float64]
_STEPS = np.array([1e-6] * 6 + [1e-3] + [1e-6] * 5)  # of a camera's nine numbers and a point's three
_LAMBDA_MAX = 1e10


def reference_cost(file: Path, iterations: int = 100, tolerance: float = 1e-7) -> float:
    """Half the sum of squares that Levenberg-Marquardt reaches from the file's own start."""
    numbers = np.array(file.read_text().split(), np.float64)
    cameras, points, count = (int(value) for value in numbers[:3])
    rows = numbers[3 : 3 + 4 * count].reshape(-1, 4)
    split = 9 * cameras
    columns = np.hstack([
        9 * rows[:, :1].astype(int) + np.arange(9), split + 3 * rows[:, 1:2].astype(int) + np.arange(3),
    ])  # fmt: skip
    at, damping = numbers[3 + 4 * count :], 1e-4
    cost = 0.5 * float((_residuals(at[columns], rows) ** 2).sum())
    for _ in range(iterations):
        jacobian, residuals = _jacobian(at[columns], rows, columns, len(at)), _residuals(at[columns], rows).ravel()
        hessian, downhill = (jacobian.T @ jacobian).tocsr(), -(jacobian.T @ residuals)
        while True:
            moved = at + _step(hessian, downhill, split, points, damping)
            lower = 0.5 * float((_residuals(moved[columns], rows) ** 2).sum())
            if lower < cost:
                break
            damping *= 4.0
            if damping > _LAMBDA_MAX:
                return cost
        at, gained, cost, damping = moved, cost - lower, lower, damping / 8.0
        if gained < tolerance * cost:
            break
    return cost


def _residuals(unknowns: Numbers, rows: Numbers) -> Numbers:
    """(M, 2) of the twelve numbers that each observation depends on."""
    seen = Rotation.from_rotvec(unknowns[:, :3]).apply(unknowns[:, 9:]) + unknowns[:, 3:6]
    flat = -seen[:, :2] / seen[:, 2:]
    squared = (flat**2).sum(axis=1)
    scale = unknowns[:, 6] * (1.0 + unknowns[:, 7] * squared + unknowns[:, 8] * squared**2)
    return np.asarray(scale[:, None] * flat - rows[:, 2:])


def _jacobian(unknowns: Numbers, rows: Numbers, columns: NDArray[np.int64], width: int) -> coo_array:
    slopes = np.empty((len(rows), 2, 12))
    for k, step in enumerate(_STEPS):
        aside = step * np.eye(12)[k]
        slopes[:, :, k] = (_residuals(unknowns + aside, rows) - _residuals(unknowns - aside, rows)) / (2.0 * step)
    lines = np.repeat(np.arange(2 * len(rows)), 12)
    return coo_array(
        (slopes.ravel(), (lines, np.repeat(columns, 2, axis=0).ravel())), shape=(2 * len(rows), width)
    ).tocsr()


def _step(hessian: coo_array, downhill: Numbers, split: int, points: int, damping: float) -> Numbers:
    """Points are eliminated first."""
    damped = hessian + coo_array((damping * hessian.diagonal(), (np.arange(len(downhill)),) * 2)).tocsr()
    of_points = bsr_array(damped[split:, split:], blocksize=(3, 3)).data
    inverse = bsr_array((np.linalg.inv(of_points), np.arange(points), np.arange(points + 1)))
    carried = damped[:split, split:] @ inverse
    reduced = (damped[:split, :split] - carried @ damped[split:, :split]).toarray()
    by_cameras = np.linalg.solve(reduced, downhill[:split] - carried @ downhill[split:])
    return np.concatenate([by_cameras, inverse @ (downhill[split:] - damped[split:, :split] @ by_cameras)])
