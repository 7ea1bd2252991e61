"""What a robot's own camera sees, as its failure reports tell it: its angles and where it is mounted. Pure."""

from collections.abc import Mapping

import numpy as np

from fleetmap.messages import CameraNote
from mapserver.serving.expected_views import is_camera

_FARTHEST_M = 20.0  # from the middle of a robot to its camera


def robot_views(cameras: Mapping[str, CameraNote]) -> dict[str, list[float]]:
    """By robot the tangents of the angles to the left, right, upper and lower edge in the camera's axes (x right, y down), and the upper
    three rows of base_from_cam, row by row. Robots that tell what no camera is, or one that is not on the robot, are left out."""
    found = {robot: _view(camera) for robot, camera in cameras.items()}
    return {robot: view for robot, view in found.items() if view is not None}


def _view(camera: CameraNote) -> list[float] | None:
    if not is_camera(camera):
        return None
    base_from_cam = camera.base_from_cam.target_from_source
    if not np.isfinite(base_from_cam).all() or np.abs(base_from_cam[:3, 3]).max() > _FARTHEST_M:
        return None
    (width_px, height_px), (x_px, y_px), focal_px = camera.size_px, camera.centre_px, camera.focal_px
    edges_px = -x_px, width_px - x_px, -y_px, height_px - y_px
    return [*(round(edge / focal_px, 4) for edge in edges_px), *base_from_cam[:3].ravel().round(4).tolist()]
