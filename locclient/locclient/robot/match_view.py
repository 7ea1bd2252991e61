"""Picture of what a robot sees beside what the map expects there, for the analysis of a failure. Pure."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features import extract
from fleetmap.geometry import Array
from fleetmap.mapformat import Tile
from fleetmap.relocalization.landmark_visibility import cones_of_tiles, match_visible, visible_landmarks
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Image
from locclient.localization.settings import LocalizerSettings

Canvas = NDArray[np.uint8]
Matches = tuple[Array, Array, NDArray[np.int64]]
_FOUND, _MISSING, _OTHER, _INK = (60, 200, 60), (70, 70, 230), (150, 150, 150), (255, 255, 255)
_WINDOW_PX = 25.0  # the place may be off: the view shows whether anything would match nearby


def expected_matches(
    left: Image, camera: StereoCamera, map_from_cam: Array, tiles: Iterable[Tile], settings: LocalizerSettings
) -> Matches:
    """Pixels (E, 2) of the landmarks that should be seen from map_from_cam (4, 4), pixels (N, 2) of the image's features, and (E,) the
    feature that matches each landmark near its pixel, -1 for none."""
    tiles = list(tiles)
    max_angle_rad = np.radians(settings.fix.max_view_angle_deg)
    expected = visible_landmarks(cones_of_tiles(tiles), map_from_cam, camera, 0.0, max_angle_rad)
    pixels = expected.pixels
    features = extract(left, settings.orb)
    hit = np.full(len(pixels), -1, np.int64)
    if len(pixels) and len(features):
        descriptors = np.concatenate([tile.descriptors for tile in tiles])[expected.rows]
        hit = match_visible(expected, descriptors, np.full(len(pixels), _WINDOW_PX), features, settings.fix)
    return pixels, features.pixels, hit


def match_view(left: Image, matches: Matches, title: str) -> Canvas:
    """(H + 30, 2 W, 3) BGR: the left image with its features, and the landmarks that should be in it.

    Green: features and landmarks that match near the projected pixel, joined in the right half; red: landmarks that do not.
    """
    pixels, features, hit = matches
    seen = cv2.cvtColor(np.ascontiguousarray(left), cv2.COLOR_GRAY2BGR)
    told = np.full_like(seen, 30)
    for pixel in features:
        cv2.circle(seen, _at(pixel), 2, _OTHER, 1, cv2.LINE_AA)
    for pixel, feature in zip(pixels, hit, strict=True):
        cv2.circle(told, _at(pixel), 3, _MISSING if feature < 0 else _FOUND, -1, cv2.LINE_AA)
        if feature >= 0:
            cv2.circle(seen, _at(features[feature]), 4, _FOUND, 2, cv2.LINE_AA)
            cv2.line(told, _at(pixel), _at(features[feature]), _FOUND, 1, cv2.LINE_AA)
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


def _at(pixel: Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
