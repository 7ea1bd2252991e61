"""Plug-ins: each is registered by entry points alone, and the road neither imports one nor mentions its name."""

import re
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from fleetmap.errors import UsageError
from locclient.config import LocclientConfig, read_config, with_plugins
from mapserver.hooks import command_hooks, route_hooks
from support.fleet.contracts_documents import REPOSITORY, text

FOLDERS = sorted(path.parent for path in REPOSITORY.glob("*/plugins/*/README.md"))
GROUPS = tomllib.loads(text("pyproject.toml"))["project"].get("entry-points", {})
ROAD = [
    path
    for package in ("shared/fleetmap", "locclient", "mapserver")
    for path in (REPOSITORY / package).rglob("*.py")
    if "plugins" not in path.relative_to(REPOSITORY).parts
]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_plugin_is_registered_and_the_road_does_not_know_it(folder: Path) -> None:
    package = ".".join(folder.relative_to(REPOSITORY).parts)
    registered = [group for group, points in GROUPS.items() for where in points.values() if where.startswith(package)]
    assert registered, f"no entry point in pyproject.toml names {package}"
    title = (folder / "README.md").read_text("utf-8").splitlines()[0].removeprefix("# ")
    name = re.compile(rf"(?<![a-z0-9])({folder.name}|{re.escape(title.lower())})(?![a-z0-9])")
    assert [str(path) for path in ROAD if name.search(path.read_text("utf-8").lower())] == []


def test_entry_points_lead_to_hooks() -> None:
    for group, points in GROUPS.items():
        hooks = (REPOSITORY / group.partition(".")[0] / "hooks.py").read_text("utf-8")
        assert f"`{group}`" in hooks
        for point in (EntryPoint(name, where, group) for name, where in points.items()):
            if (REPOSITORY / "/".join(point.module.split(".")[:3])).exists():
                assert point.load() is not None, point.value


def test_without_plugins_a_robot_reads_its_file_and_refuses_their_sections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith(("locclient.plugins", "mapserver.plugins"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "locclient.plugins", None)
    monkeypatch.setitem(sys.modules, "mapserver.plugins", None)
    assert with_plugins()[0].__struct_fields__ == LocclientConfig.__struct_fields__
    assert route_hooks() == command_hooks() == {}
    file = tmp_path / "robot.toml"
    file.write_text('[vda5050]\nbroker = "mqtts://host"\n')
    with pytest.raises(UsageError, match="vda5050"):
        read_config(file, {})
