"""Codes keep what they promise and are stable."""

from itertools import permutations, product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.geometry import rotation_angle_rad, rotation_from_quat_wxyz, so3_exp
from fleetmap.mapformat import tile_codec as quantise


def test_every_direction_code_is_stable_and_directions_are_good_to_their_step() -> None:
    axis = np.arange(-42, 43)
    codes = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2).astype(np.int8)
    first = quantise.direction_code(quantise.direction_value(codes))
    assert np.array_equal(quantise.direction_code(quantise.direction_value(first)), first)
    # Only codes on the folded edge have a second spelling.
    changed = (first != codes).any(axis=1)
    assert (np.abs(codes[changed].astype(int)).max(axis=1) == 42).all()
    directions = np.random.default_rng(1).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    back = quantise.direction_value(quantise.direction_code(directions.astype(np.float32)))
    cosines = np.clip((directions * back).sum(axis=1), -1, 1)
    assert np.degrees(np.arccos(cosines)).max() < 3.0
    assert np.allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)


def _check_rotation(rotation: np.ndarray) -> None:
    code = quantise.rotation_code(rotation)
    back = quantise.rotation_values(np.array([code[0]], np.uint8), code[1][None])[0]
    assert np.allclose(back, rotation_from_quat_wxyz(np.insert(code[1] / 32767, code[0], 1.0)), atol=1e-15)
    assert rotation_angle_rad(rotation.T @ back) < 1e-4
    again = quantise.rotation_code(back)
    assert again[0] == code[0]
    assert np.array_equal(again[1], code[1])


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rotations_are_stable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _check_rotation(so3_exp(rng.normal(size=3) * rng.choice([1e-9, 1e-4, 1.0, 3.0])))


def test_rotations_with_ties_are_stable() -> None:
    # Quaternions whose largest components are equal, or nearly: there the choice of the largest is delicate.
    for base in ((1, 1, 1, 1), (1, 1, 0, 0), (1, 1, 1, 0), (1, 1 - 1e-5, 0.3, 0), (1, 1 - 2e-5, 1 - 1e-5, 0.1)):
        for order, signs in product(set(permutations(base)), product((1, -1), repeat=4)):
            _check_rotation(rotation_from_quat_wxyz(np.array(order) * np.array(signs)))


def test_log_codes_clip_and_are_within_half_a_step() -> None:
    values = np.geomspace(0.11, 600, 500).astype(np.float32)
    codes = quantise.log_code(values, 0.1, 20)
    back = quantise.log_value(codes, 0.1, 20)
    assert np.abs(np.log2(back / values)).max() <= 0.5 / 20 + 1e-6
    assert np.array_equal(quantise.log_code(back, 0.1, 20), codes)
    assert quantise.log_code(np.array([0.0, 1e9], np.float32), 0.1, 20).tolist() == [0, 255]


def test_half_angles_clip_and_are_within_half_a_step() -> None:
    angles = np.linspace(0, np.pi, 500).astype(np.float32)
    codes = quantise.half_angle_code(angles)
    back = quantise.half_angle_value(codes)
    assert np.abs(back - angles).max() <= np.pi / 120 + 1e-6
    assert np.array_equal(quantise.half_angle_code(back), codes)
    assert quantise.half_angle_value(np.array([60, 255], np.uint8)).tolist() == [np.float32(np.pi)] * 2
