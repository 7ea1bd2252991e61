"""Nights of one site with lifts, slips, exchanged pairs and a wrong calibration a week: ghosts that they publish, robots that these lose.

Each night one drive lies in the inbox; a sound robot of day 2 is replayed in each version that it publishes. The seeds are sites of their
own, each with the demo's lifted drive. A ghost is a landmark for robots of which the keyframe that defines it is so far off, by the
simulator's truth, that it is moved by more than 0.2 m. A run that is interrupted goes on from what lies in the work folder.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.console import Console

from benchmarks.common.recorded_runs import Options, Results, benchmark, played, rendered
from fleetmap.errors import FleetmapError
from fleetmap.geometry import se3_inverse
from fleetmap.mapformat.tile import decode_tile
from fleetmap.recordings import open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetsim.motion import Route
from fleetsim.recorder import Order, Session
from fleetsim.scenarios import SCENARIOS, Run
from fleetsim.sensors import Fault, HiddenErrors
from locclient.replay import run_metrics
from mapserver.drafting.draft import BuildOptions
from mapserver.library import build_map
from mapserver.plugins.nightly_builds.night import NightRequest, last_report, run_night
from mapserver.quality.gate import GateSettings
from mapserver.store import Actor, MapStore
from mapserver.store.archive import decode_archive

SITE, CLIP = "hall", SCENARIOS["clip"]()
AISLE_M, ASIDE_M = CLIP.layout.aisle_y_m(0), CLIP.layout.aisle_y_m(1)  # nobody surveys the second one
GHOST_M, LOST_SHARE = 0.2, 0.9
PIECES = {
    "lifted": 2,
    "lifted twice": 3,
    "sound": 1,
    "slip in the dark": 1,
    "slip": 1,
    "lifted aside": 2,
    "exchanged": 1,
}
WRONG, NOTHING = HiddenErrors(turn_rad=0.02, shift_m=0.01), HiddenErrors()
_frames = Session.frames


def drive(night: int) -> tuple[str, Run, HiddenErrors]:
    """The kind of a night's drive, its run, and errors that its calibration does not contain."""
    rng, kind = np.random.default_rng([53, night]), list(PIECES)[night % len(PIECES)]
    routes = []
    for n in range(PIECES[kind]):
        y_m = (ASIDE_M if n and kind == "lifted aside" else AISLE_M) + rng.uniform(-0.25, 0.25)
        start_m, way_m = rng.uniform(3.0, 6.5), rng.uniform(4.0, 6.0)
        routes.append(Route(((start_m, y_m), (start_m + way_m, y_m + rng.uniform(-0.1, 0.1))), rest_s=0.5))
    names = ("wheel-slip", "camera-dark")[: 2 if kind.endswith("dark") else int(kind == "slip")]
    run = Run("tote", tuple(routes), 10.0, faults=tuple(Fault(name, 1.5, 4.5) for name in names))
    return kind, run, WRONG if night % 7 == 3 else NOTHING


def exchanged(session: Session) -> Iterator[CameraFrame]:
    """What a robot records whose front and rear topics are exchanged."""
    for frame in _frames(session):
        (rear,) = frame.others
        yield replace(rear, others=(replace(frame, others=()),))


def recorded(path: Path, run: Run, seed: int, day: int, kind: str = "", hidden: HiddenErrors = NOTHING) -> Path:
    """The recording of a run."""
    rig, frames = ("front-rear", exchanged) if kind == "exchanged" else ("pair", _frames)
    with patch.object(Session, "frames", frames):
        order = Order("nights", seed, day, robot="drive", rig=rig, hidden=hidden)
        return rendered(path, order, replace(CLIP, runs={"drive": run}))


def surveyed(folder: Path, seed: int) -> None:
    """Publish a survey of the first aisle in the folder's store, in the frame of the truth, unless it is there."""
    bends = [(x_m, AISLE_M + aside_m) for x_m, aside_m in ((2.7, -0.4), (6.0, 0.4), (9.5, -0.4), (13.0, 0.4))]
    path = recorded(folder / "survey.mcap", Run("surveyor", (Route(tuple(bends)),), 10.0, is_sharp=True), seed, 0)
    if not (folder / "surveyed").exists():
        shutil.rmtree(folder / "store", ignore_errors=True)
        built = build_map(path, folder / "store", SITE, BuildOptions(frame_from_ground_truth=True))
        built.publish(trust_calibration=True, actor=Actor("bench", "short, and simulated"))
        (folder / "surveyed").touch()


def night(folder: Path, recording: Path) -> dict[str, Any]:
    """Spend a night with one recording; return its fate, and what it published."""
    inbox = folder / "inbox" / recording.name
    inbox.parent.mkdir(exist_ok=True)
    shutil.copy(recording, inbox)
    request = NightRequest(SITE, inbox.parent, folder / "store", time.time_ns(), settle_s=0.0)
    with suppress(FleetmapError):
        run_night(request, GateSettings(), Console(quiet=True))
    report = last_report(folder / "store", SITE) or {}
    inbox.unlink(missing_ok=True)
    fate = next(iter(report.get("recordings", ())), {"fate": "none", "reason": report.get("message", "")})
    row = {key: fate[key][:300] for key in ("fate", "reason")}
    return row | (ghosts(folder / "store", report["published"][0], recording) if report.get("published") else {})


def ghosts(store: Path, version: int, recording: Path) -> dict[str, Any]:
    """Count the landmarks for robots that this recording's keyframes define, and those that are off."""
    with MapStore.open(store) as maps, open_recording(recording) as opened:
        manifest, truth = maps.manifest(SITE, version), opened.ground_truth
        body_from_cam = Rectifier(opened.calibration).body_from_cam
        ids = np.concatenate([decode_tile(maps.blob(tile.sha256)).landmark_ids for tile in manifest.tiles])
        old, new = (decode_archive(maps.archive(SITE, number) or b"") for number in (manifest.parent or 1, version))
    rows = np.flatnonzero(np.isin(new.landmark_ids, ids))
    seen, reference = np.unique(new.obs_landmark, return_index=True)
    keyframe = new.obs_keyframe[reference[np.searchsorted(seen, rows)]]
    off_m = np.zeros(len(rows))
    for k in range(len(old.map_from_body), len(new.map_from_body)):
        place, own = truth.at(int(new.keyframe_stamps_ns[k])), keyframe == k
        moved = place @ body_from_cam @ se3_inverse(new.map_from_body[k] @ new.body_from_cam)
        points = new.points_map[rows[own]]
        off_m[own] = np.linalg.norm(points @ moved[:3, :3].T + moved[:3, 3] - points, axis=1)
    found = {"of_tonight": int((keyframe >= len(old.map_from_body)).sum()), "worst_m": round(float(off_m.max()), 3)}
    return found | {"version": version, "landmarks": len(rows), "ghosts": int((off_m > GHOST_M).sum())}


def spent(folder: Path, number: int, robot: Path) -> dict[str, Any]:
    """One of the nights."""
    kind, run, hidden = drive(number)
    recording = recorded(folder / f"night-{number}.mcap", run, 1, 1, kind, hidden)
    row = {"night": number, "kind": kind, "miscalibrated": hidden is WRONG} | night(folder, recording)
    if "version" in row:
        frames = played(robot, folder / "store").frames
        row |= {"localised": run_metrics.localised_share_of_all(frames), "error_m": run_metrics.error_m(frames)}
    return row


@benchmark(nights=30, seeds=10)
def main(arguments: Options) -> Results:
    rows = []
    work, carried = arguments.work / "nights-with-lifts", CLIP.run("carried")[1]
    for n in range(-arguments.seeds, arguments.nights):
        folder = work if n >= 0 else work / f"seed{n}"
        done = work / f"{n}.json"
        if not done.exists():
            surveyed(folder, max(1, -n))
            way = Route(((3.5, AISLE_M - 0.1), (11.0, AISLE_M + 0.1)))
            robot = recorded(work / "robot.mcap", Run("tote", (way,), 10.0), 1, 2)
            lifted = folder / "carried.mcap"
            row = spent(work, n, robot) if n >= 0 else {"seed": -n} | night(folder, recorded(lifted, carried, -n, 1))
            done.write_text(json.dumps(row), "utf-8")
        rows.append(json.loads(done.read_text("utf-8")))
        print(rows[-1], flush=True)
    versions = [row for row in rows if "version" in row]
    figures = {
        "ghosts": sum(row["ghosts"] for row in versions),
        "published": len(versions),
        "versions_that_lose_a_robot": sum(row.get("localised", 1.0) < LOST_SHARE for row in versions),
    }
    return {"figures": figures, "nights": rows}
