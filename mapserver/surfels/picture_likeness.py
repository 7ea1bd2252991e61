"""How alike two grey pictures are: PSNR, and SSIM as Wang et al. 2004 define it (11 x 11 Gaussian window of 1.5 px)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array

_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
Grey = NDArray[np.uint8]


def psnr_db(first: Grey, second: Grey, where: NDArray[np.bool_] | None = None) -> float:
    """Peak signal over noise of the pixels (H, W) that are asked for, all without `where`."""
    squared = (first.astype(np.float64) - second) ** 2
    return float(10 * np.log10(255.0**2 / squared[slice(None) if where is None else where].mean()))


def ssim(first: Grey, second: Grey, where: NDArray[np.bool_] | None = None) -> float:
    """Mean structural similarity; `where`: of windows around these pixels alone."""

    def mean(values: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5))

    a, b = first.astype(np.float64), second.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, both = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + _C1) * (2 * both + _C2)
    likeness /= (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    return float(likeness[slice(None) if where is None else where].mean())
