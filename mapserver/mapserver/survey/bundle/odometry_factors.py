"""Odometry between neighbouring keyframes, as factors of an adjustment and as edges of a pose graph. Pure."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from fleetmap.geometry import Array, se3_inverse, skew
from mapserver.survey.bundle.bundle_adjustment import RelativeTerm
from mapserver.survey.bundle.bundle_rounds import SurveyState
from mapserver.survey.keyframes.connected_components import MIN_SEEN
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.pose_graph.pose_graph import PoseEdge, adjoint

_FLOOR = 0.004, 0.01, 0.02  # least sigma of a step: of its turn, in metres, and in metres for each metre of way
# With an IMU, of keyframes that are adjusted with their neighbours; what is wrong with a calibration is in no odometry's covariance.
_INERTIAL_FLOOR = 0.0005, 0.002, 0.005


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
    covariance = _independent_step if odometry.inertial else edge_covariance
    return [
        PoseEdge(
            k,
            k + 1,
            se3_inverse(state.map_from_body[k]) @ state.map_from_body[k + 1],
            covariance(odometry, a, b),
            is_loop=False,
        )
        for k, a, b in _neighbours(odometry)
    ]


def _independent_step(odometry: OdometryPass, a: int, b: int) -> Array:
    """As `edge_covariance`, for steps whose covariances are to be added up along the way.

    What odometry does not know of its direction moves all that comes later: its covariance of the position has that with every step
    anew. Perturbed about the origin of its frame instead, its steps are independent of each other.
    """
    first, last = odometry.odom_from_body[[a, b]]
    carry = adjoint(se3_inverse(first))
    gained = _about_origin(odometry.covariances[b], last) - _about_origin(odometry.covariances[a], first)
    distance = float(np.linalg.norm(last[:3, 3] - first[:3, 3]))
    return _positive(carry @ gained @ carry.T) + _floor(distance, _INERTIAL_FLOOR)


def _about_origin(cov_rot_trans: Array, odom_from_body: Array) -> Array:
    """(6, 6) of a perturbation Exp(x) @ odom_from_body, from that of the rotation and of the position."""
    about = np.eye(6)
    about[3:, :3] = skew(odom_from_body[:3, 3])
    return np.asarray(about @ cov_rot_trans @ about.T)


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
    carry = np.kron(np.eye(2), odom_from_body.T)
    return np.asarray(carry @ _positive(gained) @ carry.T + _floor(distance, _FLOOR))


def _positive(covariance: Array) -> Array:
    """The nearest matrix (6, 6) that may be a covariance: a filter that learns knows in part more than before."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _floor(distance: float, least: tuple[float, float, float]) -> Array:
    turn_rad, slip_m, share = least
    return np.diag([turn_rad**2] * 3 + [(slip_m + share * distance) ** 2] * 3)
