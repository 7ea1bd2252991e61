"""`serve --foxglove`: viewers see the current map, the robots where they say they are, failures, and a survey under way."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.bus import Bus
from fleetmap.errors import UsageError
from fleetmap.foxglove import ViewerAddress
from fleetmap.foxglove.server import FoxgloveServer
from fleetmap.geometry import se3, so3_exp
from fleetmap.live_survey import LiveSurveyState
from fleetmap.messages import FailureReport, Placement, PoseMessage, Thumbnail, encode_message, robot_key
from mapserver import releases
from mapserver.cli import app
from mapserver.fleet.fleet import Fleet
from mapserver.serving.fleet_viewer import FleetViewer
from mapserver.serving.live_surveys import LiveSurveys
from mapserver.store import MapStore
from support.fleet.foxglove_client import FoxgloveClient
from support.storage.map_samples import save_sample_draft

MAP_FROM_BASE = se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, 4.0, 0.1]))
JPEG = b"\xff\xd8 picture \xff\xd9"


def said(status: str = "TRACKING") -> PoseMessage:
    return PoseMessage.of(7, MAP_FROM_BASE, np.eye(6), status, 1)


def failure(number: int) -> FailureReport:
    picture = Thumbnail(stamp_ns=1, kind="matches", jpeg=JPEG)
    return FailureReport(
        site="lab", robot="r1", id=f"f{number}", stamp_ns=1, wall_ns=time.time_ns(), duration_s=1.0, kind="blind", status="LOST",
        cause="dark", version=1, map_from_base=Placement.of(MAP_FROM_BASE), thumbnails=(picture,),
    )  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "maps", create=True) as made:
        save_sample_draft(made)
        releases.publish(made, "lab")
        yield made


def test_a_site_is_seen_as_it_changes(store: MapStore) -> None:
    fleet, surveys = Fleet(store), LiveSurveys()
    with FoxgloveServer(ViewerAddress("127.0.0.1", 0), "lab") as server:
        view = FleetViewer(store, fleet, surveys, "lab", server)
        for number in range(3):
            assert fleet.take_failure("lab", "r1", failure(number)).refused == ""
        view.look()
        with FoxgloveClient(server.url, within_s=60.0) as early:  # the server's own thread has sent them all then
            early.subscribe(["/failures/report"])
            early.wait_for_one("/failures/report", lambda report: report["id"] == "f2")
        with FoxgloveClient(server.url, within_s=60.0) as viewer:
            viewer.subscribe(["/map", "/failures/report", "/failures/matches", "/robots", "/tf"])
            cloud = viewer.wait_for("/map")[0][1]
            assert len(cloud.data) == 12 * store.manifest("lab", 1).landmarks > 0
            assert viewer.wait_for("/failures/report")[0][1]["id"] == "f2"
            assert viewer.wait_for("/failures/matches")[0][1].data == JPEG
            fleet.take_pose("lab", "r1", said())
            fleet.take_pose("lab", "broken", PoseMessage.of(7, np.full((4, 4), np.nan), np.eye(6), "TRACKING", 1))
            while not (server.wants("/robots") and server.wants("/tf")):
                time.sleep(0.01)
            view.look()
            (entity,) = viewer.wait_for("/robots")[0][1].entities
            assert entity.texts[0].text == "r1: TRACKING"
            (link,) = viewer.wait_for("/tf")[0][1].transforms
            assert (link.parent_frame_id, link.child_frame_id) == ("map", "r1")
            np.testing.assert_allclose([link.translation.x, link.translation.y, link.translation.z], [3.0, 4.0, 0.1])
            assert link.rotation.z == pytest.approx(np.sin(0.25))
            save_sample_draft(store, seed=3)
            releases.publish(store, "lab", 2)
            fleet.take_failure("lab", "r1", failure(3))
            path = np.array([[0, 1], [2, 3]], "<f4").tobytes()
            surveys.take(
                LiveSurveyState(
                    site="lab", recording="monday", stamp_ns=7, phase="tracking", seconds=1.0, frames=2, keyframes=2,
                    path_m=path, quality=b"\xff\xff",
                )
            )  # fmt: skip
            view.look()
            assert len(viewer.wait_for("/map", 2)[1][1].data) == 12 * store.manifest("lab", 2).landmarks
            assert viewer.wait_for("/failures/report", 2)[1][1]["id"] == "f3"
            viewer.subscribe(["/survey/path"])
            path = viewer.wait_for("/survey/path")[0][1]
            assert [(each.position.x, each.position.y) for each in path.poses] == [(0, 1), (2, 3)]
            view.look()
            viewer.read(0.3)
            assert len(viewer.messages["/map"]) == 2, "the same map is not sent again"
            assert len(viewer.messages["/failures/report"]) == 2


def test_a_site_without_a_map_yet_is_waited_for(store: MapStore) -> None:
    with FoxgloveServer(ViewerAddress("127.0.0.1", 0), "yard") as server:
        view = FleetViewer(store, Fleet(store), LiveSurveys(), "yard", server)
        view.look()
        save_sample_draft(store, site="yard")
        view.look()
        releases.publish(store, "yard")
        view.look()
        with FoxgloveClient(server.url, within_s=60.0) as viewer:
            viewer.subscribe(["/map"])
            assert viewer.wait_for("/map")[0][1].data


def test_a_server_shows_what_robots_say_on_the_bus(store: MapStore, tmp_path: Path) -> None:
    given = ["--store", tmp_path / "maps", "--http", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0", "--foxglove", "0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mapserver.cli", "serve", *map(str, given)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        told = dict(process.stdout.readline().strip().split(": ", 1) for _ in range(3))
        assert process.stdout.readline() == "ready\n"
        assert told["foxglove"].startswith("ws://127.0.0.1:")
        with Bus.connect(told["zenoh"]) as bus, FoxgloveClient(told["foxglove"], within_s=60.0) as viewer:
            viewer.subscribe(["/map", "/robots"])
            assert viewer.wait_for("/map")[0][1].frame_id == "map"
            entities = []
            while not entities:
                bus.publish(robot_key("lab", "r1", "pose"), encode_message(said("DEGRADED")))
                entities = viewer.wait_for("/robots", len(viewer.messages.get("/robots", [])) + 1)[-1][1].entities
            arrow = entities[0].arrows[0].pose.position
            assert (entities[0].texts[0].text, arrow.x, arrow.y) == ("r1: DEGRADED", 3.0, 4.0)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait(30)
        process.stdout.close()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--foxglove", "x"], "write it like 8765"),
        (["--foxglove", "0.0.0.0:0"], "--insecure"),
        (["--foxglove", "TAKEN"], "cannot listen there"),
        (["--foxglove-site", "lab"], "--foxglove PORT"),
        (["--foxglove", "0", "--foxglove-site", "a/b"], "a/b"),
        (["--foxglove", "0"], "--foxglove-site"),
    ],
)
def test_wrong_orders_are_told_before_the_work(store: MapStore, tmp_path: Path, given: list[str], words: str) -> None:
    save_sample_draft(store, site="yard")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        asked = [str(taken.getsockname()[1]) if word == "TAKEN" else word for word in given]
        done = CliRunner().invoke(app, ["serve", "--store", str(tmp_path / "maps"), "--http", "127.0.0.1:0", *asked])
    assert isinstance(done.exception, UsageError), done.output
    assert words in str(done.exception)
