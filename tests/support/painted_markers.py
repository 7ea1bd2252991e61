"""Pictures of markers, by OpenCV: as a pinhole camera sees them, on grey."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import StereoCamera

_TAG_PX, _MARGIN_PX, _FINER = 240, 40, 3


def painted(
    camera: StereoCamera, map_from_cam: Array, markers: dict[int, Array], size_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture of AprilTags, map_from_marker by number, with noise of two grey values."""
    wide = np.full((_FINER * camera.height_px, _FINER * camera.width_px), 120, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    half, side = size_m / 2 * (1 + 2 * _MARGIN_PX / _TAG_PX), _TAG_PX + 2 * _MARGIN_PX
    square = np.array([[-half, half, 0, 1], [half, half, 0, 1], [half, -half, 0, 1], [-half, -half, 0, 1]])
    texels = np.array([[0, 0], [side, 0], [side, side], [0, side]]) - 0.5
    finer = np.array([[_FINER, 0, (_FINER - 1) / 2], [0, _FINER, (_FINER - 1) / 2], [0, 0, 1]])
    for number, map_from_marker in markers.items():
        corners = (square @ (se3_inverse(map_from_cam) @ map_from_marker).T)[:, :3]
        pixels = camera.pixel_from_point(corners)[:, :2]
        if not np.isfinite(pixels).all():
            continue
        tag = np.pad(cv2.aruco.generateImageMarker(dictionary, number, _TAG_PX), _MARGIN_PX, constant_values=235)
        flat = finer @ cv2.getPerspectiveTransform(texels.astype(np.float32), pixels.astype(np.float32))
        cv2.warpPerspective(tag, flat, wide.shape[::-1], wide, borderMode=cv2.BORDER_TRANSPARENT)
    small = cv2.resize(wide, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    return np.clip(small + rng.normal(0.0, 2.0, small.shape), 0, 255).astype(np.uint8)


def facing(position_m: Array, towards_rad: float) -> Array:
    """map_from_marker of an upright marker that faces this direction in the plan."""
    cosine, sine = np.cos(towards_rad), np.sin(towards_rad)
    map_from_marker = np.eye(4)
    map_from_marker[:3, :3] = np.array([[-sine, 0.0, cosine], [cosine, 0.0, sine], [0.0, 1.0, 0.0]])
    map_from_marker[:3, 3] = position_m
    return map_from_marker
