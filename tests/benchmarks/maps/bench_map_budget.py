"""What a robot loses with fewer landmarks: share of frames localised and error against the landmark budget.

    python tests/benchmarks/maps/bench_map_budget.py --store maps --site hall OTHER_RECORDING [--frames 1::2] [--out FILE.json]

The version's archive holds all landmarks of its survey; its tiles are cut again at the default budget and at the full map,
1/2, 1/4 and 1/8 of it, and the recording is replayed in each. Run it on a recording that did not make the map: the other
half of one (`mapserver build --frames 0::2`, then `--frames 1::2` here), or a robot of the next simulated day. A map in the
frame of the ground truth (`--frame-from-ground-truth`) has errors too, the others shares only.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.mapformat import Manifest, Tile, decode_tile, encode_tile
from fleetmap.messages import WantedVersion
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sources.replay_source import ReplaySource
from locclient.maps.connection import MapConnection
from locclient.maps.map_source import FetchedTiles, ReadyVersion
from locclient.replay.replay import ReplayOptions, replay
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.survey_map import SurveyMap
from mapserver.tiles.landmark_budget import choose_landmarks
from mapserver.tiles.tiling import tiles_from_survey

SHARES = (1.0, 0.5, 0.25, 0.125)


@dataclass
class Cut:
    """A version whose tiles were cut anew: what a replay reads its map from."""

    made: Manifest
    words: bytes
    cut: list[Tile]

    def ready(self) -> ReadyVersion:
        return ReadyVersion(WantedVersion(site=self.made.site, version=self.made.version, manifest_sha256="0" * 64))

    def manifest(self, _: WantedVersion) -> Manifest:
        return self.made

    def vocabulary(self, _: Manifest) -> bytes:
        return self.words

    def tiles(self, _: Manifest, cells: Iterable[tuple[int, int]] | None = None) -> FetchedTiles:
        assert cells is None
        return FetchedTiles({(tile.tile_x, tile.tile_y): tile for tile in self.cut})


def row(
    name: str, survey: SurveyMap, chosen: NDArray[np.bool_], made: Manifest, words: bytes, source: ReplaySource
) -> dict[str, object]:
    """Bytes and quality of one budget."""
    encoded = [encode_tile(tile) for tile in tiles_from_survey(survey, made.tile_size_m, chosen=chosen)]
    link = MapConnection(Cut(made, words, [decode_tile(data) for data in encoded]), None, made.site, "bench")
    begun_s = time.process_time()
    report = replay(source, link, ReplayOptions()).report
    size = sum(len(data) for data in encoded)
    return {
        "budget": name,
        "landmarks": int(chosen.sum()),
        "bytes": size,
        "bytes_per_m": size / float(made.report["path_m"]),
        "largest_tile_bytes": max(len(data) for data in encoded),
        "localised_share_of_all": report["localised_share_of_all"],
        "localised_share": report["localised_share"],
        "error_m": report["error_m"],
        "silent_failures": report["silent_failures"],
        "cpu_s": time.process_time() - begun_s,
    }


def measure(store: Path, site: str, version: int | None, recording: Path, frames: str) -> list[dict[str, object]]:
    """One row for the default budget, then one for each share of the full map."""
    with MapStore.open(store) as maps:
        number = version if version is not None else maps.versions(site)[-1].version
        made, archive = maps.manifest(site, number), maps.archive(site, number)
        assert archive is not None, f"version {number} of {site} has no archive"
        words, survey = maps.blob(made.vocabulary.sha256), decode_archive(archive)
    seen = len(np.unique(survey.obs_landmark))
    cuts = {"default": choose_landmarks(survey, BudgetSettings(), made.tile_size_m)}
    for share in SHARES:
        exactly = BudgetSettings(landmarks_per_m=0.0, min_landmarks=round(share * seen), tile_landmarks=1 << 30)
        cuts[f"{share:g} of the map"] = choose_landmarks(survey, exactly, made.tile_size_m)
    rows = []
    with open_recording(recording) as opened:
        for name, cut in cuts.items():
            source = ReplaySource.of(opened, FrameSelection.parse(frames), reverse=False)
            rows.append(row(name, survey, cut, made, words, source))
            show(rows[-1])
    return rows


def show(found: dict[str, object]) -> None:
    """One line of the table."""
    error = found["error_m"] if isinstance(found["error_m"], dict) else {}
    error_text = " ".join(f"{name} {1e3 * value:6.1f} mm" for name, value in error.items() if value is not None)
    print(
        f"{found['budget']!s:18s} {found['landmarks']:6d} landmarks {found['bytes']:8d} bytes {found['bytes_per_m']:8.0f} B/m "
        f"localised {found['localised_share']:.3f} {error_text} silent {found['silent_failures']} cpu {found['cpu_s']:.0f} s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--site", required=True)
    parser.add_argument("--version", type=int)
    parser.add_argument("--frames", default="::")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = measure(options.store, options.site, options.version, options.recording, options.frames)
    if options.out is not None:
        about = {"machine": platform.machine(), "cores": os.cpu_count(), "numpy": np.__version__, "command": sys.argv}
        options.out.write_bytes(msgspec.json.format(msgspec.json.encode(about | {"rows": rows}), indent=2) + b"\n")


if __name__ == "__main__":
    main()
