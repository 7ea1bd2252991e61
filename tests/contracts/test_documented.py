"""Commands, options, endpoints, metrics, bus keys and report keys stand in the documents, and no table row is stale."""

import dataclasses
import inspect
import re
import tomllib
from pathlib import Path

import click
import msgspec
import pytest

from fleetmap import messages
from fleetmap.messages import Cause, Flag
from locclient.replay.run_metrics import METRICS
from mapserver.drafting.report import BuildReport
from mapserver.fleet_statistics.kpis import Kpis
from mapserver.nightly.night import NightReport
from mapserver.quality import figures
from mapserver.survey.merge.pipeline import Counts
from support.fleet.contracts_documents import REPOSITORY, click_command, code_words, rows, section, text

ROOTS = ("shared", "mapserver", "locclient", "deploy", "docs", "examples", "tests")
COMMANDS = "docs/command_line.md"
SERVICE = "docs/service.md"
REPORTS = "docs/reports.md"
DOCUMENTS = sorted(str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("docs/*.md"))
LINKED = re.compile(r"\]\((?!https?:)([^)#]+)")


def _scripts() -> list[str]:
    return sorted(tomllib.loads(text("pyproject.toml"))["project"]["scripts"])


def _documented_commands() -> list[str]:
    return re.findall(r"^## `(\w+(?: [\w-]+)+)`", text(COMMANDS), re.MULTILINE)


def _leaves(path: str) -> set[str]:
    """The command itself, or all commands of a group and its groups."""
    groups = getattr(click_command(path), "commands", None)
    return {path} if groups is None else {leaf for name in groups for leaf in _leaves(f"{path} {name}")}


def _arguments(command: click.Command) -> set[str]:
    """Names of the arguments as the command's help shows them."""
    arguments = (parameter for parameter in command.params if parameter.param_type_name == "argument")
    return {argument.metavar or (argument.name or "").upper() for argument in arguments}


@pytest.mark.parametrize("script", _scripts())
def test_commands_are_documented(script: str) -> None:
    assert _leaves(script) == {path for path in _documented_commands() if path.split()[0] == script}


@pytest.mark.parametrize("path", _documented_commands())
def test_options_are_documented(path: str) -> None:
    command = click_command(path)
    options = {parameter.opts[0] for parameter in command.params if parameter.param_type_name == "option"}
    documented = {code_words(row[0])[0] for row in rows(section(COMMANDS, f"`{path}`"))}
    assert {word.split()[0] for word in documented if word.startswith("--")} == options - {"--help"}
    assert {word for word in documented if not word.startswith("--")} == _arguments(command)


def test_every_command_that_reads_a_recording_takes_the_names_of_its_topics() -> None:
    commands = {path: click_command(path) for path in _documented_commands()}
    readers = {path: command for path, command in commands.items() if "RECORDING" in str(_arguments(command))}
    assert len(readers) >= 7
    for path, command in (readers | {"mapserver nightly": click_command("mapserver nightly")}).items():
        assert "--topic" in {option for parameter in command.params for option in parameter.opts}, path


def test_endpoints_are_documented(tmp_path: Path) -> None:
    from mapserver.api.app import create_app
    from mapserver.api.metrics import Metrics
    from mapserver.fleet.fleet import Fleet
    from mapserver.store import MapStore

    with MapStore.open(tmp_path, create=True) as store:
        fleet = Fleet(store)
        metrics = Metrics(store, fleet)
        paths = set(create_app(store, fleet, metrics, None).openapi()["paths"])
        families = set(re.findall(r"^# TYPE (fleetmap_\w+)", metrics.text().decode(), re.MULTILINE))
    documented = {code_words(row[0])[0] for row in rows(section(SERVICE, "HTTP"))}
    assert documented == paths | {"/openapi.json"}
    # The client library exposes the creation time of every counter beside it.
    assert {code_words(row[0])[0] for row in rows(section(SERVICE, "Metrics"))} == {
        family for family in families if not family.endswith("_created")
    }


def test_bus_keys_are_documented() -> None:
    keys = set(re.findall(r"^(fleetmap/\S+)", inspect.getdoc(messages) or "", re.MULTILINE))
    assert len(keys) >= 7
    assert {code_words(row[0])[0] for row in rows(section(SERVICE, "Bus"))} == keys


def test_causes_are_documented() -> None:
    causes = {cause.value for cause in Cause if cause is not Cause.NONE}
    assert {code_words(row[0])[0] for row in rows(section(SERVICE, "Causes"))} == causes


def test_flags_are_documented() -> None:
    assert {code_words(row[0])[0] for row in rows(section(SERVICE, "Flags"))} == {flag.value for flag in Flag}


def test_build_report_keys_are_documented() -> None:
    keys = {field.name for field in msgspec.structs.fields(BuildReport)}
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Build"))} == keys


def test_session_keys_are_documented() -> None:
    keys = {"recording", "joined", "verdict", "reason", "evidence"} | {
        field.name for field in dataclasses.fields(Counts)
    }
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Sessions"))} == keys


def test_evidence_keys_are_documented() -> None:
    kinds = (
        figures.Evidence,
        figures.Compared,
        figures.ProbeFigures,
        figures.Aliasing,
        figures.TrajectoryBreaks,
        figures.TileDirections,
        figures.Starts,
        figures.LookAlike,
        figures.RigEvidence,
    )
    keys = {field.name for kind in kinds for field in msgspec.structs.fields(kind)}
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Evidence"))} == keys


def test_nightly_report_keys_are_documented() -> None:
    keys = {"state", "message"} | set(dataclasses.asdict(NightReport(1)))
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Nightly"))} == keys


def test_replay_report_keys_are_documented() -> None:
    keys = set(METRICS) | {"aligned_error_m", "peak_rss_mb", "map_version", "not_localised_m", "failure_reports"}
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Replay"))} == keys


def test_fleet_measures_are_documented() -> None:
    keys = {field.name for field in dataclasses.fields(Kpis)}
    assert {code_words(row[0])[0] for row in rows(section(REPORTS, "Fleet"))} == keys


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_document_is_reached_from_the_readme(document: str) -> None:
    assert document in text("README.md")


@pytest.mark.parametrize(
    "document", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "shared/README.md", *DOCUMENTS]
)
def test_links_lead_somewhere(document: str) -> None:
    folder = (REPOSITORY / document).parent
    missing = [target for target in LINKED.findall(text(document)) if not (folder / target).exists()]
    assert missing == []


@pytest.mark.parametrize("document", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", *DOCUMENTS])
def test_files_that_are_named_exist(document: str) -> None:
    """A path in a document may be shortened at its left: `survey/pipeline.py`."""
    named = set(re.findall(r"`([\w./-]+\.(?:py|toml|sh|service))`", text(document)))
    files = [path.as_posix() for root in ROOTS for path in (REPOSITORY / root).rglob("*") if path.is_file()]
    files += [path.as_posix() for path in REPOSITORY.iterdir() if path.is_file()]
    missing = {name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in files)}
    # A reader's own files, and files that a robot or server makes.
    assert missing <= {"locclient.toml", "mapserver.toml", "camchain.yaml"}
