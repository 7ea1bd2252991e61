"""What draws and merges pictures in the core: arrays that do not fit are refused, and no number leads out of them."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap import core
from fleetmap.geometry import Array

NUMBERS = np.zeros(3, np.int32)
POINTS, LEVELS, POSE, LENS = np.zeros((3, 3), np.float32), np.zeros(3, np.uint8), np.eye(4), np.ones(4)
CENTRES, RAYS, DEPTHS = np.zeros((3, 3)), np.zeros((20, 30, 3)), np.ones((20, 30), np.float32)
CELLS, VOXELS = np.full((7, 8), 255, np.uint8), np.zeros((7, 8, 8), np.uint8)
WINDOW = VOXELS.astype(np.uint16), VOXELS, np.zeros((7, 8, 2), np.uint8)
TILE = *np.zeros((3, 5, 5, 8), np.uint8), np.zeros((5, 5, 4), np.uint8)
SPOTS = np.zeros((3, 2))
SPLATS = SPOTS, np.zeros((3, 3)), np.zeros((3, 2)), np.zeros(3), np.zeros(3)


def drawn(numbers: Any = NUMBERS, pixels: Any = SPOTS, levels: Any = LEVELS, depths: Any = DEPTHS) -> Any:
    return core.draw_discs(numbers, CENTRES, pixels, POSE, POINTS, levels, LEVELS, 9.0, 1.2, RAYS, depths)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: core.cast_view(DEPTHS, DEPTHS[:5], 0.3, LENS, np.eye(3), CENTRES[0], CELLS), "nearest_px"),
        (lambda: core.add_view(*WINDOW[:2], WINDOW[2][:2], 0, 0, *TILE), "heights"),
        (lambda: core.add_view(*WINDOW, 0, 0, *TILE[:2], TILE[2][:2], TILE[3]), "hidden"),
        (lambda: core.add_view(*WINDOW, 0, 0, *TILE[:3], TILE[3][:2]), "tile_heights"),
        (lambda: core.voxel_keys(POINTS, LEVELS + np.uint8(5)), "levels"),
        (lambda: core.look_at(POINTS, LEVELS[:2], DEPTHS, 4, 0.3, LENS, POSE, 3.0, 0.05), "levels"),
        (lambda: core.look_at(POINTS, LEVELS, DEPTHS, 0, 0.3, LENS, POSE, 3.0, 0.05), "step_px"),
        (lambda: core.discs_before(POINTS, POINTS[:2], POSE, 0.3, 9.0, LENS, 30, 20), "normals_map"),
        (lambda: drawn(numbers=NUMBERS + 3), "numbers"),
        (lambda: drawn(pixels=np.zeros((2, 2))), "pixels"),
        (lambda: drawn(levels=LEVELS + np.uint8(5)), "levels"),
        (lambda: drawn(depths=DEPTHS[:5]), "pixels_per_rad"),
        (lambda: core.blend(*SPLATS[:4], np.zeros(2), 30, 20), "greys"),
        (lambda: core.blend(*SPLATS, -1, 20), "width"),
        (lambda: core.blend_backward(*SPLATS, np.zeros(2), 0.3, RAYS[..., 0].copy(), RAYS[..., 0].copy()), "opacities"),
        (lambda: core.blend_backward(*SPLATS, np.zeros(3), 0.3, np.zeros((2, 2)), RAYS[..., 0].copy()), "slopes"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call: object, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        call()  # type: ignore[operator]


UNLIKELY = np.array([0.0, -0.0, 1.0, -7.3, 1e-310, 1e30, -1e30, np.inf, -np.inf, np.nan])


@given(st.integers(0, 1 << 32))
@settings(max_examples=100, deadline=None)
def test_hostile_numbers_lead_nowhere(seed: int) -> None:
    """Not a number, infinite, huge and tiny ones, wherever a number is taken."""
    rng = np.random.default_rng(seed)

    def one() -> float:
        return float(rng.choice(UNLIKELY))

    def reals(*shape: int) -> Array:
        return rng.choice(UNLIKELY, shape)

    def floats(*shape: int) -> Any:
        return reals(*shape).astype(np.float32)

    table, points, normals, pose = core.VoxelTable(), floats(3, 3), floats(3, 3), reals(4, 4)
    table.add(floats(12, 14), one(), reals(4), pose)
    assert len({len(column) for column in table.surfels()}) == 1
    assert len(core.voxel_keys(points, LEVELS)) == 3
    core.look_at(points, LEVELS, floats(5, 6), 4, one(), reals(4), pose, one(), 0.05)
    core.discs_before(points, normals, pose, one(), one(), reals(4), 30, 20)
    window = core.cast_view(floats(12, 14), floats(12, 14), one(), reals(4), reals(3, 3), reals(3), CELLS)
    for row, column in rng.choice([-(1 << 31), -3, 0, 2, (1 << 31) - 1], (4, 2)).tolist():
        core.add_view(*window, row, column, *TILE)
    pixels = reals(3, 2)
    core.draw_discs(
        NUMBERS, reals(3, 3), pixels, pose, normals, LEVELS, LEVELS, one(), one(), reals(5, 6, 3), floats(5, 6)
    )
    gaussians = pixels, reals(3, 3), reals(3, 2), reals(3), reals(3)
    core.blend(*gaussians, 6, 5)
    core.blend_backward(*gaussians, reals(3), one(), reals(5, 6), reals(5, 6))
