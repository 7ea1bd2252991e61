"""The core's solvers refuse what cannot be, and give values for numbers that are not finite."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleetmap import core
from fleetmap.geometry import Array

POSES, EYES = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(6), (1, 1, 1))
# Three keyframes with motion, four landmarks, each seen by two keyframes, and one of every other measurement.
BUNDLE: dict[str, Any] = {
    "lens": np.array([500.0, 320.0, 240.0, 50.0]),
    "body_from_cams": np.eye(4)[None],
    "map_from_body": POSES,
    "motions": np.zeros((3, 9)),
    "points_map": np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 4.0], [0.0, 1.0, 5.0], [1.0, 1.0, 6.0]]),
    "free": np.ones((3, 15), np.bool_),
    "points_held": False,
    "obs_keyframe": np.array([0, 1, 1, 2, 2, 0, 0, 1], np.int32),
    "obs_camera": np.zeros(8, np.int32),
    "obs_landmark": np.array([0, 0, 1, 1, 2, 2, 3, 3], np.int32),
    "obs_pixels": np.full((8, 3), 300.0),
    "obs_sigma_px": np.ones((8, 2)),
    "relative_ends": np.array([[0, 2]]),
    "i_from_j": POSES[:1],
    "relative_information": EYES,
    "prior_keyframe": np.array([1]),
    "prior_map_from_body": POSES[:1],
    "prior_information": EYES,
    "edge_ends": np.array([[0, 1]]),
    "increments": np.full((1, 67), 0.1),
    "edge_information": np.eye(15)[None],
    "motion_mean": np.zeros((3, 9)),
    "motion_weight": np.ones((3, 9)),
    "gravity": np.array([0.0, 0.0, -9.81]),
    "huber": 2.5,
    "cutoff": 9.0,
}
WITHOUT_MOTION = dict.fromkeys(("motions", "motion_mean", "motion_weight"), np.zeros((3, 0)))


def bundle(**other: object) -> core.BundleSolver:
    return core.BundleSolver(**(BUNDLE | other))


def rows(observations: int = 8, unknowns: int = 2, keyframes: int = 3) -> core.BundleSolver:
    """With a calibration of two unknowns, whose rows are those of another problem."""
    shapes = (observations, 4), (observations, 4, 3), (observations, 4, unknowns), (keyframes, 3), (4,)
    return calibrated(lambda *_: tuple(map(np.ones, shapes)))


def calibrated(rows: Any) -> core.BundleSolver:
    return bundle(calibration=(np.zeros(2), np.ones(2), np.zeros((1, 3)), 1, rows))


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: bundle().factorise_sparsely(np.array([0, 1, 2, 3, 4, 4])), "order: each node once"),
        (lambda: bundle(free=np.ones((3, 6), np.bool_), **WITHOUT_MOTION), "edge_ends: of keyframes with motion"),
        (lambda: calibrated(lambda *_: None).cost(), "rows: residuals, derivatives"),
        (lambda: calibrated(lambda *_: (np.ones((8, 3)),) * 5).cost(), "rows: residuals, derivatives"),
        (lambda: rows(observations=7).cost(), "rows: residuals of each"),
        (lambda: rows(unknowns=3).reduced(0.0), "rows: derivatives"),
        (lambda: rows(keyframes=2).reduced(0.0), "rows: a position"),
    ],
)
def test_what_cannot_be_is_refused(call: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        call()


HARD = st.sampled_from([0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, 5e-324])
HOSTILE = st.one_of(st.floats(-2.0, 2.0), st.floats(width=64), HARD)
NUMBERS = [name for name, value in BUNDLE.items() if isinstance(value, np.ndarray) and value.dtype == np.float64]


@settings(max_examples=100, deadline=None)
@given(
    name=st.sampled_from([*NUMBERS, "rows"]),
    numbers=arrays(np.float64, 40, elements=HOSTILE),
    sparse=st.booleans(),
    held=st.booleans(),
)
def test_hostile_numbers_give_values(name: str, numbers: Array, sparse: bool, held: bool) -> None:
    if name == "rows":
        shapes = (8, 4), (8, 4, 3), (8, 4, 2), (3, 3), (4,)
        solver = calibrated(lambda *_: tuple(np.resize(numbers, shape) for shape in shapes))
    else:
        solver = bundle(**{name: np.resize(numbers, BUNDLE[name].shape)}, points_held=held)
    if sparse:
        solver.factorise_sparsely(np.arange(len(solver.nodes()[0])))
    costs, iterations, _ = solver.optimize(1e-4, 5, 1e-6)
    assert 1 <= len(costs) <= iterations + 1 <= 6
    assert solver.points_map().shape == (4, 3)
    assert solver.squared_sigmas().shape == (8,)
