"""How much memory a robot takes on a large site, and whether it grows over half an hour.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_robot_memory.py [--minutes M] [--site-mb MB] [--work FOLDER] [--out FILE.json]`. The
simulated next day again and again, by the parts of the daemon, in a process that holds nothing else. The site is the survey's map with
copies of its tiles in a wide grid far from it, as many as make it so large: the robot holds those within reach. Recording and map are
kept in the work folder, where bench_localization.py finds the same.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common.laps import repeated
from benchmarks.common.recorded_runs import (
    AT_MOST,
    SITE,
    Promises,
    kept_folder,
    recorded,
    resident_mb,
    show_against,
    surveyed,
    write_results,
)
from fleetmap.numerics.free_memory import give_back_free_memory
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.replay_source import ReplaySource
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.settings import LocalizerSettings
from locclient.maps.map_source import LocalMapSource
from locclient.maps.tile_loader import TileLoader
from locclient.maps.tile_selection import PositionBound, PositionBoundTracker, TileSelectionSettings
from locclient.robot.health_report import HealthFigures
from locclient.robot.jit_warmup import drop_compiler_code, warm_up_kernels
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings

PROMISES: Promises = {"resident_mb": (240, AT_MOST), "anonymous_mb": (200, AT_MOST), "growth_mb": (5, AT_MOST)}
_RUNNER = ("--robot", "runner-1", "--day", "1")
_SETTLED_MIN = 2  # before it, kernels are loaded and queues fill
_WARMING_UP_MIN = 3.0
_MAP_EVERY = 15  # frames
_FAR_M = 600.0  # to the copies, which are twins of every place: a robot that is carried must not have to choose


def large_site(work: Path, megabytes: float) -> Path:
    """A store with the survey's tiles and copies of them in a grid around, so many bytes in all."""
    from dataclasses import replace

    import msgspec

    from fleetmap.mapformat import encode_tile
    from mapserver import releases
    from mapserver.store import DraftContent, MapStore
    from mapserver.store.rows import DraftDetails

    folder = work / f"large-{megabytes:g}"
    if (folder / "built").exists():
        return folder
    source = LocalMapSource(surveyed(work), SITE)
    manifest = source.manifest(source.ready().wanted)
    own = list(source.tiles(manifest).tiles.values())
    rounds = int(np.ceil(megabytes * 1e6 / sum(len(encode_tile(tile)) for tile in own)))
    wide = 1 + max(tile.tile_x for tile in own) - min(tile.tile_x for tile in own)
    high = 1 + max(tile.tile_y for tile in own) - min(tile.tile_y for tile in own)
    columns, tiles, far = int(np.ceil(np.sqrt(rounds))), [], int(np.ceil(_FAR_M / manifest.tile_size_m))
    for number in range(rounds):
        dx, dy = wide * (number % columns) + far * (number > 0), high * (number // columns)
        offset_m = manifest.tile_size_m * np.array([dx, dy, 0.0])
        for tile in own:
            places = tile.map_from_cam.copy()
            places[:, :3, 3] += offset_m
            tiles.append(
                replace(
                    tile, tile_x=tile.tile_x + dx, tile_y=tile.tile_y + dy, points_map=tile.points_map + offset_m,
                    map_from_cam=places,
                )
            )  # fmt: skip
    details = DraftDetails(
        created=manifest.created, tile_size_m=manifest.tile_size_m, camera=manifest.camera,
        recordings=manifest.recordings, configuration=manifest.configuration, libraries=manifest.libraries,
        report=msgspec.to_builtins(manifest.report),
    )  # fmt: skip
    with MapStore.open(folder, create=True) as store:
        store.save_draft(
            SITE, DraftContent(tiles=tiles, vocabulary=source.vocabulary(manifest), details=details, archive=b"none")
        )
        releases.publish(store, SITE)
    (folder / "built").touch()
    return folder


def long_enough(recording: Recording, minutes: float) -> Recording:
    """The recording driven as often as it takes; from where it stands at the end the robot is carried back to where it began."""
    last = len(recording.frame_stamps_ns) - 1
    lap_s = float(recording.frame_stamps_ns[last] - recording.frame_stamps_ns[0]) * 1e-9
    return repeated(recording, int(np.ceil(60.0 * minutes / lap_s)) + 1, (0, last))


def drive(store: Path, recording: Path, minutes: float) -> dict[str, Any]:
    """The robot's life, and its memory minute by minute."""
    cv2.setNumThreads(1)
    link = LocalMapSource(store, SITE)
    wanted = link.ready().wanted
    site_mb = sum(entry.bytes for entry in link.manifest(wanted).tiles) / 1e6
    figures, loader, tracker = (
        HealthFigures(),
        TileLoader(link, TileSelectionSettings()),
        PositionBoundTracker(TileSelectionSettings()),
    )
    memory, tiles_held, begun_s = [], [], time.process_time()
    with open_recording(recording) as opened:
        source = ReplaySource.of(long_enough(opened, minutes), FrameSelection.parse(":"), reverse=False)
        rectifier = Rectifier(source.calibration)
        warm_up_kernels(source.calibration, rectifier, LocalizerSettings())
        drop_compiler_code()
        give_back_free_memory()
        robot = Robot(source.calibration, rectifier, LocalizerSettings(), TrialSettings(), time.process_time)
        bound, first_ns = PositionBound(), None
        for number, imu in enumerate(source.imu_before_each()):
            priors = source.priors_before(number)
            if number == 0 and priors:  # a robot that starts on its dock
                bound = PositionBound(priors[0].map_from_base[:3, 3])
            if number % _MAP_EVERY == 0:
                loaded = loader.load(wanted, bound)
                if loaded is not None:
                    robot.use(loaded)
                tiles_held.append(sum(len(held.tiles) for held in robot.held))
            bundle = SensorBundle(source.frame(number), imu, list(source.wheel_before(number)), priors)
            outcome = robot.handle(bundle)
            assert outcome is not None
            figures.handle(outcome)
            estimate = outcome.estimate
            bound = tracker.handle(estimate)
            first_ns = estimate.stamp_ns if first_ns is None else first_ns
            if estimate.stamp_ns - first_ns >= 60e9 * len(memory):
                memory.append(resident_mb())
                print(f"minute {len(memory) - 1}: {memory[-1]}", file=sys.stderr, flush=True)
            if estimate.stamp_ns - first_ns >= 60e9 * minutes:
                break
    settled = memory[_SETTLED_MIN:]
    report = figures.report(SITE, "bench", 0, {}, silent=False).metrics
    return {
        "frames": number + 1, "site_mb": site_mb, "tiles": len(link.manifest(wanted).tiles),
        "tiles_held_most": max(tiles_held), "tiles_held_last": tiles_held[-1],
        "resident_mb": max(row["resident"] for row in memory), "anonymous_mb": max(row["anonymous"] for row in memory),
        "growth_mb": settled[-1]["resident"] - settled[0]["resident"], "by_minute": memory,
        "localised_share": report["localised_share"], "cpu_ms": 1e3 * (time.process_time() - begun_s) / (number + 1),
    }  # fmt: skip


def bench(work: Path, minutes: float, site_mb: float) -> dict[str, Any]:
    """The figures, of a process of its own; another one before it compiles the kernels, which takes twice a robot's memory."""
    recording, store = recorded(work, _RUNNER), large_site(work, site_mb)
    child = [sys.executable, __file__, "--drive", str(store), str(recording), "--minutes"]
    done = ""
    for driven in (min(minutes, _WARMING_UP_MIN), minutes):
        done = subprocess.run(
            [*child, str(driven)], env=os.environ, stdout=subprocess.PIPE, check=True, text=True
        ).stdout
    found: dict[str, Any] = json.loads(done)
    return found


def main() -> None:
    """The command; with --drive, the process that is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--site-mb", type=float, default=50.0)
    parser.add_argument("--work", type=Path, default=kept_folder())
    parser.add_argument("--out", type=Path)
    parser.add_argument("--drive", nargs=2, type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.drive is not None:
        print(json.dumps(drive(given.drive[0], given.drive[1], given.minutes)))
        return
    given.work.mkdir(parents=True, exist_ok=True)
    found = bench(given.work, given.minutes, given.site_mb)
    show_against("memory of a robot", {key: value for key, value in found.items() if key != "by_minute"}, PROMISES)
    write_results(given.out, {"memory": found})


if __name__ == "__main__":
    main()
