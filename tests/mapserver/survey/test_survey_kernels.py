"""The survey's inner loops against plain numpy twins."""

import numpy as np
import pytest

from fleetmap.features import patch_align
from fleetmap.features.matching import packed
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import se3, so3_exp, transform_points
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.finish.map_assembly_kernels import mark_duplicates, medoids
from mapserver.survey.tracks.pairs_kernels import predict_features, share_in_view
from mapserver.survey.tracks.tracks_kernels import PatchFeatures, align_observations
from support.worlds.synthetic_texture import picture, smooth_texture

CAMERA = StereoCamera(300.0, 160.0, 120.0, 0.1, 320, 240)
LENS = np.array([300.0, 160.0, 120.0, 320.0, 240.0])
B_FROM_A = se3(so3_exp(np.array([0.05, -0.1, 0.02])), np.array([0.1, -0.05, 0.4]))


def some_points(rng: np.random.Generator, count: int) -> np.ndarray:
    """Before and behind the camera, in and out of the picture."""
    return rng.uniform([-3.0, -2.0, -1.0], [3.0, 2.0, 6.0], (count, 3))


def test_features_are_looked_for_where_the_camera_model_puts_them() -> None:
    rng = np.random.default_rng(1)
    points, octaves = some_points(rng, 300), rng.integers(0, 8, 300).astype(np.int8)
    disparities = np.where(rng.random(300) < 0.2, np.nan, 3.0)
    predicted, radius, span = np.empty((300, 2)), np.empty(300), np.zeros((300, 2), np.int64)
    predict_features(B_FROM_A, points, disparities, octaves, LENS, 6.0, predicted, radius, span)
    seen = transform_points(B_FROM_A, points)
    pixels = CAMERA.pixel_from_point(seen)[:, :2]
    inside = np.isfinite(disparities) & (pixels > 0).all(axis=1) & (pixels < [320, 240]).all(axis=1)
    assert 20 < inside.sum() < 280
    np.testing.assert_array_equal(np.isfinite(predicted).all(axis=1), inside)
    np.testing.assert_allclose(predicted[inside], pixels[inside], atol=1e-9)
    octave = octaves + np.log(np.clip(points[:, 2] / np.maximum(seen[:, 2], 0.05), 0.1, 10.0)) / np.log(1.2)
    np.testing.assert_allclose(radius[inside], 6.0 * 1.2 ** np.clip(octave[inside], 0, 4))
    np.testing.assert_array_equal(span[inside, 0], np.floor(octave[inside]) - 2)
    np.testing.assert_array_equal(span[inside, 1], np.ceil(octave[inside]) + 2)
    ratio = seen[:, 2] / points[:, 2]
    expected = (inside & (ratio > 0.4) & (ratio < 2.5)).sum() / np.isfinite(disparities).sum()
    assert share_in_view(B_FROM_A, points, disparities, LENS) == pytest.approx(expected)
    assert share_in_view(B_FROM_A, points, np.full(300, np.nan), LENS) == 0.0


def test_patches_are_aligned_as_one_by_one() -> None:
    """Against the vectorised functions of patch_align, with points that the motion can and cannot warp."""
    rng = np.random.default_rng(2)
    columns, lines = np.meshgrid(np.arange(320.0), np.arange(240.0))
    image = picture(smooth_texture(rng), columns, lines)
    pyramid = patch_align.half_pyramid(image)
    count = 60
    pixels = rng.uniform([40, 40], [280, 200], (count, 2))
    octaves, own_octaves = (rng.integers(0, 5, count).astype(np.int8) for _ in range(2))
    angles, own_angles = (rng.uniform(-4, 4, count).astype(np.float32) for _ in range(2))
    own_pixels = pixels + rng.uniform(-1.5, 1.5, (count, 2))
    points = CAMERA.point_from_pixel(pixels, np.full(count, 10.0))
    points[::7] = np.nan
    motion = se3(so3_exp(np.array([0.0, 0.0, 0.02])), np.array([0.0, 0.0, 0.05]))
    found = np.empty((count, 3))
    rows = np.arange(count)
    whole, half, quarter = pyramid
    reference = PatchFeatures((whole, half, quarter), pixels, octaves, angles, rows)
    own = PatchFeatures((whole, half, quarter), own_pixels, own_octaves, own_angles, rows)
    align_observations(reference, own, points, motion, (4, 3.0, 0.8), found)
    warp = patch_align.similarity_from_motion(CAMERA, points, motion)
    unknown = ~np.isfinite(warp).all(axis=(1, 2))
    assert 0 < unknown.sum() < count
    warp[unknown] = patch_align.similarity_from_features(octaves, angles, own_octaves, own_angles)[unknown]
    first = patch_align.Patches(pyramid, pixels, octaves)
    current = patch_align.Patches(pyramid, own_pixels, own_octaves)
    expected = patch_align.refine_matches(first, current, warp, AlignSettings())
    assert np.isfinite(expected[:, 0]).sum() > count // 3
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_medoid_is_the_nearest_to_all_others() -> None:
    rng = np.random.default_rng(4)
    rows = rng.integers(0, 256, (40, 32)).astype(np.uint8)
    starts = np.array([0, 1, 4, 20, 40])
    chosen = np.zeros(4, np.int64)
    medoids(packed(rows), starts, chosen)
    for n in range(4):
        own = np.unpackbits(rows[starts[n] : starts[n + 1]], axis=1).astype(int)
        total = np.abs(own[:, None] - own[None]).sum(axis=(1, 2))
        assert chosen[n] == starts[n] + int(np.argmin(total))


def test_only_what_could_be_one_landmark_is_a_duplicate() -> None:
    """Five near pairs: alike; unlike; too far for their sigmas; seen side by side; alike again, the less observed one goes."""
    rng = np.random.default_rng(5)
    base = rng.integers(0, 256, (5, 32)).astype(np.uint8)
    words = np.repeat(base, 2, axis=0)
    words[3] = ~words[3]
    points = np.repeat(10.0 * np.arange(5.0), 2)[:, None] * np.ones(3)
    points[1::2] += 0.01
    points[5] += 0.2
    keyframes = [[0, 1], [2], [0, 1], [2], [0, 1], [2], [0, 1], [1, 2], [0], [2, 3]]
    starts = np.cumsum([0, *(len(k) for k in keyframes)])
    double = np.zeros(10, bool)
    mark_duplicates(
        np.arange(10).reshape(5, 2), points, np.full(10, 0.02), starts, np.concatenate(keyframes).astype(np.int32),
        packed(words), 50, double,
    )  # fmt: skip
    assert np.flatnonzero(double).tolist() == [1, 8]
