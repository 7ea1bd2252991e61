"""The terms of a bundle problem except its images, as arrays for the core."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial import Preintegrated
from mapserver.survey.bundle.problem import BundleProblem

# Lower bound of an increment's covariance: below is rounding error, and the bound keeps empty intervals invertible.
FLOOR_SIGMA = np.repeat([1e-7, 1e-6, 1e-7, 1e-9, 1e-8], 3)

# Parts of an increment in the core's order, and their sizes.
_INCREMENTS = {
    "dt_s": 1,
    "delta_rotation": 9,
    "delta_velocity_mps": 3,
    "delta_position_m": 3,
    "d_rotation_d_gyro": 9,
    "d_velocity_d_gyro": 9,
    "d_velocity_d_accel": 9,
    "d_position_d_gyro": 9,
    "d_position_d_accel": 9,
    "gyro_bias_radps": 3,
    "accel_bias_mps2": 3,
}


class Terms(NamedTuple):
    """Arrays of R relative poses, Q pose priors, E inertial edges, and motion priors of K keyframes, with the core's names."""

    relative_ends: AnyArray
    i_from_j: Array
    relative_information: Array
    prior_keyframe: AnyArray
    prior_map_from_body: Array
    prior_information: Array
    edge_ends: AnyArray
    increments: Array
    edge_information: Array
    motion_mean: Array
    motion_weight: Array


def pack_terms(problem: BundleProblem) -> Terms:
    """Pack the terms of `problem` into arrays."""
    relative, priors, inertial = problem.relative, problem.priors, problem.inertial
    edges = [] if inertial is None else inertial.edges
    width = 0 if inertial is None else 9
    mean, weight = np.zeros((len(problem.map_from_body), width)), np.zeros((len(problem.map_from_body), width))
    for prior in [] if inertial is None else inertial.priors:
        mean[prior.k] = np.where(np.isfinite(prior.sigma), prior.mean, 0.0)
        weight[prior.k] = 1.0 / prior.sigma**2
    return Terms(
        np.array([(term.i, term.j) for term in relative], np.int64).reshape(-1, 2),
        np.array([term.i_from_j for term in relative], np.float64).reshape(-1, 4, 4),
        np.array([term.information for term in relative], np.float64).reshape(-1, 6, 6),
        np.array([prior.k for prior in priors], np.int64),
        np.array([prior.map_from_body for prior in priors], np.float64).reshape(-1, 4, 4),
        np.array([prior.information for prior in priors], np.float64).reshape(-1, 6, 6),
        np.array([(i, j) for i, j, _ in edges], np.int64).reshape(-1, 2),
        packed_increments([summed for _, _, summed in edges]),
        _informations(np.array([summed.cov for _, _, summed in edges]).reshape(-1, 15, 15)),
        mean,
        weight,
    )


def packed_increments(summed: Sequence[Preintegrated]) -> Array:
    """Return (E, 67): dt, dR, dv, dp, the five derivatives by the biases, and the biases of linearisation."""
    parts = [np.array([getattr(each, name) for each in summed]).reshape(-1, size) for name, size in _INCREMENTS.items()]
    return np.concatenate(parts, axis=1)


def _informations(covariances: Array) -> Array:
    """Return inverse covariances (E, 15, 15), scaled first: rotation and velocity differ by many orders of magnitude."""
    sigma = np.sqrt(np.einsum("eaa->ea", covariances) + FLOOR_SIGMA**2)
    outer = sigma[:, :, None] * sigma[:, None, :]
    inverse = np.linalg.inv((covariances + np.diag(FLOOR_SIGMA**2)) / outer)
    return np.asarray(0.5 * (inverse + inverse.transpose(0, 2, 1)) / outer)
