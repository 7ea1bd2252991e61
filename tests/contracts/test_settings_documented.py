"""Every setting is in a tier that exists, is read somewhere, or says why it is a constant. docs/settings.md is generated."""

import ast
import importlib
import re

import msgspec
import pytest

from fleetmap.config import Section, Setting, Tiers, settings_in, tier_of
from locclient.config import TIERS as LOCCLIENT_TIERS
from locclient.config import LocclientConfig
from mapserver.config import TIERS as MAPSERVER_TIERS
from mapserver.config import MapserverConfig
from support.fleet.contracts_documents import REPOSITORY

# The simulator has no configuration file: its sections are values in its code.
PACKAGES = {
    "shared/fleetmap": "fleetmap",
    "mapserver": "mapserver",
    "locclient": "locclient",
}
PROGRAMS: dict[str, tuple[Section, Tiers]] = {
    "mapserver": (MapserverConfig(), MAPSERVER_TIERS),
    "locclient": (LocclientConfig(), LOCCLIENT_TIERS),
}


def _sections() -> dict[str, type[Section]]:
    """All settings sections by name. Modules are found by their text, so that not all must be imported."""
    found = {}
    for folder, package in PACKAGES.items():
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            names = re.findall(r"^class ([A-Z]\w*)\((?:\w+\.)?Section\b", path.read_text("utf-8"), re.MULTILINE)
            if names:
                parts = path.relative_to(REPOSITORY / folder).with_suffix("").parts
                module = importlib.import_module(".".join((package, *parts)).removesuffix(".__init__"))
                found |= {name: getattr(module, name) for name in names}
    return found


def _settings(program: str) -> list[Setting]:
    """All but the options of commands, which docs/command_line.md lists."""
    return list(settings_in(PROGRAMS[program][0]))


def test_the_settings_are_found() -> None:
    assert len(_sections()) > 15
    assert len(_settings("mapserver")) > 200


@pytest.mark.parametrize("program", PROGRAMS)
def test_tiers_name_settings_that_exist(program: str) -> None:
    existing = {(setting.section, setting.key) for setting in settings_in(PROGRAMS[program][0])}
    existing |= {(section, "*") for section, _ in existing}
    named = {
        (section, key)
        for keys in PROGRAMS[program][1].values()
        for section, words in keys.items()
        for key in words.split()
    }
    assert named <= existing


def test_internal_constants_say_what_they_are() -> None:
    """Each has a comment in the code, on its line or above it."""
    internal = {
        (kind.__name__, setting.key)
        for program, (config, tiers) in PROGRAMS.items()
        for setting, kind in _with_types(config)
        if tier_of(setting, tiers) is None
    }
    silent = []
    for name, kind in _sections().items():
        module = REPOSITORY.joinpath(*_path_of(kind)).read_text("utf-8")
        lines = module.splitlines()
        (definition,) = (
            node for node in ast.parse(module).body if isinstance(node, ast.ClassDef) and node.name == name
        )
        for node in definition.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                around = "".join(lines[node.lineno - 2 : node.end_lineno])
                if (name, node.target.id) in internal and "#" not in around:
                    silent.append(f"{name}.{node.target.id}")
    assert silent == []


def _with_types(section: Section, name: str = "") -> list[tuple[Setting, type[Section]]]:
    found = []
    for field in msgspec.structs.fields(section):
        value = getattr(section, field.name)
        if isinstance(value, Section):
            found += _with_types(value, f"{name}.{field.encode_name}".lstrip("."))
        else:
            found.append((Setting(name, field.encode_name, value), type(section)))
    return found


def _path_of(kind: type[Section]) -> list[str]:
    package, *parts = kind.__module__.split(".")
    (folder,) = (folder for folder, name in PACKAGES.items() if name == package)
    path = REPOSITORY.joinpath(folder, *parts)
    return [folder, *parts, "__init__.py"] if path.is_dir() else [folder, *parts[:-1], f"{parts[-1]}.py"]


def test_every_setting_is_read_somewhere() -> None:
    """A setting that nothing reads promises something that does not happen."""
    source = "\n".join(
        path.read_text("utf-8") for folder in PACKAGES for path in sorted((REPOSITORY / folder).rglob("*.py"))
    )
    read = {*re.findall(r"\.(\w+)", source), *re.findall(r"[\"'](\w+)(?=[\"'])", source)}
    unread = [
        f"{name}.{field.name}"
        for name, kind in _sections().items()
        for field in msgspec.structs.fields(kind)
        if field.name not in read
    ]
    assert unread == []
