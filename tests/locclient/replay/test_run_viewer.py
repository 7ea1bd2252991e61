"""`locclient replay --foxglove` and `--mcap` as a process: what viewers see is where the robot was, whichever moment they go to."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from typer.testing import CliRunner

from fleetmap.errors import UsageError
from fleetmap.foxglove.channels import CHANNELS
from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3
from locclient.cli import app
from mapserver.store import MapStore
from support.fleet.foxglove_client import ENDED, PAUSED, PLAYING, FoxgloveClient
from support.worlds import robot_world

FRAMES, CARRIED_AT = 110, 75
pytestmark = pytest.mark.timeout(600)


class Run(NamedTuple):
    """A replay that has ended and waits for viewers."""

    process: subprocess.Popen[str]
    url: str
    mcap: Path


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store with a map, and the recording of a robot that is put down 2.4 m away."""
    folder = tmp_path_factory.mktemp("room")
    with MapStore.open(folder / "maps", create=True) as store:
        robot_world.save(store)
    return folder / "maps", robot_world.write(folder / "carried", robot_world.carried(FRAMES, CARRIED_AT))


@pytest.fixture(scope="module")
def run(room: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    store, recording = room
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    given = ["--site", "room", "--store", store, "--robot", "r1", "--foxglove", "0", "--mcap", path]
    process = subprocess.Popen(
        [sys.executable, "-m", "locclient.cli", "replay", str(recording), *map(str, given)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        url = process.stdout.readline().removeprefix("foxglove: ").strip()
        said = ""
        while "Ctrl-C" not in said:
            said = process.stdout.readline()
            assert said, "the replay ended"
        yield Run(process, url, path)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait(30)
        process.stdout.close()


def truth(stamp_ns: int) -> Array:
    """Where the robot was."""
    stamps = [bundle.frame.stamp_ns for bundle in robot_world.bundles(FRAMES)]
    return robot_world.truth(stamps.index(stamp_ns))


def map_from_base(message: Any) -> Array | None:
    """From the message of `/tf`; None where the robot is not in the map."""
    known = {
        (link.parent_frame_id, link.child_frame_id): se3(
            rotation_from_quat_wxyz(np.array([link.rotation.w, link.rotation.x, link.rotation.y, link.rotation.z])),
            np.array([link.translation.x, link.translation.y, link.translation.z]),
        )
        for link in message.transforms
    }
    map_from_odom = known.get(("map", "odom"))
    return None if map_from_odom is None else map_from_odom @ known["odom", "base_link"]


def test_a_viewer_goes_to_any_moment(run: Run) -> None:
    with FoxgloveClient(run.url, within_s=60.0) as viewer:
        first_ns = viewer.info["dataStartTime"]["sec"] * 10**9 + viewer.info["dataStartTime"]["nsec"]
        viewer.subscribe(["/map", "/tf", "/camera", "/robots", "/camera/calibration"])
        cloud = viewer.wait_for("/map")[0][1]
        landmarks = np.concatenate([tile.points_map for tile in robot_world.tiles()])
        np.testing.assert_allclose(
            np.frombuffer(cloud.data, "<f4").reshape(-1, 3), landmarks, atol=3e-3
        )  # tiles hold millimetres
        for number in (60, 30, 50):
            at_ns = first_ns + number * 100_000_000
            assert viewer.control(play=False, seek_ns=at_ns).at_ns == at_ns
            message = viewer.wait_until("/tf", at_ns)
            assert np.linalg.norm(map_from_base(message)[:3, 3] - truth(at_ns)[:3, 3]) < 0.05
        image = cv2.imdecode(np.frombuffer(viewer.wait_until("/camera", at_ns).data, np.uint8), cv2.IMREAD_GRAYSCALE)
        lens = viewer.wait_for("/camera/calibration")[0][1]
        assert image.shape == (lens.height, lens.width)
        scene = viewer.wait_until("/robots", at_ns)
        assert [entity.texts[0].text for entity in scene.entities] == ["r1: TRACKING"]


def test_two_viewers_see_the_run_play_to_its_end(run: Run) -> None:
    with FoxgloveClient(run.url, within_s=60.0) as first, FoxgloveClient(run.url, within_s=60.0) as second:
        for viewer in (first, second):
            viewer.subscribe(["/tf", "/failures/report"])
            viewer.wait_for("/tf")
        first_ns = first.info["dataStartTime"]["sec"] * 10**9 + first.info["dataStartTime"]["nsec"]
        assert first.control(play=True, speed=4.0, seek_ns=first_ns).status == PLAYING
        for viewer in (first, second):
            assert viewer.wait_for_playback(ENDED).at_ns == first_ns + (FRAMES - 1) * 100_000_000
            assert viewer.wait_for("/failures/report")[0][1]["cause"] == "carried"
        assert second.control(play=False, seek_ns=first_ns).status == PAUSED


def test_the_mcap_file_holds_the_same(run: Run) -> None:
    seen: dict[str, dict[int, Any]] = {}
    with run.mcap.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        in_file = {channel.topic for channel in reader.get_summary().channels.values()}
        for _, channel, message, decoded in reader.iter_decoded_messages(sorted(in_file - {"/failures/report"})):
            seen.setdefault(channel.topic, {})[message.log_time] = decoded
    assert {"/map", "/tf", "/camera", "/camera/matches", "/fixes", "/robots", "/path", "/log"} <= in_file
    assert {"/failures/log", "/failures/place", "/failures/frame", "/failures/matches", "/failures/report"} <= in_file
    assert len(seen["/camera"]) == len(seen["/tf"]) == FRAMES
    frames = {bundle.frame.stamp_ns: n for n, bundle in enumerate(robot_world.bundles(FRAMES))}
    errors = [
        np.linalg.norm(placed[:3, 3] - truth(stamp_ns)[:3, 3])
        for stamp_ns, message in seen["/tf"].items()
        if frames[stamp_ns] < CARRIED_AT and (placed := map_from_base(message)) is not None
    ]
    assert len(errors) > 50
    assert max(errors) < 0.1
    for stamp_ns, found in seen["/camera/matches"].items():
        assert stamp_ns in seen["/camera"], "they are drawn into the image that they were found in"
        dots, lines = found.points
        ends = np.array([(end.x, end.y) for end in lines.points]).reshape(-1, 2, 2)
        assert len(dots.points) == len(ends) > 10
        assert np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)) < 3.0
    told = [seen["/log"][stamp_ns].message for stamp_ns in sorted(seen["/log"])]
    assert "TRACKING" in told
    with FoxgloveClient(run.url) as viewer:
        viewer.subscribe(in_file)
        assert set(viewer.channels) == set(CHANNELS) > in_file


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--foxglove", "x"], "write it like 8765"),
        (["--foxglove", "0.0.0.0:0"], "--insecure"),
        (["--mcap", "run.txt"], "must end in .mcap"),
        (["--foxglove", "TAKEN"], "cannot listen there"),
    ],
)
def test_wrong_orders_are_told_before_the_work(room: tuple[Path, Path], given: list[str], said: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        words = [str(taken.getsockname()[1]) if word == "TAKEN" else word for word in given]
        done = CliRunner().invoke(app, ["replay", str(room[1]), "--site", "room", "--store", str(room[0]), *words])
    assert isinstance(done.exception, UsageError)
    assert said in str(done.exception)


def test_without_the_library_the_extra_is_named(room: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    given = ["replay", str(room[1]), "--site", "room", "--store", str(room[0]), "--foxglove", "0"]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, UsageError)
    assert "pip install '.[foxglove]'" in str(done.exception)
