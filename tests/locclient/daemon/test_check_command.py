"""`locclient check` and `locclient run`: what is wrong is told with the next step, before any work."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import typer

from fleetmap.errors import UsageError
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame
from locclient import cli
from locclient.config import LocclientConfig
from locclient.daemon.preflight import _clock, _pair
from mapserver.store import MapStore
from support.command_line import status
from support.recordings.recording_samples import make_sample, write_mcap
from support.storage.map_samples import publish_samples

Said = pytest.CaptureFixture[str]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A robot that lacks nothing."""
    write_mcap(tmp_path / "walk", make_sample(12))
    with MapStore.open(tmp_path / "store", create=True) as maps:
        publish_samples(maps, 1)
    path = tmp_path / "robot.toml"
    path.write_text(
        f'[run]\nstore = "{tmp_path}/store"\nsite = "lab"\nrobot = "r1"\noutbox = "{tmp_path}/spool"\n'
        f'[source]\nkind = "recording"\nrecording = "{tmp_path}/walk"\nspeed = 0\n'
    )
    return path


def _read(file: Path) -> tuple[LocclientConfig, dict[str, dict[str, object]]]:
    return typer.main.get_command(cli.app).context_settings["obj"].read_config(file)


def test_site_and_server_are_said_once_and_old_keys_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('site = "lab"\nserver = "tcp/10.0.0.2:7447"\n[run]\nrobot = "r1"\n[replay]\nstore = "maps"\n')
    settings, options = _read(file)
    assert (settings.run.site, settings.run.server, settings.run.store) == ("lab", "tcp/10.0.0.2:7447", None)
    assert options["replay"] == {"site": "lab", "store": "maps"}
    file.write_text("[localizer.track]\nmax_misses = 9\n")
    with pytest.raises(UsageError, match=r"localizer\.track\.max_misses is an internal constant now"):
        _read(file)
    file.write_text('[output]\nmap = ""\n')
    with pytest.raises(UsageError, match=r"unknown field `map`.*docs/settings\.md"):
        _read(file)


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
    monkeypatch.setattr("locclient.daemon.preflight._ANSWER_S", 0.3)
    config.write_text(config.read_text().replace(old, new))
    assert status("locclient", "check", "--config", config, "--seconds", "0") == 3
    out = capsys.readouterr().out
    assert any(found.startswith(line) and said in found for found in out.splitlines()), out


def test_a_robot_that_cannot_run_says_so_at_once(config: Path, capsys: Said) -> None:
    good = config.read_text()
    for old, new, code, said in (
        ('robot = "r1"', "", 2, "[run] robot is missing"),
        ('robot = "r1"', 'robot = "r 1"', 2, "r 1"),
        ("speed = 0", "speed = 0\nspede = 1", 2, "spede"),
        ("/walk", "/nowhere", 3, "does not exist"),
        ("[source]", "[run.trial]\ncontradicting_looks = 9\n[source]", 2, "kidnap_fixes"),
        ("[source]", '[output]\nformat = "xml"\nendpoint = "tcp/127.0.0.1:1"\n[source]', 2, "xml"),
    ):
        config.write_text(good.replace(old, new))
        assert status("locclient", "run", "--config", config) == code, said
        told = capsys.readouterr()
        assert said in told.err, told.err
        assert "Traceback" not in told.err


def test_clocks_are_judged() -> None:
    assert _clock(5, True).level == "fail"
    assert _clock(1_800_000_000 * 10**9, False).level == "warn"
    assert _clock(1_800_000_000 * 10**9, True).level == "ok"


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
