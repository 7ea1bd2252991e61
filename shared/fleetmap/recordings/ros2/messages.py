"""ROS 2 messages of recordings: conversion between bytes (CDR) and the project's values.

Decoding raises ValueError for invalid bytes; the reader counts them. Rotations are written as
quaternions x y z w and covariances translation first, as in ROS; here they are wxyz and rotation first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fleetmap.geometry import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3
from fleetmap.recordings.images import INVERSE_DEPTH, StoredImage, file_kind
from fleetmap.recordings.ros2.cdr import byte_order, pack, unpack
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import PositionPrior, Stamps, WheelSample

# Assumed for odometry without a covariance
UNKNOWN_WHEEL_SIGMA_MPS, UNKNOWN_WHEEL_SIGMA_RADPS = 0.05, 0.05
HALVES_SWAPPED = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])  # of a covariance (6, 6): translation or rotation first
_IMU_DOUBLES = 37
_SLIGHTLY_OFF_UNIT, _MOST_OFF_UNIT = 1e-3, 0.1  # of a quaternion's length: rounded by hand; not a rotation


@dataclass(frozen=True, slots=True)
class FrameLink:
    """One transform of a /tf or /tf_static message: parent_from_child (4, 4), and its stamp if it was read from one.

    issue: fault of its numbers; parent_from_child is NaN if they are not a transform.
    """

    parent: str
    child: str
    parent_from_child: Array
    stamp_ns: int = 0
    issue: str = ""

    @property
    def is_usable(self) -> bool:
        """True unless parent_from_child is NaN."""
        return bool(np.isfinite(self.parent_from_child).all())


def header_of(data: bytes) -> tuple[int, str]:
    """Stamp in ns and frame_id of a message that begins with a header."""
    stamp_ns, frame_id = unpack("std_msgs/Header", data)
    return stamp_ns, frame_id


def decode_image(data: bytes, where: str) -> StoredImage:
    """sensor_msgs/Image."""
    _, _, height, width, encoding, big_endian, step, pixels = unpack("sensor_msgs/Image", data)
    return StoredImage(encoding, pixels, where, width, height, step, bool(big_endian))


def encode_image(stamp_ns: int, frame_id: str, image: StoredImage) -> bytes:
    """sensor_msgs/Image of an image stored in rows."""
    form = image.encoding, image.big_endian, image.step_bytes
    return pack("sensor_msgs/Image", stamp_ns, frame_id, image.height_px, image.width_px, *form, image.data)


def decode_compressed_image(data: bytes, where: str) -> StoredImage:
    """sensor_msgs/CompressedImage: an image file's bytes, after a 12-byte header if packed by compressed_depth_image_transport."""
    _, _, form, content = unpack("sensor_msgs/CompressedImage", data)
    if "compressedDepth" in form and form.strip().startswith("32FC1"):
        return StoredImage(INVERSE_DEPTH, content, where, form=form)
    if "compressedDepth" in form and file_kind(content[12:]) == "png":
        content = content[12:]
    return StoredImage("file", content, where, form=form)


def encode_compressed_image(stamp_ns: int, frame_id: str, image: StoredImage, form: str) -> bytes:
    """sensor_msgs/CompressedImage of an image file's bytes."""
    return pack("sensor_msgs/CompressedImage", stamp_ns, frame_id, form, image.data)


def encode_camera_info(stamp_ns: int, frame_id: str, camera: CameraCalibration) -> bytes:
    """sensor_msgs/CameraInfo of an unrectified camera: its projection is that of the camera itself, without binning, of the whole image."""
    fx, fy, cx, cy = camera.intrinsics_px
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    name, distortion = camera.model, camera.distortion
    if name == "radial-tangential" and len(distortion) <= 5:  # plumb_bob has five coefficients in ROS
        name, distortion = "plumb_bob", np.pad(distortion, (0, 5 - len(distortion)))
    elif name == "radial-tangential":
        name = "rational_polynomial"
    matrices = np.concatenate([each.ravel() for each in (matrix, np.eye(3), np.pad(matrix, ((0, 0), (0, 1))))])
    values = camera.height_px, camera.width_px, name, distortion, matrices
    return pack("sensor_msgs/CameraInfo", stamp_ns, frame_id, *values, *[0] * 7)


def decode_imu(messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
    """Stamps (N,), gyro (N, 3), accelerometer (N, 3) of sensor_msgs/Imu messages, and the frame_id of the first.

    Messages of one length and byte order are read together; ValueError does not name the faulty one: the caller decodes one by one to
    find it.
    """
    if len({(len(data), data[:2]) for data in messages}) > 1:
        *columns, frame_ids = zip(*(decode_imu([data]) for data in messages), strict=True)
        stamps_ns, gyro, accel = (np.concatenate(column) for column in columns)
        return stamps_ns, gyro, accel, frame_ids[0]
    _, frame_id = header_of(messages[0])
    order = byte_order(messages[0])
    name_bytes = int(np.frombuffer(messages[0][12:16], order + "u4")[0])
    start = 16 + name_bytes + (-(12 + name_bytes) % 8)
    if len(messages[0]) < start + 8 * _IMU_DOUBLES:
        raise ValueError(f"an Imu message of {len(messages[0])} bytes is too short")
    table = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
    seconds = np.ascontiguousarray(table[:, 4:8]).view(order + "i4")[:, 0].astype(np.int64)
    nanoseconds = np.ascontiguousarray(table[:, 8:12]).view(order + "u4")[:, 0].astype(np.int64)
    values = np.ascontiguousarray(table[:, start : start + 8 * _IMU_DOUBLES]).view(order + "f8").astype(np.float64)
    return seconds * 1_000_000_000 + nanoseconds, values[:, 13:16].copy(), values[:, 25:28].copy(), frame_id


def encode_imu(stamp_ns: int, frame_id: str, gyro_radps: Array, accel_mps2: Array) -> bytes:
    """sensor_msgs/Imu without orientation (marked so by -1, as ROS asks)."""
    values = np.zeros(_IMU_DOUBLES)
    values[3], values[4] = 1.0, -1.0
    values[13:16], values[25:28] = gyro_radps, accel_mps2
    return pack("sensor_msgs/Imu", stamp_ns, frame_id, values)


def decode_odometry(data: bytes) -> WheelSample:
    """The twist of nav_msgs/Odometry, in the axes of its child frame (the base).

    A variance that is not positive is unknown.
    """
    stamp_ns, _, _, values = unpack("nav_msgs/Odometry", data)
    twist, variances = values[43:49], np.diag(values[49:].reshape(6, 6))
    sigma_mps = float(np.sqrt(variances[0])) if variances[0] > 0 else UNKNOWN_WHEEL_SIGMA_MPS
    sigma_radps = float(np.sqrt(variances[5])) if variances[5] > 0 else UNKNOWN_WHEEL_SIGMA_RADPS
    if not np.isfinite(twist).all():
        raise ValueError("the twist is not finite")
    return WheelSample(stamp_ns, twist[:3].copy(), float(twist[5]), sigma_mps, sigma_radps)


def encode_odometry(sample: WheelSample, frame_id: str, child_frame_id: str) -> bytes:
    """nav_msgs/Odometry that carries the twist; its pose stays at the origin with an infinite variance."""
    twist = np.concatenate([sample.velocity_base_mps, [0.0, 0.0, sample.yaw_rate_radps]])
    variances = np.diag([sample.sigma_mps**2] * 3 + [sample.sigma_radps**2] * 3)
    return encode_motion(sample.stamp_ns, frame_id, child_frame_id, np.eye(4), np.diag([np.inf] * 6), twist, variances)


def encode_motion(
    stamp_ns: int, frame_id: str, child_id: str, frame_from_child: Array, cov: Array, twist: Array, twist_cov: Array
) -> bytes:
    """nav_msgs/Odometry; covariances (6, 6) in ROS's order, translation first."""
    values = [each.ravel() for each in (position_quat_xyzw(frame_from_child), cov, twist, twist_cov)]
    return pack("nav_msgs/Odometry", stamp_ns, frame_id, child_id, np.concatenate(values))


def decode_prior(data: bytes) -> PositionPrior:
    """geometry_msgs/PoseWithCovarianceStamped as map_from_base."""
    stamp_ns, _, values = unpack("geometry_msgs/PoseWithCovarianceStamped", data)
    position_m, quat_xyzw, cov = values[:3], values[3:7], values[7:]
    if not np.isfinite(values[:7]).all() or abs(float(np.linalg.norm(quat_xyzw)) - 1) > 0.01:
        raise ValueError(f"the quaternion {quat_xyzw.tolist()} is not of unit length")
    map_from_base = se3(rotation_from_quat_wxyz(quat_xyzw[[3, 0, 1, 2]]), position_m)
    return PositionPrior(stamp_ns, map_from_base, cov.reshape(6, 6)[HALVES_SWAPPED])


def encode_prior(prior: PositionPrior, frame_id: str) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped."""
    values = np.append(position_quat_xyzw(prior.map_from_base), prior.cov_rot_trans[HALVES_SWAPPED])
    return pack("geometry_msgs/PoseWithCovarianceStamped", prior.stamp_ns, frame_id, values)


def decode_pose(data: bytes) -> tuple[int, Array]:
    """geometry_msgs/PoseStamped: stamp and x y z qw qx qy qz (7,), not checked."""
    stamp_ns, _, values = unpack("geometry_msgs/PoseStamped", data)
    return stamp_ns, values[[0, 1, 2, 6, 3, 4, 5]]


def encode_pose(stamp_ns: int, frame_id: str, frame_from_body: Array) -> bytes:
    """geometry_msgs/PoseStamped."""
    return pack("geometry_msgs/PoseStamped", stamp_ns, frame_id, position_quat_xyzw(frame_from_body))


def decode_frame_links(data: bytes) -> list[FrameLink]:
    """tf2_msgs/TFMessage."""
    (links,) = unpack("tf2_msgs/TFMessage", data)
    return [
        replace(frame_link(parent, child, values[:3], values[[6, 3, 4, 5]]), stamp_ns=stamp_ns)
        for stamp_ns, parent, child, values in links
    ]


def frame_link(parent: str, child: str, translation: Array, quat_wxyz: Array) -> FrameLink:
    """The transform of a quaternion that may deviate slightly from unit length; NaN with an issue if it is not a rotation."""
    parent, child, norm = parent.lstrip("/"), child.lstrip("/"), float(np.linalg.norm(quat_wxyz))
    is_usable = bool(np.isfinite(translation).all() and abs(norm - 1) < _MOST_OFF_UNIT)  # False for NaN
    issue = ""
    if not is_usable or abs(norm - 1) > _SLIGHTLY_OFF_UNIT:
        done = (
            "it is normalised" if is_usable else "it is left out; publish it with a unit quaternion and finite numbers"
        )
        issue = f"{parent} -> {child}: position {translation.tolist()}, quaternion w x y z {quat_wxyz.tolist()}; {done}"
    if not is_usable:
        return FrameLink(parent, child, np.full((4, 4), np.nan), issue=issue)
    return FrameLink(parent, child, se3(rotation_from_quat_wxyz(quat_wxyz), translation), issue=issue)


def encode_frame_links(stamp_ns: int, links: Sequence[FrameLink]) -> bytes:
    """tf2_msgs/TFMessage."""
    values = [(stamp_ns, k.parent, k.child, position_quat_xyzw(k.parent_from_child)) for k in links]
    return pack("tf2_msgs/TFMessage", values)


def position_quat_xyzw(target_from_source: Array) -> Array:
    """x y z qx qy qz qw (7,), the numbers of a geometry_msgs/Pose."""
    quat_wxyz = quat_wxyz_from_rotation(target_from_source[:3, :3])
    return np.concatenate([target_from_source[:3, 3], quat_wxyz[1:], quat_wxyz[:1]])


DECODERS: dict[str, Callable[[bytes], Any]] = {
    "sensor_msgs/Image": partial(decode_image, where=""),
    "sensor_msgs/CompressedImage": partial(decode_compressed_image, where=""),
    "sensor_msgs/Imu": lambda data: decode_imu([data]),
    "nav_msgs/Odometry": decode_odometry,
    "geometry_msgs/PoseWithCovarianceStamped": decode_prior,
    "geometry_msgs/PoseStamped": decode_pose,
}
"""From the bytes of a message to its value: StoredImage, as of `decode_imu`, WheelSample, PositionPrior, stamp and pose."""
