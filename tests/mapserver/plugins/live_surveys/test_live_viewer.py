"""`mapserver live --foxglove` as a process: a viewer sees the survey while it drives."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import UsageError
from mapserver.cli import app
from support.fleet.foxglove_client import FoxgloveClient
from support.recordings.recording_samples import make_sample, write_mcap

pytestmark = pytest.mark.timeout(900)


@contextmanager
def live(recording: Path, store: Path, *given: str) -> Iterator[FoxgloveClient]:
    """What a viewer sees of a survey, which must end well."""
    words = ["live", str(recording), "--site", "lab", "--store", str(store), "--foxglove", "0", *given]
    process = subprocess.Popen(
        [sys.executable, "-m", "mapserver.cli", *words],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
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
