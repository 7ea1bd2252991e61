"""Left and right image against the calibration: checks for exchanged images, and for equal rows after rectification."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fleetmap.features.matching import match_mutual
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.doctor.findings import Finding, Limits, judge, not_judged

_MIN_MATCHES = 40
_ALIKE = 47  # bits of 256 that may differ between two descriptors
_NEAR = "drive in the light where both cameras see the same objects, some of them near"
SWAPPED = "left and right"
ROTATE_BACK = "switch the driver's rotation (flip) off, or calibrate the rig with these images"
_SEARCH_ROWS_PX = 25.0
_LARGEST_SHARE_OF_WIDTH = 0.3


@dataclass(frozen=True, slots=True)
class StereoMatches:
    """Matched points of one rectified pair.

    disparities_px (N,) left minus right column, row_errors_px (N,) left minus right row, columns_px (N,) left of the
    image's middle negative.
    """

    disparities_px: Array
    row_errors_px: Array
    columns_px: Array


_NOTHING = StereoMatches(np.zeros(0), np.zeros(0), np.zeros(0))


def match_stereo(frame: RectifiedFrame) -> StereoMatches:
    """Return matches independent of the calibration. ORB both ways, refined by Lucas-Kanade, any sign of disparity, rows within 25 px."""
    if frame.right is None:
        return _NOTHING
    orb = cv2.ORB.create(nfeatures=1200, nlevels=4, fastThreshold=8)
    left_points, left_words = orb.detectAndCompute(frame.left, None)
    right_points, right_words = orb.detectAndCompute(frame.right, None)
    if left_words is None or right_words is None:
        return _NOTHING
    words = np.asarray(left_words, np.uint8), np.asarray(right_words, np.uint8)
    a, b = match_mutual(*words, _ALIKE, 1.0).T
    left, right = (np.asarray(cv2.KeyPoint.convert(points), np.float32) for points in (left_points, right_points))
    left, right = left[a], right[b]
    width = frame.left.shape[1]
    plausible = (np.abs(left - right) < [_LARGEST_SHARE_OF_WIDTH * width, _SEARCH_ROWS_PX]).all(axis=1)
    if not plausible.any():
        return _NOTHING
    corners, guess = left[plausible].reshape(-1, 1, 2), right[plausible].reshape(-1, 1, 2).copy()
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        frame.left, frame.right, corners, guess, winSize=(15, 15), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    found = found.reshape(-1, 2)
    kept = (status.ravel() == 1) & (np.abs(found - right[plausible]).max(axis=1) < 3.0)
    offsets = (left[plausible] - found)[kept].astype(np.float64)
    columns = left[plausible][kept, 0].astype(np.float64) - 0.5 * (width - 1)
    if len(offsets) >= 8:  # without wrong matches: they fall on any row, right ones near the median
        off_rows = np.abs(offsets[:, 1] - np.median(offsets[:, 1]))
        near = off_rows < max(4 * 1.4826 * np.median(off_rows), 1.0)
        offsets, columns = offsets[near], columns[near]
    return StereoMatches(offsets[:, 0], offsets[:, 1], columns)


def swapped_cameras(pairs: Sequence[StereoMatches], *, upside_down: bool | None = None) -> Finding:
    """Judge the order of the images: points lie further left in the right image, unless images are swapped or both rotated by 180 degrees.

    upside_down: True if they turn as if rotated, None if unknown.
    """
    disparities = np.concatenate([p.disparities_px for p in pairs]) if pairs else np.zeros(0)
    decided = disparities[np.abs(disparities) > 1.0]
    if len(decided) < _MIN_MATCHES:
        return not_judged(SWAPPED, f"{len(decided)} matches with a disparity above 1 px are too few", _NEAR)
    wrong_share = float((decided < 0).mean())
    cause = "left and right are swapped: exchange the folders or topics"
    if upside_down is not False:
        rotated = f"the images of both cameras are rotated by 180 degrees: {ROTATE_BACK}"
        cause = rotated if upside_down else f"{cause}; or {rotated}"
    bad = f"{wrong_share:.0%} of the matches have negative disparity; {cause}"
    limits = Limits(0.2, 0.5, "of the matches with negative disparity")
    return judge(SWAPPED, wrong_share, limits, "the left image is the left one", bad)


def epipolar_error(pairs: Sequence[StereoMatches], focal_px: float) -> Finding:
    """Judge distances of matches from their row after rectification: the median; names the 90 % quantile and the fitting angles."""
    name = "epipolar error"
    errors = np.concatenate([p.row_errors_px for p in pairs]) if pairs else np.zeros(0)
    if len(errors) < _MIN_MATCHES:
        return not_judged(name, f"{len(errors)} stereo matches are too few", _NEAR)
    magnitude = np.abs(errors)
    median, p90 = float(np.median(magnitude)), float(np.percentile(magnitude, 90))
    roll, at_middle_px = np.polyfit(np.concatenate([p.columns_px for p in pairs]), errors, 1)
    tilt_deg, roll_deg = np.degrees(np.arctan2(at_middle_px, focal_px)), np.degrees(np.arctan(roll))
    angles = f"the cameras look {tilt_deg:+.2f} degrees apart up and down and are rolled by {roll_deg:+.2f} degrees"
    words = f"rows differ by {median:.2f} px in the median, {p90:.2f} px at 90 %, {np.median(errors):+.2f} px with sign"
    bad = f"{words}: {angles}; calibrate the cameras again, or check their time"
    return judge(name, median, Limits(0.5, 1.2, "px (median)"), words, bad)
