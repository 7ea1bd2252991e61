"""Features of one frame, with depth for those that match a map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, stereo
from fleetmap.features.matching import Packed, packed
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Image


@dataclass(slots=True)
class FrameFeatures:
    """Features of one frame: pixels (N, 3) u_left v u_right, NaN where unknown.

    For a pair, depth is measured only for matched features, while `frame` is held; `is_tried` (N,) marks them.
    """

    features: orb.Features
    pixels: Array
    frame: RectifiedFrame | None = None
    is_tried: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls, frame: RectifiedFrame, features: orb.Features, camera: StereoCamera, settings: StereoSettings
    ) -> "FrameFeatures":
        """Features of `frame`; depth of a pair is not measured yet, a depth image is read at once."""
        if frame.right is not None and frame.disparity_px is None:
            pixels = np.column_stack([features.pixels, np.full(len(features), np.nan)])
            return cls(features, pixels, frame, np.zeros(len(features), bool))
        return with_depth(frame, features, camera, settings)

    def packed(self) -> tuple[Array, Array, NDArray[np.int8], Packed]:
        """Features in the core's format."""
        features = self.features
        pixels, left = np.ascontiguousarray(self.pixels), np.ascontiguousarray(features.pixels, np.float64)
        return pixels, left, np.ascontiguousarray(features.octaves), packed(features.descriptors)

    def unmeasured(self) -> tuple[Image, Image, Array, NDArray[np.bool_]] | None:
        """The pair of images, and arrays that the core fills when it measures depth."""
        if self.frame is None or self.is_tried is None:
            return None
        assert self.frame.right is not None
        return self.frame.left, self.frame.right, self.pixels, self.is_tried

    def measured(self, rows: NDArray[np.int64], camera: StereoCamera, settings: StereoSettings) -> Array:
        """Pixels (P, 3) of some features; measures depth not tried before."""
        if self.frame is not None and self.is_tried is not None:
            at = rows[~self.is_tried[rows]]
            found = stereo.disparities(self.frame, camera, self.features.pixels[at], settings)
            self.pixels[at, 2] = self.pixels[at, 0] - found[:, 0]
            self.is_tried[at] = True
        return self.pixels[rows]

    def without_depth(self) -> "FrameFeatures":
        """A copy as of a single camera."""
        return FrameFeatures(self.features, np.column_stack([self.pixels[:, :2], np.full(len(self.pixels), np.nan)]))


def with_depth(
    frame: RectifiedFrame, features: orb.Features, camera: StereoCamera, settings: StereoSettings
) -> FrameFeatures:
    """Features of one frame with the depth of all; the frame itself is not kept."""
    found = stereo.disparities(frame, camera, features.pixels, settings)
    return FrameFeatures(features, np.column_stack([features.pixels, features.pixels[:, 0] - found[:, 0]]))
