"""Makes the vocabulary that ships with fleetmap, from pictures of simulated warehouses and nothing else.

    PYTHONPATH=tests python -m benchmarks.survey.default_vocabulary FILE.fmvb

It writes the same bytes every time, in some minutes. The warehouses are others than those that tests, demo and benches use, so
that these measure how the vocabulary fares elsewhere.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.extraction import extract
from fleetmap.features.settings import OrbSettings
from fleetmap.mapformat.names import sha256_hex
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetsim.recorder import Order, prepare
from support.worlds.vocabulary_training import encode_vocabulary, train_vocabulary

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


def features() -> list[NDArray[np.uint8]]:
    """Features (N, 32) of each picture of all runs, as a survey finds them in its keyframes."""
    found: list[NDArray[np.uint8]] = []
    for order in RUNS:
        session = prepare(order)
        rectifier, times = Rectifier(session.nominal), session.frame_times_s
        for number in np.unique(np.linspace(0, len(times) - 1, PICTURES).round().astype(int)):
            left, right = session.renderer.shoot(times[number])
            frame = rectifier.rectify(CameraFrame(0, left.image, right.image))
            found.append(extract(frame.left, OrbSettings()).descriptors)
        session.renderer.close()
        print(f"{order.scenario} seed {order.seed}: {len(found)} pictures so far", flush=True)
    return found


def main() -> None:
    """Makes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    found = features()
    images = np.repeat(np.arange(len(found)), [len(rows) for rows in found])
    vocabulary = train_vocabulary(np.concatenate(found), 10, 4, np.random.default_rng(0), images)
    data = encode_vocabulary(vocabulary)
    out.write_bytes(data)
    print(f"{len(images)} features, {vocabulary.word_count} words, {len(data)} bytes")
    print(sha256_hex(data))


if __name__ == "__main__":
    main()
