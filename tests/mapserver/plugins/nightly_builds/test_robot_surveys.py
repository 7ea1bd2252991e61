"""A re-racked aisle, from the request of an operator to the version in use, with two ordinary robots and no survey robot."""

import io
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from fleetmap.encoding import to_json
from fleetmap.failure_summary import ReplayPart
from fleetmap.messages import FailureAck, SurveyArea, decode_message
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.source import ReplaySource
from locclient.delivery.survey_drives import SurveyDrives
from locclient.localization.settings import LocalizerSettings
from locclient.replay.replay import fetch_map
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings
from mapserver.drafting.draft import BuildOptions
from mapserver.fleet.building import keep_areas
from mapserver.floor_plan.survey_requests import courses
from mapserver.library import build_map, open_map
from mapserver.nightly.robot_drives import RobotDrives
from mapserver.plugins.nightly_builds.night import NightRequest, run_night
from mapserver.quality.gate import GateSettings
from mapserver.store import Actor, MapStore
from support.recordings.recording_samples import START_NS, write_mcap
from support.worlds.box_room import out_and_back, poster, ride_sample

ADA = Actor("ada", "new racks")
RACKS_M = np.array([[-0.4, -1.4], [0.6, 1.4]])
AISLE = [(-0.5, -1.0), (0.7, -1.0), (0.7, 3.3), (-0.5, 3.3)]


def drive(recording: Path, store: Path, area: SurveyArea, folder: Path) -> SurveyDrives:
    """A robot on its way, whose client may survey."""
    with open_recording(recording) as opened:
        source = ReplaySource.of(opened, FrameSelection.parse("::"), reverse=False)
        robot = Robot(Rectifier(source.calibration), LocalizerSettings(), TrialSettings())
        robot.use(fetch_map(store, "lab"))
        drives = SurveyDrives(folder, source.calibration)
        drives.requests = (area,)
        for number, before in enumerate(source.samples_before_each()):
            bundle = replace(before, frame=source.frame(number))
            outcome = robot.handle(bundle)
            drives.handle(bundle, None if outcome is None else outcome.estimate)
            drives.work()
        drives.finish()
    return drives


def test_from_request_to_use_with_two_robots(tmp_path: Path) -> None:
    store, inbox, config = tmp_path / "store", tmp_path / "inbox", GateSettings()
    write_mcap(tmp_path / "survey", ride_sample(out_and_back(9.0, reach_m=4.8, start_m=(-2.4, 0.6, 0.0)), 90, 0.1))
    build_map(tmp_path / "survey", store, "lab", BuildOptions(frame_from_ground_truth=True)).publish(
        trust_calibration=True, actor=ADA
    )
    before = open_map(store, "lab")
    with poster(7, RACKS_M):
        rides = [out_and_back(8.0, reach_m=4.6, start_m=(-2.3, y, 0.1)) for y in (0.5, 0.58)]
        ways = [
            write_mcap(tmp_path / f"way{n}", ride_sample(ride, 80, 0.1, seed=n + 1)) for n, ride in enumerate(rides)
        ]

    def night(site: str) -> None:
        request = NightRequest(site, inbox / site, store, time.time_ns() + 10**12)
        run_night(request, config, Console(file=io.StringIO()))

    clock = SimpleNamespace(now_ns=START_NS - 60 * 10**9)
    nights: Any = SimpleNamespace(inbox=inbox, start=night)
    with MapStore.open(store, clock_ns=lambda: clock.now_ns) as maps:
        properties = {"name": "aisle 7", "correction": {"kind": "forget"}}
        shape = {"type": "Polygon", "coordinates": [[*AISLE, AISLE[0]]]}
        feature = {"type": "Feature", "geometry": shape, "properties": properties}
        areas = to_json({"type": "FeatureCollection", "frame": "map", "features": [feature]})
        keep_areas(maps, "lab", areas, "aisle 7", ADA)
        (request,) = maps.survey_requests("lab")
        area = SurveyArea(id=request.id, corners_map_m=[(x, y) for x, y in request.corners_map_m])
        intake = RobotDrives(maps, nights)
        for number, way in enumerate(ways):
            robot = f"r{number}"
            drives = drive(way, store, area, tmp_path / robot)

            def send(_: str, payload: bytes, robot: str = robot) -> FailureAck:
                return intake.take("lab", robot, decode_message(payload, ReplayPart))

            client: Any = SimpleNamespace(deliver=send)
            clock.now_ns += 20 * 60 * 10**9
            while drives.deliver_part(client):
                pass
            assert not list((tmp_path / robot).iterdir())
        arrived = sorted(path.name for path in (inbox / "lab").iterdir())
        assert [name.split("-")[:3] for name in arrived] == [["survey", request.id, f"r{n}"] for n in range(2)]
        clock.now_ns = time.time_ns() + 10**12  # the drives lie there long enough
        intake.build()
        assert maps.survey_requests("lab") == []
        (course,) = courses((e.stamp_ns, e.kind, e.detail) for e in maps.events("lab"))
        assert (course.robots, course.place.split(",")[0]) == (["r0", "r1"], "aisle 7")
        assert 0 < course.asked_ns < course.driven_ns < course.used_ns
        names = [entry.name for entry in maps.manifest("lab", 2).recordings]
        assert [name.split("-")[0] for name in names] == [request.id] * 2
    after = open_map(store, "lab")
    assert after.version == 2
    there = [
        ((m.points_map[:, :2] > (-0.5, -1.0)) & (m.points_map[:, :2] < (0.7, 3.3))).all(axis=1) for m in (before, after)
    ]
    assert not np.isin(after.landmark_ids[there[1]], before.landmark_ids).any(), "nothing of the old racks"
    assert there[1].sum() > 0.3 * there[0].sum(), "and the new ones"
