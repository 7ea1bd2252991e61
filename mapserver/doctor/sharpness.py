"""Sharpness of the images: the variance of their Laplacian. Source: Pech-Pacheco et al. 2000."""

from collections.abc import Sequence

import cv2
import numpy as np

from fleetmap.sensors.samples import Image
from mapserver.doctor.findings import Finding, Verdict, not_judged

_BLIND, _FLAT = 1.5, 6.0  # variance in grey levels squared: a covered lens; hardly an edge
_BLURRED_SHARE_OF_MEDIAN, _MANY = 0.25, 0.25


def laplacian_variance(image: Image) -> float:
    """Variance of the Laplacian after a light smoothing that takes pixel noise away, in grey levels squared."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var())


def sharpness(variances: Sequence[float]) -> Finding:
    """Judges the variances of some frames: how sharp the median is and how many fall far below it."""
    if not variances:
        return not_judged("sharpness", "no frame could be read", "copy the recording again")
    values = np.array(variances)
    median = float(np.median(values))
    blurred = float((values < _BLURRED_SHARE_OF_MEDIAN * median).mean())
    quarter = f"warn if {_MANY:.0%} are below a quarter of the median"
    limit = f"median: warn below {_FLAT:g}, fail below {_BLIND:g}; {quarter}"
    spread = f"variance of the Laplacian: median {median:.0f}, tenth percentile {np.percentile(values, 10):.0f}"
    if median < _BLIND:
        advice = "the images show next to nothing, look at the lens"
        return Finding("sharpness", Verdict.FAIL, median, limit, f"{spread}; {advice}")
    if median < _FLAT or blurred > _MANY:
        advice = f"{blurred:.0%} are blurred; shorten the exposure, clean and focus the lens"
        return Finding("sharpness", Verdict.WARN, median, limit, f"{spread}; {advice}")
    return Finding("sharpness", Verdict.OK, median, limit, spread)
