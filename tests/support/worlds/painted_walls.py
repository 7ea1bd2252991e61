"""What a camera sees inside a box of a room whose faces are painted: pictures and depth by casting a ray for each pixel."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array


@lru_cache(maxsize=4)
def pixel_rays(width: int, height: int, focal_px: float, cx_px: float, cy_px: float) -> Array:
    """(height, width, 3) rays of a pinhole's pixels in its own axes, one metre deep."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([(u - cx_px) / focal_px, (v - cy_px) / focal_px, np.ones_like(u, float)], -1)


def reach(rays: Array, origin: Array, room_m: Array) -> Array:
    """How many times each ray (..., 3) goes to the room's faces across each axis; room_m: lowest and highest corner."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(rays > 0, room_m[1] - origin, room_m[0] - origin) / rays)


def view(
    map_from_cam: Array, rays_cam: Array, room_m: Array, paint: NDArray[np.uint8], begin_m: Array, texel_m: float,
    border: int = cv2.BORDER_CONSTANT,
) -> NDArray[np.uint8]:  # fmt: skip
    """Grey image: for each pixel the face of the room that its ray leaves by.

    paint (6 * side, side): the faces -x +x -y +y -z +z, one under another, each from the place begin_m (3,) on; border: what is beyond
    it in OpenCV's terms.
    """
    rays, origin = rays_cam @ map_from_cam[:3, :3].T, map_from_cam[:3, 3]
    times = reach(rays, origin, room_m)
    axis = np.argmin(times, axis=2)
    at = (origin + rays * np.min(times, axis=2)[..., None] - begin_m) / texel_m
    face = 2 * axis + (np.take_along_axis(rays, axis[..., None], 2)[..., 0] > 0)
    across = np.where(axis == 0, at[..., 1], at[..., 0]).astype(np.float32)
    along = np.where(axis == 2, at[..., 1], at[..., 2]).astype(np.float32)
    # In steps of OpenCV's interpolation: as exact on the last face as on the first.
    along = np.rint(along * 32) / 32 + (face * paint.shape[1]).astype(np.float32)
    return np.asarray(cv2.remap(paint, across, along, cv2.INTER_LINEAR, borderMode=border), np.uint8)
