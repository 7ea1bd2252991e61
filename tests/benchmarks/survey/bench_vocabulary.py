"""How well vocabularies find places again in other recordings of the same site, against their size.

`python tests/benchmarks/survey/bench_vocabulary.py MAP_RECORDING ROBOT_RECORDING... [--vocabulary FILE...] [--out FILE.json]`:
places are every 0.5 m of the first recording; pictures of each other one are looked up among them. A picture counts where the truth
knows a place
within 1 m and 25 degrees. Beside the given vocabularies and the one that ships stand those trained on the map's own places.
"""

import argparse
import json
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import PlaceIndex, Vocabulary, decode_vocabulary, encode_vocabulary, train_vocabulary
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.features.orb import OrbSettings, detect
from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.recordings import open_recording
from fleetmap.sensors.rectification import Rectifier

NEAR_M, NEAR_RAD, PLACE_M = 1.0, np.radians(25.0), 0.5
ROBOT_PICTURES = 120


@dataclass(frozen=True)
class Looks:
    """Pictures of a recording: descriptors of each, and where the truth says the camera was (N, 4, 4)."""

    descriptors: list[NDArray[np.uint8]]
    map_from_cam: Array


@dataclass(frozen=True, slots=True)
class Retrieval:
    """How often the most similar place, or one of eight, is a right one; milliseconds to find words and look them up."""

    vocabulary: str
    words: int
    bytes: int
    recording: str
    pictures: int
    first: float
    among_eight: float
    look_up_ms: float


def looks(path: Path, *, every_m: float | None) -> Looks:
    """Pictures every so many metres, or evenly spread ones."""
    with open_recording(path) as recording:
        rectifier, truth = Rectifier(recording.calibration), recording.ground_truth
        assert truth is not None, f"{path} holds no truth"
        known = [(n, truth.at(int(stamp))) for n, stamp in enumerate(recording.frame_stamps_ns)]
        places = [(n, body @ rectifier.body_from_cam) for n, body in known if body is not None]
        if every_m is None:
            chosen = [places[k] for k in np.unique(np.linspace(0, len(places) - 1, ROBOT_PICTURES).round().astype(int))]
        else:
            chosen = places[:1]
            for n, place in places[1:]:
                if np.linalg.norm(place[:3, 3] - chosen[-1][1][:3, 3]) > every_m or _turn(place, chosen[-1][1]) > 0.26:
                    chosen.append((n, place))
        found = [detect(rectifier.rectify(recording.read_frame(n)).left, OrbSettings()).descriptors for n, _ in chosen]
        return Looks(found, np.array([place for _, place in chosen]))


def retrieve(name: str, vocabulary: Vocabulary, held: Looks, asked: Looks, recording: str) -> Retrieval:
    """The figures of one vocabulary."""
    index = PlaceIndex(vocabulary.word_count)
    for k, rows in enumerate(held.descriptors):
        index.add(k, vocabulary.bow_vector(vocabulary.words(rows)))
    possible = first = eight = 0
    seconds = 0.0
    for rows, place in zip(asked.descriptors, asked.map_from_cam, strict=True):
        right = {
            k
            for k, there in enumerate(held.map_from_cam)
            if np.linalg.norm(there[:3, 3] - place[:3, 3]) < NEAR_M and _turn(there, place) < NEAR_RAD
        }
        if right:
            started = time.perf_counter()
            ids, _ = index.query(vocabulary.bow_vector(vocabulary.words(rows)), None, 8)
            seconds += time.perf_counter() - started
            possible += 1
            first += int(ids[0]) in right
            eight += not right.isdisjoint(ids.tolist())
    size, of = len(encode_vocabulary(vocabulary)), max(possible, 1)
    return Retrieval(name, vocabulary.word_count, size, recording, possible, first / of, eight / of, 1e3 * seconds / of)


def own(held: Looks, branching: int, levels: int) -> Vocabulary:
    """Trained on the map's places alone."""
    images = np.repeat(np.arange(len(held.descriptors)), [len(rows) for rows in held.descriptors])
    return train_vocabulary(np.concatenate(held.descriptors), branching, levels, np.random.default_rng(0), images)


def bench(mapped: Path, robots: Sequence[Path], files: Sequence[Path]) -> list[Retrieval]:
    """All vocabularies over all recordings."""
    held = looks(mapped, every_m=PLACE_M)
    vocabularies = {"ships": default_vocabulary(), "own k10 L4": own(held, 10, 4)}
    vocabularies |= {file.stem: decode_vocabulary(file.read_bytes()) for file in files}
    results = []
    for robot in robots:
        asked = looks(robot, every_m=None)
        results += [retrieve(name, words, held, asked, robot.stem) for name, words in vocabularies.items()]
    return results


def show(results: Sequence[Retrieval]) -> None:
    """The table."""
    print(
        f"{'recording':24} {'vocabulary':14} {'words':>7} {'bytes':>9} {'pictures':>8} {'first':>6} {'of 8':>6} {'ms':>6}"
    )
    for r in results:
        print(
            f"{r.recording:24} {r.vocabulary:14} {r.words:7} {r.bytes:9} {r.pictures:8} {r.first:6.3f} {r.among_eight:6.3f} "
            f"{r.look_up_ms:6.2f}"
        )


def _turn(a: Array, b: Array) -> float:
    return float(rotation_angle_rad(a[:3, :3].T @ b[:3, :3]))


def main() -> None:
    """Prints the table; writes JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mapped", type=Path)
    parser.add_argument("robots", type=Path, nargs="+")
    parser.add_argument("--vocabulary", type=Path, action="append", default=[])
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    results = bench(arguments.mapped, arguments.robots, arguments.vocabulary)
    show(results)
    if arguments.out is not None:
        machine = {"machine": platform.processor() or platform.machine(), "python": platform.python_version()}
        arguments.out.write_text(json.dumps(machine | {"results": [asdict(r) for r in results]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
