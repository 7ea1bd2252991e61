"""A picture of what a robot sees beside what the map expects there, for whoever looks into a failure. Pure."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb
from fleetmap.features.matching import match_by_projection
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat import Tile
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Image
from locclient.localization.settings import LocalizerSettings

Canvas = NDArray[np.uint8]
_FOUND, _MISSING, _OTHER, _INK = (60, 200, 60), (70, 70, 230), (150, 150, 150), (255, 255, 255)
_REACH_SHARE = 1.3
_WINDOW_PX = 25.0  # the place may be off: what is shown is whether anything would fit nearby


def match_view(
    left: Image, camera: StereoCamera, map_from_cam: Array, tiles: Iterable[Tile], settings: LocalizerSettings, title: str
) -> Canvas:  # fmt: skip
    """(H + 30, 2 W, 3) BGR: the left image with its features, and the landmarks that should be in it from map_from_cam (4, 4).

    Green: features and landmarks that match near the projected pixel, joined in the right half; red: landmarks that do not.
    """
    pixels, octaves, descriptors = _expected(camera, map_from_cam, tiles, np.radians(settings.fix.max_view_angle_deg))
    features = orb.detect(left, settings.orb)
    hit = np.full(len(pixels), -1, np.int64)
    if len(pixels) and len(features):
        span = np.column_stack([np.floor(octaves) - 2, np.ceil(octaves) + 2]).astype(np.int64)
        hit, _ = match_by_projection(
            pixels[:, :2], np.full(len(pixels), _WINDOW_PX), descriptors, span, features.pixels, features.octaves,
            features.descriptors, settings.fix.guided_distance, settings.fix.guided_ratio,
        )  # fmt: skip
    seen = cv2.cvtColor(np.ascontiguousarray(left), cv2.COLOR_GRAY2BGR)
    told = np.full_like(seen, 30)
    for pixel in features.pixels:
        cv2.circle(seen, _at(pixel), 2, _OTHER, 1, cv2.LINE_AA)
    for pixel, feature in zip(pixels, hit, strict=True):
        cv2.circle(told, _at(pixel), 3, _MISSING if feature < 0 else _FOUND, -1, cv2.LINE_AA)
        if feature >= 0:
            cv2.circle(seen, _at(features.pixels[feature]), 4, _FOUND, 2, cv2.LINE_AA)
            cv2.line(told, _at(pixel), _at(features.pixels[feature]), _FOUND, 1, cv2.LINE_AA)
    head = np.zeros((30, 2 * left.shape[1], 3), np.uint8)
    text = f"{title}: {int((hit >= 0).sum())} of {len(pixels)} expected landmarks match, {len(features)} features"
    cv2.putText(head, text, (8, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
    return np.vstack([head, np.hstack([seen, told])])


def small_jpeg(image: NDArray[np.uint8], width_px: int, max_bytes: int) -> bytes:
    """JPEG of an image (H, W) or (H, W, 3), not wider than width_px; quality gives way to max_bytes, then size does."""
    while True:
        scale = min(1.0, width_px / image.shape[1])
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        for quality in (80, 60, 40, 20):
            _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if len(data) <= max_bytes:
                return data.tobytes()
        width_px = max(1, min(width_px, image.shape[1]) // 2)


def _expected(
    camera: StereoCamera, map_from_cam: Array, tiles: Iterable[Tile], max_angle_rad: float
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Pixels (N, 3), octaves (N,) and descriptors (N, 32) of landmarks that a camera there should see."""
    parts = [_expected_of(camera, map_from_cam, tile, max_angle_rad) for tile in tiles]
    if not parts:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 32), np.uint8)
    pixels, octaves, descriptors = zip(*parts, strict=True)
    return np.concatenate(pixels), np.concatenate(octaves), np.concatenate(descriptors)


def _expected_of(
    camera: StereoCamera, map_from_cam: Array, tile: Tile, max_angle_rad: float
) -> tuple[Array, Array, NDArray[np.uint8]]:
    cam_from_map = se3_inverse(map_from_cam)
    pixels = camera.pixel_from_point(tile.points_map @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])
    towards = map_from_cam[:3, 3] - tile.points_map
    distance_m = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    cosine = np.sum(towards * tile.view_directions_map, axis=1) / distance_m
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[:, 0] >= 0)
            & (pixels[:, 0] < camera.width_px)
            & (pixels[:, 1] >= 0)
            & (pixels[:, 1] < camera.height_px)
        )
    visible = inside & (distance_m < _REACH_SHARE * tile.max_distance_m)
    visible &= np.arccos(np.clip(cosine, -1, 1)) < tile.view_half_angle_rad + max_angle_rad
    octaves = np.log(np.maximum(tile.max_distance_m / distance_m, 0.5)) / np.log(orb.SCALE_FACTOR)
    return pixels[visible], octaves[visible], tile.descriptors[visible]


def _at(pixel: Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
