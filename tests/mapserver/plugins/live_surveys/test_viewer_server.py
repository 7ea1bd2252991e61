"""The server against viewers of another library: several at once, some that do not read; and `mapserver live` as a process."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import se3, so3_exp
from fleetmap.messages import EstimateMessage, Placement
from fleetmap.plugins.viewer_channels import channels
from fleetmap.plugins.viewer_channels.channels import ChannelMessage, Shown
from mapserver.cli import app
from mapserver.plugins.live_surveys.command import viewer_address
from mapserver.plugins.live_surveys.message import LiveSurveyState
from mapserver.plugins.live_surveys.viewer_server import FoxgloveServer, LiveViewer
from support.fleet.foxglove_client import FoxgloveClient
from support.fleet.foxglove_schemas import decoded, matrix
from support.recordings.recording_samples import make_sample, write_mcap

FREE = ("127.0.0.1", 0)
TURNED = se3(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([1.0, -2.0, 3.0]))
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
HANGING = """
import json, os, signal, sys
from websockets.sync.client import connect
with connect(sys.argv[1], subprotocols=["foxglove.sdk.v1"]) as viewer:
    viewer.recv(), viewer.recv()
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": int(sys.argv[2])}]}))
    viewer.recv()
    print("hangs", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
"""


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with FoxgloveServer(*FREE, "hall") as made:
        yield made


def place(stamp_ns: int) -> Shown:
    return Shown("/fixes", stamp_ns, lambda: channels.place("/fixes", stamp_ns, np.eye(4)))


def is_shown(server: FoxgloveServer) -> bool:
    return server._channels["/fixes"].has_sinks()


@contextmanager
def looking(server: FoxgloveServer) -> Iterator[FoxgloveClient]:
    """The first viewer that looks at fixes."""
    assert not is_shown(server)
    with FoxgloveClient(server.url) as viewer:
        viewer.subscribe(["/fixes"])
        while not is_shown(server):
            time.sleep(0.01)
        yield viewer


def test_viewers_get_what_stands_there_and_what_comes(server: FoxgloveServer) -> None:
    server.show([Shown.now(channels.points(5, POINTS))])
    with FoxgloveClient(server.url) as first, FoxgloveClient(server.url) as second:
        assert first.info["name"] == "hall"
        assert first.info["capabilities"] == []
        for viewer in (first, second):
            viewer.subscribe(["/map"])
            ((stamp_ns, cloud),) = viewer.wait_for("/map")
            assert stamp_ns == 5
            np.testing.assert_array_equal(np.frombuffer(cloud.data, "<f4").reshape(-1, 3), POINTS)
        server.show([place(6)])
        for viewer in (first, second):
            viewer.subscribe(["/fixes"])
            assert viewer.wait_for("/fixes")[0][0] == 6


def test_nothing_is_made_that_nobody_looks_at(server: FoxgloveServer) -> None:
    make = Mock(return_value=channels.place("/fixes", 1, np.eye(4)))
    assert not is_shown(server)
    server.show([Shown("/fixes", 1, make)] * 3)
    time.sleep(0.2)
    make.assert_not_called()
    with FoxgloveClient(server.url) as viewer:
        viewer.subscribe(["/fixes"])
        viewer.wait_for("/fixes")
        make.assert_called_once()
        assert is_shown(server)


def test_a_message_that_cannot_be_made_ends_nothing(server: FoxgloveServer) -> None:
    faults = RecordingError("an image is damaged; leave it out"), ZeroDivisionError()
    with looking(server) as viewer:
        server.show([*(Shown("/fixes", n, Mock(side_effect=fault)) for n, fault in enumerate(faults, 1)), place(3)])
        assert viewer.wait_for("/fixes")[0][0] == 3


def test_a_viewer_that_hangs_keeps_nobody_waiting() -> None:
    """It reads no more while 60 MB are shown; another viewer gets them all, giving them takes no time, nor does the end."""
    data = os.urandom(60_000)
    with ExitStack() as stack:
        server = stack.enter_context(FoxgloveServer(*FREE, "hall"))
        server.show([Shown.now(channels.jpeg("/camera", 0, data))])
        with FoxgloveClient(server.url, within_s=60.0) as viewer:
            viewer.subscribe(["/camera"])
            viewer.wait_for("/camera")
            words = [sys.executable, "-c", HANGING, server.url, str(viewer.channels["/camera"]["id"])]
            hanging = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
            try:
                assert hanging.stdout.readline() == "hangs\n"
                spent_s = 0.0
                for number in range(1, 1001):
                    begun_s = time.thread_time()
                    server.show([Shown.now(channels.jpeg("/camera", number, data))])
                    spent_s += time.thread_time() - begun_s
                    if number % 20 == 0:
                        viewer.read(0.02)
                viewer.wait_until("/camera", 1000)
                got = len({stamp_ns for stamp_ns, _ in viewer.messages["/camera"]})
                assert got > 100
                assert got + server.dropped >= 1001 - 256, "what did not come was counted, or left its queue"
                assert spent_s < 2.0
                begun_s = time.monotonic()
                stack.close()
                assert time.monotonic() - begun_s < 10.0
            finally:
                hanging.kill()
                hanging.wait(10)
                hanging.stdout.close()


def test_what_comes_too_quickly_is_dropped_and_counted(server: FoxgloveServer) -> None:
    release = []

    def slow() -> ChannelMessage:
        while not release:
            time.sleep(0.01)
        return channels.place("/fixes", 1, np.eye(4))

    with looking(server) as viewer:
        server.show([Shown("/fixes", 1, slow)])
        time.sleep(0.2)
        server.show(place(stamp_ns) for stamp_ns in range(2, 102))
        assert server.dropped == 100 - 32
        release.append(True)
        assert [stamp_ns for stamp_ns, _ in viewer.wait_for("/fixes", 33)] == [1, *range(70, 102)]


def test_surveys_are_shown_in_their_own_frame_or_in_the_map() -> None:
    estimate = EstimateMessage(
        stamp_ns=6, status="TRACKING", map_version=None, odom_from_base=Placement.of(TURNED), map_from_odom=Placement.of(TURNED),
        cov_rot_trans=None,
    )  # fmt: skip
    plain = {
        "site": "hall", "recording": "monday", "stamp_ns": 7, "phase": "tracking", "seconds": 2.0, "frames": 40, "keyframes": 2,
        "path_m": np.array([[0, 1], [2, 3]], "<f4").tobytes(), "quality": b"\xff\xff", "landmarks_m": np.array([[4, 5]], "<f4").tobytes(),
        "loops_m": np.array([[0, 1, 2, 3]], "<f4").tobytes(),
    }  # fmt: skip
    told: list[list[Shown]] = []
    rig = SimpleNamespace(base_from_body=np.eye(4), body_from_cam=np.eye(4), camera=None)
    viewer = LiveViewer(SimpleNamespace(show=told.append), SimpleNamespace(calibration=rig, rectifier=rig))
    for at in (estimate, estimate, None):
        viewer.tell(LiveSurveyState(**plain, estimate=at))
    first = {shown.topic: decoded(shown.make()) for shown in told[0]}
    assert set(first) == {"/survey/landmarks", "/survey/path", "/survey/revisits", "/survey/robot", "/log", "/tf"}
    np.testing.assert_array_equal(np.frombuffer(first["/survey/landmarks"].data, "<f4"), [4, 5, 0])
    assert [(p.position.x, p.position.y) for p in first["/survey/path"].poses] == [(0, 1), (2, 3)]
    line = first["/survey/revisits"].entities[0].lines[0]
    assert (line.type, [(p.x, p.y) for p in line.points]) == (2, [(0, 1), (2, 3)])
    np.testing.assert_allclose(matrix(first["/survey/robot"].entities[0].arrows[0].pose), TURNED @ TURNED, atol=1e-12)
    links = {(link.parent_frame_id, link.child_frame_id) for link in first["/tf"].transforms}
    assert links == {("survey", "odom"), ("odom", "base_link"), ("base_link", "camera")}
    assert "/log" not in {shown.topic for shown in told[1]}, "its status is the same"
    assert {shown.topic for shown in told[2]} == {"/survey/landmarks", "/survey/path", "/survey/revisits", "/log"}


def test_addresses() -> None:
    assert viewer_address("8765", insecure=False) == ("127.0.0.1", 8765)
    assert viewer_address("localhost:0", insecure=False) == ("localhost", 0)
    assert viewer_address("[::1]:9", insecure=False) == ("::1", 9)
    assert viewer_address("0.0.0.0:1", insecure=True) == ("0.0.0.0", 1)
    for text in ("", "x", "127.0.0.1", "70000", "-1", "1:", "127.0.0.1:x", "²"):
        with pytest.raises(UsageError, match="write it like 8765"):
            viewer_address(text, insecure=False)
    for text in ("0.0.0.0:1", "maps.example:1", "[::]:1"):
        with pytest.raises(UsageError, match="--insecure"):
            viewer_address(text, insecure=False)


@contextmanager
def live(recording: Path, store: Path, *given: str) -> Iterator[FoxgloveClient]:
    """What a viewer sees of a survey, which must end well."""
    words = ["live", str(recording), "--site", "lab", "--store", str(store), "--foxglove", "0", *given]
    command = [sys.executable, "-m", "mapserver.cli", *words]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        url = process.stdout.readline().removeprefix("foxglove: ").strip()
        with FoxgloveClient(url, within_s=240.0) as viewer:
            yield viewer
        process.stdout.read()
        assert process.wait(240) == 0
    finally:
        process.kill()
        process.wait(30)
        process.stdout.close()


@pytest.mark.timeout(900)
def test_the_map_grows_before_the_viewers_eyes(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "walk", make_sample(24))
    with live(recording, tmp_path / "maps") as viewer:
        viewer.subscribe(["/survey/path", "/survey/landmarks", "/camera", "/camera/matches", "/camera/calibration"])
        image = viewer.wait_for("/camera")[0][1]
        picture = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        lens = viewer.wait_for("/camera/calibration")[0][1]
        assert picture.shape == (lens.height, lens.width)
        count, dots = 0, []
        while not dots:
            count += 1
            dots = viewer.wait_for("/camera/matches", count)[-1][1].points[0].points
        assert all(0 <= dot.x < lens.width and 0 <= dot.y < lens.height for dot in dots)
        path = viewer.wait_for("/survey/path")[-1][1]
        while len(path.poses) < 2:
            path = viewer.wait_for("/survey/path", len(viewer.messages["/survey/path"]) + 1)[-1][1]
        assert path.frame_id == "survey"
        assert len(viewer.wait_for("/survey/landmarks")[-1][1].data) % 12 == 0


@pytest.mark.parametrize(("given", "words"), [("x", "8765"), ("0.0.0.0:0", "--insecure"), ("TAKEN", "cannot listen")])
def test_wrong_orders_are_told_before_the_drive(tmp_path: Path, given: str, words: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = str(taken.getsockname()[1]) if given == "TAKEN" else given
        asked = ["live", str(tmp_path / "none"), "--site", "lab", "--store", str(tmp_path / "maps"), "--foxglove"]
        done = CliRunner().invoke(app, [*asked, address])
    assert isinstance(done.exception, UsageError)
    assert words in str(done.exception)
