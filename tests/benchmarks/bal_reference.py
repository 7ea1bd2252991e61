"""A second opinion on a problem of bundle adjustment in the large: scipy's trust region, told nothing but the residuals.

Nothing is shared with the project's solver: the projection is written from the format's definition (Agarwal et al. 2010),
with rotation vectors as unknowns and derivatives by differences, and no observation is left out.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

Numbers = NDArray[np.float64]


def reference_cost(file: Path, start: Numbers | None = None, max_evaluations: int = 200) -> float:
    """Half the sum of squares that scipy reaches; start (9 cameras + 3 points,) in the place of the file's own."""
    numbers = np.array(file.read_text().split(), np.float64)
    cameras, points, count = (int(value) for value in numbers[:3])
    rows = numbers[3 : 3 + 4 * count].reshape(-1, 4)
    camera, point, pixels = rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:]

    def residuals(unknowns: Numbers) -> Numbers:
        placed = unknowns[: 9 * cameras].reshape(-1, 9)[camera]
        seen = Rotation.from_rotvec(placed[:, :3]).apply(unknowns[9 * cameras :].reshape(-1, 3)[point]) + placed[:, 3:6]
        flat = -seen[:, :2] / seen[:, 2:]
        squared = (flat**2).sum(axis=1)
        scale = placed[:, 6] * (1.0 + placed[:, 7] * squared + placed[:, 8] * squared**2)
        return (scale[:, None] * flat - pixels).ravel()

    pattern = lil_matrix((2 * count, 9 * cameras + 3 * points), dtype=np.int8)
    each = np.arange(count)
    for side in (0, 1):
        for k in range(9):
            pattern[2 * each + side, 9 * camera + k] = 1
        for k in range(3):
            pattern[2 * each + side, 9 * cameras + 3 * point + k] = 1
    found = least_squares(
        residuals, numbers[3 + 4 * count :] if start is None else start, jac_sparsity=pattern, x_scale="jac", method="trf",
        ftol=1e-5, max_nfev=max_evaluations,
    )  # fmt: skip
    return float(found.cost)
