"""The command line as a whole: exit statuses, configuration file, speed of --help."""

import json
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import typer

from fleetmap.cli_options import Group, file_type
from fleetmap.config import Section
from fleetmap.errors import UsageError
from fleetmap.sensors.samples import SensorSet
from mapserver import cli
from mapserver.config import MapserverConfig, read_config
from mapserver.drafting.draft import Draft
from mapserver.quality.figures import Evidence, TileDirections
from mapserver.store import DraftContent, MapStore
from support.command_line import status
from support.storage.map_samples import draft_details, random_tile, save_sample_draft

REPOSITORY = Path(__file__).resolve().parents[3]
HEAVY = ("numpy", "cv2", "scipy", "gtsam", "matplotlib", "zenoh", "fastapi", "rich.progress", "msgspec")
HEAVY += ("jinja2", "starlette", "pydantic", "distributed", "dask", "mcap", "tuf", "securesystemslib")


@pytest.mark.parametrize("package", ["mapserver", "locclient"])
def test_the_command_line_imports_nothing_heavy(package: str) -> None:
    """Half a second is not to be had with one of them."""
    code = f"""
import atexit, sys, {package}.cli
atexit.register(lambda: print([m for m in {HEAVY!r} if m in sys.modules]))
sys.argv = ["{package}", "--help"]
{package}.cli.main()
"""
    paths = [str(REPOSITORY / part) for part in ("shared", "")]
    words = [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{code}"]
    shown = subprocess.check_output(words, text=True)
    assert "Usage" in shown
    assert shown.splitlines()[-1] == "[]"


def test_exit_statuses(tmp_path: Path, capsys) -> None:
    with MapStore.open(tmp_path / "store", create=True) as maps:
        save_sample_draft(maps)
        maps.save("empty", DraftContent(tiles=[], vocabulary=b"w", details=draft_details()))
    to_store = ("--store", tmp_path / "store")
    assert status("mapserver", "versions", "--site", "lab", *to_store) == 0
    assert status("mapserver", "--help") == 0
    assert status("mapserver", "build", "--site", "lab") == 2
    assert status("mapserver", "no-such-command") == 2
    assert status("mapserver", "versions", "--site", "unknown", *to_store) == 2
    assert status("mapserver", "fleet", "replay", 10**20, *to_store) == 2
    capsys.readouterr()
    assert status("mapserver", "build", tmp_path / "missing", "--site", "lab", *to_store) == 3
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith(f"error: {tmp_path / 'missing'} does not exist")
    assert "Traceback" not in told.err
    build = ("build", tmp_path, "--site", "lab", *to_store)
    assert status("mapserver", *build, "--replay", tmp_path / "gone.mcap") == 2, "before the survey, not behind it"
    assert "gone.mcap does not exist" in capsys.readouterr().err
    assert status("mapserver", "publish", "--site", "empty", *to_store) == 4
    assert status("mapserver", "publish", "--site", "lab", *to_store) == 0


def test_publishing_says_which_way_nobody_drove(capsys, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as maps:
        tiles = [random_tile(np.random.default_rng(0), cell=(3, -1))]
        seen = Evidence(directions=[TileDirections((3, -1), {"E": 12}, {"W": 12})])
        maps.save(
            "lab",
            DraftContent(tiles=tiles, vocabulary=b"words", details=draft_details(), archive=b"archive", evidence=seen),
        )
    assert status("mapserver", "publish", "--site", "lab", "--store", tmp_path / "store") == 0
    assert "tile 3,-1: 12 places face E and none near them W" in capsys.readouterr().out


def test_interruption_is_130(monkeypatch, capsys) -> None:
    interrupted = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(cli, "app", interrupted)
    assert status("mapserver", "build") == 130
    monkeypatch.undo()
    monkeypatch.setattr("mapserver.store.MapStore.open", interrupted)
    assert status("mapserver", "versions", "--site", "lab", "--store", "s") == 130
    assert "Traceback" not in capsys.readouterr().err


def test_every_option_has_its_key_in_the_file() -> None:
    """And every section and key belongs to a command, to a command of a group, or to settings of their own."""
    file = file_type(MapserverConfig, cli.COMMANDS)()
    settings = {"site", "store", "source", "topics", "survey", "gate", "ingest", "canary", "resurvey", "alerts"}
    assert set(_keys(file)) == settings | {name.replace("-", "_") for name in cli.COMMANDS}
    shown = typer.main.get_command(cli.app).commands
    commands = {name: (command, _keys(file)[name.replace("-", "_")]) for name, command in shown.items()}
    groups = [name for name, command in cli.COMMANDS.items() if isinstance(command, Group)]
    assert len(groups) >= 5
    for group in groups:
        _, sections = commands.pop(group)
        assert set(_keys(sections)) == set(shown[group].commands)
        commands |= {f"{group} {name}": (one, _keys(sections)[name]) for name, one in shown[group].commands.items()}
    for name, (command, section) in commands.items():
        options = {p.name.rstrip("_") for p in command.params if p.param_type_name == "option"}
        assert set(_keys(section)) == options - {"config"}, name


def _keys(section: Section) -> dict[str, object]:
    return {field.encode_name: getattr(section, field.name) for field in msgspec.structs.fields(section)}


def test_the_file_gives_defaults_and_the_command_line_wins(tmp_path: Path, capsys) -> None:
    """Site and store are said once for all commands; a section of a command comes before them."""
    with MapStore.open(tmp_path / "store", create=True) as maps:
        for site in ("lab", "hall", "hall"):
            save_sample_draft(maps, site=site)
    file = tmp_path / "site.toml"
    common = f'site = "lab"\nstore = "{tmp_path / "store"}"\n'
    file.write_text(f'{common}[versions]\njson = true\n[inspect]\nsite = "hall"\nversion = 2\n')
    for more, sites in (((), ["lab"]), (("--site", "hall"), ["hall", "hall"])):
        assert status("mapserver", "--config", file, "versions", *more) == 0
        assert [info["site"] for info in json.loads(capsys.readouterr().out)] == sites
    assert status("mapserver", "--config", file, "inspect") == 0
    assert "site hall version 2" in capsys.readouterr().out


def test_build_takes_its_settings_from_the_file(monkeypatch, tmp_path: Path, capsys) -> None:
    build = Mock(return_value=(Draft(1, "done", {}, {}), None))
    monkeypatch.setattr("mapserver.library.build_draft", build)
    opened = nullcontext(SimpleNamespace(sensor_set=SensorSet.STEREO))
    monkeypatch.setattr("mapserver.library.open_recording", lambda path, options: opened)
    file = tmp_path / "site.toml"
    file.write_text(
        f'[build]\nsite = "lab"\nstore = "{tmp_path}"\nframes = "::3"\nframe_from_ground_truth = true\n'
        "[survey]\nseed = 7\n[survey.keyframes]\nmin_overlap = 0.5\n"
    )
    assert status("mapserver", "build", "r", "--config", file) == 0
    assert status("mapserver", "--config", file, "build", "r", "--frames", "::2") == 0
    (order, settings), (second, _) = (call.args for call in build.call_args_list)
    assert (order.site, order.store, order.options.frames) == ("lab", tmp_path, "::3")
    assert order.options.frame_from_ground_truth
    assert (settings.seed, settings.keyframes.min_overlap, settings.keyframes.max_interval_s) == (7, 0.5, 2.0)
    assert (second.options.frames, second.site) == ("::2", "lab")
    assert capsys.readouterr().out == "done\ndone\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[build]\nsight = 'lab'", "sight"),
        ("[survey.loops]\ntop = 'many'", "survey.loops.top"),
        ("[biuld]", "biuld"),
        ("[survey.bundle]\nlambda_start = 1e-3", "survey.bundle.lambda_start is an internal constant now"),
        ("[build", "site.toml"),
        ("[source]\nspeed = -1.0", "source.speed = -1.0: give a finite number, 0 or more"),
        ("[survey.keyframes]\nmin_overlap = nan", "survey.keyframes.min_overlap = nan"),
        ("[alerts]\nlost_s = inf", "alerts.lost_s = inf"),
        ("[ingest]\nfailure_days = 1e6", "ingest.failure_days"),
        ("[build]\nthreads = -1", "build.threads = -1"),
    ],
)
def test_a_wrong_file_is_a_usage_error(tmp_path: Path, capsys, text: str, said: str) -> None:
    file = tmp_path / "site.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=said):
        read_config(file, cli.COMMANDS)
    assert status("mapserver", "build", "r", "--site", "lab", "--store", "s", "--config", file) == 2
    assert said in capsys.readouterr().err


def test_no_file_sets_nothing() -> None:
    assert read_config(None, cli.COMMANDS) == (MapserverConfig(), {})
