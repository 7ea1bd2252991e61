"""Confirmation of a map by a session: the share of its expected parts that it sees again. Pure.

The unit is a cell of space, not a landmark: landmarks of one object stay or vanish together, and a wrongly located session also
sees the common parts of halls (walls, columns, the ends of racks), many landmarks of few objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array, Mask
from fleetmap.relocalization.map_view import MapView, Rows, VisibleLandmarks, match_visible
from fleetmap.relocalization.relocalizer import FrameFeatures
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.rectification import StereoCamera

EDGE_PX = 12.0
_BESIDE_PX = 25.0  # distance within which a measured corner hides farther points
WIDER_VIEW_RAD = 0.17
_MAX_OCTAVE = 7.0
_WINDOW_PX, _DISPARITY_PX = 4.0, 2.0  # around a prediction accurate to 1 cm at 2 m
_MATCHING = FixSettings(guided_distance=60)  # bits: two looks at one object differ by about 40, two objects by 128
# An object, and objects that may change together: goods on one pallet, pictures on one wall
_CELL_M, _BLOCK_M = 0.75, 1.5
_FIRM_OBSERVATIONS = 4  # keyframes of the map that must observe a landmark to expect it again
_MIN_LANDMARKS = 4  # for a cell to be judged
_SEEN_SHARE = 1 / 3  # of a cell's landmarks; by chance about 1 % match, of present objects most


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Cells of the map that a session should see, and those seen; low, high: bounds of their share at the test's error rate.

    blocks: of the cells.
    """

    cells: int
    seen: int
    blocks: int
    low: float
    high: float
    error_rate: float

    @property
    def share(self) -> float:
        """Share of the expected cells that were seen; 0 without any."""
        return self.seen / max(self.cells, 1)


def firm_landmarks(count: int, obs_landmark: NDArray[np.int32]) -> Mask:
    """Return (N,) which of `count` landmarks are observed (M,) by enough keyframes of the map to be expected again."""
    return np.bincount(obs_landmark, minlength=count) >= _FIRM_OBSERVATIONS


def due(expected: VisibleLandmarks, pixels: Array) -> Mask:
    """Return (V,) which visible landmarks a picture with features at pixels (F, 3) should show.

    Their octave is searched, and no corner beside them is much nearer.
    """
    fits = np.asarray((expected.octaves > 0.0) & (expected.octaves < _MAX_OCTAVE))
    known = np.flatnonzero(np.isfinite(pixels[:, 2]))
    if not len(known) or not len(expected.rows):
        return fits
    away_px, nearest = scipy.spatial.cKDTree(pixels[known, :2]).query(expected.pixels[:, :2])
    measured = (pixels[:, 0] - pixels[:, 2])[known[nearest]]
    disparity = expected.pixels[:, 0] - expected.pixels[:, 2]
    hidden = (away_px < _BESIDE_PX) & (measured > disparity + np.maximum(2.0, 0.15 * disparity))
    return fits & ~hidden


def look(view: MapView, camera: StereoCamera, query: FrameFeatures, map_from_cam: Array) -> tuple[Rows, Mask]:
    """Return rows (V,) of the landmarks expected in a picture at this pose, and which of them it shows: the pose is not refined.

    A picture without features, in the dark, is no look.
    """
    if not len(query.pixels):
        return np.zeros(0, np.int64), np.zeros(0, bool)
    expected = view.visible(map_from_cam, camera, -EDGE_PX, WIDER_VIEW_RAD)
    shown = due(expected, query.pixels)
    expected = VisibleLandmarks(expected.rows[shown], expected.pixels[shown], expected.octaves[shown])
    if not len(expected.rows):
        return expected.rows, np.zeros(0, bool)
    windows_px = _WINDOW_PX * SCALE_FACTOR ** np.clip(expected.octaves, 0, 3)
    hit = match_visible(expected, view.descriptors[expected.rows], windows_px, query.features, _MATCHING)
    measured = (query.pixels[:, 0] - query.pixels[:, 2])[hit]
    off_px = np.abs(measured - expected.pixels[:, 0] + expected.pixels[:, 2])
    return expected.rows, (hit >= 0) & ~(off_px > _DISPARITY_PX)


def confirmation(points_map: Array, looks: Sequence[tuple[Rows, Mask]], firm: Mask, error_rate: float) -> Confirmation:
    """Return the cells in which `firm` landmarks (N, 3) are expected by two or more looks, and those with enough of them seen.

    The bounds are those of Clopper and Pearson 1934 for the number of independent cells with the measured variance: blocks of cells
    are the clusters of the sample. Source: Cochran 1977, Sampling Techniques, section 9A.
    """
    expected, seen = np.zeros(len(points_map), np.int64), np.zeros(len(points_map), np.int64)
    for rows, is_seen in looks:
        expected[rows] += 1
        seen[rows[is_seen]] += 1
    judged = np.flatnonzero(firm & (expected >= 2))
    corners, cell = np.unique(np.floor(points_map[judged] / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    landmarks, found = (np.bincount(cell, weights, len(corners)) for weights in (None, (seen[judged] > 0) * 1.0))
    enough = landmarks >= _MIN_LANDMARKS
    is_seen = found[enough] >= _SEEN_SHARE * landmarks[enough]
    count = len(is_seen)
    if count == 0:
        return Confirmation(0, 0, 0, 0.0, 1.0, error_rate)
    share = float(is_seen.mean())
    _, block = np.unique(np.floor(corners[enough] * (_CELL_M / _BLOCK_M)), axis=0, return_inverse=True)
    off = np.bincount(block.reshape(-1), is_seen - share)
    clustered = float((off**2).sum()) / count**2 * len(off) / max(len(off) - 1, 1)
    alone = share * (1.0 - share) / count
    effective = count * min(1.0, alone / clustered) if clustered > 0 else float(count)
    k = share * effective
    low = float(scipy.special.betaincinv(k, effective - k + 1, error_rate)) if k > 0 else 0.0
    high = float(scipy.special.betaincinv(k + 1, effective - k, 1.0 - error_rate)) if k < effective else 1.0
    return Confirmation(count, int(is_seen.sum()), len(off), low, high, error_rate)
