"""Messages and services between a robot's localizer and nav2: conversion between bytes (CDR) and values.

Decoding raises ValueError for invalid bytes, FleetmapError for unusable content.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.occupancy_grid import OccupancyGrid
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import pack, unpack
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior
from locclient.plugins.ros2_node import keys  # noqa: F401 -- has the definitions of the messages here

EMPTY = pack("std_srvs/srv/Empty_Response", 0)


@dataclass(frozen=True, slots=True)
class Motion:
    """odom_from_base (4, 4) with its covariance (6, 6, rotation first, odom axes), and the velocity of the base in its own axes.

    twist_base: (6,) linear m/s, then angular rad/s; twist_cov (6, 6) in that order.
    """

    odom_from_base: Array
    cov_rot_trans: Array
    twist_base: Array
    twist_cov: Array


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """diagnostic_msgs/DiagnosticStatus. level: 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class BondStatus:
    """bond/Status: one side of a bond reports that it is alive, or that it ends."""

    bond: str
    instance: str
    is_active: bool


def decode_initial_pose(data: bytes, map_frame: str) -> PositionPrior:
    """geometry_msgs/PoseWithCovarianceStamped of an operator: a prior from now on, independent of its stamp.

    RecordingError for another frame, a pose or covariance that is not finite, and an invalid covariance.
    """
    _, frame_id = messages.header_of(data)
    if frame_id.lstrip("/") != map_frame:
        raise RecordingError(f"an initial pose in the frame {frame_id!r} is not used; give it in {map_frame!r}")
    try:
        prior = messages.decode_prior(data)
    except ValueError as error:
        raise RecordingError(f"an initial pose is not used: {error}; give a finite pose and a quaternion") from error
    cov = prior.cov_rot_trans
    if not np.isfinite(cov).all():
        raise RecordingError(
            "an initial pose is not used: its covariance holds NaN or infinity; give variances, or zeros"
        )
    if not np.allclose(cov, cov.T, atol=1e-6) or np.linalg.eigvalsh((cov + cov.T) / 2)[0] < -1e-6:
        raise RecordingError(
            "an initial pose is not used: its covariance is not symmetric and positive; check its order"
        )
    said = np.diag(cov) > 0
    unsaid = np.diag(np.where(said, 0.0, UNSAID_SIGMAS**2))
    cov = np.where(np.outer(said, said), (cov + cov.T) / 2, 0.0) + unsaid
    return PositionPrior(0, prior.map_from_base, cov, is_revisable=True)


def encode_text(text: str) -> bytes:
    """std_msgs/String."""
    return pack("std_msgs/String", text)


def encode_motion(stamp_ns: int, frame_id: str, child_frame_id: str, motion: Motion) -> bytes:
    """nav_msgs/Odometry."""
    placed = motion.odom_from_base, motion.cov_rot_trans[messages.HALVES_SWAPPED]
    return messages.encode_motion(stamp_ns, frame_id, child_frame_id, *placed, motion.twist_base, motion.twist_cov)


def encode_diagnostics(stamp_ns: int, diagnoses: Sequence[Diagnosis]) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    rows = [(one.level, one.name, one.message, one.hardware_id, one.values.items()) for one in diagnoses]
    return pack("diagnostic_msgs/DiagnosticArray", stamp_ns, "", rows)


def encode_bond(stamp_ns: int, status: BondStatus, timeout_s: float, period_s: float) -> bytes:
    """bond/Status."""
    return pack("bond/Status", stamp_ns, "", status.bond, status.instance, status.is_active, timeout_s, period_s)


def decode_bond(data: bytes) -> BondStatus:
    """bond/Status."""
    _, _, bond, instance, is_active, *_ = unpack("bond/Status", data)
    return BondStatus(bond, instance, bool(is_active))


def encode_grid(stamp_ns: int, frame_id: str, grid: OccupancyGrid) -> bytes:
    """nav_msgs/OccupancyGrid."""
    height, width = grid.cells.shape
    place, cells = messages.position_quat_xyzw(grid.map_from_grid), np.ascontiguousarray(grid.cells, np.int8).tobytes()
    size = grid.resolution_m, width, height
    return pack("nav_msgs/OccupancyGrid", stamp_ns, frame_id, stamp_ns, *size, place, cells)
