"""The terms of a bundle problem besides its images, packed into arrays and linearised."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import AnyArray, Array
from fleetmap.inertial import GRAVITY_MAP, Preintegrated
from mapserver.survey.bundle.factor_kernels import Measurement, linearise_inertial, linearise_prior, linearise_relative
from mapserver.survey.bundle.problem import BundleProblem, PriorTerm
from mapserver.survey.state import RelativeTerm

# Below this an increment's covariance means nothing: rounding of the sums, and it keeps empty intervals invertible.
FLOOR_SIGMA = np.repeat([1e-7, 1e-6, 1e-7, 1e-9, 1e-8], 3)


@dataclass
class State:
    """Everything that moves: rotations (K, 3, 3), positions_m (K, 3), motions (K, 9) or (K, 0), points_map (N, 3)."""

    rotations: Array
    positions_m: Array
    motions: Array
    points_map: Array

    def like(self) -> "State":
        """Room for another state of the same size."""
        return State(*(np.empty_like(a) for a in (self.rotations, self.positions_m, self.motions, self.points_map)))


@dataclass(frozen=True)
class Normal:
    """Normal equations of the terms: diagonal blocks and right-hand sides by keyframe, couplings by edge."""

    cost: float
    relative_blocks: Array
    relative_rhs: Array
    prior_blocks: Array
    prior_rhs: Array
    edge_blocks: Array
    edge_rhs: Array
    motion_diagonal: Array
    motion_rhs: Array


@dataclass(frozen=True)
class Terms:
    """Packed BundleProblem terms. ends (E, 2), increments (E, 67), informations (E, 15, 15); motion priors (K, 9)."""

    relative: list[RelativeTerm]
    priors: list[PriorTerm]
    ends: AnyArray
    increments: Array
    informations: Array
    motion_mean: Array
    motion_weight: Array

    def linearise(self, state: State) -> Normal:
        """Cost and normal equations at `state`."""
        relative_blocks, relative_rhs = np.zeros((len(self.relative), 12, 12)), np.zeros((len(self.relative), 12))
        prior_blocks, prior_rhs = np.zeros((len(self.priors), 6, 6)), np.zeros((len(self.priors), 6))
        edge_blocks, edge_rhs = np.zeros((len(self.ends), 30, 30)), np.zeros((len(self.ends), 30))
        cost = 0.0
        for n, term in enumerate(self.relative):
            measured, output = _measurement(term.i_from_j, term.information), (relative_blocks[n], relative_rhs[n])
            cost += linearise_relative(state.rotations, state.positions_m, (term.i, term.j), measured, *output)
        for n, prior in enumerate(self.priors):
            measured, output = _measurement(prior.map_from_body, prior.information), (prior_blocks[n], prior_rhs[n])
            cost += linearise_prior(state.rotations[prior.k], state.positions_m[prior.k], measured, *output)
        if len(self.ends):
            variables, edges = (state.rotations, state.positions_m, state.motions), (self.increments, self.informations)
            cost += linearise_inertial(variables, GRAVITY_MAP, self.ends, edges, edge_blocks, edge_rhs)
        off = state.motions - self.motion_mean
        cost += 0.5 * float((self.motion_weight * off**2).sum())
        blocks = relative_blocks, relative_rhs, prior_blocks, prior_rhs, edge_blocks, edge_rhs
        return Normal(cost, *blocks, self.motion_weight, -self.motion_weight * off)


def pack_terms(problem: BundleProblem) -> Terms:
    """The terms of `problem` in arrays."""
    inertial = problem.inertial
    edges = [] if inertial is None else inertial.edges
    width = 0 if inertial is None else 9
    mean, weight = np.zeros((len(problem.map_from_body), width)), np.zeros((len(problem.map_from_body), width))
    for prior in [] if inertial is None else inertial.priors:
        mean[prior.k] = np.where(np.isfinite(prior.sigma), prior.mean, 0.0)
        weight[prior.k] = 1.0 / prior.sigma**2
    return Terms(
        relative=problem.relative,
        priors=problem.priors,
        ends=np.array([(i, j) for i, j, _ in edges], np.int64).reshape(-1, 2),
        increments=np.array([packed_increments(summed) for _, _, summed in edges]).reshape(-1, 67),
        informations=np.array([_information(summed.cov) for _, _, summed in edges]).reshape(-1, 15, 15),
        motion_mean=mean,
        motion_weight=weight,
    )


def packed_increments(summed: Preintegrated) -> Array:
    """(67,) as `inertial_residual` takes them."""
    s = summed
    increments = [s.dt_s], s.delta_rotation, s.delta_velocity_mps, s.delta_position_m
    by_gyro_accel = (
        s.d_rotation_d_gyro,
        s.d_velocity_d_gyro,
        s.d_velocity_d_accel,
        s.d_position_d_gyro,
        s.d_position_d_accel,
    )
    parts = *increments, *by_gyro_accel, s.gyro_bias_radps, s.accel_bias_mps2
    return np.concatenate([np.ravel(part) for part in parts])


def _information(cov: Array) -> Array:
    """Inverse covariance (15, 15), scaled first: rotation and velocity differ by many orders of magnitude."""
    sigma = np.sqrt(np.diag(cov) + FLOOR_SIGMA**2)
    scaled = (cov + np.diag(FLOOR_SIGMA**2)) / np.outer(sigma, sigma)
    inverse = np.linalg.inv(scaled)
    return np.asarray(0.5 * (inverse + inverse.T) / np.outer(sigma, sigma))


def _measurement(measured: Array, information: Array) -> Measurement:
    return Measurement(np.ascontiguousarray(measured[:3, :3]), np.ascontiguousarray(measured[:3, 3]), information)
