"""Inner loop of matching two keyframes: where the features of one should appear in the other."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

_LOG_SCALE = np.log(1.2)


@kernel
def predict_features(
    b_from_a: Array,
    points_a: Array,
    disparities_a: Array,
    octaves_a: NDArray[np.int8],
    lens: Array,
    radius_px: float,
    predicted: Array,
    radius: Array,
    span: NDArray[np.int64],
) -> None:
    """Fills predicted (N, 2) pixels in b, radius (N,) and the octaves span (N, 2) to search; NaN pixels where a feature has no
    disparity (N,) or b cannot see it.

    b_from_a (4, 4), points_a (N, 3) as camera a sees them. lens: focal, cx, cy, width, height. Nearer, a feature appears larger
    and so on a higher octave; there pixels are coarser and the search is wider.
    """
    for n in range(len(points_a)):
        predicted[n, 0] = predicted[n, 1] = np.nan
        radius[n] = 0.0
        if not np.isfinite(disparities_a[n]):
            continue
        x, y, z = points_a[n, 0], points_a[n, 1], points_a[n, 2]
        bz = b_from_a[2, 0] * x + b_from_a[2, 1] * y + b_from_a[2, 2] * z + b_from_a[2, 3]
        if not bz > 1e-6:
            continue
        bx = b_from_a[0, 0] * x + b_from_a[0, 1] * y + b_from_a[0, 2] * z + b_from_a[0, 3]
        by = b_from_a[1, 0] * x + b_from_a[1, 1] * y + b_from_a[1, 2] * z + b_from_a[1, 3]
        u, v = lens[0] * bx / bz + lens[1], lens[0] * by / bz + lens[2]
        if not (0.0 < u < lens[3] and 0.0 < v < lens[4]):
            continue
        ratio = min(max(z / max(bz, 0.05), 0.1), 10.0)
        octave = octaves_a[n] + np.log(ratio) / _LOG_SCALE
        predicted[n, 0], predicted[n, 1] = u, v
        span[n, 0], span[n, 1] = int(np.floor(octave)) - 2, int(np.ceil(octave)) + 2
        radius[n] = radius_px * 1.2 ** min(max(octave, 0.0), 4.0)


@kernel
def share_in_view(b_from_a: Array, points_a: Array, disparities_a: Array, lens: Array) -> float:
    """Share of a's points with a disparity that b sees, at a similar distance; arguments as in `predict_features`."""
    known, seen = 0, 0
    for n in range(len(points_a)):
        if not np.isfinite(disparities_a[n]):
            continue
        known += 1
        x, y, z = points_a[n, 0], points_a[n, 1], points_a[n, 2]
        bz = b_from_a[2, 0] * x + b_from_a[2, 1] * y + b_from_a[2, 2] * z + b_from_a[2, 3]
        if not (bz > 1e-6 and 0.4 < bz / z < 2.5):
            continue
        bx = b_from_a[0, 0] * x + b_from_a[0, 1] * y + b_from_a[0, 2] * z + b_from_a[0, 3]
        by = b_from_a[1, 0] * x + b_from_a[1, 1] * y + b_from_a[1, 2] * z + b_from_a[1, 3]
        u, v = lens[0] * bx / bz + lens[1], lens[0] * by / bz + lens[2]
        seen += 0.0 < u < lens[3] and 0.0 < v < lens[4]
    return seen / known if known else 0.0
