"""Brightness of each view of a drive, and vignetting of its lens, from points seen in several images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from fleetmap.geometry import Array, Array32, Indices
from fleetmap.sensors.rectification import StereoCamera

FALLOFF = 3  # coefficients: of the squared tangent of the angle to the axis and of its powers
_ROUNDS, _HUBER, _MIN_SAMPLES, _PRIOR = 3, 0.1, 200, 1e-2


class Sample(NamedTuple):
    """N observations of points: point and view (N,), squared tangent of the angle to the axis (N,), logarithm of the grey level (N,)."""

    points: Indices
    images: Indices
    squared: Array
    logs: Array


@dataclass(frozen=True, slots=True)
class Exposure:
    """Logarithms of the images' brightness (K,) with mean 0, and coefficients (FALLOFF,) of the lens."""

    logs: Array
    falloff: Array


def squared_tangent(pixels: Array32, camera: StereoCamera) -> Array:
    """Return (N,) squared tangents of the angle to the axis, of pixels (N, 2)."""
    off = (pixels.astype(np.float64) - np.array([camera.cx_px, camera.cy_px])) / camera.focal_px
    return np.asarray((off**2).sum(axis=1))


def lens_factor(squared: Array, falloff: Array) -> Array:
    """Return the share of light transmitted by a lens at these squared tangents (...,), by its coefficients."""
    return np.asarray(np.exp(_powers(squared) @ falloff))


def estimate_exposure(samples: Sequence[Sample], images: int) -> Exposure:
    """Estimate by least squares on logarithms with Huber's weights; neutral for too few observations.

    Source: Goldman and Chen 2005, vignette and exposure calibration, with the response of the camera taken as linear.
    """
    every = Sample(*(np.concatenate([np.zeros(0), *(sample[i] for sample in samples)]) for i in range(4)))
    count = len(every.logs)
    if count < _MIN_SAMPLES:
        return Exposure(np.zeros(images), np.zeros(FALLOFF))
    _, shown = np.unique(every.points, return_inverse=True)
    # Columns of the lens and of the images; the points' own are eliminated by the Schur complement.
    first = FALLOFF + images
    columns = np.column_stack([np.tile(np.arange(FALLOFF), (count, 1)), FALLOFF + every.images]).astype(np.int32)
    values = np.column_stack([_powers(every.squared), np.ones(count)])
    starts = np.arange(0, values.size + 1, FALLOFF + 1)
    design = scipy.sparse.csr_array((values.ravel(), columns.ravel(), starts), (count, first))
    points = scipy.sparse.csr_array((np.ones(count), (np.arange(count), shown)))
    # Gauge: brighter images with darker points are equivalent. Unobserved values stay 0.
    prior = _PRIOR**2 * scipy.sparse.eye_array(first)
    weights, start = np.ones(count), np.zeros(first)
    for _ in range(_ROUNDS):
        weighted = design.T @ scipy.sparse.diags_array(weights)
        sums, sums_of_logs = (np.asarray(points.T @ column) for column in (weights, weights * every.logs))
        of_points = points.T @ weighted.T
        means = scipy.sparse.diags_array(np.reciprocal(sums)) @ of_points
        left = weighted @ design - of_points.T @ means + prior
        start = scipy.sparse.linalg.spsolve(left.tocsc(), weighted @ every.logs - means.T @ sums_of_logs)
        off = np.abs(every.logs - design @ start - (sums_of_logs / sums - means @ start)[shown])
        weights = np.minimum(1.0, _HUBER / np.maximum(off, 1e-9))
    logs = start[FALLOFF:]
    return Exposure(logs - logs.mean(), start[:FALLOFF])


def _powers(squared: Array) -> Array:
    return np.stack([squared ** (n + 1) for n in range(FALLOFF)], axis=-1)
