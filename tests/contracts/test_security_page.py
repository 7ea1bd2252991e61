"""docs/security.md names all 38 attacks, and tests that are there."""

import re

import pytest

from support.fleet.contracts_documents import REPOSITORY, text

ROWS = re.findall(r"^\| ([\d, ]*)\|.*\| ([^|]*) \|$", text("docs/security.md"), re.MULTILINE)
NAMED = re.compile(r"`(?:(tests/[\w/]+\.py|\w+\.py))?((?:::\w+)*)`")


def test_every_attack_stands_in_a_table() -> None:
    assert {int(number) for numbers, _ in ROWS for number in re.findall(r"\d+", numbers)} == set(range(1, 39))


@pytest.mark.parametrize("tests", sorted({tests for _, tests in ROWS if "`" in tests}))
def test_its_tests_exist(tests: str) -> None:
    path, named = None, NAMED.findall(tests)
    assert named
    for file, names in named:
        if file:
            path = REPOSITORY / file if file.startswith("tests/") else path.parent / file
        for name in names.split("::")[1:]:
            assert re.search(rf"^\s*(?:def|class) {name}\b", path.read_text("utf-8"), re.MULTILINE), (str(path), name)
