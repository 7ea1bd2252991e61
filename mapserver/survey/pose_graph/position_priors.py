"""Position priors as edges of the loops' gate: relative poses of keyframes by docks, tags and zones. Pure.

In a survey among similar aisles some devices give its position to a metre from time to time. Its pose graph drifts by more than that;
an aisle is 4.5 m wide. The gate therefore uses each prior relative to the first one with a heading. The map does not: its shape is
measured by the sensors only.
"""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, adjoint
from mapserver.survey.state import OdometryPass

_MAX_GAP_NS = 500_000_000  # between a prior and the frame used for it
_HEADING_KNOWN_RAD = 0.2
_UNKNOWN_VARIANCE = np.array([1.0] * 3 + [1e4] * 3)  # rad^2, m^2
# Errors of a prior by the floor's unevenness and a robot's tilt (roll, pitch, yaw in rad; x, y, z in m), and by its transfer to a keyframe.
_BETWEEN = np.diag(np.square([0.05, 0.05, 0.0, 0.05, 0.05, 0.25]))


def learn_priors(
    marginals: GraphMarginals, priors: Sequence[PositionPrior], base_from_body: Array, odometry: OdometryPass
) -> int:
    """Add position priors to a graph of the odometry's keyframes; return how many contradict it and were left out.

    Without a prior with a heading nothing is added: positions alone do not give the survey's heading.
    """
    usable = _usable(priors, odometry)
    first = next((n for n, (prior, _) in enumerate(usable) if prior.cov_rot_trans[2, 2] <= _HEADING_KNOWN_RAD**2), None)
    if first is None:
        return 0
    contradicting = 0
    reference, frame = usable[first]
    keyframe = _keyframe_at(frame, odometry)
    map_from_i = reference.map_from_base @ base_from_body @ se3_inverse(_led(keyframe, frame, odometry))
    for n, (prior, at) in enumerate(usable):
        other = _keyframe_at(at, odometry)
        if n == first or other == keyframe:
            continue
        led = _led(other, at, odometry)
        edge = _edge(marginals, keyframe, map_from_i, reference, other, prior, led, base_from_body)
        if marginals.innovation_squared(edge) <= CHI2_6_0999:
            marginals.add(edge)
        else:
            contradicting += 1
    return contradicting


def _usable(priors: Sequence[PositionPrior], odometry: OdometryPass) -> list[tuple[PositionPrior, int]]:
    """Return priors of devices with known position in the plane, each with the frame nearest in time."""
    stamps_ns = np.array([e.stamp_ns for e in odometry.estimates], np.int64)
    found = []
    for prior in priors:
        frame = int(np.argmin(np.abs(stamps_ns - prior.stamp_ns)))
        is_near = abs(int(stamps_ns[frame]) - prior.stamp_ns) <= _MAX_GAP_NS
        if is_near and not prior.is_revisable and np.isfinite(np.diag(prior.cov_rot_trans)[3:5]).all():
            found.append((prior, frame))
    return found


def _keyframe_at(frame: int, odometry: OdometryPass) -> int:
    """Return the keyframe nearest to a frame."""
    return int(np.argmin([abs(k.frame_index - frame) for k in odometry.keyframes]))


def _led(keyframe: int, frame: int, odometry: OdometryPass) -> Array:
    """Return keyframe_from_frame (4, 4) of the body, by odometry."""
    first = odometry.odom_from_body[odometry.keyframes[keyframe].frame_index]
    return np.asarray(se3_inverse(first) @ odometry.odom_from_body[frame])


def _edge(
    marginals: GraphMarginals,
    i: int,
    map_from_i: Array,
    reference: PositionPrior,
    j: int,
    prior: PositionPrior,
    led: Array,
    base_from_body: Array,
) -> PoseEdge:
    """Return the pose of keyframe j relative to i by their priors. Its heading is the graph's own and unconstrained by the edge."""
    placed = marginals.map_from_body
    turn_ij = placed[i, :3, :3].T @ placed[j, :3, :3]
    turn_map_j = map_from_i[:3, :3] @ turn_ij
    turn_map_base = turn_map_j @ led[:3, :3] @ base_from_body[:3, :3].T
    body_m = prior.map_from_base[:3, 3] + turn_map_base @ base_from_body[:3, 3] - turn_map_j @ led[:3, 3]
    i_from_j = se3(turn_ij, map_from_i[:3, :3].T @ (body_m - map_from_i[:3, 3]))
    turned = np.kron(np.eye(2), map_from_i[:3, :3].T)
    free = adjoint(i_from_j)[:, :3]  # any rotation of j about itself
    where = np.diag([0.0] * 3 + [1.0] * 3)  # of the prior only its position counts
    covariance = turned @ (_finite(reference) + where @ _finite(prior) @ where + _BETWEEN) @ turned.T + free @ free.T
    return PoseEdge(i, j, i_from_j, covariance, is_loop=True)


def _finite(prior: PositionPrior) -> Array:
    """Return its covariance (6, 6) with large variances instead of infinite ones, which are uncorrelated."""
    variances = np.diag(prior.cov_rot_trans)
    finite = np.where(np.isfinite(prior.cov_rot_trans), prior.cov_rot_trans, 0.0)
    unknown = ~np.isfinite(variances)
    finite[unknown] = finite[:, unknown] = 0.0
    finite[unknown, unknown] = _UNKNOWN_VARIANCE[unknown]
    return finite
