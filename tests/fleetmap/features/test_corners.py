"""Corner selection against brute force and OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleetmap.core import centroid_angles_deg, clear_discs, min_eigenvalue_scores, select_spread
from fleetmap.features.corners import fast_corners, spread_corners
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


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([3.0, 7.5, 22.0, 60.0]), st.integers(0, 200), st.integers(1, 300))
def test_spread_is_the_greedy_choice(seed: int, distance_px: float, taken_count: int, count: int) -> None:
    """Also with many pixels taken in one place, as when tracked points run together."""
    rng = np.random.default_rng(seed)
    size = [WIDTH, HEIGHT]
    pixels = rng.integers(0, size, (200, 2)).astype(np.float32)
    near = rng.uniform(0, size, 2) + rng.normal(0, 10, (taken_count, 2))
    taken = np.clip(near, 0, np.array(size) - 1).astype(np.float32)
    order = rng.permutation(200)
    chosen = select_spread(pixels, order, taken, distance_px, count, WIDTH, HEIGHT)
    assert chosen.tolist() == brute_force(pixels.astype(float), order, taken.astype(float), distance_px, count)


def test_scores_are_the_smaller_eigenvalue(image: NDArray[np.uint8]) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(10, [WIDTH - 10, HEIGHT - 10], (40, 2)).astype(np.float32)
    grey = image.astype(float)
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    gx[:, 1:-1], gy[1:-1] = grey[:, 2:] - grey[:, :-2], grey[2:] - grey[:-2]
    expected = []
    for x, y in pixels.astype(int):
        window = np.s_[y - 3 : y + 4, x - 3 : x + 4]
        gradients = np.stack([gx[window].ravel(), gy[window].ravel()])
        expected.append(np.linalg.eigvalsh(gradients @ gradients.T)[0])
    np.testing.assert_allclose(min_eigenvalue_scores(image, pixels), expected, rtol=1e-9, atol=1e-6)
    assert min_eigenvalue_scores(image, np.array([[1.0, 1.0]], np.float32))[0] == 0


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


def test_corners_keep_their_distance_and_stay_off_the_border(image: NDArray[np.uint8]) -> None:
    taken = np.array([[80.0, 60.0], [40.0, 30.0]], np.float32)
    corners = spread_corners(image, 40, min_distance_px=9.0, taken=taken, border_px=12)
    assert len(corners) > 15
    everything = np.concatenate([taken, corners])
    apart = np.linalg.norm(everything[:, None] - everything[None], axis=2) + 1e9 * np.eye(len(everything))
    assert apart[2:].min() >= 9.0
    assert corners.min() >= 12
    assert (corners < [WIDTH - 12, HEIGHT - 12]).all()


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (39, 60), (36, 40), (70, 33)])
@pytest.mark.parametrize(("threshold", "border_px"), [(6, 3), (12, 8), (40, 3)])
def test_corners_are_those_of_opencv(
    image: NDArray[np.uint8], size: tuple[int, int], threshold: int, border_px: int
) -> None:
    """Also in pictures narrower than what is looked at together, of noise, and where some are not wanted."""
    rng, (width, height) = np.random.default_rng(5), size
    engine = cv2.FastFeatureDetector.create(threshold, True)
    free = rng.integers(0, 2, (height, width), np.uint8)
    count = 0
    for part in (np.ascontiguousarray(image[:height, :width]), rng.integers(0, 256, (height, width), np.uint8)):
        for wanted in (None, free):
            points = np.array([k.pt for k in engine.detect(part, wanted)], np.float32).reshape(-1, 2)
            expected = points[((points >= border_px) & (points < np.array(size) - border_px)).all(axis=1)]
            np.testing.assert_array_equal(fast_corners(part, threshold, border_px, wanted), expected)
            count += len(expected)
    assert count > 20


def test_a_plain_picture_has_no_corners() -> None:
    assert spread_corners(np.full((HEIGHT, WIDTH), 90, np.uint8), 40, min_distance_px=9.0).shape == (0, 2)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([4.0, 9.5, 22.0]))
def test_cleared_discs_hold_nothing_that_suppression_would_leave(seed: int, radius_px: float) -> None:
    rng = np.random.default_rng(seed)
    taken = rng.uniform([-3, -3], [WIDTH + 3, HEIGHT + 3], (12, 2)).astype(np.float32)
    free = np.full((HEIGHT, WIDTH), 255, np.uint8)
    clear_discs(free, taken, radius_px)
    u, v = pixel_grid(WIDTH, HEIGHT)
    nearest = np.min([np.hypot(u - x, v - y) for x, y in taken.astype(float)], axis=0)
    assert (nearest[free == 0] < radius_px).all()
    inside = taken[(taken >= 0).all(axis=1) & (taken < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)].astype(float)
    core = np.min([np.hypot(u - x, v - y) for x, y in inside] or [np.full(u.shape, np.inf)], axis=0)
    assert (free[core < radius_px - 2.5] == 0).all()


@pytest.mark.parametrize("taken_count", [0, 3, 40])
@pytest.mark.parametrize("count", [10, 300])  # 300: too plain an image, the threshold is halved
def test_corners_are_those_of_the_whole_image(image: NDArray[np.uint8], taken_count: int, count: int) -> None:
    """Found in a part of it, and without what is taken: to the bit as if all were found, and what is not wanted left out."""
    rng, border_px, distance_px = np.random.default_rng(taken_count), 8, 9.0
    taken = rng.uniform(0, [WIDTH, HEIGHT], (taken_count, 2)).astype(np.float32)
    everywhere = fast_corners(image, 12)
    if len(everywhere) < 2 * count:
        everywhere = fast_corners(image, 6)
    size = np.array([WIDTH, HEIGHT])
    found = everywhere[((everywhere >= border_px) & (everywhere < size - border_px)).all(axis=1)]
    scores = min_eigenvalue_scores(image, found)
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] > 0]
    expected = found[select_spread(found, order, taken, distance_px, count, WIDTH, HEIGHT)]
    chosen = spread_corners(image, count, min_distance_px=distance_px, taken=taken, border_px=border_px)
    np.testing.assert_array_equal(chosen, expected)
    assert len(chosen) > 5
    np.testing.assert_array_equal(
        fast_corners(image, 12, border_px),
        fast_corners(image, 12)[
            ((fast_corners(image, 12) >= border_px) & (fast_corners(image, 12) < size - border_px)).all(axis=1)
        ],
    )
