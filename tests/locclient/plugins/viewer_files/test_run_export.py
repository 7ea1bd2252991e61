"""`locclient replay --mcap`: what Foxglove opens shows where the robot is."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3
from fleetmap.plugins.viewer_channels.channels import CHANNELS
from locclient.cli import app
from support.room_site import run
from support.worlds import robot_world

FRAMES, CARRIED_AT = 110, 75
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store with a map, and the recording of a robot that is put down 2.4 m away."""
    folder = tmp_path_factory.mktemp("room")
    carried = robot_world.write(folder / "carried", robot_world.carried(FRAMES, CARRIED_AT))
    return robot_world.stored(folder / "maps"), carried


def map_from_base(message: Any) -> Array | None:
    """From the message of `/tf`; None where the robot is not in the map."""
    known = {}
    for link in message.transforms:
        turn, place = (
            [getattr(part, axis) for axis in "wxyz" if hasattr(part, axis)]
            for part in (link.rotation, link.translation)
        )
        known[link.parent_frame_id, link.child_frame_id] = se3(rotation_from_quat_wxyz(np.array(turn)), np.array(place))
    return known["map", "odom"] @ known["odom", "base_link"] if ("map", "odom") in known else None


def test_the_mcap_file_holds_the_same(room: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run(app, "replay", room[1], "--site", "room", "--store", room[0], "--robot", "r1", "--mcap", path)
    seen: dict[str, dict[int, Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        in_file = {channel.topic for channel in reader.get_summary().channels.values()}
        for _, channel, message, decoded in reader.iter_decoded_messages(sorted(in_file - {"/failures/report"})):
            seen.setdefault(channel.topic, {})[message.log_time] = decoded
    assert {"/map", "/tf", "/camera", "/camera/matches", "/fixes", "/robots", "/path", "/log"} <= in_file
    assert {"/failures/log", "/failures/place", "/failures/frame", "/failures/matches", "/failures/report"} <= in_file
    assert len(seen["/camera"]) == len(seen["/tf"]) == FRAMES
    places = [(n, map_from_base(seen["/tf"][b.frame.stamp_ns])) for n, b in enumerate(robot_world.bundles(CARRIED_AT))]
    errors = [np.linalg.norm((at - robot_world.truth(n))[:3, 3]) for n, at in places if at is not None]
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
    assert in_file < set(CHANNELS)


@pytest.mark.parametrize(
    ("given", "said"),
    [(["--mcap", "run.txt"], r"must end in \.mcap"), (["--mcap", "run.mcap"], r"pip install '\.\[foxglove\]'")],
)
def test_wrong_orders_are_told_before_the_work(
    room: tuple[Path, Path], given: list[str], said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match=said):
        run(app, "replay", room[1], "--site", "room", "--store", room[0], *given)
    assert not list(tmp_path.iterdir())
