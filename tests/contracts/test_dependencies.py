"""What is imported is declared where it is imported, and what is declared is imported."""

import ast
import re
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

from support.fleet.contracts_documents import REPOSITORY, code_words, rows, text

OWN = {"fleetmap", "fleetsim", "mapserver", "locclient"}
SHARED = ("shared/fleetmap", "shared/fleetsim", "locclient")
# Modules whose distribution has another name.
DISTRIBUTIONS = {
    "argon2": "argon2-cffi",
    "cv2": "opencv-python-headless",
    "foxglove": "foxglove-sdk",
    "google": "protobuf",
    "markdown_it": "markdown-it-py",
    "paho": "paho-mqtt",
    "yaml": "pyyaml",
    "zenoh": "eclipse-zenoh",
}
PROJECT = tomllib.loads(text("pyproject.toml"))["project"]
# Extras whose libraries are imported where a recording, a message or a setting asks for them.
ON_DEMAND = sorted(set(PROJECT["optional-dependencies"]) - {"client", "server", "dev"})
# ROS 2 of the robot, which its plug-in imports once the settings ask for it.
OF_THE_ROBOT = re.compile("rclpy|bond|rcl-interfaces|std-srvs|.*-msgs")
# Imported by a library that we import, which does not ask for them itself.
BEHIND = {"pg8000", "httpx", "securesystemslib"}


def declared(extra: str | None) -> set[str]:
    lines = PROJECT["dependencies"] if extra is None else PROJECT["optional-dependencies"][extra]
    return {re.split(r"[^\w.-]", line, maxsplit=1)[0].lower() for line in lines}


@cache
def imported(folder: Path) -> set[str]:
    """Distributions whose modules the folder's files import, inside of functions too, but not for types alone."""
    found = set()
    for path in folder.rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                node.body = []
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found |= {name.name.partition(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").partition(".")[0])
    modules = found - OWN - set(sys.stdlib_module_names)
    return {DISTRIBUTIONS.get(module, module.replace("_", "-")) for module in modules}


def on_demand() -> set[str]:
    """What some extra brings, and protobuf, which the formats' page says to install."""
    return {"protobuf"}.union(*(declared(extra) for extra in ON_DEMAND))


@pytest.mark.parametrize("folder", SHARED)
def test_a_robot_imports_what_the_extra_client_brings(folder: str) -> None:
    own = {name for name in imported(REPOSITORY / folder) if not OF_THE_ROBOT.fullmatch(name)}
    assert own - on_demand() <= declared(None) | declared("client")


def test_the_server_imports_what_the_extra_server_brings() -> None:
    assert imported(REPOSITORY / "mapserver") - on_demand() <= declared(None) | declared("server")


def test_nothing_is_declared_that_nothing_imports() -> None:
    shared = {name for folder in SHARED for name in imported(REPOSITORY / folder)}
    server = imported(REPOSITORY / "mapserver")
    assert declared(None) - shared <= BEHIND
    assert declared("server") <= server
    assert not declared("server") & shared, "the robot would need it too"
    for extra in ON_DEMAND:
        assert declared(extra) - BEHIND <= shared | server, extra


def test_every_extra_is_documented() -> None:
    named = {word for row in rows(text("docs/install.md").partition("## From")[0]) for word in code_words(row[0])}
    assert named == set(PROJECT["optional-dependencies"])
