"""A bad map on trial: the landmarks of one aisle are shifted by 0.5 m, some robots of a fleet try it, the server takes it back.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_canary.py [--robots 100] [--share 0.05] [--out FILE.json]

The localizer drives the simulator's next day once in the good map and once in the bad one (landmarks projected, no pixels). What
it says is recorded as health, and every robot of the fleet says it again and again, each from another second on, by the version
that the server tells it to run.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import os
import platform
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import estimator_loop
from fleetmap.bus import MemoryBus, MemoryHub
from fleetmap.mapformat import Tile
from fleetmap.messages import RobotHealth, WantedVersion, decode_message, robot_key
from fleetsim.recorder import Order, prepare
from locclient.localization.estimate import Estimate
from locclient.robot.health_report import FixFigures
from mapserver import releases
from mapserver.fleet.canary_controller import review
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.canary_test import CanarySettings, number_of
from mapserver.serving.bus_service import BusService
from mapserver.store import DraftContent, MapStore
from support.estimator.simulated_run import EstimatorSession
from support.storage.map_samples import draft_details

SITE, SHIFT_M, AISLE_Y_M = "hall", np.array([0.5, 0.0, 0.0]), 3.8
_NS = 1_000_000_000
_MAX_S = 3 * 3600


def shifted(tile: Tile) -> Tile:
    """The tile with everything of the aisle at small y moved along it."""
    points, places = tile.points_map.copy(), tile.map_from_cam.copy()
    points[points[:, 1] < AISLE_Y_M] += SHIFT_M
    places[places[:, 1, 3] < AISLE_Y_M, :3, 3] += SHIFT_M
    return replace(tile, points_map=points, map_from_cam=places)


def health_series(session: EstimatorSession, estimates: list[Estimate]) -> list[tuple[str, dict[str, float]]]:
    """What a robot would have said, second by second: status and figures. It knows no truth."""
    said: list[tuple[str, dict[str, float]]] = []
    figures = FixFigures()
    has_fix = False
    for number, estimate in enumerate(estimates):
        figures.handle(estimate, None)
        has_fix = has_fix or estimate.fix is not None
        if session.session.frame_times_s[number] >= len(said) + 1:
            told = {name: float(value) for name, value in figures.take().items() if value is not None}
            said.append(
                (estimate.status.value, told | {"frames": float(number)} | ({"first_fix_s": 1.0} if has_fix else {}))
            )
    return said


def record() -> dict[int, list[tuple[str, dict[str, float]]]]:
    """Health by version: 1 is the good map, 2 the bad one; with its tiles' errors checked against the truth."""
    sessions = [prepare(Order("small-loop")), prepare(Order("small-loop", robot="tote-1", day=1))]
    for session in sessions:
        session.renderer.close()
    survey, robot = (EstimatorSession(session) for session in sessions)
    (tile,), vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(0))
    found = {}
    for version, used in ((1, tile), (2, shifted(tile))):
        estimates = estimator_loop.run_localizer(robot, estimator_loop.map_view(robot, [used], vocabulary))
        errors = estimator_loop.position_errors_m(estimates, robot.map_from_body)
        print(f"version {version}: errors median {np.median(errors):.3f} m, largest {errors.max():.3f} m", flush=True)
        found[version] = health_series(robot, estimates)
    return found


def publish(folder: Path, clock: dict[str, int]) -> MapStore:
    """A store with a current version 1 and a draft 2."""
    store = MapStore.open(folder, create=True, clock_ns=lambda: clock["ns"])
    rng = np.random.default_rng(0)
    from support.storage.map_samples import random_tile

    for _ in range(2):
        store.save_draft(
            SITE, DraftContent(tiles=[random_tile(rng)], vocabulary=b"words" * 50, details=draft_details(path_m=40.0))
        )
    releases.publish(store, SITE, 1)
    return store


def bench(robots: int, share: float) -> dict[str, Any]:
    """Minutes and failures until the bad version is taken back, and who saw it."""
    series = record()
    clock = {"ns": 1_767_000_000 * _NS}
    names = [f"robot-{n}" for n in range(robots)]
    told: dict[str, list[int | None]] = {name: [] for name in names}

    def hear(key: str, payload: bytes) -> None:
        told[key.split("/")[3]].append(decode_message(payload, WantedVersion).version)

    with tempfile.TemporaryDirectory() as name, publish(Path(name), clock) as store, MemoryBus(MemoryHub()) as bus:
        fleet = Fleet(store, clock_ns=lambda: clock["ns"])
        service = BusService(store, fleet, bus, lambda *_: None)
        bus.subscribe(robot_key(SITE, "*", "wanted"), hear)
        for robot in names:
            fleet.take_question(SITE, robot)
        service.announce_changes()
        _drive(fleet, names, told, series, clock, 120)
        begun_ns = clock["ns"]
        canary = releases.start_canary(store, SITE, 2, share)
        members = {robot for robot in names if number_of(SITE, 2, robot) < canary.threshold}
        service.announce_changes()
        findings = []
        while not findings and clock["ns"] - begun_ns < _MAX_S * _NS:
            _drive(fleet, names, told, series, clock, 10)
            findings = review(store, CanarySettings(), clock["ns"])
        service.announce_changes()
        assert findings and findings[0].action == "roll_back", "the bad version was not taken back"
        assert {robot for robot, versions in told.items() if 2 in versions} == members
        assert all(versions[-1] == 1 for versions in told.values())
        (row,) = store.canaries(SITE)
        service.close()
    return {
        "robots": robots, "members": len(members), "minutes": (clock["ns"] - begun_ns) / _NS / 60,
        "canary_events": findings[0].canary.events, "canary_robot_days": findings[0].canary.robot_days,
        "others_events": findings[0].others.events, "others_robot_days": findings[0].others.robot_days,
        "evidence": findings[0].evidence, "reason": row.outcome,
    }  # fmt: skip


def _drive(
    fleet: Fleet, names: list[str], told: dict[str, list[int | None]],
    series: dict[int, list[tuple[str, dict[str, float]]]], clock: dict[str, int], seconds: int,
) -> None:  # fmt: skip
    """Everybody says what was recorded with the version that it was told to run."""
    for _ in range(seconds):
        clock["ns"] += _NS
        for number, robot in enumerate(names):
            version = told[robot][-1] or 1
            said = series[version]
            status, figures = said[(clock["ns"] // _NS + 7 * number) % len(said)]
            health = RobotHealth(
                site=SITE, robot=robot, stamp_ns=clock["ns"], wall_ns=clock["ns"], version=version, status=status,
                metrics=dict(figures),
            )  # fmt: skip
            fleet.take_health(SITE, robot, health)
    fleet.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--share", type=float, default=0.05)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = bench(options.robots, options.share)
    for key, value in found.items():
        print(f"  {key:20} {value}")
    about = {"machine": platform.machine(), "cores": os.cpu_count(), "command": sys.argv}
    print(json.dumps(about | found))
    if options.out is not None:
        options.out.write_text(json.dumps(about | found, indent=2) + "\n")


if __name__ == "__main__":
    main()
