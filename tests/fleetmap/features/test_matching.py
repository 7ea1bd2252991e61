"""Matching against brute force in numpy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.features.matching import FAR, Projected, match_by_projection, match_mutual, packed
from fleetmap.features.orb import Features
from fleetmap.geometry import Array


def features_of(pixels: Array, octaves: NDArray[np.int8], descriptors: NDArray[np.uint8]) -> Features:
    return Features(pixels, octaves, np.zeros(len(pixels), np.float32), descriptors)


def _descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(2).astype(np.int64)


def _family(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Two shuffled sets with near copies, exact copies and strangers in them."""
    a = _descriptors(rng, count)
    noise = np.packbits(rng.random((count, 256)) < rng.uniform(0.0, 0.25, (count, 1)), axis=1)
    b = np.concatenate([a ^ noise, a[: count // 5], _descriptors(rng, count // 3)])
    return a, b[rng.permutation(len(b))]


@pytest.mark.parametrize("nodes", [0, 1, 3, 4])  # 0: all with all
@pytest.mark.parametrize(("max_distance", "ratio"), [(256, 0.99), (256, 1.0), (64, 0.8), (30, 0.95)])
def test_mutual_is_brute_force_over_what_shares_a_node(max_distance: int, ratio: float, nodes: int) -> None:
    rng = np.random.default_rng(max_distance + nodes)
    a, b = _family(rng, 70)
    nodes_a, nodes_b = (rng.integers(0, max(nodes, 1), shape).astype(np.int32) for shape in ((len(a), 2), len(b)))
    table, wanted = _distances(a, b), []
    table[~(nodes_a[:, :, None] == nodes_b).any(axis=1)] = FAR
    for i, row in enumerate(table):
        j = int(row.argmin())
        if row[j] <= max_distance and row[j] < ratio * np.sort(row)[1] and table[:, j].argmin() == i:
            wanted.append((i, j))
    assert len(wanted) > 5
    nothing, within = np.zeros((0, 32), np.uint8), (nodes_a, nodes_b) if nodes else None
    np.testing.assert_array_equal(match_mutual(a, b, max_distance, ratio, within), wanted)
    assert match_mutual(nothing, b, 64, 0.8, within and (nodes_a[:0], nodes_b)).shape == (0, 2)
    assert match_mutual(a, nothing, 64, 0.8, within and (nodes_a, nodes_b[:0])).shape == (0, 2)


def _projection_twin(
    predicted: Array, radius: Array, a: np.ndarray, span: np.ndarray, pixels: Array, octaves: np.ndarray, b: np.ndarray,
    max_distance: int, ratio: float,
) -> list[int]:  # fmt: skip
    table = _distances(a, b)
    claims: dict[int, list[tuple[int, int]]] = {}
    for i in range(len(a)):
        near = np.linalg.norm(pixels - predicted[i], axis=1) <= radius[i]
        allowed = np.flatnonzero(near & (octaves >= span[i, 0]) & (octaves <= span[i, 1]))
        if len(allowed) == 0:
            continue
        j = int(allowed[table[i, allowed].argmin()])
        rivals = allowed[(allowed != j) & (octaves[allowed] == octaves[j])]
        second = table[i, rivals].min() if len(rivals) else FAR
        if table[i, j] <= max_distance and table[i, j] < ratio * second:
            claims.setdefault(j, []).append((int(table[i, j]), i))
    index = [-1] * len(a)
    for j, contenders in claims.items():
        index[min(contenders)[1]] = j
    return index


@pytest.mark.parametrize("seed", range(6))
def test_projection_is_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = _family(rng, 80)
    a = np.concatenate([a, a[:20] ^ np.packbits(rng.random((20, 256)) < 0.02, axis=1)])  # contenders for the same b
    predicted = rng.uniform(-20.0, [340.0, 260.0], (len(a), 2))
    predicted[::17] = np.nan
    radius = rng.uniform(20.0, 300.0, len(a))
    radius[3] = np.inf
    low = rng.integers(0, 4, len(a))
    span = np.column_stack([low, low + rng.integers(0, 5, len(a))])
    pixels = rng.uniform(0.0, [320.0, 240.0], (len(b), 2))
    octaves = rng.integers(0, 8, len(b)).astype(np.int8)
    features = features_of(pixels, octaves, b)
    index, distance = match_by_projection(Projected(predicted, radius, a, span), features, 90, 0.9)
    wanted = _projection_twin(predicted, radius, a, span, pixels, octaves, b, 90, 0.9)
    np.testing.assert_array_equal(index, wanted)
    matched = index >= 0
    assert matched.sum() > 10
    assert len(np.unique(index[matched])) == matched.sum()
    np.testing.assert_array_equal(distance[matched], _distances(a, b)[np.flatnonzero(matched), index[matched]])
    assert (distance[~matched] == FAR).all()


def test_projection_survives_wild_coordinates() -> None:
    rng = np.random.default_rng(1)
    a = _descriptors(rng, 4)
    span, octaves = np.tile([0, 7], (4, 1)), np.zeros(4, np.int8)
    pixels = np.array([[10.0, 10.0], [np.nan, 5.0], [1e12, -1e12], [20.0, 20.0]])
    predicted = np.array([[10.0, 10.0], [10.0, 5.0], [1e12, -1e12], [1e300, 20.0]])
    projected = Projected(predicted, np.full(4, 5.0), a, span)
    index, _ = match_by_projection(projected, features_of(pixels, octaves, a), 64, 0.9)
    np.testing.assert_array_equal(index, [0, -1, 2, -1])
    index, _ = match_by_projection(projected, Features.empty(), 64, 0.9)
    assert (index == -1).all()


def test_packing_read_only_and_unaligned_bytes() -> None:
    stored = np.random.default_rng(2).integers(0, 256, 1 + 10 * 32, dtype=np.uint8).tobytes()
    descriptors = np.frombuffer(stored, np.uint8, offset=1).reshape(10, 32)
    words = packed(descriptors)
    assert words.flags.writeable and words.flags.aligned
    np.testing.assert_array_equal(words.view(np.uint8).reshape(10, 32), descriptors)
