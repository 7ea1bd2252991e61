"""Image pipelines: what each stage does to a picture, that none moves anything, and that recordings go through them."""

import numpy as np
import pytest

from fleetmap.sensors.samples import CameraFrame
from fleetsim import pipelines as stages
from fleetsim.pipelines import IMAGE_PIPELINES, process_frame

RNG = np.random.default_rng(0)
REAL_PIPELINES = [name for name in IMAGE_PIPELINES if name != "clean"]


def _blobs(shift_x: float = 0.0, shift_y: float = 0.0) -> stages.Grey:
    """One bright blob, far from the border, on grey ground."""
    y, x = np.mgrid[0:96, 0:128]
    blob = np.exp(-((x - 64.3 - shift_x) ** 2 + (y - 47.8 - shift_y) ** 2) / (2 * 3.0**2))
    return np.asarray(60.0 + 100.0 * blob, np.float32)


def _centroid(picture: stages.Grey) -> np.ndarray:
    y, x = np.mgrid[34:62, 50:79]
    weight = picture[34:62, 50:79].astype(np.float64) - float(np.median(picture))
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize(
    "stage",
    [
        lambda picture: stages.lens_blur(picture, 1.5),
        lambda picture: stages.sharpen(picture, 1.2, 1.5),
        lambda picture: stages.rescale(picture, 0.8),
        lambda picture: stages.rescale(picture, 1.25),
        lambda picture: stages.gamma(picture, 2.2),
        lambda picture: stages.bayer(picture, 0.0, RNG),
        lambda picture: stages.jpeg(stages.quantise(picture), 80).astype(np.float32),
    ],
    ids=["blur", "sharpen", "smaller", "larger", "gamma", "bayer", "jpeg"],
)
def test_no_stage_moves_anything(stage) -> None:  # type: ignore[no-untyped-def]
    places = [_blobs(*shift) for shift in np.random.default_rng(1).uniform(-2.0, 2.0, (40, 2))]
    moved = np.array([_centroid(stage(place)) - _centroid(place) for place in places])
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=0.02)


@pytest.mark.parametrize("gain", [1.0, 4.0, 16.0])
def test_noise_follows_light_and_gain(gain: float) -> None:
    flat = np.full((200, 300), 120.0, np.float32)
    noise = stages.sensor_noise(flat, gain, np.random.default_rng(3)) - flat
    # at gain 1 a grey value is 39 electrons; 5 electrons and half a grey value of read noise
    expected = np.sqrt(120 * gain / 39.0 + (5.0 * gain / 39.0) ** 2 + 0.25)
    assert noise.std() == pytest.approx(expected, rel=0.02)
    assert abs(noise.mean()) < 0.02 * expected


@pytest.mark.parametrize("name", REAL_PIPELINES)
def test_noise_follows_from_seed_stamp_and_camera(name: str) -> None:
    picture = stages.quantise(_blobs())
    pipeline = IMAGE_PIPELINES[name]
    one = process_frame(CameraFrame(5, picture, picture), pipeline, 1)
    again = process_frame(CameraFrame(5, picture, picture), pipeline, 1)
    assert one.right is not None
    assert one.left.shape == picture.shape
    np.testing.assert_array_equal(one.left, again.left)
    others = [
        process_frame(CameraFrame(5, picture, picture), pipeline, 2),
        process_frame(CameraFrame(6, picture, picture), pipeline, 1),
    ]
    assert not any(np.array_equal(one.left, other.left) for other in others)
    assert not np.array_equal(one.left, one.right)
