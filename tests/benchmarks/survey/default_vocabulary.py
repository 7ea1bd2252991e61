"""Makes the vocabulary that ships with fleetmap, from pictures of simulated warehouses and nothing else.

    PYTHONPATH=tests python tests/benchmarks/survey/default_vocabulary.py FILE.fmvb [--features FILE.npz]

It writes the same bytes every time, in some minutes. The warehouses are others than those that tests, demo and benches use, so
that these measure how the vocabulary fares elsewhere.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary, encode_vocabulary
from fleetmap.features.orb import detect
from fleetmap.features.settings import OrbSettings
from fleetmap.mapformat import sha256_hex
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetsim.recorder import Order, prepare
from support.worlds.vocabulary_training import train_vocabulary

BRANCHING, LEVELS, SEED = 10, 4, 0
PICTURES = 60  # of each run, evenly spread
RUNS = (
    Order("small-loop", 101),
    Order("small-loop", 102, light="night"),
    Order("small-loop", 103, day=1, robot="tote-1", light="evening"),
    Order("small-loop", 104, robot="tote-2"),
    Order("busy", 106),
    Order("busy", 107, robot="tote-1", light="evening"),
    Order("busy", 108, robot="pallet-1", light="night"),
    Order("busy", 109, day=1, robot="pallet-1"),
    Order("identical-aisles", 110),
    Order("identical-aisles", 111, robot="tote-1", light="evening"),
)


@dataclass(frozen=True, slots=True)
class Examples:
    """Descriptors (N, 32) and which picture each is from (N,)."""

    descriptors: NDArray[np.uint8]
    images: NDArray[np.int64]


def examples(runs: tuple[Order, ...] = RUNS, pictures: int = PICTURES) -> Examples:
    """Features of pictures of all runs, as a survey finds them in its keyframes."""
    found: list[NDArray[np.uint8]] = []
    for order in runs:
        session = prepare(order)
        rectifier, times = Rectifier(session.nominal), session.frame_times_s
        for number in np.unique(np.linspace(0, len(times) - 1, pictures).round().astype(int)):
            shot = session.renderer.shoot(times[number])
            frame = rectifier.rectify(CameraFrame(0, shot.left, shot.right))
            found.append(detect(frame.left, OrbSettings()).descriptors)
        session.renderer.close()
        print(f"{order.scenario} seed {order.seed}: {len(found)} pictures so far", flush=True)
    images = np.repeat(np.arange(len(found)), [len(rows) for rows in found])
    return Examples(np.concatenate(found), images)


def train(given: Examples, branching: int = BRANCHING, levels: int = LEVELS) -> Vocabulary:
    """The vocabulary of these examples."""
    return train_vocabulary(given.descriptors, branching, levels, np.random.default_rng(SEED), given.images)


def main() -> None:
    """Makes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--features", type=Path, help="keep the features here, or take them from here")
    arguments = parser.parse_args()
    if arguments.features is not None and arguments.features.is_file():
        held = np.load(arguments.features)
        given = Examples(held["descriptors"], held["images"])
    else:
        given = examples()
        if arguments.features is not None:
            np.savez(arguments.features, descriptors=given.descriptors, images=given.images)
    vocabulary = train(given)
    data = encode_vocabulary(vocabulary)
    arguments.out.write_bytes(data)
    print(f"{len(given.descriptors)} features, {vocabulary.word_count} words, {len(data)} bytes")
    print(sha256_hex(data))


if __name__ == "__main__":
    main()
