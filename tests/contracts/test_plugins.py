"""Plug-ins: each is registered by entry points alone, and the road neither imports one nor mentions its name."""

import re
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from fleetmap.errors import UsageError
from fleetmap.hooks import plugins
from locclient.config import LocclientConfig, read_config, with_plugins
from mapserver.store import MapStore
from mapserver.store.places import Places, write_places
from support.fleet.contracts_documents import REPOSITORY, text

SIDES = ("shared/fleetmap", "locclient", "mapserver")
FOLDERS = sorted(path.parent for side in SIDES for path in REPOSITORY.glob(f"{side}/plugins/*/README.md"))
GROUPS = tomllib.loads(text("pyproject.toml"))["project"].get("entry-points", {})
SOURCES = [path for side in SIDES for path in (REPOSITORY / side).rglob("*.py")]
ROAD = [path for path in SOURCES if "plugins" not in path.relative_to(REPOSITORY).parts]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_plugin_is_registered_and_the_road_does_not_know_it(folder: Path) -> None:
    package = ".".join(folder.relative_to(REPOSITORY).parts).removeprefix("shared.")
    named = [where for points in GROUPS.values() for where in points.values()]
    named += [path.read_text("utf-8") for other in FOLDERS if other != folder for path in other.glob("*.py")]
    assert any(package in words for words in named), f"no entry point in pyproject.toml and no plug-in names {package}"
    readme = (folder / "README.md").read_text("utf-8")
    files = re.findall(r"`(?!test_)(\w+\.(?:py|js|html))`", readme)
    assert [name for name in files if not any(folder.rglob(name))] == [], "the README names files that are not there"
    title = readme.splitlines()[0].removeprefix("# ")
    name = re.compile(rf"(?<![a-z0-9])({folder.name}|{re.escape(title.lower())})(?![a-z0-9])")
    assert [str(path) for path in ROAD if name.search(path.read_text("utf-8").lower())] == []


def test_entry_points_lead_to_hooks() -> None:
    for group, points in GROUPS.items():
        side = next(side for side in SIDES if side.endswith(group.partition(".")[0]))
        assert f"`{group}`" in text(f"{side}/hooks.py")
        for point in (EntryPoint(name, where, group) for name, where in points.items()):
            if (REPOSITORY / side / "/".join(point.module.split(".")[1:3])).exists():
                assert point.load() is not None, point.value


def test_without_plugins_a_robot_reads_its_file_and_refuses_their_sections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages = tuple(f"{side.rpartition('/')[2]}.plugins" for side in SIDES)
    for name in [name for name in sys.modules if name.startswith(packages)]:
        monkeypatch.delitem(sys.modules, name)
    for package in packages:
        monkeypatch.setitem(sys.modules, package, None)
    assert with_plugins()[0].__struct_fields__ == LocclientConfig.__struct_fields__
    groups = ("fleetmap.recordings", *(f"mapserver.{what}" for what in ("routes", "commands", "parts", "stages")))
    assert [plugins(group) for group in groups] == [{}] * len(groups)
    for places, scheme in ((Places(content="s3://b"), "s3"), (Places(database="postgresql://h/n"), "postgresql")):
        write_places(tmp_path, places)
        with pytest.raises(UsageError, match=f"under {scheme}:// needs a plug-in"):
            MapStore.open(tmp_path, create=True)
    file = tmp_path / "robot.toml"
    file.write_text('[vda5050]\nbroker = "mqtts://host"\n')
    with pytest.raises(UsageError, match="vda5050"):
        read_config(file, {})
