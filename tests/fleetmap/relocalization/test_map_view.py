"""What a robot should see of its map, against plain numpy."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
from fleetmap.relocalization.map_view import MapView, most_similar
from fleetmap.sensors.rectification import StereoCamera
from support.storage.map_samples import random_tile
from support.worlds.vocabulary_training import changed, train_vocabulary

CAMERA = StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
SURVEY_FOCAL_PX = 350.0


@pytest.fixture(scope="module")
def view() -> MapView:
    tile = random_tile(np.random.default_rng(3))
    vocabulary = train_vocabulary(tile.descriptors, 4, 2, np.random.default_rng(0))
    return MapView([tile], vocabulary, SURVEY_FOCAL_PX)


def expected(view: MapView, map_from_cam: Array, margin_px: float, angle_rad: float) -> set[int]:
    """Rows by the definition: inside the widened picture, within reach, near a direction that it was mapped from."""
    away = map_from_cam[:3, 3] - view.points_map
    distance = np.linalg.norm(away, axis=1)
    pixels = CAMERA.pixel_from_point(transform_points(se3_inverse(map_from_cam), view.points_map))
    reach = 1.3 * view.cones.max_distances_m * (CAMERA.focal_px / SURVEY_FOCAL_PX)
    turned = np.arccos(np.clip(np.einsum("ni,ni->n", away / distance[:, None], view.cones.directions_map), -1, 1))
    seen = (distance > 0.2) & (distance < reach) & (turned < view.cones.half_angles_rad + angle_rad)
    seen &= (pixels[:, 0] > -margin_px) & (pixels[:, 0] < CAMERA.width_px + margin_px)
    seen &= (pixels[:, 1] > -margin_px) & (pixels[:, 1] < CAMERA.height_px + margin_px)
    return set(np.flatnonzero(seen).tolist())


@pytest.mark.parametrize(("margin_px", "angle_rad"), [(0.0, 1.3), (50.0, np.pi), (12.0, 0.2)])
def test_visible_landmarks_are_those_of_the_definition(view: MapView, margin_px: float, angle_rad: float) -> None:
    rng = np.random.default_rng(1)
    middle = view.points_map.mean(axis=0)
    total = 0
    for _ in range(40):
        map_from_cam = se3(so3_exp(rng.normal(0.0, 1.5, 3)), middle + rng.normal(0.0, 4.0, 3))
        rows, pixels, octaves = view.visible(map_from_cam, CAMERA, margin_px, angle_rad)
        assert set(rows.tolist()) == expected(view, map_from_cam, margin_px, angle_rad)
        there = transform_points(se3_inverse(map_from_cam), view.points_map[rows])
        np.testing.assert_allclose(pixels, CAMERA.pixel_from_point(there), atol=1e-6)
        assert np.isfinite(octaves).all()
        total += len(rows)
    assert total > 0


def test_a_place_is_found_by_the_share_of_it_that_is_seen() -> None:
    """A robot sees ten times what the map holds; what the map lacks must not count against a place."""
    rng = np.random.default_rng(5)
    tile = random_tile(rng, landmarks=9000, places=12)
    tile = replace(tile, place_landmark_ids=tuple(np.sort(tile.landmark_ids[k : k + 4800 : 80]) for k in range(12)))
    view = MapView([tile], train_vocabulary(tile.descriptors, 10, 4, rng), SURVEY_FOCAL_PX)
    clutter = rng.integers(0, 256, (600, 32), np.uint8)
    for place, rows in enumerate(view.place_rows):
        seen = view.similarities(np.concatenate([clutter, view.descriptors[rows]]))
        assert most_similar(seen, None, 3)[0] == place
        days_later = np.concatenate([clutter, changed(view.descriptors[rows], 25, rng)])
        assert most_similar(view.similarities(days_later), None, 1).tolist() == [place]
        assert place not in most_similar(seen, np.arange(len(view.place_rows)) != place, 3)
    assert len(most_similar(view.similarities(np.zeros((0, 32), np.uint8)), None, 3)) == 0
