"""Which places of a map the relocalizer tries for a frame of a robot that does not know its place, and what several frames may prove."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from fleetmap.features.orb import Features
from fleetmap.geometry import Array, se3
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import EarlierFrame, Fix, FrameFeatures, Relocalizer
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.time_sliced import finished
from support.storage.map_samples import random_tile
from support.worlds.vocabulary_training import train_vocabulary

CAMERA = StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
PLACES = 20


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The places that are tried, none of which verifies."""
    places: list[int] = []
    monkeypatch.setattr(Relocalizer, "at_place", lambda _, query, place, rotation: places.append(place))
    return places


def search(view: MapView, failed: list[Array] | None) -> None:
    rng = np.random.default_rng(1)
    descriptors = np.concatenate([view.descriptors[::3], rng.integers(0, 256, (100, 32), np.uint8)])
    count = len(descriptors)
    features = Features(np.zeros((count, 2)), np.zeros(count, np.int8), np.zeros(count, np.float32), descriptors)
    relocalizer = Relocalizer(view, CAMERA, RelocalizerSettings())
    assert not finished(relocalizer.anywhere(FrameFeatures(features, np.zeros((count, 3))), failed=failed))


def line_of_places() -> MapView:
    """Three metres apart."""
    rng = np.random.default_rng(5)
    tile = random_tile(rng, landmarks=4000, places=PLACES)
    lists = tuple(np.sort(tile.landmark_ids[k * 200 : k * 200 + 200]) for k in range(PLACES))
    map_from_cam = np.array([se3(np.eye(3), np.array([3.0 * k, 0.0, 0.0])) for k in range(PLACES)])
    tile = replace(tile, place_landmark_ids=lists, map_from_cam=map_from_cam)
    return MapView([tile], train_vocabulary(tile.descriptors, 10, 3, rng), 420.0)


def test_a_standing_robot_tries_every_place_once_before_any_again(tried: list[int]) -> None:
    view, failed, rounds = line_of_places(), [], []
    for _ in range(3):
        search(view, failed)
        rounds.append(tried.copy())
        tried.clear()
    top = RelocalizerSettings().fix.top_places
    assert [len(places) for places in rounds] == [top, top, PLACES - 2 * top]
    assert set().union(*rounds) == set(range(PLACES))
    search(view, failed)
    assert tried == rounds[0]


def test_without_memory_the_same_places_are_tried(tried: list[int]) -> None:
    view = line_of_places()
    search(view, None)
    first = tried.copy()
    search(view, None)
    assert tried == first * 2


@pytest.mark.parametrize(
    ("sigma_m", "motion_m", "recall", "frames"),
    [(0.01, 0.01, 0.3, 2), (0.5, 0.01, 0.3, 0), (0.01, 0.5, 0.3, 1), (0.01, 0.01, 0.05, 0)],
)
def test_several_frames_prove_a_place_only_where_pose_and_motion_are_known(
    monkeypatch: pytest.MonkeyPatch, sigma_m: float, motion_m: float, recall: float, frames: int
) -> None:
    """Else what looks a little like it, as the next bay does, would agree in one frame after the other."""
    asked = Mock(side_effect=lambda query, place, *_: Fix(place, np.eye(6), 20, 9, landmark_recall=recall))
    monkeypatch.setattr(Relocalizer, "by_projection", asked)
    view, moved = line_of_places(), np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    relocalizer = Relocalizer(view, CAMERA, RelocalizerSettings())
    nothing, amid = FrameFeatures(Features.empty(), np.zeros((0, 3))), se3(np.eye(3), view.points_map.mean(axis=0))
    earlier = [EarlierFrame(nothing, np.eye(4), m**2 * moved) for m in (0.01, motion_m)]
    fix = relocalizer.near(nothing, amid, sigma_m**2 * moved, earlier)
    assert (0 if fix is None else len(asked.call_args.args[3])) == frames
    assert relocalizer.near(nothing, se3(np.eye(3), np.full(3, 1e4)), 1e-4 * moved) is None, "nothing is in view"
