"""Calibration from an MCAP file's CameraInfo messages and static transforms, if it has no calibration attachment."""

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
    """A camera described by its CameraInfo; `is_rectified`: its images are rectified already."""

    info: CameraInfo
    is_rectified: bool

    @property
    def frame(self) -> str:
        """Name of its frame in the transforms."""
        return self.info.frame_id.lstrip("/")


def same_lens(one: CameraInfo, other: CameraInfo) -> bool:
    """True if both describe one lens at one setting, to the rounding of drivers."""
    sizes, others = ((i.width_px, i.height_px, i.lens, len(i.distortion), i.binning, i.roi) for i in (one, other))
    values, again = (np.hstack([i.matrix.ravel(), i.projection.ravel(), i.distortion]) for i in (one, other))
    return sizes == others and np.allclose(values, again, rtol=1e-3, atol=1e-3, equal_nan=True)


def setting_of(info: CameraInfo) -> str:
    """Format a CameraInfo's values for messages."""
    fx, cx, cy = (float(info.matrix[at]) for at in ((0, 0), (0, 2), (1, 2)))
    x, y, width, height = info.roi
    binned = "" if info.binning == (1, 1) else f", binning {info.binning[0]} x {info.binning[1]}"
    roi = f", roi {width}x{height} at ({x}, {y})" if any(info.roi) else ""
    return f"{info.width_px}x{info.height_px}, fx cx cy {fx:.1f} {cx:.1f} {cy:.1f}{binned}{roi}"


def info_of_images(info: CameraInfo, size_px: tuple[int, int], where: str) -> CameraInfo:
    """The CameraInfo for images of `size_px`, which the driver bins or crops from the full image.

    CalibrationError if binning and region of interest give another size. Source: the definition of sensor_msgs/CameraInfo. A binned
    pixel's centre is that of its source pixels.
    """
    (x, y, width, height), (bin_x, bin_y) = info.roi, info.binning
    width, height = width or info.width_px - x, height or info.height_px - y
    whole = info.width_px, info.height_px
    if size_px == whole or (x, y, width, height, bin_x, bin_y) == (0, 0, *whole, 1, 1):
        return info
    if not (0 <= width - size_px[0] * bin_x < bin_x and 0 <= height - size_px[1] * bin_y < bin_y):
        raise CalibrationError(
            f"{where}: the images have {size_px[0]}x{size_px[1]} px, which the CameraInfo ({setting_of(info)}) does not make; "
            "correct binning and roi in the driver, or pass a calibration of these images with --calibration FILE"
        )
    image_from_whole = np.array(
        [[1 / bin_x, 0, (0.5 - x) / bin_x - 0.5], [0, 1 / bin_y, (0.5 - y) / bin_y - 0.5], [0, 0, 1]]
    )
    return replace(
        info,
        width_px=size_px[0],
        height_px=size_px[1],
        matrix=image_from_whole @ info.matrix,
        projection=image_from_whole @ info.projection,
        binning=(1, 1),
        roi=(0, 0, 0, 0),
    )


def calibration_of_messages(
    cameras: Sequence[InfoCamera], links: Sequence[FrameLink], imu_frame: str | None, where: str
) -> RigCalibration:
    """Build the calibration from CameraInfo (left first, further ones as `mounted` gives them) and transforms between frames.

    The body is `imu_frame` if transforms connect it to every camera (the IMU's noise is then the default),
    else the left camera; the right camera's pose then comes from the transforms or from the baseline in its
    projection matrix.
    """
    lenses = [_lens(camera, where) for camera in cameras]
    found = [_target_from_source(links, imu_frame, camera.frame) if imu_frame else None for camera in cameras[:2]]
    body_from_cams = [body_from_cam for body_from_cam in found if body_from_cam is not None]
    has_imu = len(body_from_cams) == len(cameras[:2])
    if not has_imu:
        body_from_cams = [np.eye(4)] + [_left_from_right(cameras, links, where) for _ in cameras[1:2]]
    for number in range(2, len(cameras)):
        before, camera = cameras[number - 1 : number + 1]
        if camera.frame == before.frame:
            body_from_cams.append(body_from_cams[-1] @ _left_from_right((before, camera), links, where))
        else:
            cam0_from_cam = _target_from_source(links, cameras[0].frame, camera.frame)
            assert cam0_from_cam is not None, "as `mounted` says"
            body_from_cams.append(body_from_cams[0] @ cam0_from_cam)
    placed = [
        check_camera(replace(lens, body_from_cam=body_from_cam), f"{where}: {camera.info.frame_id}")
        for lens, body_from_cam, camera in zip(lenses, body_from_cams, cameras, strict=True)
    ]
    body_frame = imu_frame if has_imu and imu_frame else cameras[0].frame
    bases = (_target_from_source(links, name, body_frame) for name in _BASE_FRAMES)
    base_from_body = next((base for base in bases if base is not None), None)
    assumed = (*(["imu"] if has_imu else []), *(["base_from_body"] if base_from_body is None else []))
    base = np.eye(4) if base_from_body is None else base_from_body
    return RigCalibration(tuple(placed), ImuNoise() if has_imu else None, base, assumed)


def mounted(cameras: Sequence[InfoCamera], links: Sequence[FrameLink]) -> list[int]:
    """Numbers of the cameras whose pose is known: the first two, whatever they lack; further ones that transforms connect to the first, and
    those behind such a one in its frame, with a baseline in the projection."""
    numbers = list(range(len(cameras[:2])))
    for number in range(2, len(cameras)):
        before, camera = cameras[number - 1 : number + 1]
        is_beside = camera.frame == before.frame and number - 1 in numbers[2:] and camera.info.projection[0, 3] < 0
        is_linked = camera.frame not in (cameras[0].frame, before.frame)
        if is_beside or (is_linked and _target_from_source(links, cameras[0].frame, camera.frame) is not None):
            numbers.append(number)
    return numbers


def frames_not_optical(cameras: Sequence[InfoCamera], links: Sequence[FrameLink]) -> list[str]:
    """Warning on cameras whose frame has the axes of the robot (x forward, z up); images need one with z forward and y down."""
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
            f"{where}: the pose of the right camera is unknown (no transform from {left.frame_id} to "
            f"{right.frame_id}, no baseline in its projection {right.projection[0].tolist()}{issues}); pass a calibration "
            "with --calibration FILE"
        )
    rect_from_rect = se3(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    left_rotation, right_rotation = (
        np.eye(3) if camera.is_rectified else camera.info.rect_from_cam for camera in cameras
    )
    return se3_inverse(se3(left_rotation, np.zeros(3))) @ rect_from_rect @ se3(right_rotation, np.zeros(3))


def _target_from_source(links: Sequence[FrameLink], target: str, source: str) -> Array | None:
    """(4, 4) target_from_source along the links in either direction, None if they are not connected."""
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
