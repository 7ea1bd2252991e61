"""`locclient check`: what is wrong is told with the next step."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame
from locclient.plugins.preflight.checks import _clock, _pair
from support.command_line import status
from support.fleet.robot_file import good_robot

Said = pytest.CaptureFixture[str]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return good_robot(tmp_path)


def test_a_good_robot_passes(config: Path, capsys: Said) -> None:
    assert status("locclient", "check", "--config", config, "--seconds", "0.5") == 0
    lines = dict(line.split(":", 1) for line in capsys.readouterr().out.splitlines())
    assert set(lines) >= {"ok    configuration", "ok    calibration", "ok    frames", "ok    spool", "ok    store"}
    assert "20.0 Hz" in lines["ok    frames"]
    assert "baseline 200 mm" in lines["ok    calibration"]


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ('site = "lab"', "", "fail  configuration", "[run] site is missing"),
        ('site = "lab"', 'site = "else"', "fail  store", "else"),
        ('kind = "recording"', 'kind = "radar"', "fail  calibration", "'radar'; known are recording"),
        ("/walk", "/nowhere", "fail  calibration", "does not exist"),
        ('store = "', 'server = "tcp/127.0.0.1:1"\n#', "fail  connection", "is the server running"),
        ('store = "', 'server = "tcp/127.0.0.1:1"\nstore = "', "fail  configuration", "either"),
    ],
)
def test_what_is_wrong_is_told(
    monkeypatch: pytest.MonkeyPatch, config: Path, capsys: Said, old: str, new: str, line: str, said: str
) -> None:
    monkeypatch.setattr("locclient.plugins.preflight.checks._ANSWER_S", 0.3)
    config.write_text(config.read_text().replace(old, new))
    assert status("locclient", "check", "--config", config, "--seconds", "0") == 3
    out = capsys.readouterr().out
    assert any(found.startswith(line) and said in found for found in out.splitlines()), out


def test_clocks_are_judged() -> None:
    assert next(_clock(5, True)).level == "fail"
    assert next(_clock(1_800_000_000 * 10**9, False)).level == "warn"
    assert next(_clock(1_800_000_000 * 10**9, True)).level == "ok"


@pytest.mark.parametrize(("shift_px", "level"), [(12, "ok"), (-12, "fail"), (0, "warn")])
def test_an_exchanged_pair_fails_the_check(shift_px: int, level: str) -> None:
    """Blocks that lie farther left in the right image, farther right, as of exchanged or mirrored cameras, or at infinity."""
    rng = np.random.default_rng(3)
    wide = np.kron(rng.integers(20, 230, (60, 90)), np.ones((8, 8))) + rng.normal(0, 6, (480, 720))
    left, right = (wide[:, at : at + 640].clip(0, 255).astype(np.uint8) for at in (40, 40 + shift_px))
    rectifier = SimpleNamespace(rectify=lambda frame: RectifiedFrame(0, frame.left, frame.right, None))
    (finding,) = _pair(CameraFrame(0, left, right, None), cast(Rectifier, rectifier))
    assert (finding.what, finding.level) == ("left and right", level)
    assert list(_pair(CameraFrame(0, left, None, None), cast(Rectifier, rectifier))) == []
