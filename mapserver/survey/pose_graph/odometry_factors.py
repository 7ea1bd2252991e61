"""Odometry between neighbouring keyframes, as factors of an adjustment and as edges of a pose graph. Pure."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse, transport_cov, turned_cov
from fleetmap.odometry.sensor_buffer import is_pause
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.settings import MIN_SEEN
from mapserver.survey.state import OdometryPass, RelativeTerm, SurveyState


class Floor(NamedTuple):
    """Smallest sigma of a step: of its rotation, constant and per radian, of its translation, constant and per metre."""

    rotation_rad: float
    rotation_share: float
    translation_m: float
    translation_share: float

    def covariance(self, first_from_last: Array) -> Array:
        """Return (6, 6) of a step (4, 4)."""
        turn_rad, way_m = rotation_angle_rad(first_from_last[:3, :3]), float(np.linalg.norm(first_from_last[:3, 3]))
        sigmas = self.rotation_rad + self.rotation_share * turn_rad, self.translation_m + self.translation_share * way_m
        return np.diag(np.repeat(np.square(sigmas), 3))


FLOOR = Floor(0.004, 0.0, 0.01, 0.02)
# With an IMU, of a chain of keyframes that are adjusted with their neighbours. Odometry covariances do not include calibration errors:
# data sheets of IMUs give the scale and the axes of their gyros to about 1 %, and a warm mount bends a stereo pair by as much.
INERTIAL_FLOOR = Floor(0.0005, 0.01, 0.002, 0.01)


def odometry_factors(odometry: OdometryPass, map_from_body: Array) -> list[RelativeTerm]:
    """Return weak odometry factors between neighbours, without an IMU: they matter only without landmarks.

    For one camera they also fix the scale, which its landmarks leave free.
    """
    return [
        _factor(k, se3_inverse(map_from_body[k]) @ map_from_body[k + 1], 25.0 * edge_covariance(odometry, a, b))
        for k, (a, b) in enumerate(pairwise(odometry.keyframe_frames))
    ]


def blackout_factors(odometry: OdometryPass, state: SurveyState) -> list[RelativeTerm]:
    """Return odometry factors across pauses, which no inertial factor spans, and from and to keyframes with few observations.

    There wheel odometry adds to the inertial factors; without wheels it adds nothing, and with landmarks it is not needed.
    """
    seen = np.bincount(state.landmarks.obs_keyframe, minlength=len(state.stamps_ns))
    stamps_ns = (state.stamps_ns + int(state.motion.imu_minus_cam_s * 1e9)).tolist()
    factors = []
    for k, (a, b) in enumerate(pairwise(odometry.keyframe_frames)):
        is_blind = odometry.has_wheels and min(seen[k], seen[k + 1]) < MIN_SEEN
        if is_blind or is_pause(state.motion.imu.stamps_ns, stamps_ns[k], stamps_ns[k + 1]):
            i_from_j = se3_inverse(odometry.odom_from_body[a]) @ odometry.odom_from_body[b]
            factors.append(_factor(k, i_from_j, edge_covariance(odometry, a, b)))
    return factors


def chain_edges(odometry: OdometryPass, state: SurveyState) -> list[PoseEdge]:
    """Return edges between neighbours with their adjusted motion and the covariance of the odometry."""
    least, edges = INERTIAL_FLOOR if odometry.inertial else FLOOR, []
    for k, (a, b) in enumerate(pairwise(odometry.keyframe_frames)):
        i_from_j = se3_inverse(state.map_from_body[k]) @ state.map_from_body[k + 1]
        edges.append(PoseEdge(k, k + 1, i_from_j, edge_covariance(odometry, a, b, least), is_loop=False))
    return edges


def _factor(k: int, i_from_j: Array, covariance: Array) -> RelativeTerm:
    return RelativeTerm(k, k + 1, i_from_j, np.linalg.inv(covariance).astype(np.float64))


def edge_covariance(odometry: OdometryPass, a: int, b: int, least: Floor = FLOOR) -> Array:
    """Return (6, 6) of i_from_j between frames a and b, axes of a: the growth of the odometry's uncertainty, with a least one."""
    first, last = odometry.odom_from_body[[a, b]]
    known = odometry.covariances[a], odometry.covariances[b]
    return step_covariance(known, first[:3, :3], se3_inverse(first) @ last, least)


def step_covariance(known: tuple[Array, Array], odom_from_first: Array, first_from_last: Array, least: Floor) -> Array:
    """Return (6, 6) of a step in axes of its first body, from covariances (6, 6) of both poses in odom axes; first's rotation (3, 3).

    An initial error of direction also moves the last pose, and is contained in its covariance at every step. About the position of
    the first pose, where it has no effect, the last covariance is larger by the step's own part: such steps are independent.
    """
    gained = transport_cov(known[1], -odom_from_first @ first_from_last[:3, 3]) - known[0]
    values, vectors = np.linalg.eigh(0.5 * (gained + gained.T))
    gained = (vectors * np.maximum(values, 0.0)) @ vectors.T  # one camera's first frames may have moved since
    return turned_cov(gained, odom_from_first.T) + least.covariance(first_from_last)
