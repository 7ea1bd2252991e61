"""Calibration from CameraInfo messages and static transforms, for files without a calibration attachment."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array, se3, se3_inverse, so3_log
from fleetmap.plugins.other_recorders.decoders import CameraInfo
from fleetmap.recordings.ros2.messages import FrameLink
from fleetmap.sensors import calibration
from fleetmap.sensors.calibration import LEAST_BASELINE_M, CameraCalibration, ImuNoise, RigCalibration, check_camera
from fleetmap.sensors.cameras import lens_of

_UPRIGHT = 0.9  # the cosine of 26 degrees
_BASE_FRAMES = ("base", "base_link", "base_footprint")


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
    full_px = info.width_px, info.height_px
    if size_px == full_px or (x, y, width, height, bin_x, bin_y) == (0, 0, *full_px, 1, 1):
        return info
    if not (0 <= width - size_px[0] * bin_x < bin_x and 0 <= height - size_px[1] * bin_y < bin_y):
        raise CalibrationError(
            f"{where}: the images have {size_px[0]}x{size_px[1]} px, which the CameraInfo ({setting_of(info)}) does not make; "
            "correct binning and roi in the driver, or pass a calibration of these images with --calibration FILE"
        )
    image_from_whole = np.array(
        [[1 / bin_x, 0, (0.5 - x) / bin_x - 0.5], [0, 1 / bin_y, (0.5 - y) / bin_y - 0.5], [0, 0, 1]]
    )
    matrix, projection = image_from_whole @ info.matrix, image_from_whole @ info.projection
    whole = replace(info, width_px=size_px[0], height_px=size_px[1], binning=(1, 1), roi=(0, 0, 0, 0))
    return replace(whole, matrix=matrix, projection=projection)


def calibration_of_messages(
    cameras: Sequence[CameraInfo],
    cam0_from_cams: Sequence[Array | None],
    links: Sequence[FrameLink],
    imu_frame: str | None,
    where: str,
) -> RigCalibration:
    """Build the calibration from CameraInfo, the poses of `camera_poses`, and transforms; cameras without a pose are left out.

    The body is `imu_frame` if transforms connect it to the first camera (the IMU's noise is then the default), else that camera.
    """
    body_from_cam0 = _target_from_source(links, imu_frame, cameras[0].frame) if imu_frame else None
    has_imu = body_from_cam0 is not None
    body_from_first = np.eye(4) if body_from_cam0 is None else body_from_cam0
    posed = zip(cameras, cam0_from_cams, strict=True)
    placed = [_camera(info, body_from_first @ mount, where) for info, mount in posed if mount is not None]
    body_frame = imu_frame if has_imu and imu_frame else cameras[0].frame
    bases = (_target_from_source(links, name, body_frame) for name in _BASE_FRAMES)
    base_from_body = next((base for base in bases if base is not None), None)
    assumed = (*(["imu"] if has_imu else []), *(["base_from_body"] if base_from_body is None else []))
    base = np.eye(4) if base_from_body is None else base_from_body
    return RigCalibration(tuple(placed), ImuNoise() if has_imu else None, base, assumed)


def camera_poses(cameras: Sequence[CameraInfo], links: Sequence[FrameLink], where: str) -> list[Array | None]:
    """cam0_from_cam (4, 4) of every camera: by transforms, or in the frame of an earlier camera by the baseline in the projection.

    None for an unknown one, CalibrationError for that of the second camera.
    """
    frames, cam0_from_cams = [camera.frame for camera in cameras], list[Array | None]([np.eye(4)])
    for number, camera in list(enumerate(cameras))[1:]:
        first = frames.index(camera.frame)
        cam0_from_left = cam0_from_cams[first % number]  # of camera 0 for the second camera, whatever its frame
        if cam0_from_left is not None and (number == 1 or (first < number and camera.projection[0, 3] < 0)):
            cam0_from_cams.append(cam0_from_left @ _left_from_right((cameras[first % number], camera), links, where))
        else:
            cam0_from_cams.append(_target_from_source(links, frames[0], frames[number]) if first == number else None)
    return cam0_from_cams


def last_links(links: Sequence[FrameLink]) -> tuple[list[FrameLink], list[str]]:
    """The last usable transform of each child frame, as tf2 keeps it, and those that cannot be used; also words on children with several
    values."""
    sound = [link for link in links if link.is_usable and link.parent != link.child]
    last, others = {link.child: link for link in sound}, {}
    for link in sound:
        now = last[link.child]
        is_alike = np.allclose(now.parent_from_child, link.parent_from_child, atol=1e-6)  # drivers round
        if now.parent != link.parent or not is_alike:
            others[link.child] = link
    words = [f"{_in_words(link)}, and later {_in_words(last[child])}" for child, link in others.items()]
    return [*(link for link in links if not link.is_usable), *last.values()], words


def _in_words(link: FrameLink) -> str:
    place_m, turn_deg = link.parent_from_child[:3, 3], np.degrees(so3_log(link.parent_from_child[:3, :3]))
    return f"{link.parent} -> {link.child} at {place_m.round(4).tolist()} m, turned by {turn_deg.round(2).tolist()} degrees"


def frames_not_optical(cameras: Sequence[CameraInfo], links: Sequence[FrameLink]) -> list[str]:
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


def _camera(info: CameraInfo, body_from_cam: Array, where: str) -> CameraCalibration:
    model, distortion = lens_of(info.lens, info.distortion, f"{where}: CameraInfo of {info.frame_id}")
    lens = model, info.width_px, info.height_px, calibration.intrinsics_of(info.matrix), distortion
    return check_camera(CameraCalibration(*lens, body_from_cam), f"{where}: {info.frame_id}")


def _left_from_right(cameras: Sequence[CameraInfo], links: Sequence[FrameLink], where: str) -> Array:
    """(4, 4) cam0_from_cam1 by the transforms, else by the right camera's projection.

    There, K, R and P are those of ROS's stereo calibration: P[0, 3] = -fx * baseline. Drivers without a calibration send transforms of
    length 0, which are right only for cameras that look different ways.
    """
    left, right = cameras
    cam0_from_cam1 = _target_from_source(links, left.frame, right.frame)
    if cam0_from_cam1 is not None and np.linalg.norm(cam0_from_cam1[:3, 3]) > LEAST_BASELINE_M:
        return cam0_from_cam1
    fx = right.projection[0, 0]
    baseline_m = -right.projection[0, 3] / fx if fx else 0.0
    if baseline_m <= LEAST_BASELINE_M:
        if cam0_from_cam1 is not None and cam0_from_cam1[2, 2] < calibration.SAME_WAY_COSINE:
            return cam0_from_cam1
        issues = "".join(f", {link.issue}" for link in links if link.issue)
        raise CalibrationError(
            f"{where}: the pose of the right camera is unknown (no transform from {left.frame_id} to "
            f"{right.frame_id} with a length, no baseline in its projection {right.projection[0].tolist()}{issues}); pass a calibration "
            "with --calibration FILE"
        )
    rect_from_rect = se3(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    rect_from_left, rect_from_right = (se3(camera.rect_from_cam, np.zeros(3)) for camera in cameras)
    return se3_inverse(rect_from_left) @ rect_from_rect @ rect_from_right


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
