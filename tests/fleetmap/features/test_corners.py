"""Corner selection against brute force and OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleetmap.features.corner_kernels import centroid_angles_deg, min_eigenvalue_scores, select_spread
from fleetmap.features.corners import spread_corners
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
    np.testing.assert_allclose(min_eigenvalue_scores(image, pixels, 3), expected, rtol=1e-9, atol=1e-6)
    assert min_eigenvalue_scores(image, np.array([[1.0, 1.0]], np.float32), 3)[0] == 0


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


def test_a_plain_picture_has_no_corners() -> None:
    assert spread_corners(np.full((HEIGHT, WIDTH), 90, np.uint8), 40, min_distance_px=9.0).shape == (0, 2)
