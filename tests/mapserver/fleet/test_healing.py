"""A place that heals by itself: failures gather, robots survey it, a build mends it, and the figures say whether it helped."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.failure_summary import ReplayPart
from fleetmap.messages import Placement
from mapserver import releases
from mapserver.cli import app
from mapserver.fleet import healing
from mapserver.fleet.canary_controller import review
from mapserver.fleet.healing import heal
from mapserver.fleet.resurvey_list import courses_of
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.floor_plan.survey_requests import ASKED, KIND, TILES, courses
from mapserver.nightly import robot_drives
from mapserver.nightly.robot_drives import RobotDrives
from mapserver.quality.gate import GateSettings
from mapserver.store import Actor, DraftContent, FleetBatch, MapStore
from support.fleet.reports import blindness
from support.storage.map_samples import draft_details, random_tile, save_sample_draft

ON, NIGHT, HOUR = ResurveySettings(requests=True), Actor("nightly"), 490_000
DATA = bytes(range(256)) * 40


class Scene:
    """Site lab, whose robots began to fail in tile 1,0 in the last hours; share: of them that try versions first."""

    def __init__(self, folder: Path) -> None:
        self.hour = float(HOUR)
        self.store = MapStore.open(folder / "store", create=True, clock_ns=lambda: int(self.hour * HOUR_NS))
        save_sample_draft(self.store)
        releases.publish(self.store, "lab")
        self.drive(HOUR - 24 * 7, 2, 100.0)
        self.drive(HOUR - 3, 20, 10.0)
        self.inbox = folder / "inbox"
        self.share: float | None = None
        self.nights: Any = SimpleNamespace(inbox=self.inbox, start=self.night)
        self.drives = RobotDrives(self.store, self.nights)

    def drive(self, hour: int, failures: int, hours: float, tile: str = "1,0") -> None:
        batch, driven_ms = FleetBatch(), round(hours * 3.6e6)
        found = Counters(failures=failures, driving_ms=driven_ms, judged_ms=driven_ms, found_ms=round(0.8 * driven_ms))
        batch.add("lab", "tile", tile, hour, found)
        self.store.fleet.add(batch)

    def hand_in(self, name: str) -> str:
        """A whole drive for the open request; the refusal."""
        (request,) = self.store.survey_requests("lab")
        part = ReplayPart(id=name, offset=0, data=DATA, survey=request.id, total_bytes=len(DATA))
        return self.drives.take("lab", "r1", part).refused or ""

    def night(self, site: str) -> None:
        """What a night does with the drives, but for the building: a draft that covers the request is published or tried."""
        said = {"surveyed_requests": {request.id: 0.97 for request in self.store.survey_requests(site)}}
        tiles = [random_tile(np.random.default_rng(5), cell=cell) for cell in ((1, 0), (0, 0))]
        details = draft_details(path_m=12.5, **said)
        content = DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=details, archive=b"archive")
        version = self.store.save(site, content).version
        releases.publish_or_try(self.store, site, version, self.share, actor=NIGHT, gate=GateSettings())
        for path in (self.inbox / site).iterdir():
            path.unlink()


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.setattr(robot_drives, "SETTLE_S", -1e12)  # files are younger than the scene's clock
    made = Scene(tmp_path)
    for number, x in enumerate((21.0, 23.5, 22.0)):
        place = Placement(position_m=(x, 4.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
        report = blindness(f"f{number}", f"r{number}", tile=(1, 0), map_from_base=place)
        made.store.fleet.add_failure(report, (made.store.now_ns(), made.store.now_ns()), {})
    yield made
    made.store.close()


def test_failures_become_a_request_a_version_and_a_line_of_the_log(scene: Scene, tmp_path: Path) -> None:
    store = scene.store
    heal(store, ResurveySettings(), store.now_ns())
    assert store.survey_requests("lab") == [], "not without the setting"
    for _ in range(2):
        heal(store, ON, store.now_ns())
    (request,) = store.survey_requests("lab")
    assert request.corners_map_m == [[18.0, 1.0], [26.5, 1.0], [26.5, 7.0], [18.0, 7.0]], (
        "around the failures, in the tile"
    )
    assert (request.actor, "20 failures in 10.0 h of driving" in request.reason) == ("server", True)
    scene.hour += 0.5
    assert scene.hand_in("ab12ab12") == ""
    scene.drives.build()
    current = store.current("lab")
    assert current is not None and (current.version, store.survey_requests("lab")) == (2, [])
    scene.drive(HOUR, 5, 1.0)  # the hour of the change
    scene.drive(HOUR + 1, 1, 8.0)
    scene.drive(HOUR + 2, 0, 4.0, tile="0,0")
    scene.hour += 6
    heal(store, ON, store.now_ns())
    assert store.survey_requests("lab") == [], "failures of before the survey ask for no other one"
    words = "before 20 in 10.0 h of driving, localised 80.0%; since 1 in 8.0 h of driving, localised 80.0%"
    (course,) = courses_of(store, "lab", ON, store.now_ns())
    assert (course.effect, course.told_ns, course.robots) == (words, 0, ["r1"])
    shown = CliRunner().invoke(app, ["fleet", "resurvey", "--site", "lab", "--store", str(tmp_path / "store")])
    assert shown.exit_code == 0, shown.output
    scene.hour += 24
    for _ in range(2):
        heal(store, ON, store.now_ns())
    logged = [event.detail for event in store.events("lab") if event.kind == f"survey request {request.id}"]
    assert [line.partition(" ")[0] for line in logged] == ["asked", "driven", "done:", "failures"]
    assert logged[-1] == f"failures there: {words}"


def test_a_mended_version_is_tried_first_and_taken_back_as_any(scene: Scene) -> None:
    store, share = scene.store, 0.5
    for robot in ("r1", "r2", "r3", "r4"):
        store.record_robot_report("lab", robot, {})
    scene.share, scene.drives = share, RobotDrives(store, scene.nights, waits=True)
    heal(store, ON, store.now_ns())
    assert scene.hand_in("ab12ab12") == ""
    scene.drives.build()
    (trial,) = store.canaries(running=True)
    current = store.current("lab")
    assert current is not None and (trial.version, current.version, len(store.survey_requests("lab"))) == (2, 1, 1)
    assert scene.hand_in("cd12cd12") == ""
    scene.drives.build()
    assert len(store.versions("lab")) == 2, "its drive waits for the end of the trial"
    scene.hour += 24 * 7
    (finding,) = review(store, CanarySettings(), store.now_ns())
    assert (finding.action, store.version("lab", 2).state) == ("roll_back", "retired")
    assert len(store.survey_requests("lab")) == 1, "the place is not mended"
    for robot in ("r1", "r2"):
        store.record_robot_report("lab", robot, {})
    scene.drives.build()
    assert [trial.version for trial in store.canaries(running=True)] == [3]


def test_neither_robots_nor_another_site_end_it_or_ask_for_more(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A damaged site, a place outside its tile, and a tile where one robot of several fails."""
    store, usual = scene.store, healing.resurvey_list
    save_sample_draft(store, site="damaged")
    releases.publish(store, "damaged")
    monkeypatch.setattr(healing, "resurvey_list", lambda _, site, *given: usual(store, site[:3], *given))
    scene.drive(HOUR - 24 * 7, 2, 100.0, tile="0,0")
    scene.drive(HOUR - 3, 20, 10.0, tile="0,0")
    place = Placement(position_m=(60.0, -1e300, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
    for name, tile in (("far", (1, 0)), ("alone", (0, 0))):
        store.record_robot_report("lab", name, {})
        store.fleet.add_failure(
            blindness(name, name, tile=tile, map_from_base=place), (store.now_ns(), store.now_ns()), {}
        )
    heal(store, ON, store.now_ns())
    (request,) = store.survey_requests("lab")
    assert request.corners_map_m == [[18.0, 0.0], [31.99, 0.0], [31.99, 7.0], [18.0, 7.0]], "within the tile"


def test_an_area_may_be_called_as_tiles_are() -> None:
    words = f"{ASKED}通路, tiles 3, 40 m2 around 3.0, 4.0 m{TILES}1,0 2,0"
    (course,) = courses([(5, f"{KIND}ab", words)])
    assert (course.place, course.tiles) == ("通路, tiles 3, 40 m2 around 3.0, 4.0 m", ["1,0", "2,0"])
