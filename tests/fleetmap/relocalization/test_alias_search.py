"""Places that look the same: found wherever they are, however thinned the map; and none where there are none."""

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import packed
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.relocalization.alias_search import AliasCandidate, LandmarkSet, find_aliases
from fleetmap.time_sliced import finished

PITCH_M, AISLES = 5.0, 7
BODY_FROM_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


def spoiled(rng: np.random.Generator, descriptors: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """With so many bits turned over."""
    turned = rng.random((*descriptors.shape, 8)) < share
    return descriptors ^ np.packbits(turned, axis=-1)[..., 0]


class Hall:
    """Aisles along x with the same goods, of which the map holds two thirds of each; the last is turned round."""

    def __init__(self, rng: np.random.Generator) -> None:
        goods = rng.uniform((0, -1.5, 0), (20, 1.5, 3), (900, 3))
        looks = rng.integers(0, 256, (900, 32), np.uint8)
        self.camera = se3(BODY_FROM_CAM, np.array([6.0, 2 * PITCH_M, 1.0]))
        points, descriptors = [], []
        for aisle in range(AISLES):
            kept = rng.random(len(goods)) < 2 / 3
            turn = np.diag([-1.0, -1.0, 1.0]) if aisle == AISLES - 1 else np.eye(3)
            points.append(goods[kept] @ turn.T + (0, aisle * PITCH_M, 0))
            descriptors.append(spoiled(rng, looks[kept], 0.05))
        self.points_map, self.descriptors = np.concatenate(points), np.concatenate(descriptors)
        ahead = (goods[:, 0] > 7) & (goods[:, 0] < 12)
        self.seen_map, self.seen = goods[ahead] + (0, 2 * PITCH_M, 0), spoiled(rng, looks[ahead], 0.05)

    def twins(self, least_share: float = 0.2) -> list[AliasCandidate]:
        seen, held = LandmarkSet(self.seen_map, self.seen), LandmarkSet(self.points_map, self.descriptors)
        return finished(find_aliases(seen, held, self.camera, least_share, 64))


def test_every_twin_is_found_also_one_that_is_turned() -> None:
    hall = Hall(np.random.default_rng(0))
    twins = hall.twins()
    assert len(twins) == AISLES - 1
    turned = [twin for twin in twins if twin.map_from_cam[0, 2] < 0]
    expected = {(6.0, PITCH_M * k) for k in (0, 1, 3, 4, 5)} | {(-6.0, PITCH_M * (AISLES - 1))}
    found = {tuple(np.round(twin.map_from_cam[:2, 3], 1).tolist()) for twin in twins}
    assert expected == found
    assert len(turned) == 1
    np.testing.assert_allclose(turned[0].map_from_cam[:3, :3], np.diag([-1.0, -1.0, 1.0]) @ BODY_FROM_CAM, atol=1e-12)
    assert all(twin.alias_ratio > 0.7 for twin in twins)


def test_what_speaks_for_a_twin_are_the_same_goods() -> None:
    hall = Hall(np.random.default_rng(1))
    for twin in hall.twins():
        turn = twin.map_from_cam[:3, :3] @ hall.camera[:3, :3].T
        there = (hall.seen_map[twin.features] - hall.camera[:3, 3]) @ turn.T + twin.map_from_cam[:3, 3]
        off_m = np.linalg.norm(there - hall.points_map[twin.landmarks], axis=1)
        assert np.median(off_m) < 0.05


def test_a_hall_in_which_nothing_repeats_has_no_twins() -> None:
    rng = np.random.default_rng(2)
    hall = Hall(rng)
    own = np.abs(hall.points_map[:, 1] - 2 * PITCH_M) < PITCH_M / 2
    hall.descriptors[~own] = rng.integers(0, 256, (int((~own).sum()), 32), np.uint8)
    assert hall.twins() == []


def test_what_lies_beside_a_camera_is_no_twin_of_itself() -> None:
    """Looking at the floor below: from whichever side it would be seen, the same things lie in the same square metre."""
    rng = np.random.default_rng(4)
    points = rng.uniform((-0.4, -0.4, 0), (0.4, 0.4, 0.2), (90, 3))
    looks = rng.integers(0, 256, (90, 32), np.uint8)
    far = rng.uniform((-15, -15, 0), (15, 15, 0.2), (400, 3))
    held = np.concatenate([spoiled(rng, looks, 0.05), rng.integers(0, 256, (400, 32), np.uint8)])
    down = se3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))
    landmarks = LandmarkSet(np.concatenate([points, far]), held)
    assert finished(find_aliases(LandmarkSet(points, looks), landmarks, down, 0.2, 64)) == []


def test_alike_is_what_its_definition_says() -> None:
    rng = np.random.default_rng(3)
    looks = rng.integers(0, 256, (40, 32), np.uint8)
    landmarks = spoiled(rng, looks[rng.integers(0, 40, 300)], 0.15)
    points: Array = rng.uniform(0, 1, (300, 3))
    heights: Array = rng.uniform(0, 1, 40)
    features, held = packed(looks), packed(landmarks)
    parts = [core.lookalikes(features, heights, held, points, *part, 20_000) for part in ((0, 170), (170, 300))]
    pairs = np.concatenate(parts)
    bits = np.bitwise_count(looks[:, None] ^ landmarks).sum(axis=2)
    expected = (bits <= 50) & (np.abs(points[:, 2] - heights[:, None]) <= 0.3)
    assert 20 < expected.sum() == len(pairs)
    assert set(map(tuple, pairs.tolist())) == set(zip(*(axis.tolist() for axis in np.nonzero(expected)), strict=True))
    np.testing.assert_array_equal(core.lookalikes(features, heights, held, points, 0, 300, 7), pairs[:7])


def test_a_feature_votes_once_in_a_square() -> None:
    """Two landmarks a hand apart that look like one feature are no two reasons."""
    pairs = np.array([[0, 0], [0, 1], [1, 2]], np.int32)
    points = np.array([[5.0, 5.0, 1.0], [5.05, 5.0, 1.0], [7.0, 5.0, 1.0]])
    offsets = np.array([[1.0, 0.0], [3.0, 0.0]])
    counts = core.camera_votes(pairs, offsets, points, np.zeros(2), 0.5, 40, 40)
    assert counts.max() == 2
    assert counts[7:9, 9:11].min() == 2
    assert counts.sum() == 8


def test_a_twin_next_door_turned_by_little_is_the_place_itself() -> None:
    hall = Hall(np.random.default_rng(4))
    turned = so3_exp(np.array([0.0, 0.0, 0.02])) @ hall.camera[:3, :3]
    hall.camera = se3(turned, hall.camera[:3, 3] + (0.2, -0.2, 0.0))
    assert len(hall.twins()) == AISLES - 1


def test_one_landmark_far_away_costs_no_memory_and_hides_no_twin() -> None:
    """1500 km: cells for a map of that size would take hundreds of gigabytes."""
    hall = Hall(np.random.default_rng(0))
    twins = hall.twins()
    hall.points_map = np.concatenate([hall.points_map, [[1.5e6, -3.2e4, 1.0]]])
    hall.descriptors = np.concatenate([hall.descriptors, hall.seen[:1]])
    places = [[np.round(twin.map_from_cam[:2, 3], 1).tolist() for twin in each] for each in (hall.twins(), twins)]
    assert sorted(places[0]) == sorted(places[1])
