"""Order of a stereo pair: in the right order, features lie farther left in the right image; those of another view lie in neither. Pure."""

from enum import StrEnum

import numpy as np

from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame

_MIN_MATCHES = 40
# minimum size of a signed disparity; rows and columns as shares of the image
_DECIDED_PX, _ROW_SHARE, _WIDTH_SHARE = 1.0, 0.03, 0.3
_MAX_BITS, _RATIO = 48, 0.9
_ODDS = 3.0  # random matches have both signs equally often


class PairOrder(StrEnum):
    """Order of the images of a pair. CROSSED: one of them is exchanged with an image of another view."""

    UNKNOWN = "unknown"
    RIGHT = "right"
    REVERSED = "reversed"
    CROSSED = "crossed"


FAULTS = {
    PairOrder.REVERSED: "matches have negative disparity: left and right images are exchanged, or mirrored; exchange the two topics, "
    "folders or cables, or switch the mirroring off in the camera's driver",
    PairOrder.CROSSED: "an image of the first pair is exchanged with one of another view: they match each other, those of the pair do not; "
    "exchange the two topics, folders or cables",
}


def pair_order(frame: RectifiedFrame, settings: OrbSettings) -> PairOrder:
    """Return the order by one frame at half its size; UNKNOWN for a single camera, too few features or only distant ones."""
    if frame.right is None:
        return PairOrder.UNKNOWN
    pair = [extract(image, settings) for image in (frame.half_left, frame.half_right)]
    height, width = frame.half_left.shape
    offsets = _offsets(pair[0], pair[1], height)
    if len(offsets) >= _MIN_MATCHES:
        return _order(offsets, width)
    for view in filter(None, (frame.view(n + 1) for n in range(len(frame.others)))):
        images = [view.half_left] if view.right is None else [view.half_left, view.half_right]
        for other in (extract(image, settings) for image in images):
            if any(_order(_offsets(own, other, height), width) is not PairOrder.UNKNOWN for own in pair):
                return PairOrder.CROSSED
    return PairOrder.UNKNOWN


def _offsets(left: Features, right: Features, height: int) -> Array:
    """Return (M,) how much farther left features of two images are in the right one, of matches in about the same row."""
    pairs = match_mutual(left.descriptors, right.descriptors, _MAX_BITS, _RATIO)
    offsets = left.pixels[pairs[:, 0]] - right.pixels[pairs[:, 1]]
    return np.asarray(offsets[np.abs(offsets[:, 1]) < _ROW_SHARE * height, 0])


def _order(offsets: Array, width: int) -> PairOrder:
    decided = offsets[(np.abs(offsets) > _DECIDED_PX) & (np.abs(offsets) < _WIDTH_SHARE * width)]
    positive, negative = int((decided > 0).sum()), int((decided < 0).sum())
    if max(positive, negative) < _MIN_MATCHES:
        return PairOrder.UNKNOWN
    if negative > _ODDS * positive:
        return PairOrder.REVERSED
    return PairOrder.RIGHT if positive > _ODDS * negative else PairOrder.UNKNOWN
