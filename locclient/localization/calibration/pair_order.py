"""Order of a stereo pair: in the right order, features lie farther left in the right image. Pure."""

from enum import StrEnum

import numpy as np

from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.settings import OrbSettings
from fleetmap.sensors.rectification import RectifiedFrame

REVERSED_TEXT = (
    "matches have negative disparity: left and right images are exchanged, or mirrored; exchange the two topics, folders or cables, "
    "or switch the mirroring off in the camera's driver"
)
_MIN_MATCHES = 40
# minimum size of a signed disparity; rows and columns as shares of the image
_DECIDED_PX, _ROW_SHARE, _WIDTH_SHARE = 1.0, 0.03, 0.3
_MAX_BITS, _RATIO = 48, 0.9
_ODDS = 3.0  # random matches have both signs equally often


class PairOrder(StrEnum):
    """Order of the images of a pair."""

    UNKNOWN = "unknown"
    RIGHT = "right"
    REVERSED = "reversed"


def pair_order(frame: RectifiedFrame, settings: OrbSettings) -> PairOrder:
    """Return the order by one frame at half its size; UNKNOWN for a single camera, too few features or only distant ones."""
    if frame.right is None:
        return PairOrder.UNKNOWN
    left, right = extract(frame.half_left, settings), extract(frame.half_right, settings)
    pairs = match_mutual(left.descriptors, right.descriptors, _MAX_BITS, _RATIO)
    offsets = left.pixels[pairs[:, 0]] - right.pixels[pairs[:, 1]]
    height, width = (size // 2 for size in frame.left.shape)
    is_near_row = np.abs(offsets[:, 1]) < _ROW_SHARE * height
    decided = offsets[is_near_row & (np.abs(offsets[:, 0]) > _DECIDED_PX), 0]
    decided = decided[np.abs(decided) < _WIDTH_SHARE * width]
    positive, negative = int((decided > 0).sum()), int((decided < 0).sum())
    if max(positive, negative) < _MIN_MATCHES:
        return PairOrder.UNKNOWN
    if negative > _ODDS * positive:
        return PairOrder.REVERSED
    return PairOrder.RIGHT if positive > _ODDS * negative else PairOrder.UNKNOWN
