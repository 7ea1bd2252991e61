"""A chain with measured differences against the whole joint covariance, conditioned at once; memory does not know the chain."""

import tracemalloc
from collections.abc import Callable

import numpy as np

from fleetmap.geometry import Array
from mapserver.survey.pose_graph.chain_covariance import ChainCovariance


def _spread(rng: np.random.Generator, count: int, scale: float) -> Array:
    roots = scale * rng.normal(size=(count, 6, 6))
    return roots @ roots.transpose(0, 2, 1) + 1e-3 * scale**2 * np.eye(6)


def _joint(sums: Array) -> Array:
    """(6 K, 6 K) covariance of all places: what two share is the way to the earlier one."""
    count = len(sums)
    earlier = np.minimum(*np.meshgrid(np.arange(count), np.arange(count)))
    return np.asarray(sums[earlier].transpose(0, 2, 1, 3).reshape(6 * count, 6 * count))


def _difference(count: int, i: int, j: int) -> Array:
    taken = np.zeros((6, 6 * count))
    taken[:, 6 * j : 6 * j + 6] += np.eye(6)
    taken[:, 6 * i : 6 * i + 6] -= np.eye(6)
    return taken


def test_it_is_the_whole_joint_covariance() -> None:
    """Thirty measurements, more anchors than there is room for at first, between any two places."""
    rng, count = np.random.default_rng(0), 70
    sums = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(_spread(rng, count - 1, 0.1), axis=0)])
    chain, joint, everyone = ChainCovariance(sums), _joint(sums), np.arange(count)
    for _ in range(30):
        i, j = rng.choice(count, 2, replace=False).tolist()
        cov, taken = _spread(rng, 1, 0.2)[0], _difference(count, i, j)
        wanted = np.linalg.solve(taken @ joint @ taken.T + cov, taken @ joint).T
        joint = joint - wanted @ taken @ joint
        gain = chain.measure(i, j, cov)
        np.testing.assert_allclose(gain.reshape(-1, 6), wanted, atol=1e-9)
    for i in (0, 17, 69):
        wanted_covs = [_difference(count, i, j) @ joint @ _difference(count, i, j).T for j in range(count)]
        np.testing.assert_allclose(chain.of_differences(i, everyone), wanted_covs, atol=1e-9)


def test_memory_goes_with_the_measurements_alone() -> None:
    rng = np.random.default_rng(1)
    sizes = []
    for count in (200, 4000):
        sums = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(np.tile(1e-4 * np.eye(6), (count - 1, 1, 1)), axis=0)])
        chain = ChainCovariance(sums)
        for _ in range(20):
            i, j = rng.choice(np.arange(1, count), 2, replace=False).tolist()
            chain.measure(i, j, 1e-4 * np.eye(6))
        sizes.append(chain._joint.nbytes)
    assert sizes[0] == sizes[1]


def test_an_answer_costs_what_it_is_about_and_a_measurement_no_second_matrix() -> None:
    """In bytes that are allocated meanwhile, after few measurements and after many."""
    rng, count, asked = np.random.default_rng(2), 2000, np.arange(700, 720)
    steps = np.tile(1e-4 * np.eye(6), (count - 1, 1, 1))
    chain, peaks, done = ChainCovariance(np.concatenate([np.zeros((1, 6, 6)), np.cumsum(steps, axis=0)])), [], 0
    for measurements in (15, 150):
        for _ in range(done, measurements):
            i, j = rng.choice(np.arange(1, count), 2, replace=False).tolist()
            chain.measure(i, j, 1e-4 * np.eye(6))
        done = measurements
        peaks.append(_peak_bytes(lambda: chain.of_differences(30, asked)))
    assert peaks[1] < 1.1 * peaks[0]
    chain.measure(1000, 10, 1e-4 * np.eye(6))
    assert _peak_bytes(lambda: chain.measure(1000, 10, 1e-4 * np.eye(6))) < 0.5 * chain._joint.nbytes


def _peak_bytes(work: Callable[[], object]) -> int:
    work()
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
