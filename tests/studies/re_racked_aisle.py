"""A re-racked aisle that passing robots mend: their drives, the builds of each hour, and bad drives of others. All is rendered."""

import os
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from benchmarks.common.recorded_runs import SITE, mapped
from fleetmap.errors import FleetmapError
from fleetmap.failure_definition import is_wrong
from fleetmap.geometry import inside_rings, rotation_angle_rad
from fleetmap.messages import Status
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.recordings.images import StoredFrame, jpeg_image
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.samples import Trajectory
from fleetmap.sources.source import ReplaySource
from fleetsim.motion import Route
from fleetsim.recorder import Order, record_order
from fleetsim.scenarios import SCENARIOS, Run, Scenario
from fleetsim.scene import layout as layouts
from fleetsim.scene.layout import Layout, Slot
from fleetsim.sensors import START_NS
from locclient.delivery.survey_drives import SurveyDrives
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from locclient.replay import run_metrics
from locclient.replay.replay import ReplayOptions, replay, starts
from mapserver.config import MapserverConfig
from mapserver.fleet.building import ask_for_survey
from mapserver.fleet.fleet import Fleet
from mapserver.nightly.robot_drives import RobotDrives
from mapserver.plugins.nightly_builds.night import NightRequest, last_report, run_night
from mapserver.serving.bus_service import BusService
from mapserver.store import Actor, MapStore
from studies.study import PAGES, Column, Row, publish, results, table
from support.fleet.memory_bus import MemoryBus, MemoryHub

SEEDS = (1013, 2027)
WORK = PAGES.parents[1] / "out" / "re_racked_aisle"
SCENARIO, AISLE, HOUR_NS = "re-racked-aisle", 1, 3600 * 10**9
_USUAL = layouts.last_restock_day
BEFORE = Layout(aisles=3, bays=5, restock_per_day=0.06)
AFTER = Layout(aisles=3, bays=5, restock_per_day=0.06, moved_rows=((2, 0.35), (3, -0.35)))
_OTHER_LENS = np.array([1.25, 1.25, 1.0, 1.0])  # of fx, fy, cx, cy
_EVERY = 3  # frames in the aisle, about 0.75 m, between places where robots are switched on
ASKED_NS = START_NS - HOUR_NS  # recordings of the simulator begin at one moment: all of them after the request


# What happens, and the faults of bad drives of that hour; drives are handed in where there is one
HOURS = (
    ("as mapped", ""), ("re-racked", ""), ("first pass", "cameras"), ("second pass", "other-imu"), ("third pass", "rig"),
    ("after three passes", "baseline"), ("lifted", "lifted"),
)  # fmt: skip
BAD = {
    "cameras": "cameras exchanged", "baseline": "cameras stated 3 % too near to each other",
    "other-imu": "IMU of the drive before, along the same way",
    "rig": "calibration of another lens", "lifted": "lifted in the aisle and carried 6 m on",
}  # fmt: skip
_X0, _X1, _Y = BEFORE.bay_x_m(0), BEFORE.bay_x_m(BEFORE.bays), BEFORE.aisle_y_m(AISLE)
# The aisle, with the fronts of its racks
RING = [(_X0, _Y - 1.7), (_X1, _Y - 1.7), (_X1, _Y + 1.7), (_X0, _Y + 1.7)]


def restocked(layout: Layout, seed: int, day: int, slot: Slot) -> int:
    """As `last_restock_day`; all stock of the aisle is exchanged on the first day."""
    return max(_USUAL(layout, seed, day, slot), int(slot.row // 2 == AISLE and day > 0))


def scenario(name: str, *, is_changed: bool, is_lifted: bool) -> Scenario:
    """The site, and a robot that goes through the re-racked aisle between the two others. The survey of the first map is such a drive."""
    layout = AFTER if is_changed else BEFORE
    y, left, right = [layout.aisle_y_m(aisle) for aisle in range(3)], 2.7, layout.length_m - 2.7
    ways = [(left, y[0]), (right, y[0]), (right, y[1]), (left, y[1]), (left, y[2]), (left + 8.0, y[2])]
    routes: tuple[Route, ...] = (Route(tuple(ways)),)
    if is_lifted:
        middle = layout.length_m / 2
        routes = Route((*ways[:3], (middle + 3.0, y[1]))), Route(((middle - 3.0, y[1] + 0.2), *ways[3:]))
    return Scenario("", layout, {name: Run("tote", routes, 8.0)})


def record(seed: int, name: str, *, is_changed: bool = True, is_lifted: bool = False) -> Path:
    """Recording of a run; each name drives a little differently."""
    path = WORK / f"recordings-{seed}" / f"{name}.mcap"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        made = {SCENARIO: partial(scenario, name, is_changed=is_changed, is_lifted=is_lifted)}
        with patch.dict(SCENARIOS, made), patch.object(layouts, "last_restock_day", restocked):
            record_order(Order(SCENARIO, seed=seed, day=int(is_changed), robot=name), path.with_suffix(".part"))
        path.with_suffix(".part").rename(path)
    return path


class Robot:
    """A robot with `surveys = true` on the bus: it localizes, and keeps its drives through requested areas. An export of `replay`."""

    def __init__(self, link: MapClient, source: ReplaySource, folder: Path) -> None:
        self.drives = SurveyDrives(folder, source.calibration)
        self._before = source.samples_before_each()
        link.wanted()
        self.drives.requests = link.surveys

    def begin(self, *_: Any) -> None:
        """Nothing of the map is kept."""

    def handle(self, frame: Any, outcome: Any) -> None:
        """Take a frame with the samples before it."""
        self.drives.handle(replace(next(self._before), frame=frame), outcome.estimate)
        self.drives.work()


def is_off(estimate: Estimate, truth: Trajectory | None) -> bool:
    """True for a pose that is stated as known, and beyond the limits of a failure."""
    place = None if truth is None else truth.at(estimate.stamp_ns)
    if place is None or estimate.map_from_body is None or estimate.status is not Status.TRACKING:
        return False
    off = np.linalg.inv(place) @ estimate.map_from_body
    return is_wrong(float(np.linalg.norm(off[:3, 3])), rotation_angle_rad(off[:3, :3]))


class Site:
    """Server and inbox of a site. A night of a drive is what `mapserver serve` starts, in this process."""

    def __init__(self, folder: Path, hour: int) -> None:
        self.folder, self.said = folder, list[Any]()
        self.store = MapStore.open(folder / "store", clock_ns=lambda: ASKED_NS + hour * HOUR_NS)
        nights: Any = SimpleNamespace(inbox=folder / "inbox", start=self._night)
        self.intake, self.hub = RobotDrives(self.store, nights), MemoryHub()
        bus, fleet = MemoryBus(self.hub), Fleet(self.store)
        self.service = BusService(self.store, fleet, bus, lambda *_: None, take_drive=self.intake.take)

    def client(self, robot: str) -> MapClient:
        return MapClient(MemoryBus(self.hub), TileCache(self.folder / "cache" / robot), SITE, robot)

    def passed(self, recording: Path, robot: str) -> Row:
        """A robot's pass, with what it localizes; its drive waits in its folder."""
        link = self.client(robot)
        with open_recording(recording) as opened:
            source = ReplaySource.of(opened, FrameSelection.parse(":"), reverse=False)
            export = Robot(link, source, self.folder / "drives" / robot)
            done = replay(source, link, ReplayOptions(LocalizerSettings(), export=export))
            places = np.array([truth[:2, 3] for truth in done.truths if truth is not None])
            there = inside_rings(places, [np.array(RING)])
            looks = list(starts(source, np.flatnonzero(there)[::_EVERY].tolist(), done.loaded, LocalizerSettings()))
            woken = [(e, is_off(e, opened.ground_truth)) for look in looks for e in look]
        export.drives.finish()
        in_aisle = [frame for frame, is_there in zip(done.frames, there, strict=True) if is_there]
        errors = run_metrics.error_m(in_aisle)
        return {
            "version": done.loaded.version, "in_aisle": float(np.mean(np.array(run_metrics.localised(done.frames))[there])),
            "p99_mm": errors and 1e3 * errors["p99"], "failures": run_metrics.position_failures(done.frames),
            "silent": run_metrics.silent_failures(done.frames), "starts": len(looks),
            "found": sum(look[-1].status is Status.TRACKING for look in looks),
            "woken": float(np.mean([estimate.status is Status.TRACKING for estimate, _ in woken])),
            "wrong": sum(is_bad for _, is_bad in woken),
        }  # fmt: skip

    def send(self, recording: Path, robot: str) -> None:
        """Hand in a file as a robot's drive, as robots do."""
        (request,), data = self.store.survey_requests(SITE), recording.read_bytes()
        folder = self.folder / "sent" / f"{robot}-{len(data)}"
        folder.mkdir(parents=True)
        (folder / f"{request.id}-{len(data):012x}.mcap").write_bytes(data)
        with open_recording(recording) as opened:
            drives = SurveyDrives(folder, opened.calibration)
        while drives.deliver_part(self.client(robot)):
            pass

    def build(self) -> Row:
        """What the server's periodic work builds of the drives, and what became of each."""
        with patch.object(self.store, "now_ns", lambda: time.time_ns() + 10**12):  # all drives lie there long enough
            self.intake.build()
        said = self.said.pop()
        return {
            "version": said["version"], "published": said["published"], "is_open": bool(self.store.survey_requests(SITE)),
            "fates": {r["name"]: [r["fate"], r["reason"].rpartition(f"{SITE}/")[2]] for r in said["recordings"]},
        }  # fmt: skip

    def _night(self, site: str) -> None:
        request = NightRequest(site, self.folder / "inbox" / site, self.folder / "store", time.time_ns() + 10**12, 0.0)
        try:
            run_night(request, MapserverConfig().gate, Console(stderr=True))
        except FleetmapError as error:
            print(error)
        self.said.append(last_report(self.folder / "store", site))


def spoilt(folder: Path, kind: str, source: Path, before: Path) -> Path:
    """A copy of a good drive with a fault of the robot that made it. before: recording of another drive along its way."""
    out = folder / f"{kind}.mcap"
    with open_recording(source) as good, open_recording(before) as other:
        rig, imu = good.calibration, good.imu
        left, right = rig.cameras
        if kind == "other-imu":
            imu = other.imu.between(int(imu.stamps_ns[0]), int(imu.stamps_ns[-1]) + 1)
        if kind == "rig":
            cameras = [replace(each, intrinsics_px=each.intrinsics_px * _OTHER_LENS) for each in rig.cameras]
            rig = replace(rig, cameras=tuple(cameras))
        elif kind == "baseline":
            shifted = left.body_from_cam + 0.97 * (right.body_from_cam - left.body_from_cam)
            rig = replace(rig, cameras=(left, replace(right, body_from_cam=shifted)))
        frames = (good.read_frame(number) for number in range(len(good.frame_stamps_ns)))
        sides = ((frame.stamp_ns, jpeg_image(frame.left, 90), jpeg_image(frame.right, 90)) for frame in frames)  # type: ignore[arg-type]
        stored = (StoredFrame(ns, *((b, a) if kind == "cameras" else (a, b)), None) for ns, a, b in sides)
        with McapRecordingWriter(out, rig) as writer:
            writer.write_all(stored, imu, good.wheel, (), None, on_frame=lambda: None)
    return out


def hour(seed: int, number: int) -> Row:
    """A pass of a robot, and what is built in an hour: of a spoilt copy of its drive, then of its drive."""
    folder, name = WORK / str(seed), f"r{number}"
    if number == 0:
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "inbox").mkdir(parents=True)
        mapped(folder / "store", record(seed, "survey", is_changed=False), folder / "survey.json")
    site, faults = Site(folder, number), HOURS[number][1].split()
    path = record(seed, name, is_changed=number > 0, is_lifted="lifted" in faults)
    if faults and not site.store.survey_requests(SITE):
        ask_for_survey(site.store, SITE, RING, Actor("ada", "new racks"))
    row: Row = {"seed": seed, "hour": number} | site.passed(path, name)
    if faults:
        drive, row["bad"] = next((folder / "drives" / name).glob("*.mcap"), None), {}
        for fault in faults if drive is not None else ():
            bad = drive if fault == "lifted" else spoilt(folder, fault, drive, record(seed, f"r{number - 1}"))
            site.send(bad, f"bad-{fault}")
            row["bad"][fault] = site.build()
        if drive is not None and "lifted" not in faults:
            site.send(drive, name)
            row["good"] = site.build()
    site.service.close()
    return row


CASES = {f"site {seed}, hour {number}": partial(hour, seed, number) for seed in SEEDS for number in range(len(HOURS))}
COLUMNS = [
    Column("seed", "site"), Column("what", "hour"), Column("version", "version"), Column("in_aisle", "passing, localised", "{:.1%}"),
    Column("p99_mm", "its p99, mm", "{:.0f}"), Column("found_of", "switched on, found within 3 s"),
    Column("woken", "localised of those 3 s", "{:.1%}"), Column("wrong", "wrong frames"), Column("failures", "failures"),
    Column("silent", "silent"),
]  # fmt: skip


def draw(rows: list[Row]) -> Figure:
    """Shares by the hour, a line for each site."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    titles = {"woken": "switched on in the aisle", "in_aisle": "passing through it"}
    for axes, (key, title) in zip(figure.subplots(1, 2, sharey=True), titles.items(), strict=True):
        for seed in SEEDS:
            own = [row for row in rows if row["seed"] == seed]
            axes.plot([row["hour"] for row in own], [100 * row[key] for row in own], "o-", label=f"site {seed}")
        axes.axhline(98, color="#888888", linestyle="--", linewidth=1, label="98 %")
        axes.set_xticks(range(len(HOURS)), [what for what, _ in HOURS], rotation=35, ha="right", fontsize=8)
        axes.set_title(title, fontsize=10)
        axes.set_ylim(0, 102)
        axes.legend(frameon=False, fontsize=8, loc="lower right")
    figure.axes[0].set_ylabel("localised, % of frames in the aisle")
    return figure


def main() -> None:
    """Rows, tables and picture of docs/studies/re_racked_aisle.md."""
    if os.environ.get("FRESH"):
        shutil.rmtree(WORK, ignore_errors=True)
    rows = results("re_racked_aisle", CASES, SEEDS)
    shown = [row | {"what": HOURS[row["hour"]][0], "found_of": f"{row['found']} of {row['starts']}"} for row in rows]
    bad = [
        {"seed": row["seed"], "what": BAD[fault], "fate": fate, "reason": reason.replace("|", "/")[:240]}
        for row in rows for fault, said in row.get("bad", {}).items() for fate, reason in said["fates"].values()
    ]  # fmt: skip
    columns = [Column("seed", "site"), Column("what", "drive"), Column("fate", "became"), Column("reason", "why")]
    publish("re_racked_aisle", [table(shown, COLUMNS), table(bad, columns)], draw(rows))


if __name__ == "__main__":
    main()
