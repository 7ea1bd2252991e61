"""Real pictures: places of a flight recognised in pictures that the index does not hold."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.bow.place_index import PlaceIndex
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.features.orb import detect
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, rotation_angle_rad, rotation_from_quat_wxyz
from support.recordings.realdata import real_data
from support.worlds.vocabulary_training import train_vocabulary


@lru_cache(maxsize=1)
def _flight(root: Path) -> tuple[list[np.ndarray], Array, list[Array]]:
    """Descriptors, position (N, 3) and rotation of each left picture."""
    rows = [line.split(",") for line in (root / "cam0" / "data.csv").read_text().splitlines()[1:]]
    truth = np.loadtxt(root / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    near = [int(np.argmin(np.abs(truth[:, 0] - int(stamp)))) for stamp, _ in rows]
    pictures = [cv2.imread(str(root / "cam0" / "data" / name.strip()), cv2.IMREAD_GRAYSCALE) for _, name in rows]
    looks = [detect(picture, OrbSettings()).descriptors for picture in pictures]
    return looks, truth[near, 1:4], [rotation_from_quat_wxyz(quat_wxyz) for quat_wxyz in truth[near, 4:8]]


@pytest.mark.parametrize("words", ["own", "shipped"])
def test_pictures_find_their_neighbours(words: str) -> None:
    """Every second picture of V1_01 is in the index, the others are looked up; right is within 1 m and 25 degrees.

    The words that ship were trained on simulated warehouses alone.
    """
    looks, positions, rotations = _flight(real_data("euroc_v101_keyframes") / "mav0")
    held, asked = range(0, len(looks), 2), range(1, len(looks), 2)
    images = np.repeat(np.arange(len(held)), [len(looks[k]) for k in held])
    vocabulary = default_vocabulary()
    if words == "own":
        vocabulary = train_vocabulary(np.concatenate([looks[k] for k in held]), 10, 4, np.random.default_rng(0), images)
    index = PlaceIndex(vocabulary.word_count)
    for k in held:
        index.add(k, vocabulary.bow_vector(vocabulary.words(looks[k])))
    possible = first = among_five = 0
    for k in asked:
        neighbours = {
            h
            for h in held
            if np.linalg.norm(positions[h] - positions[k]) < 1.0
            and np.degrees(rotation_angle_rad(rotations[h].T @ rotations[k])) < 25.0
        }
        if neighbours:
            found, _ = index.query(vocabulary.bow_vector(vocabulary.words(looks[k])), None, top_k=5)
            possible += 1
            first += int(found[0]) in neighbours
            among_five += not neighbours.isdisjoint(found.tolist())
    assert possible > 40
    assert first >= 0.8 * possible
    assert among_five >= 0.9 * possible
