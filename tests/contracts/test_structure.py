"""The tree stays navigable: small folders and files, short signatures, no import circles, the field's words."""

import ast
import re
from collections import defaultdict
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from support.fleet.contracts_documents import REPOSITORY

PACKAGES = {
    "fleetmap": REPOSITORY / "shared" / "fleetmap",
    "fleetsim": REPOSITORY / "shared" / "fleetsim",
    "mapserver": REPOSITORY / "mapserver" / "mapserver",
    "locclient": REPOSITORY / "locclient" / "locclient",
}
MOST_SKIPS = 29

# Private words that the project once had, by the field's word that replaced them. Whole words of identifiers, not parts of words.
# Where a package uses a word in the field's own sense (anchors of features, shelves of racks), the others are named.
RETIRED = {
    "doubts": "divergence_monitor",
    "standing": "zero_velocity or ranking",
    "first_guess": "odometry_pass",
    "pair_turn": "stereo_yaw",
    "noted_job": "job_record",
    "chores": "background_tasks",
    "recent_kinds": "caches",
    "recent_bytes": "caches",
    "rate_words": "kpis",
    "robot_watch": "health_stream",
    "site_plan": "version_assignment",
    "refused_reports": "rejected_reports",
    "picture_files": "image_spill",
    "shelf": "image_store",
    "distinct_landmarks": "distinctive_landmarks",
    "ledger": "transactions",
    "kept_files": "compression_cache",
    "telling_apart": "alias_disambiguation",
    "told_apart": "disambiguated",
    "twins": "aliases",
    "twin": "alias",
    "anchors": "hypotheses",
    "rivals": "competitors",
    "unmistakable": "unambiguous",
    "strangers": "kidnap_hypotheses or unreferenced",
    "held_prior": "initial_pose_prior",
    "sight": "image_quality",
    "hit_share": "landmark_recall",
    "map_room": "tile_loader",
    "tile_window": "tile_selection",
    "whereabouts": "position_bound",
    "part_reader": "chunk_reader",
    "server_talk": "server_sync",
    "spool": "outbox",
    "settled_memory": "gc_frozen",
    "dock_watch": "dock_check",
    "self_check": "preflight",
    "leads_back": "forward_backward_check",
    "resection": "pnp",
}
ONLY_IN = {"anchors": ("locclient",), "shelf": ("mapserver",), "standing": ("fleetmap", "mapserver", "locclient")}
# Stable keys of settings and reports.
KEPT = {
    "view_distinct_landmarks",
    "most_twins",
    "twin_votes_share",
    "strong_twin_share",
    "min_hit_share",
    "rival_hit_share",
    "spool",
    "spool_bytes",
    "sight",
}


@cache
def _modules() -> dict[str, Path]:
    found = {}
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join((package, *(part for part in parts if part != "__init__")))] = path
    return found


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def _python_files() -> list[Path]:
    return [*_modules().values(), *sorted((REPOSITORY / "tests").rglob("*.py"))]


def test_the_formatter_is_hardly_ever_switched_off() -> None:
    skips = {module: path.read_text("utf-8").count("# fmt: skip") for module, path in _modules().items()}
    assert sum(skips.values()) <= MOST_SKIPS, {module: count for module, count in skips.items() if count}


def _imports(module: str, path: Path) -> set[str]:
    """The project's modules that this one imports when it is imported; not inside functions, not for types alone."""
    found: set[str] = set()
    pending: list[ast.stmt] = list(_tree(path).body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test):
            pending += [*node.body, *node.orelse]
        elif isinstance(node, ast.Try):
            pending += [*node.body, *node.orelse, *(s for handler in node.handlers for s in handler.body)]
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                name if (name := f"{node.module}.{alias.name}") in _modules() else node.module for alias in node.names
            }
    return {name for name in found if name in _modules() and name != module}


def test_nothing_imports_itself_by_way_of_others() -> None:
    try:
        TopologicalSorter({module: _imports(module, path) for module, path in _modules().items()}).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize("package", PACKAGES)
def test_a_class_name_means_one_thing_in_a_package(package: str) -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for module, path in _modules().items():
        if module.partition(".")[0] == package:
            for node in _tree(path).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name].append(module)
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def _words(identifier: str) -> str:
    """snake_case of any identifier, with underscores around it."""
    return f"_{re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', identifier).lower().strip('_')}_"


@cache
def _identifiers(path: Path) -> dict[str, str]:
    """The words of each."""
    found = {path.stem}
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
    return {name: _words(name) for name in found}


@pytest.mark.parametrize("word", RETIRED)
def test_retired_words_stay_retired(word: str) -> None:
    found = {
        f"{module}: {name}"
        for module, path in _modules().items()
        if module.partition(".")[0] in ONLY_IN.get(word, PACKAGES)
        for name, words in _identifiers(path).items()
        if f"_{word}_" in words and name not in KEPT
    }
    assert found == set(), f"the field says {RETIRED[word]}"


def test_retired_words_are_recognised() -> None:
    assert f"_{'hit_share'}_" in _words("min_hit_share")
    assert _words("_TwinVotes2") == "_twin_votes2_"
    assert "_sight_" not in _words("insight")
