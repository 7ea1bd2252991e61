"""What is older than its period goes: pictures and recordings of surveys, by the command and by every night."""

import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest

from fleetmap.errors import StateError
from mapserver import releases
from mapserver.drafting.job_lock import only_one
from mapserver.nightly.inbox import BAD, DONE, HELD, put_away, remove_old
from mapserver.store import FleetRetention, MapStore, Retention
from support.storage.clock import Clock
from support.storage.map_samples import save_picture_draft

DAY_S, HASH = 86_400, "ab" * 32


@pytest.mark.parametrize("since_ns", [0, 1_400_000_000 * 10**9, 4_000_000_000 * 10**9])
def test_pictures_of_surveys_go_from_every_version_that_has_them(store: MapStore, clock: Clock, since_ns: int) -> None:
    """After their period since they came: their clock counts from a start, from 1970 and is of 2014, or is ahead."""
    first = save_picture_draft(store, 0.0, 3.0, since_ns=since_ns)
    releases.publish(store, "lab", first)
    clock.now_ns += 3 * DAY_S * 10**9
    both = save_picture_draft(store, -3.0, since_ns=since_ns, before=store.survey_pictures("lab", first))
    last = save_picture_draft(store, before=store.survey_pictures("lab", both))
    for version in (both, last):
        releases.publish(store, "lab", version)
    assert [len(store.survey_pictures("lab", version)) for version in (first, both, last)] == [2, 3, 3]
    blobs = len(list(store.folder.glob("blobs/*/*")))
    assert store.remove_survey_pictures(5.0) == 0
    clock.now_ns += 3 * DAY_S * 10**9
    assert store.remove_survey_pictures(5.0, dry_run=True) == 2
    assert len(list(store.folder.glob("blobs/*/*"))) == blobs
    store.collect_garbage(Retention(keep_versions=0, keep_drafts=0, keep_days=0.0))
    assert [info.version for info in store.versions("lab")] == [both, last]
    assert store.remove_survey_pictures(5.0) == 2, "though the version that came with them is gone"
    assert [len(store.survey_pictures("lab", version)) for version in (both, last)] == [1, 1]
    assert store.verify().faults == []
    clock.now_ns += 3 * DAY_S * 10**9
    assert store.remove_survey_pictures(5.0) == 1
    with pytest.raises(StateError, match="removed after their period"):
        store.survey_pictures("lab", both)
    store.export_version("lab", both, store.folder / "lab.fmex")
    with MapStore.open(store.folder / "other", create=True) as other:
        other.import_version(store.folder / "lab.fmex")
        assert other.verify().faults == []


@pytest.fixture
def inbox(tmp_path: Path) -> Path:
    """Recordings in each folder, and one that waits."""
    for number, where in enumerate((DONE, HELD, BAD)):
        recording = tmp_path / "inbox/lab" / f"drive{number}"
        (recording / "mav0").mkdir(parents=True)
        put_away(recording, where, HASH, "it is far away")
    (tmp_path / "inbox/lab/done" / "single.mcap").write_bytes(b"x")
    (tmp_path / "inbox/lab/bad" / "link").symlink_to("/etc")
    (tmp_path / "inbox/lab" / "tonight.mcap").write_bytes(b"x")
    return tmp_path / "inbox/lab"


def test_recordings_that_were_put_away_go_and_others_stay(inbox: Path) -> None:
    now_ns = time.time_ns()
    os.utime(inbox / "done/single.mcap", (0, 0))  # copied with an old time: it came today all the same
    assert remove_old(inbox, 1.0, now_ns) == 0
    later_ns = now_ns + 2 * DAY_S * 10**9
    assert remove_old(inbox, 1.0, later_ns, dry_run=True) == 5
    assert remove_old(inbox, 3.0, later_ns) == 0
    assert remove_old(inbox, 1.0, later_ns) == 5
    left = sorted(str(path.relative_to(inbox)) for path in inbox.rglob("*"))
    assert left == ["bad", "done", "held", "tonight.mcap"]
    assert Path("/etc/passwd").exists()


def test_a_night_that_reads_its_recordings_keeps_them(run, inbox: Path, tmp_path: Path) -> None:
    """Also of a build: it begins with the recordings that its night left."""
    config = tmp_path / "site.toml"
    config.write_text("[ingest]\nrecording_days = 1e-9\n")
    command = ["retention", "--store", tmp_path / "store", "--inbox", inbox.parent, "--config", config]
    with MapStore.open(tmp_path / "store", create=True) as store, only_one(store, "lab"):
        assert "a night reads its recordings" in run(*command)
    assert (inbox / "done/single.mcap").exists()
    assert "recordings of surveys: 5 removed" in run(*command)


def test_a_recording_that_somebody_else_removes_meanwhile_ends_nothing(inbox: Path, monkeypatch) -> None:
    removed = shutil.rmtree

    def twice(path: Path) -> None:
        removed(path)
        removed(path)

    monkeypatch.setattr(shutil, "rmtree", twice)
    assert remove_old(inbox, 1.0, time.time_ns() + 2 * DAY_S * 10**9) == 2, "the file and the link"


def test_the_command_takes_its_periods_from_the_file(run, inbox: Path, tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_picture_draft(store, 0.0, 3.0)
    config = tmp_path / "site.toml"
    config.write_text("[ingest]\nrecording_days = 1e-9\nsurvey_picture_days = 1e-9\n")
    command = ["retention", "--store", tmp_path / "store", "--inbox", inbox.parent]
    assert "recordings of surveys: 0 removed\n" in run(*command)
    command += ["--config", config]
    assert "recordings of surveys: 5 would be removed\n" in run(*command, "--dry-run")
    removed = json.loads(run(*command, "--json"))
    assert (removed["recordings of surveys"], removed["pictures of surveys"]) == (5, 2)
    assert set(removed) >= {"failures", "pictures of failures", "recordings of failures", "ways of robots"}
    assert FleetRetention() == replace(FleetRetention(), recording_days=400.0, picture_days=30.0)
