"""The features of one frame, with the depth of those that match something in a map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, stereo
from fleetmap.features.extraction import extract
from fleetmap.features.settings import OrbSettings, StereoSettings
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera


@dataclass(slots=True)
class FrameFeatures:
    """Features of one frame: pixels (N, 3) u_left v u_right, NaN where unknown.

    Depth is measured only for features that match something, while `frame` is held: `is_tried` (N,) says for which it was.
    """

    features: orb.Features
    pixels: Array
    frame: RectifiedFrame | None = None
    is_tried: NDArray[np.bool_] | None = None

    def measured(
        self, rows: NDArray[np.int64], camera: StereoCamera, settings: StereoSettings, prior_px: Array | None = None
    ) -> Array:
        """Pixels (P, 3) of some features, depth measured now where it was not tried before; prior_px (P,) narrows the search."""
        if self.frame is not None and self.is_tried is not None:
            new = np.flatnonzero(~self.is_tried[rows])
            at = rows[new]
            prior = None if prior_px is None else prior_px[new]
            found = stereo.disparities(self.frame, camera, self.features.pixels[at], settings, prior)
            self.pixels[at, 2] = self.pixels[at, 0] - found[:, 0]
            self.is_tried[at] = True
        return self.pixels[rows]

    def without_depth(self) -> "FrameFeatures":
        """A copy as of a single camera."""
        return FrameFeatures(self.features, np.column_stack([self.pixels[:, :2], np.full(len(self.pixels), np.nan)]))


def features_with_depth(
    frame: RectifiedFrame, camera: StereoCamera, settings: OrbSettings, stereo_settings: StereoSettings
) -> FrameFeatures:
    """The features of one frame with the depth of all of them; the frame itself is not kept."""
    features = extract(frame.left, settings)
    found = stereo.disparities(frame, camera, features.pixels, stereo_settings)
    return FrameFeatures(features, np.column_stack([features.pixels, features.pixels[:, 0] - found[:, 0]]))
