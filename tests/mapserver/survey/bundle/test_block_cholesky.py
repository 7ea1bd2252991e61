"""Sparse Cholesky over blocks against dense algebra and against SuperLU, on couplings of many shapes."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from fleetmap import core
from fleetmap.geometry import Array, se3_exp, se3_inverse
from mapserver.survey.bundle.bundle_adjustment import minimum_degree, solver_of
from mapserver.survey.bundle.problem import BundleProblem, ImageRows, InertialTerms, MotionPrior, SelfCalibration
from mapserver.survey.settings import BundleSettings
from mapserver.survey.state import PriorTerm, RelativeTerm
from support.worlds.bundle_scene import make_scene

Pairs = Callable[[np.random.Generator], list[tuple[int, int]]]
NODES = 60
SCENE = make_scene(keyframes=2, landmarks=50, step_s=0.4, seed=1, inertial=True).problem
SPARSE = BundleSettings(dense_unknowns=0)


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


def problem(pairs: Sequence[tuple[int, int]], kind: str = "poses", count: int = NODES) -> BundleProblem:
    """Keyframes with priors, coupled in pairs: by relative poses, each second one also by an inertial edge, all by a calibration."""
    rng = np.random.default_rng(1)
    map_from_body = np.array([se3_exp(0.3 * step) for step in rng.normal(size=(count, 6))])
    roots = rng.normal(size=(count + len(pairs), 6, 6))
    steps = [se3_inverse(map_from_body[i]) @ map_from_body[j] @ se3_exp(0.1 * rng.normal(size=6)) for i, j in pairs]
    told = zip(pairs, steps, roots[count:], strict=True)
    relative = [RelativeTerm(i, j, step, root @ root.T) for (i, j), step, root in told]
    priors = [PriorTerm(k, map_from_body[k], roots[k] @ roots[k].T + np.eye(6)) for k in range(count)]
    moved = {"map_from_body": map_from_body, "fixed": np.zeros(count, np.bool_), "relative": relative, "priors": priors}
    terms = replace(SCENE.observed(np.zeros(len(SCENE.obs_pixels), np.bool_)), **moved, inertial=None)
    if kind != "poses":
        increment = replace(SCENE.inertial.edges[0][2], cov=np.eye(15))
        told = [MotionPrior(k, np.zeros(9), np.ones(9)) for k in range(count)]
        terms.inertial = InertialTerms(rng.normal(size=(count, 9)), [(i, j, increment) for i, j in pairs[::2]], told)
    if kind == "calibration":
        rows = ImageRows(np.zeros((0, 4)), np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), map_from_body[:, :3, 3])
        ways = rng.normal(size=(len(pairs), 3))
        terms.calibration = SelfCalibration(np.zeros(3), np.ones(3), ways, 1, lambda *_: rows)
    return terms


def matrix_of(solver: core.BundleSolver) -> Array:
    lower, _ = solver.reduced(0.0)
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


@pytest.fixture(params=PATTERNS)
def pairs(request) -> list[tuple[int, int]]:
    return [(i, j) for i, j in PATTERNS[request.param](np.random.default_rng(1)) if i != j]


@pytest.mark.parametrize("kind", ["poses", "motion", "calibration"])
def test_solves_as_superlu_does(pairs: list[tuple[int, int]], kind: str) -> None:
    solver = solver_of(problem(pairs, kind), SPARSE)
    matrix, rhs, step = matrix_of(solver), solver.reduced(0.0)[1], solver.step(0.0)
    np.testing.assert_allclose(matrix @ step, rhs, atol=1e-10 * np.abs(rhs).max())
    superlu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix))
    np.testing.assert_allclose(step, superlu.solve(rhs), atol=1e-9)
    assert solver.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-10)


@pytest.mark.parametrize("kind", ["poses", "motion"])
def test_refuses_what_is_not_positive_definite(pairs: list[tuple[int, int]], kind: str) -> None:
    """Eigenvalues tell: with its diagonal less by just above the smallest, a matrix is indefinite, though no number there is negative."""
    solver = solver_of(problem(pairs, kind), SPARSE)
    scale = np.sqrt(np.diag(matrix_of(solver)))
    smallest = np.linalg.eigvalsh(matrix_of(solver) / np.outer(scale, scale))[0]
    assert solver.step(1e-6 - smallest) is not None
    assert solver.step(-1e-6 - smallest) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_refuses_numbers_that_are_none(bad: float) -> None:
    spoilt = problem([])
    spoilt.priors[17].information[0, 0] = bad
    assert solver_of(spoilt, SPARSE).step(0.0) is None


def test_a_chain_fills_in_nothing() -> None:
    """Whatever number its nodes have: a chain's factor has no more blocks than the chain, but for zeros taken in on purpose."""
    numbers = np.random.default_rng(1).permutation(5000)
    chain = problem(list(zip(numbers[:-1].tolist(), numbers[1:].tolist(), strict=True)), count=5000)
    solver = solver_of(chain, SPARSE)
    assert solver.factorise_sparsely(minimum_degree(5000, solver.nodes()[1])) < 4 * 5000 * 2 * 36
