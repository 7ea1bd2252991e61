"""Rules of releases over made rows: what is decided where others were faster."""

import pytest

from fleetmap.errors import StateError, UsageError
from mapserver.releases import rules
from mapserver.store import Actor, CanaryRow, NewCanary, VersionInfo
from mapserver.store.rows import SiteReleases

ADA = Actor("ada", "a test")
CANARY = CanaryRow(7, "lab", 2, 1, 0.1, 0.1, "running", 5, None, "ada", "", "")


def version(number: int, state: str) -> VersionInfo:
    sizes, sha256 = (1, 10, 40), "ab" * 32
    return VersionInfo("lab", number, state, None, "", None, sha256, 100, *sizes, sha256, 5, None, 0, None)


def rows(*states: str, canary: CanaryRow | None = None) -> SiteReleases:
    """Versions from 1 on with these states."""
    versions = {number: version(number, state) for number, state in enumerate(states, start=1)}
    return SiteReleases("lab", versions, None, None, canary)


def test_the_newest_draft_is_chosen() -> None:
    assert rules.chosen_draft(rows("current", "draft", "draft"), None).version == 3
    assert rules.chosen_draft(rows("current", "draft", "draft"), 2).version == 2
    for wanted, error, words in (
        (1, StateError, "is current"),
        (9, UsageError, "no version 9"),
        (None, UsageError, "no draft"),
    ):
        with pytest.raises(error, match=words):
            rules.chosen_draft(rows("current"), wanted)


def test_publishing_replaces_the_version_that_the_draft_was_compared_with() -> None:
    changes = rules.publication(rows("current", "draft"), 2, 1, ADA)
    assert (changes.states, changes.new_current) == (((1, "published"), (2, "current")), 2)
    assert [(entry.kind, entry.detail) for entry in changes.log] == [("published", "version 2, replacing 1")]
    with pytest.raises(StateError, match="became current while draft 3 was compared with 1"):
        rules.publication(rows("published", "current", "draft"), 3, 1, ADA)
    with pytest.raises(StateError, match="only a draft"):
        rules.publication(rows("published", "current"), 1, 2, ADA)


def test_what_becomes_current_ends_the_canary() -> None:
    tried = rules.promotion(rows("current", "published", canary=CANARY), 2, ADA)
    assert tried.ended_canary == (7, "promoted", "a test")
    other = rules.promotion(rows("current", "published", "retired", canary=CANARY), 3, ADA)
    assert other.ended_canary == (7, "stopped", "version 3 became current")
    assert [entry.kind for entry in other.log] == ["canary_stopped", "promoted"]
    assert rules.promotion(rows("current"), 1, ADA).states == ()


def test_a_canary_begins_only_beside_the_version_that_it_was_judged_against() -> None:
    new = NewCanary(2, 1, 0.1, 0.2, ADA)
    begun = rules.canary_start(rows("current", "draft"), new)
    assert (begun.states, begun.new_canary) == (((2, "published"),), new)
    assert [entry.kind for entry in begun.log] == ["admitted", "canary_started"]
    for late in (rows("published", "draft", "current"), rows("current", "published", canary=CANARY)):
        with pytest.raises(StateError, match="meanwhile by another operator"):
            rules.canary_start(late, new)


def test_a_canary_that_does_not_run_any_more_is_not_ended() -> None:
    taken_back = rules.canary_withdrawal(rows("current", "published", canary=CANARY), CANARY, "complaints", ADA)
    assert (taken_back.states, taken_back.ended_canary) == (((2, "retired"),), (7, "rolled_back", "complaints"))
    for end in (rules.canary_promotion, lambda *given: rules.canary_withdrawal(*given[:2], "late", given[2])):
        with pytest.raises(StateError, match="no longer a canary"):
            end(rows("current", "published"), CANARY, ADA)
