"""Covariances that are carried along a way and back, against samples drawn of them."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from locclient.localization.place import Place, boxminus, boxplus

SAMPLES = 4000


def spd(rng: np.random.Generator) -> Array:
    """(6, 6) of some hundredths of radians and some tenths of metres."""
    factor = rng.normal(size=(6, 6)) * np.repeat([0.01, 0.1], 3)[:, None]
    return np.asarray(factor @ factor.T)


def place(rng: np.random.Generator) -> Array:
    return se3(so3_exp(rng.normal(size=3)), rng.normal(size=3) * 4.0)


def drawn(mean: Array, covariance: Array, rng: np.random.Generator) -> list[Array]:
    return [boxplus(mean, error) for error in rng.multivariate_normal(np.zeros(6), covariance, SAMPLES)]


@pytest.mark.parametrize("seed", range(3))
def test_a_place_led_back_along_the_way_and_a_place_led_on(seed: int) -> None:
    rng = np.random.default_rng(seed)
    known, way = Place(place(rng), spd(rng)), Place(place(rng), spd(rng))
    pairs = list(zip(drawn(*known[:2], rng), drawn(*way[:2], rng), strict=True))
    for (mean, claimed, _), found in (
        (known.before(way), [at @ se3_inverse(since) for at, since in pairs]),
        (known.at_end_of(way), [at @ since for at, since in pairs]),
    ):
        errors = np.array([boxminus(sample, mean) for sample in found])
        scale = np.sqrt(np.diag(claimed))
        np.testing.assert_allclose(
            np.cov(errors.T) / np.outer(scale, scale), claimed / np.outer(scale, scale), atol=0.08
        )
        assert (np.abs(errors.mean(axis=0)) < 0.1 * scale).all()


def test_there_and_back_is_where_one_began() -> None:
    rng = np.random.default_rng(5)
    known, way = Place(place(rng), spd(rng)), Place(place(rng), np.zeros((6, 6)))
    again = known.at_end_of(way).before(way)
    np.testing.assert_allclose(again.map_from_body, known.map_from_body, atol=1e-12)
    np.testing.assert_allclose(again.cov_rot_trans, known.cov_rot_trans, atol=1e-12)
