"""Depth images: whether there are depths in them at all."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapserver.doctor.findings import Finding, Limits, judge

# A wall at arm's length or a hall without end leaves a sensor little; one that is covered, off or read in a wrong unit gives nothing.
_LIMITS = Limits(0.9, 0.99, "of the pixels without a depth (median of frames)")
_RANGE_M = (0.05, 100.0)


def depth_share(depth_m: NDArray[np.float32]) -> float:
    """Share of the pixels (H, W) that have a depth which a sensor can measure."""
    return float(((depth_m > _RANGE_M[0]) & (depth_m < _RANGE_M[1])).mean())


def measured_depth(shares: Sequence[float]) -> Finding:
    """Whether frames, by their `depth_share`, have depths; the name is `depth`."""
    missing = 1.0 - float(np.median(shares)) if shares else 1.0
    bad = (
        f"{missing:.1%} of the pixels have no depth between 5 cm and 100 m; check that the depth camera runs, its topic, and that depths "
        "are metres (32FC1) or millimetres (16UC1), or leave them out with --use mono"
    )
    return judge("depth", missing, _LIMITS, f"{1 - missing:.0%} of the pixels have a depth", bad)
