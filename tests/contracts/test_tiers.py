"""The two tiers of tests: every entry of tiers.toml names something, and continuous integration drives the whole path."""

import re

import pytest

from conftest import TESTS, entries_of_tier
from support.fleet.contracts_documents import text


@pytest.mark.parametrize("entry", entries_of_tier("long") + entries_of_tier("ci"))
def test_an_entry_names_a_folder_a_file_or_a_test(entry: str) -> None:
    path, _, test = entry.partition("::")
    assert (TESTS / path).exists()
    for name in test.split("::") if test else ():
        assert re.search(rf"^\s*(?:def|class) {name}\b", (TESTS / path).read_text("utf-8"), re.MULTILINE)


def test_what_ci_adds_is_of_the_long_tier() -> None:
    long = entries_of_tier("long")
    is_long = {ci: any(ci == e or ci.startswith((f"{e}/", f"{e}::")) for e in long) for ci in entries_of_tier("ci")}
    assert [ci for ci, found in is_long.items() if not found] == []


def test_each_verb_runs_its_tier() -> None:
    makefile = text("Makefile")
    for verb, selection in (("test", '-m "not long"'), ("test-ci", '-m "not long or ci"'), ("test-all", "")):
        rule = re.search(rf"^{verb}: .*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
        assert ("-m " in rule[1], selection in rule[1]) == (bool(selection), True), verb
    commands = text(".ci/run")
    assert "make test-ci\n" in commands
    assert "make demo RECORDING=" in commands
