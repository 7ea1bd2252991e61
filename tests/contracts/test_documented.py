"""Commands, options, endpoints, metrics, bus keys and report keys stand in the documents, and no table row is stale."""

import dataclasses
import inspect
import re
from pathlib import Path

import msgspec
import pytest

from fleetmap import messages
from fleetmap.messages import Cause, Flag
from locclient.replay.run_metrics import METRICS
from mapserver.api.app import create_app
from mapserver.api.metrics import Metrics
from mapserver.drafting.report import BuildReport
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import Kpis
from mapserver.quality import figures
from mapserver.store import MapStore
from mapserver.survey.merge.multi_session import Counts
from support.fleet.contracts_documents import REPOSITORY, code_words, generate_docs, rows, section, text

ROOTS = ("shared", "mapserver", "locclient", "deploy", "docs", "examples", "tests")
GENERATE = generate_docs()
SERVICE = "docs/service.md"
REPORTS = "docs/reports.md"
DOCUMENTS = sorted(str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("docs/*.md"))
PAGES = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", *DOCUMENTS]
LINKED = re.compile(r"\]\((?!https?:)([^)#]+)")


def named(page: str, heading: str) -> set[str]:
    return {code_words(row[0])[0] for row in rows(section(page, heading))}


@pytest.mark.parametrize("path", GENERATE.PAGES, ids=str)
def test_generated_pages_are_current(path: Path) -> None:
    assert GENERATE.PAGES[path](path.read_text("utf-8")) == path.read_text("utf-8"), "`make docs` writes it anew"


def test_every_command_that_reads_a_recording_takes_the_names_of_its_topics() -> None:
    commands = GENERATE.commands()
    readers = {
        path
        for path, command in commands.items()
        if any(p.param_type_name == "argument" and "RECORDING" in (p.metavar or p.name.upper()) for p in command.params)
    }
    assert len(readers) >= 4
    for path in readers:
        assert "--topic" in {option for parameter in commands[path].params for option in parameter.opts}, path


def test_endpoints_are_documented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapserver.api.app.plugins", lambda _: {})  # a plug-in's README has its own
    with MapStore.open(tmp_path, create=True) as store:
        fleet = Fleet(store)
        metrics = Metrics(store, fleet)
        paths = set(create_app(store, fleet, metrics=metrics).openapi()["paths"])
        families = set(re.findall(r"^# TYPE (fleetmap_\w+)", metrics.text().decode(), re.MULTILINE))
    assert named(SERVICE, "HTTP") == paths | {"/openapi.json"}
    # The client library exposes the creation time of every counter beside it.
    assert named(SERVICE, "Metrics") == {family for family in families if not family.endswith("_created")}


def test_bus_keys_are_documented() -> None:
    keys = set(re.findall(r"^(fleetmap/\S+)", inspect.getdoc(messages) or "", re.MULTILINE))
    assert len(keys) >= 7
    assert named(SERVICE, "Bus") == keys


def _fields(*kinds: type) -> set[str]:
    """Names of the fields of records."""
    found = (dataclasses.fields(k) if dataclasses.is_dataclass(k) else msgspec.structs.fields(k) for k in kinds)
    return {field.name for fields in found for field in fields}


EVIDENCE = (
    figures.Evidence, figures.Comparison, figures.ProbeFigures, figures.Aliasing, figures.TrajectoryBreaks,
    figures.TileDirections, figures.Starts, figures.LookAlike, figures.Repetition, figures.SurveyedViews,
    figures.BlindView, figures.RigEvidence, figures.Displacement,
)  # fmt: skip
RUN_KEYS = {"aligned_error_m", "peak_rss_mb", "map_version", "not_localised_m", "failures_detected", "starts"}


@pytest.mark.parametrize(
    ("page", "heading", "keys"),
    [
        (SERVICE, "Causes", {cause.value for cause in Cause if cause is not Cause.NONE}),
        (SERVICE, "Flags", {flag.value for flag in Flag}),
        (REPORTS, "Build", _fields(BuildReport)),
        (REPORTS, "Sessions", _fields(Counts) | {"recording", "joined", "verdict", "reason", "evidence"}),
        (REPORTS, "Evidence", _fields(*EVIDENCE)),
        (REPORTS, "Replay", set(METRICS) | RUN_KEYS),
        (REPORTS, "Fleet", _fields(Kpis)),
    ],
)
def test_keys_are_documented(page: str, heading: str, keys: set[str]) -> None:
    assert named(page, heading) == keys


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_document_is_reached_from_the_readme(document: str) -> None:
    assert document in text("README.md")


@pytest.mark.parametrize("document", [*PAGES, "shared/README.md"])
def test_links_lead_somewhere(document: str) -> None:
    folder = (REPOSITORY / document).parent
    missing = [target for target in LINKED.findall(text(document)) if not (folder / target).exists()]
    plugins = [target.partition("/plugins/")[0] for target in missing if "/plugins/" in target]
    assert len(missing) == len(plugins) and not any((folder / side / "plugins").exists() for side in plugins), missing


@pytest.mark.parametrize("document", PAGES)
def test_files_that_are_named_exist(document: str) -> None:
    """A path in a document may be shortened at its left: `survey/pipeline.py`."""
    named = set(re.findall(r"`([\w./-]+\.(?:py|toml|sh|service))`", text(document)))
    files = [path.as_posix() for root in ROOTS for path in (REPOSITORY / root).rglob("*") if path.is_file()]
    files += [path.as_posix() for path in REPOSITORY.iterdir() if path.is_file()]
    missing = {name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in files)}
    # A reader's own files, and files that a robot or server makes.
    assert missing <= {"locclient.toml", "mapserver.toml", "camchain.yaml"}
