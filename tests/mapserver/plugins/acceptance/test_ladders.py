"""Pictures made darker and more blurred."""

import numpy as np
import pytest

from fleetmap.sensors.samples import CameraFrame
from mapserver.plugins.acceptance.ladders import BLUR_PX, STOPS, blurred, darker, darkest_grey, ladders, noise_sigma


def noisy(sigma: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    smooth = np.add.outer(np.linspace(60, 160, 240), np.linspace(0, 60, 320))
    smooth[80:120] -= 40.0  # an edge is no noise
    return np.clip(np.rint(smooth + rng.normal(0, sigma, smooth.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [2.0, 4.0])
def test_noise_is_measured_and_stays_when_the_light_goes(sigma: float) -> None:
    image = noisy(sigma)
    assert noise_sigma(image) == pytest.approx(sigma, rel=0.1)
    dark = darker(image, 2, np.random.default_rng(0))
    assert dark.mean() == pytest.approx(image.mean() / 4, rel=0.02)
    assert noise_sigma(dark) == pytest.approx(sigma, rel=0.15)


def test_a_blur_along_rows_leaves_horizontal_edges() -> None:
    image = np.zeros((40, 40), np.uint8)
    image[20:] = 200
    assert np.array_equal(blurred(image, 9), image)
    assert not np.array_equal(blurred(image.T.copy(), 9), image.T)


def test_ladders_are_the_same_each_time_and_leave_depth_alone() -> None:
    frame = CameraFrame(5, noisy(2.0), None, np.ones((240, 320), np.float32))
    for kind, levels in (("darkness", STOPS), ("blur", BLUR_PX)):
        one, two = (list(ladders(frame, 7)[kind]) for _ in range(2))
        assert [level for level, _ in one] == list(levels)
        assert all(
            np.array_equal(a.left, b.left) and a.depth_m is frame.depth_m
            for (_, a), (_, b) in zip(one, two, strict=True)
        )


def test_the_darkest_level_divides_pictures_with_a_fix_from_those_without() -> None:
    levels, fixed = np.array([100.0, 50.0, 25.0, 12.0, 6.0, 3.0]), np.array([1, 1, 1, 0, 0, 0], bool)
    assert darkest_grey(levels, fixed) == 12.0
    assert darkest_grey(levels, np.ones(6, bool)) is None
