"""Sparse Cholesky over blocks against dense algebra and against SuperLU, on patterns of many shapes."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from fleetmap import core
from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle.bundle_adjustment import minimum_degree

Pairs = Callable[[np.random.Generator], list[tuple[int, int]]]
NODES = 60


def block_cholesky(sizes: AnyArray, pairs: AnyArray) -> core.BlockCholesky:
    return core.BlockCholesky(sizes, pairs, minimum_degree(len(sizes), pairs))


def grid(width: int) -> list[tuple[int, int]]:
    right = [(n, n + 1) for n in range(NODES - 1) if (n + 1) % width]
    return right + [(n, n + width) for n in range(NODES - width)]


PATTERNS: dict[str, Pairs] = {
    "nothing coupled": lambda rng: [],
    "chain": lambda rng: [(n + 1, n) for n in range(NODES - 1)],
    "ring, given both ways": lambda rng: [(n, (n + 1) % NODES) for n in range(NODES)] + [(0, NODES - 1)],
    "star, whose middle comes first": lambda rng: [(0, n) for n in range(1, NODES)],
    "grid": lambda rng: grid(8),
    "two parts": lambda rng: [(n, n + 2) for n in range(NODES - 2)],
    "all with all": lambda rng: [(a, b) for a in range(NODES) for b in range(a)],
    "at random": lambda rng: rng.integers(0, NODES, (2 * NODES, 2)).tolist(),
}


class Problem:
    """A positive definite matrix with blocks of 1, 6 and 9 unknowns, as it is and as values of a factor."""

    def __init__(self, pairs: list[tuple[int, int]], seed: int, shift: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.sizes = rng.choice([1, 6, 9], NODES)
        self.pattern = block_cholesky(self.sizes, np.array(pairs, np.int64).reshape(-1, 2))
        begins = np.cumsum(self.sizes) - self.sizes
        self.matrix, self.values = np.zeros((self.sizes.sum(),) * 2), np.zeros(self.pattern.size)
        for a, b in sorted({(max(p), min(p)) for p in pairs} - {(n, n) for n in range(NODES)}):
            jacobian = rng.normal(size=(8, self.sizes[a] + self.sizes[b]))
            whole, cut = jacobian.T @ jacobian, self.sizes[a]
            row, col = slice(begins[a], begins[a] + self.sizes[a]), slice(begins[b], begins[b] + self.sizes[b])
            self._add(a, a, row, row, whole[:cut, :cut])
            self._add(b, b, col, col, whole[cut:, cut:])
            self.matrix[col, row] += whole[cut:, :cut]
            if rng.random() < 0.5:
                self._add(a, b, row, col, whole[:cut, cut:])
            else:  # the same, turned round
                self.matrix[row, col] += whole[:cut, cut:]
                self._place(b, a, whole[cut:, :cut])
        for n, (begin, size) in enumerate(zip(begins, self.sizes, strict=True)):
            here = slice(begin, begin + size)
            self._add(n, n, here, here, shift * np.eye(size))

    def _add(self, a: int, b: int, row: slice, col: slice, block: Array) -> None:
        self.matrix[row, col] += block
        self._place(a, b, block)

    def _place(self, a: int, b: int, block: Array) -> None:
        first, down, right = self.pattern.places(np.array([a]), np.array([b]))[0]
        self.values[first + down * np.arange(block.shape[0])[:, None] + right * np.arange(block.shape[1])] += block

    def solve(self, rhs: Array) -> Array | None:
        values = self.values.copy()
        return self.pattern.solve(values, rhs) if self.pattern.factorise(values) else None


def superlu(matrix: Array, rhs: Array) -> AnyArray:
    return scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix)).solve(rhs)


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_solves_as_superlu_does(name: str, seed: int) -> None:
    problem = Problem(PATTERNS[name](np.random.default_rng(seed)), seed)
    rhs = np.random.default_rng(seed).normal(size=len(problem.matrix))
    solution = problem.solve(rhs)
    np.testing.assert_allclose(problem.matrix @ solution, rhs, atol=1e-10)
    np.testing.assert_allclose(solution, superlu(problem.matrix, rhs), atol=1e-9)


@pytest.mark.parametrize("name", PATTERNS)
def test_refuses_what_is_not_positive_definite(name: str) -> None:
    """Eigenvalues tell: shifted to just below its smallest one, a matrix is indefinite, though no diagonal number is negative."""
    pairs = PATTERNS[name](np.random.default_rng(1))
    smallest = np.linalg.eigvalsh(Problem(pairs, 1).matrix)[0]
    assert Problem(pairs, 1, shift=1.0 - smallest + 1e-6).solve(np.zeros(Problem(pairs, 1).sizes.sum())) is not None
    assert Problem(pairs, 1, shift=1.0 - smallest - 1e-6).solve(np.zeros(Problem(pairs, 1).sizes.sum())) is None


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_refuses_unknowns_that_nothing_measures_and_numbers_that_are_none(bad: float) -> None:
    problem = Problem(PATTERNS["nothing coupled"](np.random.default_rng(1)), 1)
    first, *_ = problem.pattern.places(np.array([17]), np.array([17]))[0]
    problem.values[first] = bad
    assert problem.solve(np.ones(len(problem.matrix))) is None


def test_a_chain_fills_in_nothing() -> None:
    """Whatever number its nodes have: a chain's factor has no more blocks than the chain, but for zeros taken in on purpose."""
    numbers = np.random.default_rng(1).permutation(5000)
    pattern = block_cholesky(np.full(5000, 6), np.stack([numbers[:-1], numbers[1:]], axis=1))
    assert pattern.size < 4 * 5000 * 2 * 36
    assert sorted(pattern.order()) == list(range(30000))
