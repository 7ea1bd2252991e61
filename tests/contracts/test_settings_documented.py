"""Every setting stands in docs/settings.md with the default that it has in the code, and nothing else does."""

import importlib
import re

import msgspec
import pytest

from fleetmap.config import Section
from mapserver.config import MapserverConfig
from support.fleet.contracts_documents import REPOSITORY, code_words, rows, section, text

DOCUMENT = "docs/settings.md"
# The simulator has no configuration file: its sections are values in its code.
PACKAGES = {
    "shared/fleetmap": "fleetmap",
    "mapserver/mapserver": "mapserver",
    "locclient/locclient": "locclient",
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


def _shown(default: object) -> str:
    if default is None:
        return "none"
    if isinstance(default, Section):
        return f"[{type(default).__name__}]"
    return str(default).lower() if isinstance(default, bool) else str(default)


SECTIONS = _sections()


def test_the_sections_are_found() -> None:
    assert len(SECTIONS) > 15


@pytest.mark.parametrize("name", SECTIONS)
def test_section_is_documented(name: str) -> None:
    fields = msgspec.structs.fields(SECTIONS[name])
    wanted = {field.encode_name: _shown(field.default) for field in fields}
    documented = {code_words(row[0])[0]: row[1].strip("`") for row in rows(section(DOCUMENT, f"`{name}`"))}
    expected = "\n".join(f"| `{key}` | {default} | ... |" for key, default in wanted.items())
    assert documented == wanted, f"{DOCUMENT} needs a heading with `{name}` and under it the rows\n{expected}"


def test_no_section_is_documented_that_is_gone() -> None:
    documented = re.findall(r"^### `(\w+)`", text(DOCUMENT), re.MULTILINE)
    assert sorted(set(documented) - set(SECTIONS)) == []


def test_every_setting_is_read_somewhere() -> None:
    """A setting that nothing reads promises something that does not happen."""
    source = "\n".join(
        path.read_text("utf-8") for folder in PACKAGES for path in sorted((REPOSITORY / folder).rglob("*.py"))
    )
    by_name = {type(section).__name__ for section in msgspec.structs.astuple(MapserverConfig())}
    by_name -= {"SurveySettings", "GateSettings", "IngestSettings", "CanarySettings", "ResurveySettings"}
    by_name |= {name for name in SECTIONS if name.startswith("Fleet") and name.endswith("Section")}
    unread = [
        f"{name}.{field.name}"
        for name, kind in SECTIONS.items()
        if name not in by_name
        for field in msgspec.structs.fields(kind)
        if not re.search(rf"\.{field.name}\b|[\"']{field.name}[\"']", source)
    ]
    assert unread == []
