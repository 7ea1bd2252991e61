"""What looks like nothing else, against all pairs; and what a part of them finds."""

import numpy as np
import pytest

from fleetmap.geometry import Array
from mapserver.tiles import landmark_budget as module
from mapserver.tiles.landmark_budget import distinctive_landmarks


def racks(rng: np.random.Generator, aisles: int, count: int, noise: float) -> tuple[Array, np.ndarray]:
    """The same things in every aisle, 5 m apart, each bit of them wrong that often."""
    points = rng.uniform(0.0, 4.0, (count, 3))
    bits = rng.integers(0, 2, (count, 256))
    shifts = np.array([[0.0, 5.0 * aisle, 0.0] for aisle in range(aisles)])
    all_points = [points + shift + rng.normal(0.0, 0.02, points.shape) for shift in shifts]
    all_bits = [bits ^ (rng.random(bits.shape) < noise) for _ in range(aisles)]
    return np.concatenate(all_points), np.packbits(np.concatenate(all_bits).astype(np.uint8), axis=1)


def by_all_pairs(points: Array, descriptors: np.ndarray) -> np.ndarray:
    bits = np.unpackbits(descriptors, axis=1).astype(int)
    apart = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2) > 2.0
    level = np.abs(points[:, None, 2] - points[None, :, 2]) <= 0.15
    alike = (bits[:, None, :] != bits[None, :, :]).sum(axis=2) <= 60
    return np.asarray(~(apart & level & alike).any(axis=1))


@pytest.mark.parametrize("noise", [0.0, 0.06, 0.12])
def test_as_all_pairs_say(noise: float) -> None:
    rng = np.random.default_rng(2)
    points, descriptors = racks(rng, 3, 60, noise)
    points = np.concatenate([points, rng.uniform(0.0, 15.0, (30, 3))])
    descriptors = np.concatenate([descriptors, rng.integers(0, 256, (30, 32), dtype=np.uint8)])
    # The same thing mapped twice is one thing, and what stands on another shelf is no twin.
    points[-1], descriptors[-1] = points[-2] + [0.5, 0.0, 0.0], descriptors[-2]
    points[-3], descriptors[-3] = points[-4] + [5.0, 0.0, 0.4], descriptors[-4]
    found = distinctive_landmarks(points, descriptors)
    np.testing.assert_array_equal(found, by_all_pairs(points, descriptors))
    assert found[-30:].all()
    assert found[:180].mean() < 0.3


def test_a_part_of_the_others_finds_what_repeats_often(monkeypatch: pytest.MonkeyPatch) -> None:
    points, descriptors = racks(np.random.default_rng(3), 30, 40, 0.05)
    monkeypatch.setattr(module, "_REACH", 0)
    monkeypatch.setattr(module, "_MOST_COMPARED", 20)
    assert distinctive_landmarks(points, descriptors).mean() < 0.05


def test_an_empty_survey_has_none() -> None:
    assert distinctive_landmarks(np.zeros((0, 3)), np.zeros((0, 32), np.uint8)).shape == (0,)
