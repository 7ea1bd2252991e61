"""Messages and services between a robot's localizer and nav2: conversion between bytes (CDR) and values.

Decoding raises ValueError for invalid bytes, FleetmapError for unusable content.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.occupancy_grid import OccupancyGrid
from fleetmap.recordings.ros2.cdr import CdrReader, CdrWriter
from fleetmap.recordings.ros2.messages import HALVES_SWAPPED, decode_prior, header_of, position_quat_xyzw
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior

EMPTY = CdrWriter().byte(0).message()  # a message without fields


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
    _, frame_id = header_of(data)
    if frame_id.lstrip("/") != map_frame:
        raise RecordingError(f"an initial pose in the frame {frame_id!r} is not used; give it in {map_frame!r}")
    try:
        prior = decode_prior(data)
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
    cov = np.where(said[:, None] & said[None, :], (cov + cov.T) / 2, 0.0) + np.diag(
        np.where(said, 0.0, UNSAID_SIGMAS**2)
    )
    return PositionPrior(0, prior.map_from_base, cov, is_revisable=True)


def encode_text(text: str) -> bytes:
    """std_msgs/String."""
    return CdrWriter().text(text).message()


def encode_motion(stamp_ns: int, frame_id: str, child_frame_id: str, motion: Motion) -> bytes:
    """nav_msgs/Odometry."""
    writer = CdrWriter().header(stamp_ns, frame_id).text(child_frame_id)
    writer.doubles(position_quat_xyzw(motion.odom_from_base)).doubles(motion.cov_rot_trans[HALVES_SWAPPED])
    return writer.doubles(motion.twist_base).doubles(motion.twist_cov).message()


def encode_diagnostics(stamp_ns: int, diagnoses: Sequence[Diagnosis]) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    writer = CdrWriter().header(stamp_ns, "").unsigned(len(diagnoses))
    for one in diagnoses:
        writer.byte(one.level).text(one.name).text(one.message).text(one.hardware_id).unsigned(len(one.values))
        for key, value in one.values.items():
            writer.text(key).text(value)
    return writer.message()


def encode_bond(stamp_ns: int, status: BondStatus, timeout_s: float, period_s: float) -> bytes:
    """bond/Status."""
    writer = CdrWriter().header(stamp_ns, "").text(status.bond).text(status.instance).byte(status.is_active)
    return writer.single(timeout_s).single(period_s).message()


def decode_bond(data: bytes) -> BondStatus:
    """bond/Status."""
    reader = CdrReader(data)
    reader.stamp_ns(), reader.text()
    return BondStatus(reader.text(), reader.text(), bool(reader.byte()))


def encode_grid(stamp_ns: int, frame_id: str, grid: OccupancyGrid) -> bytes:
    """nav_msgs/OccupancyGrid."""
    height, width = grid.cells.shape
    writer = (
        CdrWriter().header(stamp_ns, frame_id).time(stamp_ns).single(grid.resolution_m).unsigned(width).unsigned(height)
    )
    return (
        writer.doubles(position_quat_xyzw(grid.map_from_grid))
        .blob(np.ascontiguousarray(grid.cells, np.int8).tobytes())
        .message()
    )
