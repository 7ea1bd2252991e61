"""What every entry of EXTRACTORS must do."""

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.features.extraction import EXTRACTORS, extract, extract_in_slices
from fleetmap.features.matching import match_mutual
from fleetmap.features.settings import OrbSettings
from fleetmap.time_sliced import finished
from support.worlds.synthetic_texture import picture, pixel_grid, smooth_texture

WIDTH, HEIGHT, SHIFT_PX = 320, 240, 6
U, V = pixel_grid(WIDTH, HEIGHT)
TEXTURE = smooth_texture(np.random.default_rng(5), shortest_px=5.0, longest_px=40.0)
IMAGE, SHIFTED = picture(TEXTURE, U, V), picture(TEXTURE, U + SHIFT_PX, V)


@pytest.fixture(params=EXTRACTORS)
def settings(request: pytest.FixtureRequest) -> OrbSettings:
    return OrbSettings(extractor=request.param, count=300)


def test_arrays_belong_together(settings: OrbSettings) -> None:
    features = extract(IMAGE, settings)
    count = len(features)
    assert 100 < count <= 1.1 * settings.count
    assert features.pixels.shape == (count, 2)
    assert (features.pixels >= 0).all()
    assert (features.pixels <= [WIDTH - 1, HEIGHT - 1]).all()
    assert features.octaves.shape == features.angles_deg.shape == (count,)
    assert ((features.octaves >= 0) & (features.octaves < settings.levels)).all()
    assert features.descriptors.shape == (count, 32)
    assert features.descriptors.dtype == np.uint8


def test_the_same_image_gives_the_same_features_in_slices_and_at_once(settings: OrbSettings) -> None:
    first, second = extract(IMAGE, settings), finished(extract_in_slices(IMAGE.copy(), settings))
    for name in ("pixels", "octaves", "angles_deg", "descriptors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_shift_is_found_again(settings: OrbSettings) -> None:
    first, second = extract(IMAGE, settings), extract(SHIFTED, settings)
    pairs = match_mutual(first.descriptors, second.descriptors, 60, 0.85)
    assert len(pairs) > 0.4 * len(first)
    moved = first.pixels[pairs[:, 0]] - second.pixels[pairs[:, 1]]
    assert np.median(np.linalg.norm(moved - [SHIFT_PX, 0], axis=1)) < 0.5


def test_a_blank_image_has_no_features(settings: OrbSettings) -> None:
    assert len(extract(np.full((HEIGHT, WIDTH), 7, np.uint8), settings)) == 0


def test_an_unknown_extractor_is_refused_with_the_choice() -> None:
    with pytest.raises(UsageError, match="grid-orb"):
        extract(IMAGE, OrbSettings(extractor="surf"))
