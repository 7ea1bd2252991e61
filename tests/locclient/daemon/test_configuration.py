"""The configuration of `locclient run`: what is wrong is told with the next step, before any work."""

from pathlib import Path

import pytest
import typer

from fleetmap.errors import UsageError
from locclient import cli
from locclient.config import LocclientConfig
from support.command_line import status
from support.fleet.robot_file import good_robot

Said = pytest.CaptureFixture[str]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return good_robot(tmp_path)


def _read(file: Path) -> tuple[LocclientConfig, dict[str, dict[str, object]]]:
    return typer.main.get_command(cli.app).context_settings["obj"](file)


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


def test_a_robot_that_cannot_run_says_so_at_once(config: Path, capsys: Said) -> None:
    good = config.read_text()
    for old, new, code, said in (
        ('robot = "r1"', "", 2, "[run] robot is missing"),
        ('robot = "r1"', 'robot = "r 1"', 2, "r 1"),
        ("speed = 0", "speed = 0\nspede = 1", 2, "spede"),
        ('robot = "r1"', 'robot = "r1"\nframe_queue = 0', 2, "`$.run.frame_queue`, which is 0;"),
        ("/walk", "/nowhere", 3, "does not exist"),
        ("[source]", '[output]\nendpoint = "local"\n[source]', 2, "[output] endpoint = endpoint 'local'"),
        ("[source]", "[run.trial]\ncontradicting_looks = 9\n[source]", 2, "kidnap_fixes"),
        ("[source]", '[output]\nformat = "xml"\nendpoint = "tcp/127.0.0.1:1"\n[source]', 2, "xml"),
    ):
        config.write_text(good.replace(old, new))
        assert status("locclient", "run", "--config", config) == code, said
        told = capsys.readouterr()
        assert said in told.err, told.err
        assert "Traceback" not in told.err
