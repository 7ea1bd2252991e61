"""The matcher of whole pictures, on a board before a wall."""

import cv2
import numpy as np

from fleetmap import core
from mapserver.plugins.dense_maps.dense_stereo import DENSE_SIGMA_PX

FAR_PX, NEAR_PX, BLANK = 12.25, 30.5, slice(0, 40)
BOARD = (slice(80, 160), slice(140, 240))  # in the left picture


def board_before_wall() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right (240, 320), and the disparities of the left one."""
    rng = np.random.default_rng(3)
    wall, board = (cv2.GaussianBlur(rng.uniform(0, 255, (240, 420)).astype(np.float32), (0, 0), 1.5) for _ in "ab")
    wall, board = (np.clip(128 + 4 * (each - 128), 0, 255) for each in (wall, board))
    wall[BLANK] = 128
    true = np.full((240, 320), FAR_PX, np.float32)
    true[BOARD] = NEAR_PX
    v, u = np.mgrid[:240, :320].astype(np.float32)
    on_board = (v >= 80) & (v < 160) & (u + NEAR_PX >= 140) & (u + NEAR_PX < 240)
    shown = [cv2.remap(each, u + shift, v, cv2.INTER_CUBIC) for each, shift in ((wall, FAR_PX), (board, NEAR_PX))]
    right = np.where(on_board, shown[1], shown[0])
    left = np.where(true == NEAR_PX, board[:, :320], wall[:, :320])
    return left.round().clip(0, 255).astype(np.uint8), right.round().clip(0, 255).astype(np.uint8), true


def test_a_board_before_a_wall_stands_where_it_is_and_what_is_hidden_is_unknown() -> None:
    left, right, true = board_before_wall()
    found = core.match_densely(left, right, 60.0) / core.DENSE_FRACTIONS
    true, is_known, seen_by_both = true[::2, ::2], found > 0, np.ones(found.shape, bool)
    seen_by_both[38:82, 60:71] = False  # of the wall, beside the board, the right camera sees nothing
    assert (np.abs(found - true)[is_known & seen_by_both] < 1.0).mean() > 0.985
    assert is_known[30:70, 80:110].mean() > 0.95, "the board"
    assert not is_known[:15].any(), "no texture"
    assert not is_known[:, :32].any(), "where the nearest would be outside of the right picture"
    assert is_known[44:76, 62:69].mean() < 0.5, "hidden"
    assert np.median(np.abs(found - true)[is_known]) < DENSE_SIGMA_PX


def test_the_last_disparity_of_a_range_is_found() -> None:
    """31 px fill two registers of the matcher."""
    wall = cv2.GaussianBlur(np.random.default_rng(4).uniform(0, 255, (60, 240)).astype(np.float32), (0, 0), 1.5)
    wall = np.clip(128 + 4 * (wall - 128), 0, 255).astype(np.uint8)
    found = core.match_densely(wall[:, :200].copy(), wall[:, 31:231].copy(), 31.0)[:, 30:] / core.DENSE_FRACTIONS
    assert (np.abs(found - 31.0) < DENSE_SIGMA_PX).mean() > 0.95
