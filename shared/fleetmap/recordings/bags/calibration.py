"""Calibration from an MCAP file's CameraInfo messages and static transforms, where it has no attachment of ours."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.recordings.ros2.messages import CameraInfo, FrameLink
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration, check_camera
from fleetmap.sensors.cameras import lens_of

_UPRIGHT = 0.9  # the cosine of 26 degrees
_BASE_FRAMES = ("base", "base_link", "base_footprint")


class InfoCamera(NamedTuple):
    """A camera by its CameraInfo; `is_rectified`: its images are rectified already."""

    info: CameraInfo
    is_rectified: bool

    @property
    def frame(self) -> str:
        """The name of its frame in the transforms."""
        return self.info.frame_id.lstrip("/")


def calibration_of_messages(
    cameras: Sequence[InfoCamera], links: Sequence[FrameLink], imu_frame: str | None, where: str
) -> RigCalibration:
    """The calibration told by CameraInfo (left first) and transforms between frames.

    The body is `imu_frame` where transforms lead from there to every camera (the IMU's noise is then the default),
    else the left camera; the right camera's place then comes from the transforms or from the baseline in its
    projection matrix.
    """
    lenses = [_lens(camera, where) for camera in cameras]
    found = [_target_from_source(links, imu_frame, camera.frame) if imu_frame else None for camera in cameras]
    body_from_cams = [body_from_cam for body_from_cam in found if body_from_cam is not None]
    has_imu = len(body_from_cams) == len(cameras)
    if not has_imu:
        body_from_cams = [np.eye(4)] + [_left_from_right(cameras, links, where) for _ in cameras[1:]]
    placed = [
        check_camera(replace(lens, body_from_cam=body_from_cam), f"{where}: {camera.info.frame_id}")
        for lens, body_from_cam, camera in zip(lenses, body_from_cams, cameras, strict=True)
    ]
    body_frame = imu_frame if has_imu and imu_frame else cameras[0].frame
    bases = (_target_from_source(links, name, body_frame) for name in _BASE_FRAMES)
    base_from_body = next((base for base in bases if base is not None), np.eye(4))
    return RigCalibration(tuple(placed), ImuNoise() if has_imu else None, base_from_body)


def frames_not_optical(cameras: Sequence[InfoCamera], links: Sequence[FrameLink]) -> list[str]:
    """Words on cameras whose frame has the axes of the robot (x forward, z up), where images need one with z forward and y down."""
    found = []
    for frame in dict.fromkeys(camera.frame for camera in cameras if "optical" not in camera.frame):
        bases = ((name, _target_from_source(links, name, frame)) for name in _BASE_FRAMES)
        base, base_from_cam = next(((name, base) for name, base in bases if base is not None), ("", np.eye(4)))
        if base and frame != base and base_from_cam[2, 2] > _UPRIGHT:
            found.append(
                f"{frame} of a CameraInfo has its z axis up in {base}, as a body's frame; if the camera does not look up, stamp images and "
                "CameraInfo with the optical frame (x right, y down, z forward), or pass a calibration with --calibration FILE"
            )
    return found


def _lens(camera: InfoCamera, where: str) -> CameraCalibration:
    info = camera.info
    matrix = info.projection[:, :3] if camera.is_rectified else info.matrix
    name, coefficients = ("", np.zeros(0)) if camera.is_rectified else (info.lens, info.distortion)
    model, distortion = lens_of(name, coefficients, f"{where}: CameraInfo of {info.frame_id}")
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    return CameraCalibration(model, info.width_px, info.height_px, intrinsics, distortion, np.eye(4))


def _left_from_right(cameras: Sequence[InfoCamera], links: Sequence[FrameLink], where: str) -> Array:
    """(4, 4) cam0_from_cam1 by the transforms, else by the right camera's projection.

    There, K, R and P are those of ROS's stereo calibration: P[0, 3] = -fx * baseline.
    """
    left, right = cameras[0].info, cameras[1].info
    if left.frame_id != right.frame_id:
        cam0_from_cam1 = _target_from_source(links, cameras[0].frame, cameras[1].frame)
        if cam0_from_cam1 is not None:
            return cam0_from_cam1
    fx = right.projection[0, 0]
    baseline_m = -right.projection[0, 3] / fx if fx else 0.0
    if baseline_m <= 0:
        issues = "".join(f", {link.issue}" for link in links if link.issue)
        raise CalibrationError(
            f"{where}: nothing says where the right camera sits (no transform from {left.frame_id} to "
            f"{right.frame_id}, no baseline in its projection {right.projection[0].tolist()}{issues}); pass a calibration "
            "with --calibration FILE"
        )
    rect_from_rect = se3(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    left_rotation, right_rotation = (
        np.eye(3) if camera.is_rectified else camera.info.rect_from_cam for camera in cameras
    )
    return se3_inverse(se3(left_rotation, np.zeros(3))) @ rect_from_rect @ se3(right_rotation, np.zeros(3))


def _target_from_source(links: Sequence[FrameLink], target: str, source: str) -> Array | None:
    """(4, 4) target_from_source along the links in either direction, None where they do not lead there."""
    target_from: dict[str, Array] = {target.lstrip("/"): np.eye(4)}
    waiting = list(target_from)
    while waiting:
        frame = waiting.pop(0)
        for link in (each for each in links if each.is_usable):
            if link.parent == frame and link.child not in target_from:
                target_from[link.child] = target_from[frame] @ link.parent_from_child
                waiting.append(link.child)
            elif link.child == frame and link.parent not in target_from:
                target_from[link.parent] = target_from[frame] @ se3_inverse(link.parent_from_child)
                waiting.append(link.parent)
    return target_from.get(source)
