"""Grid ORB: spread, orientation, scale and determinism."""

import platform

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features import orb
from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.settings import OrbSettings
from support.worlds.synthetic_texture import picture, pixel_grid, smooth_texture

WIDTH, HEIGHT = 320, 240
SOME = OrbSettings(count=300)


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    """Strong texture in the left quarter, weak elsewhere: where plain ORB piles up its features."""
    u, v = pixel_grid(WIDTH, HEIGHT)
    texture = smooth_texture(np.random.default_rng(1), shortest_px=5.0, longest_px=40.0)
    contrast = np.where(u < WIDTH / 4, 1.0, 0.35)
    return np.rint(128 + contrast * (texture(u, v) - 128)).astype(np.uint8)


def occupied(pixels: NDArray[np.floating]) -> int:
    """How many cells of 32 pixels hold a feature."""
    return len({(int(x) // 32, int(y) // 32) for x, y in pixels})


def test_features_spread_better_than_plain_orb(image: NDArray[np.uint8]) -> None:
    features = extract(image, OrbSettings(count=300))
    plain = cv2.ORB.create(nfeatures=300).detect(image, None)
    assert 200 < len(features) <= 310
    assert occupied(features.pixels) > 1.3 * occupied(np.array([k.pt for k in plain]))


def test_some_features_are_taken(image: NDArray[np.uint8]) -> None:
    features = extract(image, OrbSettings(count=200))
    taken = features.take(np.array([5, 3]))
    np.testing.assert_array_equal(taken.pixels, features.pixels[[5, 3]])
    np.testing.assert_array_equal(taken.descriptors, features.descriptors[[5, 3]])


@pytest.mark.parametrize(("scale", "angle_deg"), [(1.0, 40.0), (1.44, 0.0)])
def test_features_are_found_again_in_a_turned_or_larger_picture(scale: float, angle_deg: float) -> None:
    """Matches land where the known similarity says, with the octave and the angle that it predicts."""
    u, v = pixel_grid(WIDTH, HEIGHT)
    texture = smooth_texture(np.random.default_rng(4), shortest_px=6.0, longest_px=80.0)
    turn = np.radians(angle_deg)
    second_from_first = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    centre = np.array([WIDTH / 2, HEIGHT / 2])
    first_uv = (np.stack([u, v], -1) - centre) @ np.linalg.inv(second_from_first).T + centre
    first = extract(picture(texture, u, v), OrbSettings(count=400))
    second = extract(picture(texture, first_uv[..., 0], first_uv[..., 1]), OrbSettings(count=400))
    pairs = match_mutual(first.descriptors, second.descriptors, 60, 0.85)
    expected = (first.pixels[pairs[:, 0]] - centre) @ second_from_first.T + centre
    good = np.linalg.norm(expected - second.pixels[pairs[:, 1]], axis=1) < 4.0
    assert good.sum() > 40
    assert good.mean() > 0.8
    pairs = pairs[good]
    step = second.octaves[pairs[:, 1]].astype(float) - first.octaves[pairs[:, 0]]
    assert abs(np.median(step) - np.log(scale) / np.log(orb.SCALE_FACTOR)) <= 0.5
    turned = (second.angles_deg[pairs[:, 1]] - first.angles_deg[pairs[:, 0]] - angle_deg + 180) % 360 - 180
    assert abs(np.median(turned)) < 4.0


@pytest.mark.parametrize(
    "given", [{"fast_threshold": 300}, {"fast_threshold": -1}, {"min_distance_px": 0.0}, {"count": -1}]
)
def test_settings_that_no_corner_can_have_are_refused_where_they_are_read(given: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError, match="Expected"):
        msgspec.convert(given, OrbSettings)


def found_again(one: orb.Features, other: orb.Features) -> int:
    """Number of features that match one within two pixels of the same place."""
    pairs = match_mutual(one.descriptors, other.descriptors, 75, 0.9)
    off_px = np.linalg.norm(one.pixels[pairs[:, 0]] - other.pixels[pairs[:, 1]], axis=1)
    return int((off_px < 2.0).sum())


def test_by_night_more_of_the_scene_is_found_again(image: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a dim picture whose noise makes corners of its own; with less noise nothing changes to the bit."""
    scene = 60 + 0.3 * (image - 128.0)

    def found(sigma: float) -> list[orb.Features]:
        rng = np.random.default_rng(2)
        noisy = [np.clip(np.rint(scene + rng.normal(0.0, sigma, scene.shape)), 0, 255).astype(np.uint8) for _ in "ab"]
        return [extract(picture, SOME) for picture in noisy]

    aware = found(6.0), found(2.0)
    monkeypatch.setattr(orb, "_NOISE_SHARE", np.inf)
    unaware = found(6.0), found(2.0)
    assert found_again(*aware[0]) > 1.3 * found_again(*unaware[0])
    for one, other in zip(aware[1], unaware[1], strict=True):
        np.testing.assert_array_equal(one.descriptors, other.descriptors)


@pytest.mark.parametrize("sigma", [0.0, 3.0, 12.0])
def test_noise_is_measured_in_spite_of_the_scene(image: NDArray[np.uint8], sigma: float) -> None:
    noisy = np.clip(np.rint(image + np.random.default_rng(3).normal(0.0, sigma, image.shape)), 0, 255).astype(np.uint8)
    assert orb.noise_grey(noisy) == pytest.approx(sigma, abs=0.8)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="OpenCV rounds otherwise on other processors")
@pytest.mark.parametrize("shape", [(480, 640), (480, 752), (376, 1241), (37, 53), (2, 9)])
def test_pyramids_are_reduced_as_opencv_does_on_one_processor(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(5).integers(0, 256, shape).astype(np.uint8)
    for level in range(8):
        height, width = (round(side / orb.SCALE_FACTOR**level) for side in shape)
        np.testing.assert_array_equal(core.reduced(picture, height, width), cv2.resize(picture, (width, height)))


@pytest.mark.parametrize("shape", [(0, 0), (1, 7), (2, 2), (3, 3)])
def test_images_too_small_for_noise_have_none(shape: tuple[int, int]) -> None:
    assert orb.noise_grey(np.zeros(shape, np.uint8)) == 0.0
