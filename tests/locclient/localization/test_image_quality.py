"""What is wrong with pictures: each fault named, good pictures not."""

from collections.abc import Callable

import numpy as np
import pytest

from fleetmap import core
from fleetmap.messages import Cause
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import Image
from locclient.localization.image_quality import ImageQualityMonitor, ImageQualitySettings

Spoil = Callable[[Image, np.random.Generator], Image]


def picture(number: int) -> Image:
    """Blocks as racks have them, with a sensor's noise."""
    rng = np.random.default_rng(number)
    blocks = np.kron(np.random.default_rng(0).integers(20, 200, (30, 40)), np.ones((16, 16)))
    return np.clip(blocks + rng.normal(0, 2, blocks.shape), 0, 255).astype(np.uint8)


def frame(number: int, left: Image | None = None, right: Image | None = None) -> RectifiedFrame:
    own = (picture(2 * number + side) if image is None else image for side, image in enumerate((left, right)))
    return RectifiedFrame(number, *own, None)


def judged() -> ImageQualityMonitor:
    """After ten good frames, none of which it found fault with."""
    judge = ImageQualityMonitor(ImageQualitySettings())
    assert {judge.judge(frame(number)).cause for number in range(10)} == {Cause.NONE}
    return judge


SPOILT: dict[Cause, Spoil] = {
    Cause.DARK: lambda image, rng: rng.integers(0, 5, image.shape).astype(np.uint8),
    Cause.GLARE: lambda image, _: np.minimum(image.astype(int) * 8, 255).astype(np.uint8),
    Cause.BLURRED: lambda image, _: np.repeat(image.mean(axis=1, keepdims=True), image.shape[1], 1).astype(np.uint8),
}


@pytest.mark.parametrize("cause", SPOILT)
def test_a_fault_is_named(cause: Cause) -> None:
    judge = judged()
    assert judge.judge(frame(11, SPOILT[cause](picture(22), np.random.default_rng(5)))).cause is cause
    assert judge.judge(frame(12)).cause is Cause.NONE


@pytest.mark.parametrize("side", [0, 1])
def test_a_camera_that_repeats_itself_is_frozen(side: int) -> None:
    judge = judged()
    stuck = picture(18 + side)
    spoilt = frame(11, stuck, None) if side == 0 else frame(11, None, stuck)
    assert judge.judge(spoilt).cause is Cause.FROZEN
    left = judge.without_frozen(spoilt)
    assert left.right is None
    assert left.left.any() == (side == 1)


def test_exposure_and_sharpness_are_measured_of_every_frame() -> None:
    judge = judged()
    good = judge.judge(frame(11))
    assert good.exposure == pytest.approx(picture(22).mean() / 255.0, abs=0.01)
    assert good.sharpness == pytest.approx(1.0, abs=0.1)
    black = judge.judge(frame(12, np.zeros_like(picture(0))))
    assert (black.cause, black.exposure, black.sharpness) == (Cause.DARK, 0.0, 0.0)
    assert judge.judge(frame(13, SPOILT[Cause.BLURRED](picture(26), np.random.default_rng(5)))).sharpness < 0.1
    assert judge.judge(frame(14)).sharpness == pytest.approx(1.0, abs=0.1), "bad frames do not change what is typical"


def test_something_before_the_cameras_is_told_by_its_depth() -> None:
    judge = judged()
    assert {judge.judge_depth(depth_m) for depth_m in (3.0, 4.0, 2.5, 5.0)} == {Cause.NONE}
    assert judge.judge_depth(0.8) is Cause.OCCLUDED
    assert judge.judge_depth(3.0) is Cause.NONE


def test_figures_are_those_of_numpy() -> None:
    seen = np.random.default_rng(7).integers(0, 256, (43, 77)).astype(np.uint8)
    thinned, *figures = core.brightness(seen, 8, 250)
    assert thinned == seen[::8, ::8].tobytes()
    kept, steps = seen[::8, ::8], np.diff(seen[::8].astype(np.int64), axis=1)
    assert figures == pytest.approx([kept.mean(), kept.std(), (kept >= 250).mean(), steps.var()], rel=1e-12)
    for shape in ((0, 0), (0, 5), (5, 0)):
        assert core.brightness(np.zeros(shape, np.uint8), 8, 250) == (b"", 0.0, 0.0, 0.0, 0.0)
