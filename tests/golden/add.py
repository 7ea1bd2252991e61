"""Adds the files of formats that have none yet; never writes one again. `PYTHONPATH=tests python -m golden.add` for each new format."""

import json
import tempfile
from pathlib import Path

import msgspec
import numpy as np

from fleetmap.mapformat.manifest import MANIFEST_FORMAT
from fleetmap.mapformat.tile import TILE_FORMAT, decode_tile, encode_tile
from fleetmap.mapformat.version_file import EXPORT_FORMAT
from fleetmap.messages import Thumbnail
from fleetmap.version_grid import TILE_CELLS, encode_grid, grid_report
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.quality.figures import Comparison, Evidence, ProbeFigures, TrajectoryBreaks
from mapserver.store import DraftContent, MapStore
from mapserver.store.archive import ARCHIVE_FORMAT, encode_archive
from support.fleet.reports import blindness
from support.storage.dense_samples import surfel_extras, wall
from support.storage.map_samples import draft_details, random_survey, random_tile

GOLDEN = Path(__file__).parent
_LOOKS = ProbeFigures(40, 0.975, 0.0, 0.001, 0.004, 290.0, 1.77)
EVIDENCE = Evidence(held_out=Comparison(_LOOKS, _LOOKS, 1.0), motion=TrajectoryBreaks(100, 0, 0.01))


def write_store(folder: Path) -> None:
    """Version 1 of site lab, a draft."""
    with MapStore.open(folder, create=True, clock_ns=lambda: 1_767_323_045_000_000_000) as store:
        for seed in (1, 2, 3):
            rng = np.random.default_rng(seed)
            tiles = [random_tile(rng, landmarks=8, places=1, cell=(x, 0)) for x in range(2)]
            grid = encode_grid({(0, 0): np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)})
            extras, said = surfel_extras(wall()[:20])
            extras += [("grid", data) for data in grid]
            reported = msgspec.to_builtins(grid_report(grid, {}))
            details = draft_details(path_m=12.5, grid=reported, surfels=said)
            store.save(
                "lab", DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=details, archive=b"archive %d" % seed, extras=extras,
                evidence=EVIDENCE if seed == 3 else None),
            )  # fmt: skip
            if seed < 3:
                releases.publish(store, "lab")
        store.record_robot_report("lab", "r1", {"status": "TRACKING"}, 1)
        releases.roll_back(store, "lab")
        store.update_job(store.begin_job("lab", "nightly"), "done", "version 2 is published", {"drafts": 1})
        report = blindness(tile=(0, 0), thumbnails=(Thumbnail(stamp_ns=5, kind="frame", jpeg=b"\xff\xd8jpeg\xff\xd9"),))
        Fleet(store, clock_ns=lambda: 1_767_323_045_000_000_000).take_failure("lab", "r1", report)


def write_tile(path: Path) -> None:
    """A tile, and beside it what its bytes mean."""
    data = encode_tile(random_tile(np.random.default_rng(7), landmarks=5, places=2))
    tile = decode_tile(data)
    meaning = {
        "cell": [tile.tile_x, tile.tile_y],
        "size_m": tile.size_m,
        "landmark_ids": tile.landmark_ids.tolist(),
        "points_map": tile.points_map.tolist(),
        "descriptors": [bytes(row).hex() for row in tile.descriptors],
        "place_ids": tile.place_ids.tolist(),
        "map_from_cam": tile.map_from_cam.tolist(),
    }
    path.write_bytes(data)
    path.with_suffix(".json").write_text(json.dumps(meaning, indent=1) + "\n")


if __name__ == "__main__":
    if not (tile_path := GOLDEN / f"tile-{TILE_FORMAT}.fmtl").exists():
        write_tile(tile_path)
    if not (archive_path := GOLDEN / f"archive-{ARCHIVE_FORMAT}.fmar").exists():
        survey = random_survey(np.random.default_rng(3), keyframes=3, landmarks=8)
        archive_path.write_bytes(encode_archive(survey))
    with tempfile.TemporaryDirectory() as made:
        write_store(Path(made) / "store")
        with MapStore.open(Path(made) / "store") as store:
            if not (path := GOLDEN / f"manifest-{MANIFEST_FORMAT}.json").exists():
                path.write_bytes(store.blob(store.version("lab", 1).manifest_sha256))
            if not (path := GOLDEN / f"version-{EXPORT_FORMAT}.fmex").exists():
                store.export_version("lab", 1, path)
