"""The licences of all libraries of the default install, as docs/install.md lists them: none of them is copyleft."""

import importlib.metadata
import re
from importlib.metadata import distribution

from packaging.requirements import Requirement

from contracts.test_dependencies import PROJECT
from support.fleet.contracts_documents import section

COPYLEFT = re.compile(r"\b(A|L)?GPL|GNU|Mozilla|MPL|Eclipse|EPL|CDDL|EUPL")
UNNAMED = {"pyrage": "MIT"}  # which carries its licence as text alone
CHOICE = {"eclipse-zenoh"}  # Apache-2.0 or EPL-2.0, as the user likes


def name_of(text: str) -> str:
    return re.sub(r"[-_.]+", "-", text).lower()


def libraries() -> set[str]:
    """The default install: of the extras client and server, with all that those ask for."""
    lines = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["server"]]
    todo = [(name_of(r.name), frozenset(r.extras)) for r in map(Requirement, lines)]
    seen = set(todo)
    while todo:
        name, extras = todo.pop()
        for more in map(Requirement, distribution(name).requires or []):
            asked = any(more.marker is None or more.marker.evaluate({"extra": extra}) for extra in ("", *extras))
            entry = name_of(more.name), frozenset(more.extras)
            if asked and entry not in seen:
                seen.add(entry)
                todo.append(entry)
    return {name for name, _ in seen}


def licence(name: str) -> str:
    about: importlib.metadata.PackageMetadata = distribution(name).metadata
    kinds = [each.rpartition("::")[2].strip() for each in about.get_all("Classifier") or [] if "License ::" in each]
    lines = (about["License"] or "").strip().splitlines() if "License" in about else []
    expression = about.get("License-Expression", "")
    return expression or "; ".join(kinds) or (lines[0] if lines else UNNAMED[name])


def test_the_default_install_has_no_copyleft_and_is_listed() -> None:
    found = libraries()
    assert [name for name in sorted(found - CHOICE) if COPYLEFT.search(licence(name))] == []
    cells = re.findall(r"^\|[^|]+\|([^|]+)\|$", section("docs/install.md", "Licences"), re.M)
    listed = {name_of(word) for cell in cells for word in re.findall(r"[\w.-]+", cell)}
    assert found - listed == set(), "docs/install.md lists every library under its licence"
