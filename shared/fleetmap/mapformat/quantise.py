"""Codes of few bytes for directions, rotations and magnitudes. Encoding what was decoded gives the same code again."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, quat_wxyz_from_rotation

_RATIO = 32767.0


def log_code(values: NDArray[np.float32], smallest: float, steps_per_octave: int) -> NDArray[np.uint8]:
    """Codes c of values ~ smallest * 2 ** (c / steps_per_octave), clipped to 0..255."""
    octaves = np.log2(np.maximum(values.astype(np.float64), smallest) / smallest)
    return np.minimum(np.round(octaves * steps_per_octave), 255).astype(np.uint8)


def log_value(codes: NDArray[np.uint8], smallest: float, steps_per_octave: int) -> NDArray[np.float32]:
    """Values of `log_code`'s codes."""
    return (smallest * np.exp2(codes.astype(np.float64) / steps_per_octave)).astype(np.float32)


def half_angle_code(angles_rad: NDArray[np.float32], steps: int) -> NDArray[np.uint8]:
    """Codes of angles from 0 to pi in steps of pi / `steps`, at most 255 of them."""
    return np.clip(np.round(angles_rad.astype(np.float64) * (steps / np.pi)), 0, steps).astype(np.uint8)


def half_angle_value(codes: NDArray[np.uint8], steps: int) -> NDArray[np.float32]:
    """Angles in radians of codes; those above `steps` mean pi."""
    return (np.minimum(codes, steps) * (np.pi / steps)).astype(np.float32)


def direction_code(directions: NDArray[np.float32], steps: int) -> NDArray[np.int8]:
    """(N, 2) octahedral codes of directions (N, 3), from -steps to steps. Source: Meyer et al. 2010.

    Neighbouring codes are about 1.0 degree apart with 127 steps, 2.9 with 42.
    """
    # Twice, because the folded edge of the octahedron has two codes for one direction: the second pass picks one.
    return _direction_code(direction_value(_direction_code(directions, steps), steps), steps)


def _direction_code(directions: NDArray[np.float32], steps: int) -> NDArray[np.int8]:
    vectors = directions.astype(np.float64)
    vectors = vectors / np.abs(vectors).sum(axis=1, keepdims=True)
    upper = vectors[:, :2]
    signs = np.where(upper >= 0, 1.0, -1.0)
    folded = (1.0 - np.abs(upper[:, ::-1])) * signs
    plane = np.where(vectors[:, 2:] < 0, folded, upper)
    return np.asarray(np.clip(np.round(plane * steps), -steps, steps), np.int8)


def direction_value(codes: NDArray[np.int8], steps: int) -> NDArray[np.float32]:
    """(N, 3) unit directions of octahedral codes (N, 2)."""
    plane = np.clip(codes.astype(np.float64), -steps, steps) / steps
    z = 1.0 - np.abs(plane).sum(axis=1, keepdims=True)
    signs = np.where(plane >= 0, 1.0, -1.0)
    folded = (1.0 - np.abs(plane[:, ::-1])) * signs
    vectors = np.concatenate([np.where(z < 0, folded, plane), z], axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def rotation_code(rotation: Array) -> tuple[int, NDArray[np.int16]]:
    """Index of the quaternion's largest component and the other three divided by it (3,), good to about 5e-5 rad.

    Of components that round to the largest one the first wins, so that what was decoded is encoded alike.
    """
    quat = quat_wxyz_from_rotation(rotation)
    ratios = np.round(quat / np.abs(quat).max() * _RATIO)
    index = int(np.argmax(np.abs(ratios) == _RATIO))
    return index, (np.delete(ratios, index) * np.sign(ratios[index])).astype(np.int16)


def rotation_values(indices: NDArray[np.uint8], ratios: NDArray[np.int16]) -> Array:
    """(K, 3, 3) rotations of `rotation_code`'s codes (K,) and (K, 3)."""
    count = len(indices)
    quats = np.ones((count, 4))
    others = np.arange(4)[None] != indices[:, None]
    quats[others] = (ratios.astype(np.float64) / _RATIO).ravel()
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), -1, 0))
