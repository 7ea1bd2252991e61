"""Every setting is in a tier that exists, is read somewhere, or says why it is a constant. docs/settings.md is generated."""

import importlib
import re

import msgspec
import pytest

from fleetmap.config import Section, Tiers, settings_in
from locclient.config import with_plugins
from mapserver.config import TIERS as MAPSERVER_TIERS
from mapserver.config import MapserverConfig
from support.fleet.contracts_documents import REPOSITORY

# The simulator has no configuration file: its sections are values in its code.
PACKAGES = {"shared/fleetmap": "fleetmap", "mapserver": "mapserver", "locclient": "locclient"}
PROGRAMS: dict[str, tuple[Section, Tiers]] = {
    "mapserver": (MapserverConfig(), MAPSERVER_TIERS),
    "locclient": with_plugins(),
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


def test_the_settings_are_found() -> None:
    assert len(_sections()) > 15
    assert len(list(settings_in(PROGRAMS["mapserver"][0]))) > 200


@pytest.mark.parametrize("program", PROGRAMS)
def test_tiers_name_settings_that_exist(program: str) -> None:
    existing = {(setting.section, setting.key) for setting in settings_in(PROGRAMS[program][0])}
    existing |= {(section, "*") for section, _ in existing}
    tiers = [item for keys in PROGRAMS[program][1].values() for item in keys.items()]
    assert {(section, key) for section, words in tiers for key in words.split()} <= existing


def test_every_setting_is_read_somewhere() -> None:
    """A setting that nothing reads promises something that does not happen."""
    files = [path for folder in (*PACKAGES, "shared/core") for path in (REPOSITORY / folder).rglob("*.*")]
    source, core = (
        "\n".join(path.read_text("utf-8") for path in files if path.suffix in kinds)
        for kinds in ({".py"}, {".cpp", ".h"})
    )
    read = {*re.findall(r"\.(\w+)", source), *re.findall(r"[\"'](\w+)(?=[\"'])", source)}
    read |= {*re.findall(r'\["(\w+)"\]', core)}  # which takes a section as an object
    fields = [(name, field.name) for name, kind in _sections().items() for field in msgspec.structs.fields(kind)]
    assert [field for field in fields if field[1] not in read] == []
