"""Whether maps and estimates are the same before and after a change: hashes of six recordings' tiles, manifests and estimates, and poses.

`PYTHONPATH=tests python -m golden.equality [--only NAME...] [--work FOLDER] [--out FILE.json]`: a stereo pair, front and rear pairs, a
pair and a depth camera, RGB-D, one camera with an IMU, and two floors. `diff` names the hashes that differ from those that other code
wrote on the same machine: other processors round otherwise. Recordings of the simulator are made once in the work folder; the two real
ones are left out, loudly, where they are missing.
"""

import benchmarks  # noqa: F401 -- first of all, before numpy

# isort: split
import hashlib
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, tool
from fleetmap.encoding import to_json
from fleetmap.mapformat.building import Building, FloorEntry
from fleetmap.recordings import open_recording
from fleetmap.recordings.tum import format_tum
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.source import ReplaySource
from locclient import LocalizeOptions, localize
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_source import LocalMapSource
from locclient.replay.replay import load_map
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings
from mapserver.fleet.building import keep_building
from mapserver.store import NOBODY, MapStore
from support.recordings.hashes import hashed, tiles_of
from support.recordings.realdata import DATA
from support.storage.map_samples import align

RIGS = {"stereo": "pair", "front-rear": "front-rear", "front-depth": "front-depth"}
REAL = {"rgbd": ("7scenes_redkitchen_200", "rgbd"), "mono-inertial": ("euroc_mh01_start", "mono-inertial")}
FLOORS = "floors"
MEASURED = ("seconds", "realtime_factor", "peak_rss_mb", "pictures")
"""Figures of a build that no other one repeats: times, memory, and the address of pictures, which says when they were first kept."""


def built(recording: Path, store: Path, site: str, *options: str) -> dict[str, str]:
    """Of a recording's map, which is published: hashes as of `tiles_of`, and of the manifest without its time and MEASURED; all poses."""
    to_store, out = ["--site", site, "--store", str(store)], store.with_name(f"{site}.tum")
    kept = ["--threads", "2", "--trajectory-out", str(out)]
    subprocess.run([*tool("mapserver"), "build", str(recording), *to_store, *kept, *options], check=True)
    subprocess.run(
        [*tool("mapserver"), "publish", *to_store, "--force", "--reason", "compared", "--actor", "golden"], check=True
    )
    with MapStore.open(store) as maps:
        manifest = maps.manifest(site, 1)
    report = {name: value for name, value in manifest.report.items() if name not in MEASURED}
    same = to_json(msgspec.structs.replace(manifest, created="", report=report), order="sorted")
    return {"manifest": hashlib.sha256(same).hexdigest(), **tiles_of(store, site), "survey.tum": out.read_text()}


def in_a_building(drive: Path, store: Path) -> Iterable[Estimate]:
    """The estimates of a robot of the lower floor that drives on the upper one."""
    with MapStore.open(store) as maps:
        for site in ("low", "high"):
            align(maps, site)
        floors = tuple(FloorEntry(site=site, level=site, height_m=4.0 * n) for n, site in enumerate(("low", "high")))
        keep_building(maps, Building(name="tower", floors=floors), NOBODY)
    own = LocalMapSource(store, "low")
    held = BuildingMaps(own, lambda other: LocalMapSource(store, other))
    held.refresh()
    change = held.changes.popleft()
    with open_recording(drive) as recording:
        robot = Robot(Rectifier(recording.calibration), LocalizerSettings(), TrialSettings(), lambda: 0.0)
        robot.use(load_map(own)[0])
        robot.use_building(change.building, change.maps)
        source = ReplaySource(recording, np.arange(len(recording.frame_stamps_ns)), reverse=False)
        for number, before in enumerate(source.samples_before_each()):
            outcome = robot.handle(replace(before, frame=source.frame(number)))
            if outcome is not None:
                yield outcome.estimate


def figures(name: str, work: Path, store: Path) -> dict[str, str]:
    """The hashes of one recording."""
    if name == FLOORS:
        tower = {
            f"{site} {what}": sha256
            for site, seed in (("low", "0"), ("high", "1"))
            for what, sha256 in built(recorded(work, ("--seed", seed), "clip"), store, site).items()
        }
        return tower | hashed(
            in_a_building(recorded(work, ("--seed", "1", "--robot", "tote-1", "--day", "1"), "clip"), store)
        )
    if name in REAL:
        folder, sensors = REAL[name]
        if not (DATA / folder).is_dir():
            return {"NOT COMPARED": f"{folder} not found in {DATA}"}
        drive, frames = DATA / folder, "1:200:2"
        found = built(drive, store, name, "--use", sensors, "--frames", "::2")
    else:
        rig, frames = ("--rig", RIGS[name]), ":"
        drive = recorded(work, ("--robot", "tote-1", "--day", "1", *rig), "clip")
        found = built(recorded(work, rig, "clip"), store, name)
    run = localize(drive, store, name, options=LocalizeOptions(frames=frames))
    with open_recording(drive) as recording:
        found["recording of the robot"] = recording.content_hash()
    return found | hashed(run.estimates) | {"robot.tum": format_tum(run.trajectory)}


@benchmark([*RIGS, *REAL, FLOORS])
def main(options: Options) -> Results:
    found: Results = {}
    for name in options.only:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = figures(name, options.work, Path(folder) / "store")
    return found
