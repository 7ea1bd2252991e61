"""Corner selection against brute force and OpenCV."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.core import centroid_angles_deg, spread_corners
from fleetmap.geometry import Array
from support.worlds.synthetic_texture import picture, pixel_grid, smooth_texture

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    return picture(smooth_texture(np.random.default_rng(2), shortest_px=5.0), *pixel_grid(WIDTH, HEIGHT))


def brute_force(pixels: Array, order: Array, taken: Array, distance_px: float, count: int) -> list[int]:
    """Each pixel in turn that is far enough from all held ones."""
    held, chosen = [tuple(t) for t in taken.tolist()], list[int]()
    for index in order.tolist():
        x, y = pixels[index].tolist()
        if len(chosen) < count and all((x - a) ** 2 + (y - b) ** 2 >= distance_px**2 for a, b in held):
            held.append((x, y))
            chosen.append(index)
    return chosen


def scores_of(image: NDArray[np.uint8], pixels: Array) -> Array:
    """The smaller eigenvalue of the gradient matrix in 7x7 pixels."""
    grey = image.astype(np.int64)
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    gx[:, 1:-1], gy[1:-1] = grey[:, 2:] - grey[:, :-2], grey[2:] - grey[:-2]
    scores = np.zeros(len(pixels))
    for n, (x, y) in enumerate(pixels.astype(int).tolist()):
        if min(x, y, image.shape[1] - 1 - x, image.shape[0] - 1 - y) >= 4:
            window = np.s_[y - 3 : y + 4, x - 3 : x + 4]
            xx, xy, yy = (float((a[window] * b[window]).sum()) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
            mean = 0.5 * (xx + yy)
            scores[n] = mean - np.sqrt(max(mean * mean - (xx * yy - xy * xy), 0.0))
    return scores


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (39, 60), (36, 40), (70, 33), (5, 9)])
@pytest.mark.parametrize(("taken_count", "together_px"), [(0, 0.0), (3, 300.0), (40, 300.0), (200, 10.0)])
@pytest.mark.parametrize(
    ("threshold", "border_px", "count", "distance_px"),
    [(12, 8, 10, 9.0), (12, 3, 300, 7.5), (40, 3, 60, 4.0), (12, 3, 80, 22.0), (12, 3, 20, 60.0)],
)
def test_corners_are_the_best_of_opencvs(
    image: NDArray[np.uint8], size: tuple[int, int], taken_count: int, together_px: float, threshold: int, border_px: int, count: int,
    distance_px: float,
) -> None:  # fmt: skip
    """To the bit: all of its corners, by half the threshold where they are few, best first, each far from those before and from taken.

    Also with many taken in one place, as when tracked points run together.
    """
    rng, (width, height) = np.random.default_rng(taken_count), size
    near = rng.uniform(0, size, 2) + rng.uniform(-together_px, together_px, (taken_count, 2))
    taken = (near % (np.array(size) - 1)).astype(np.float32)
    for part in (np.ascontiguousarray(image[:height, :width]), rng.integers(0, 256, (height, width), np.uint8)):
        found = [k.pt for k in cv2.FastFeatureDetector.create(threshold, True).detect(part)]
        if len(found) < 2 * count:
            found = [k.pt for k in cv2.FastFeatureDetector.create(max(threshold // 2, 4), True).detect(part)]
        pixels = np.array(found).reshape(-1, 2)
        pixels = pixels[((pixels >= border_px) & (pixels < np.array(size) - border_px)).all(axis=1)]
        scores = scores_of(part, pixels)
        order = np.argsort(-scores, kind="stable")
        chosen = brute_force(pixels, order[scores[order] > 0], taken.astype(float), distance_px, count)
        corners, scores_found = spread_corners(part, count, distance_px, threshold, border_px, taken)
        np.testing.assert_array_equal(corners, pixels[chosen])
        np.testing.assert_array_equal(scores_found, scores[chosen])


def test_angles_turn_with_the_picture(image: NDArray[np.uint8]) -> None:
    """OpenCV's y points down: a quarter turn clockwise adds 90 degrees."""
    square = np.ascontiguousarray(image[:101, :101])
    turned = np.ascontiguousarray(np.rot90(square, -1))
    middle = np.array([[50.0, 50.0]], np.float32)
    before, after = centroid_angles_deg(square, middle, 15)[0], centroid_angles_deg(turned, middle, 15)[0]
    assert (after - before) % 360 == pytest.approx(90, abs=1e-3)


def test_angles_are_those_of_orb(image: NDArray[np.uint8]) -> None:
    engine = cv2.ORB.create(nfeatures=50, nlevels=1)
    keypoints = [k for k in engine.detect(image, None) if 25 < k.pt[0] < WIDTH - 25 and 25 < k.pt[1] < HEIGHT - 25]
    assert len(keypoints) >= 5
    pixels = np.array([k.pt for k in keypoints], np.float32)
    off = centroid_angles_deg(image, pixels, 15) - np.array([k.angle for k in keypoints])
    assert np.median(np.abs((off + 180) % 360 - 180)) < 2.0


def test_a_plain_picture_has_no_corners() -> None:
    plain, taken = np.full((HEIGHT, WIDTH), 90, np.uint8), np.zeros((0, 2), np.float32)
    corners, scores = spread_corners(plain, 40, 9.0, 12, 8, taken)
    assert (corners.shape, scores.shape) == ((0, 2), (0,))
