"""Exit of a command line: errors become messages and statuses, bugs stay tracebacks."""

import shlex
from importlib import metadata
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from fleetmap.cli_exit import require_extra, run_cli, runnable
from fleetmap.errors import GateRefusedError


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (GateRefusedError("worse than before"), 4, "worse than before"),
        (ModuleNotFoundError("No module named 'gtsam'", name="gtsam"), 3, "pip install '.[server]'"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_become_messages(
    error: BaseException, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        run_cli(Mock(side_effect=error))
    assert end.value.code == status
    assert words in capsys.readouterr().err


def test_a_module_of_our_own_that_is_missing_is_a_bug() -> None:
    with pytest.raises(ModuleNotFoundError):
        run_cli(Mock(side_effect=ModuleNotFoundError("No module named 'mapserver.gone'", name="mapserver.gone")))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("publish --store 'my maps' --site a", "mapserver versions --site a --store 'my maps'"),
        ("publish --store=m --site=a", "mapserver versions --site a --store m"),
        ("publish --config m.toml", "mapserver --config m.toml versions"),
        ("publish --config m.toml --site a", "mapserver --config m.toml versions --site a"),
        ("publish", "mapserver versions"),
    ],
)
def test_commands_in_an_error_run_as_printed(arguments: str, told: str) -> None:
    text = "`mapserver versions`, `mapserver doctor x`, `mapserver gc --store b`"
    assert runnable(text, ["mapserver", *shlex.split(arguments)]) == text.replace("mapserver versions", told)


@pytest.mark.parametrize("program", ["/opt/mapserver/bin/locclient", "/src/locclient/__main__.py"])
def test_a_robots_settings_are_not_told_to_the_server(program: str) -> None:
    text = "`mapserver robots list`"
    assert runnable(text, [program, "run", "--config", "robot.toml"]) == text


def distribution(*requires: str) -> SimpleNamespace:
    return SimpleNamespace(requires=list(requires), version="9.9", read_text={"WHEEL": "Tag: cp399-any\n"}.get)


def test_a_program_whose_extra_is_missing_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {
        "fleetmap": distribution("numpy>=2", 'no-such-sim>=1; extra == "sim"', "numpy; extra == 'server'",
                                 "no_such.one[tls]<3,>=2; python_version > '3' and extra == 'server'"),
    }  # fmt: skip
    installed = metadata.distribution
    monkeypatch.setattr(metadata, "distribution", lambda name: known[name] if name in known else installed(name))
    with pytest.raises(SystemExit) as end:
        run_cli(lambda: require_extra("server", "mapserver"))
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "extra `server`, of which no_such.one are not installed" in said
    assert "'./fleetmap-9.9-cp399-any.whl[server]'" in said
    require_extra("client", "locclient")


def test_a_source_tree_that_is_not_installed_is_asked_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "distribution", Mock(side_effect=metadata.PackageNotFoundError("fleetmap")))
    require_extra("server", "mapserver")
