"""What stays in its place in the images while the camera moves: dots of a projector, dirt, the robot itself."""

from collections.abc import Sequence

import cv2
import numpy as np

from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image
from mapserver.doctor.findings import Finding, Limits, judge, not_judged

NAME = "fixed pattern"
_WIDTH_PX, _CELL_PX, _FINE_PX = 320, 20, 2.0
_LEAST_CONTRAST = 3.0  # grey levels of fine structure in a cell: below are sensor noise and a codec's blocks
_LEAST_SHARE = 0.25  # of a cell's fine structure that is the same in all images
_SAME_SCENE = 0.95  # correlation of the coarse images of a camera that has not moved
_MIN_IMAGES = 5
_LIMITS = Limits(0.2, 0.5, "of the image stays in its place")


def fine_structure(image: Image) -> tuple[Array, Array]:
    """What of an image is finer than a few pixels, and the image coarsely: both at one size for all cameras of a shape."""
    size = _WIDTH_PX, max(_CELL_PX, round(image.shape[0] * _WIDTH_PX / image.shape[1]) // _CELL_PX * _CELL_PX)
    small: Array = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    coarse = cv2.resize(small, (size[0] // _CELL_PX, size[1] // _CELL_PX), interpolation=cv2.INTER_AREA)
    return small - cv2.GaussianBlur(small, (0, 0), _FINE_PX), np.asarray(coarse, np.float64)


def fixed_pattern(structures: Sequence[tuple[Array, Array]]) -> Finding:
    """The share of the image whose fine structure is the same in images of different scenes.

    Structures that have nothing in common leave 1 / n of their energy in the mean of n.
    """
    kept: list[tuple[Array, Array]] = []
    for fine, coarse in structures:
        if all(_correlation(coarse, other) < _SAME_SCENE for _, other in kept):
            kept.append((fine, coarse))
    if len(kept) < _MIN_IMAGES:
        return not_judged(NAME, f"{len(kept)} of the images that were looked at show different scenes", "drive further")
    cells = np.array([_cells(fine) for fine, _ in kept])  # (n, cells, pixels)
    contrast = cells.std(axis=2)
    textured = np.median(contrast, axis=0) > _LEAST_CONTRAST
    if textured.sum() < 0.1 * len(textured):
        return not_judged(NAME, "the images show next to nothing", "drive in the light")
    unit = cells[:, textured] / np.maximum(contrast[:, textured, None], 1e-6)
    count = len(kept)
    alike = (count * (unit.mean(axis=0) ** 2).mean(axis=1) - 1.0) / (count - 1)
    share = float((alike > _LEAST_SHARE).sum()) / len(textured)
    bad = (
        f"{share:.0%} of the image shows the same while the camera moves; switch a projector of infrared dots off or record the images "
        "between its flashes, clean the lens, and keep the robot itself out of the image"
    )
    return judge(NAME, share, _LIMITS, "nothing stays in its place while the camera moves", bad)


def _cells(fine: Array) -> Array:
    height, width = fine.shape
    tiled = fine.reshape(height // _CELL_PX, _CELL_PX, width // _CELL_PX, _CELL_PX)
    cells = tiled.transpose(0, 2, 1, 3).reshape(-1, _CELL_PX * _CELL_PX)
    return np.asarray(cells - cells.mean(axis=1, keepdims=True), np.float64)


def _correlation(first: Array, second: Array) -> float:
    a, b = first - first.mean(), second - second.mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-9))
