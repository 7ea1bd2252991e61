"""Exchanged and mirrored pairs, told by one frame."""

import numpy as np
import pytest

from fleetmap.features.settings import OrbSettings
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import Image
from locclient.localization.calibration.pair_order import PairOrder, pair_order

SETTINGS = OrbSettings(count=500)


def pair(disparity_px: int) -> tuple[Image, Image]:
    """Blocks at one distance, by two cameras with noise of their own."""
    rng = np.random.default_rng(3)
    wide = np.kron(rng.integers(20, 230, (60, 90)), np.ones((8, 8))) + rng.normal(0, 6, (480, 720))
    images = (wide[:, 40:680], wide[:, 40 + disparity_px : 680 + disparity_px])
    left, right = (np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in images)
    return left, right


def order_of(left: Image, right: Image | None) -> PairOrder:
    return pair_order(RectifiedFrame(0, left, right, None), SETTINGS)


def mirrored(image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


def test_a_good_pair_is_right() -> None:
    assert order_of(*pair(12)) is PairOrder.RIGHT


def test_exchanged_and_mirrored_pairs_are_reversed() -> None:
    left, right = pair(12)
    assert order_of(right, left) is PairOrder.REVERSED
    assert order_of(mirrored(left), mirrored(right)) is PairOrder.REVERSED


@pytest.mark.parametrize("what", ["dark", "far", "single"])
def test_what_shows_no_order_is_unknown(what: str) -> None:
    left, right = pair(0) if what == "far" else pair(12)
    if what == "dark":
        left, right = np.zeros_like(left), np.zeros_like(right)
    assert order_of(left, None if what == "single" else right) is PairOrder.UNKNOWN
