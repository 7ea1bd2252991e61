"""Releases where others were faster, or something else was current."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fleetmap.errors import StateError, UsageError
from mapserver import releases
from mapserver.releases import release
from mapserver.store import Actor, MapStore
from support.storage.map_samples import publish_samples, save_sample_draft

ADA = Actor("ada", "a test")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    """Versions 1 and 2, published, and 3, a draft."""
    with MapStore.open(tmp_path / "store", create=True, clock_ns=lambda: 1_000) as opened:
        publish_samples(opened, 2)
        save_sample_draft(opened, seed=3)
        yield opened


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Something that happens once between the judgement of a draft and its release."""
    real = release._pass_gate

    def between(action: Callable[[], object]) -> None:
        def judged(*given: object, **more: object) -> object:
            monkeypatch.setattr(release, "_pass_gate", real)
            found = real(*given, **more)
            action()
            return found

        monkeypatch.setattr(release, "_pass_gate", judged)

    return between


def test_the_newest_draft_is_chosen(store: MapStore) -> None:
    save_sample_draft(store, seed=4)
    for wanted, error, words in ((1, StateError, "is published"), (9, UsageError, "no version 9")):
        with pytest.raises(error, match=words):
            releases.publish(store, "lab", wanted)
    assert [releases.publish(store, "lab"), releases.publish(store, "lab")] == [4, 3]
    with pytest.raises(UsageError, match="no draft"):
        releases.publish(store, "lab")


def test_publishing_replaces_the_version_that_the_draft_was_compared_with(store: MapStore, meanwhile) -> None:
    meanwhile(lambda: releases.promote(store, "lab", 1))
    with pytest.raises(StateError, match="became current while draft 3 was compared with 2"):
        releases.publish(store, "lab")


def test_what_becomes_current_ends_the_canary(store: MapStore) -> None:
    releases.start_canary(store, "lab", 3, 0.1, actor=ADA)
    releases.promote(store, "lab", 3, actor=ADA)
    assert [(canary.state, canary.outcome) for canary in store.canaries("lab")] == [("promoted", "a test")]
    assert [event.kind for event in store.last_events("lab", 2)] == ["promoted", "canary_promoted"]
    releases.start_canary(store, "lab", 2, 0.1, actor=ADA)
    releases.promote(store, "lab", 1, actor=ADA)
    assert store.canaries("lab")[0].outcome == "version 1 became current"
    assert [event.kind for event in store.last_events("lab", 2)] == ["promoted", "canary_stopped"]


def test_a_canary_begins_only_beside_the_version_that_it_was_judged_against(store: MapStore, meanwhile) -> None:
    meanwhile(lambda: releases.promote(store, "lab", 1))
    with pytest.raises(StateError, match="meanwhile by another operator"):
        releases.start_canary(store, "lab", 3, 0.1)
    meanwhile(lambda: releases.start_canary(store, "lab", 2, 0.1))
    with pytest.raises(StateError, match="meanwhile by another operator"):
        releases.start_canary(store, "lab", 3, 0.1)
    releases.roll_back(store, "lab")
    releases.start_canary(store, "lab", 3, 0.1)
    assert [event.kind for event in store.last_events("lab", 2)] == ["canary_started", "admitted"]


def test_a_canary_that_does_not_run_any_more_is_not_ended(store: MapStore) -> None:
    canary = releases.start_canary(store, "lab", 3, 0.1)
    releases.end_canary(store, canary, promote=False, outcome="complaints", actor=ADA)
    assert (store.version("lab", 3).state, store.canaries("lab")[0].state) == ("retired", "rolled_back")
    with pytest.raises(StateError, match="no longer a canary"):
        releases.end_canary(store, canary, promote=True, outcome="late")
