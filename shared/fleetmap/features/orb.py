"""Grid ORB: oriented FAST corners spread over the image and its scales, with OpenCV's rotated binary descriptors."""

from dataclasses import dataclass
from itertools import repeat

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image
from fleetmap.time_sliced import TimeSliced

SCALE_FACTOR = 1.2
_PATCH_RADIUS = 15
_BORDER_PX = 19
# Of the threshold, which is halved where corners are few: noise of a larger sigma alone has more corners then than are wanted.
_NOISE_SHARE = 0.25
_NOISE_ROWS = 16  # step of the rows that measure it


@dataclass(frozen=True, slots=True)
class Features:
    """N features of one rectified image, in level-0 pixels.

    pixels (N, 2), octaves (N,), angles_deg (N,), descriptors (N, 32).
    """

    pixels: Array
    octaves: NDArray[np.int8]
    angles_deg: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, indices: NDArray[np.int64]) -> "Features":
        return Features(
            self.pixels[indices], self.octaves[indices], self.angles_deg[indices], self.descriptors[indices]
        )

    @classmethod
    def empty(cls) -> "Features":
        """No features."""
        return cls(np.zeros((0, 2)), np.zeros(0, np.int8), np.zeros(0, np.float32), np.zeros((0, 32), np.uint8))


def detect_in_slices(image: Image, settings: OrbSettings, clearance_px: Image | None = None) -> TimeSliced[Features]:
    """Features of a rectified grey image, spread by suppression per level, whose patches show nothing of the robot itself.

    In slices of about equal work: corners, descriptors, and the caller's use of them. An image whose noise makes corners of its own is
    smoothed first (3x3 binomial). Sources: Rublee et al. 2011 (ORB), Mur-Artal 2015 (levels).
    """
    image = np.ascontiguousarray(image)
    if noise_grey(image) > _NOISE_SHARE * settings.fast_threshold:
        image = np.asarray(cv2.GaussianBlur(image, (3, 3), 0), np.uint8)
    shares = SCALE_FACTOR ** -np.arange(settings.levels)
    quotas = [int(np.ceil(settings.count * share / shares.sum())) for share in shares]
    levels = [_detect_level(image, level, quota, settings, clearance_px) for level, quota in enumerate(quotas)]
    yield
    octaves = np.repeat(np.arange(len(levels), dtype=np.int8), [len(pixels) for pixels, _ in levels])
    pixels, angles = (np.concatenate(parts) for parts in zip(*levels, strict=True))
    features = _described(image, pixels, octaves, angles)
    yield
    return features


def noise_grey(image: Image) -> float:
    """Standard deviation of the noise in grey levels: the median of a difference that flat areas and straight edges do not have.

    Sources: Immerkaer 1996 for the difference, Donoho and Johnstone 1994 for the median.
    """
    above, at, below = (image[k : k + len(image) - 2 : _NOISE_ROWS].astype(np.int16) for k in range(3))
    columns = 2 * at - above - below
    crossed = 2 * columns[:, 1:-1] - columns[:, :-2] - columns[:, 2:]
    return float(np.median(np.abs(crossed))) / (6.0 * 0.6745) if crossed.size else 0.0


def _described(
    image: Image, pixels: NDArray[np.float32], octaves: NDArray[np.int8], angles_deg: NDArray[np.float32]
) -> Features:
    """Features of oriented corners, pixels (N, 2) as OpenCV scales them up from their levels."""
    if not len(pixels):
        return Features.empty()
    engine = cv2.ORB.create(
        nfeatures=len(pixels), scaleFactor=SCALE_FACTOR, nlevels=int(octaves[-1]) + 1, edgeThreshold=_BORDER_PX
    )
    sizes = 31.0 * SCALE_FACTOR ** octaves.astype(np.float64)
    columns = *pixels.T.tolist(), sizes.tolist(), angles_deg.tolist()
    keypoints = list(map(cv2.KeyPoint, *columns, repeat(1.0), octaves.tolist()))
    kept, descriptors = engine.compute(image, keypoints)
    assert len(kept) == len(keypoints), "corners keep to the border that descriptors need"
    # OpenCV scales level pixels up from their corners; positions in the image count from their centres.
    middle = 0.5 * (SCALE_FACTOR ** octaves.astype(np.float64) - 1.0)
    return Features(pixels.astype(np.float64) + middle[:, None], octaves, angles_deg, np.asarray(descriptors, np.uint8))


def _detect_level(
    image: Image, level: int, quota: int, settings: OrbSettings, clearance_px: Image | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (N, 2) of the image and angles (N,) of the corners of a level."""
    scale = SCALE_FACTOR**level
    scaled = image if level == 0 else core.reduced(image, *(round(s / scale) for s in image.shape))
    limits, nowhere = (settings.min_distance_px, settings.fast_threshold, _BORDER_PX), np.zeros((0, 2), np.float32)
    chosen, _ = core.spread_corners(scaled, quota, *limits, nowhere, clearance_px, scale, _PATCH_RADIUS)
    pixels = (scale * chosen.astype(np.float64)).astype(np.float32)
    return pixels, core.centroid_angles_deg(scaled, chosen, _PATCH_RADIUS)
