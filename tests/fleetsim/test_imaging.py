"""Image pipelines: what each stage does to a picture, that none moves anything, and that recordings go through them."""

import numpy as np
import pytest

from fleetmap.sensors.samples import CameraFrame
from fleetsim.imaging import pipelines as stages
from fleetsim.imaging.pipelines import IMAGE_PIPELINES, ImagePipeline, process_frame

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


def test_sharpening_overshoots_and_blur_spreads() -> None:
    step = np.where(np.arange(64) < 32, 80.0, 160.0).astype(np.float32) * np.ones((48, 1), np.float32)
    sharp = stages.sharpen(stages.lens_blur(step, 0.7), 1.0, 1.0)
    assert sharp.max() > 165
    assert sharp.min() < 75
    slope = np.abs(np.diff(stages.lens_blur(step, 1.5)[24]))
    middle = (slope * np.arange(63)).sum() / slope.sum()
    assert np.sqrt((slope * (np.arange(63) - middle) ** 2).sum() / slope.sum()) == pytest.approx(1.5, abs=0.05)


@pytest.mark.parametrize("gain", [1.0, 4.0, 16.0])
def test_noise_follows_light_and_gain(gain: float) -> None:
    flat = np.full((200, 300), 120.0, np.float32)
    noise = stages.sensor_noise(flat, gain, np.random.default_rng(3)) - flat
    # at gain 1 a grey value is 39 electrons; 5 electrons and half a grey value of read noise
    expected = np.sqrt(120 * gain / 39.0 + (5.0 * gain / 39.0) ** 2 + 0.25)
    assert noise.std() == pytest.approx(expected, rel=0.02)
    assert abs(noise.mean()) < 0.02 * expected


def test_white_balance_makes_the_noise_of_a_bayer_sensor_larger_and_correlated() -> None:
    flat = np.full((200, 300), 120.0, np.float32)
    noise = stages.bayer(flat, 4.0, np.random.default_rng(3)) - 120.0
    neighbours = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
    assert neighbours > 0.2


def test_corners_lose_light_and_rows_flicker() -> None:
    flat = np.full((100, 200), 100.0, np.float32)
    assert stages.vignette(flat, 0.4)[0, 0] == pytest.approx(60.0, abs=1.0)
    assert stages.vignette(flat, 0.4)[50, 100] == pytest.approx(100.0, abs=0.1)
    bands = stages.rolling_exposure(flat, 0.1, 2.0, 0.0)
    assert bands[:, 0].max() == pytest.approx(110.0, abs=0.1)
    assert np.ptp(bands, axis=1).max() == 0
    assert np.count_nonzero(np.diff(np.sign(bands[:, 0] - 100.0))) >= 3


def test_clean_changes_nothing() -> None:
    picture = stages.quantise(_blobs())
    frame = CameraFrame(5, picture, picture)
    assert process_frame(frame, IMAGE_PIPELINES["clean"], 1) is frame


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


def test_one_camera_has_no_right_picture() -> None:
    picture = stages.quantise(_blobs())
    assert process_frame(CameraFrame(5, picture, None), ImagePipeline(blur_px=1.0), 1).right is None
