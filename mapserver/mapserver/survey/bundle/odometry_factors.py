"""Odometry between neighbouring keyframes, as factors of an adjustment and as edges of a pose graph. Pure."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from mapserver.survey.bundle.bundle_adjustment import RelativeTerm
from mapserver.survey.bundle.bundle_rounds import SurveyState
from mapserver.survey.keyframes.connected_components import MIN_SEEN
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.pose_graph.pose_graph import PoseEdge


def odometry_factors(odometry: OdometryPass, map_from_body: Array) -> list[RelativeTerm]:
    """Without an IMU, neighbours are held by odometry: weakly, so that it decides only where landmarks do not.

    For one camera this also holds the scale, which its landmarks leave open.
    """
    return [
        _factor(k, se3_inverse(map_from_body[k]) @ map_from_body[k + 1], 25.0 * edge_covariance(odometry, a, b))
        for k, a, b in _neighbours(odometry)
    ]


def blackout_factors(odometry: OdometryPass, state: SurveyState) -> list[RelativeTerm]:
    """Odometry from and to keyframes that see next to nothing.

    With wheels it adds to the inertial factors; without wheels it adds nothing, and where there are landmarks it is not needed.
    """
    if not odometry.has_wheels:
        return []
    seen = np.bincount(state.landmarks.obs_keyframe, minlength=len(state.stamps_ns))
    factors = []
    for k, a, b in _neighbours(odometry):
        if min(seen[k], seen[k + 1]) < MIN_SEEN:
            i_from_j = se3_inverse(odometry.odom_from_body[a]) @ odometry.odom_from_body[b]
            factors.append(_factor(k, i_from_j, edge_covariance(odometry, a, b)))
    return factors


def chain_edges(odometry: OdometryPass, state: SurveyState) -> list[PoseEdge]:
    """Edges between neighbours with their adjusted motion and the covariance of the odometry."""
    edges = []
    for k, a, b in _neighbours(odometry):
        i_from_j = se3_inverse(state.map_from_body[k]) @ state.map_from_body[k + 1]
        edges.append(PoseEdge(k, k + 1, i_from_j, edge_covariance(odometry, a, b), is_loop=False))
    return edges


def _neighbours(odometry: OdometryPass) -> Iterator[tuple[int, int, int]]:
    """Number of each keyframe but the last, its frame and that of the next one."""
    for k, (a, b) in enumerate(pairwise(keyframe.frame_index for keyframe in odometry.keyframes)):
        yield k, a, b


def _factor(k: int, i_from_j: Array, covariance: Array) -> RelativeTerm:
    return RelativeTerm(k, k + 1, i_from_j, np.linalg.inv(covariance).astype(np.float64))


def edge_covariance(odometry: OdometryPass, a: int, b: int) -> Array:
    """(6, 6) of i_from_j between frames a and b, axes of a: what the odometry's uncertainty gained, with a floor."""
    first, last = odometry.odom_from_body[[a, b]]
    distance = float(np.linalg.norm(last[:3, 3] - first[:3, 3]))
    return gained_covariance(odometry.covariances[b] - odometry.covariances[a], first[:3, :3], distance)


def gained_covariance(gained: Array, odom_from_body: Array, distance: float) -> Array:
    """The same from the difference (6, 6) of two covariances in odom axes, the rotation (3, 3) at the first and the way between."""
    values, vectors = np.linalg.eigh(0.5 * (gained + gained.T))
    gained = (vectors * np.maximum(values, 0.0)) @ vectors.T
    carry = np.kron(np.eye(2), odom_from_body.T)
    floor = np.diag([0.004**2] * 3 + [(0.01 + 0.02 * distance) ** 2] * 3)
    return np.asarray(carry @ gained @ carry.T + floor)
