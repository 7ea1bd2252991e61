"""A job whose process was killed does not stand as running for ever, and one that runs is left alone."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from unittest.mock import Mock

import pytest

from fleetmap.console import plain_console
from fleetmap.errors import StoreError, SurveyError
from mapserver.drafting.job_lock import INTERRUPTED, JobProgress, end_interrupted, log_path, logged, recorded_job
from mapserver.store import MapStore
from support.storage.map_samples import save_sample_draft
from support.waiting import within_another_process

MINUTES_NS = 600 * 10**9


@contextmanager
def working(folder: Path) -> Iterator[None]:
    """A job is noted and under way."""
    with MapStore.open(folder) as maps, recorded_job(maps, "lab", "build"):
        yield


def test_a_killed_job_is_ended_and_a_running_one_is_not(metadata_folder: Path) -> None:
    tmp_path = metadata_folder
    with MapStore.open(tmp_path, create=True) as maps:
        save_sample_draft(maps)
    later_ns = time.time_ns() + MINUTES_NS
    with within_another_process(working, tmp_path), MapStore.open(tmp_path) as maps:
        assert end_interrupted(maps, later_ns) == []
        assert [job.state for job in maps.jobs()] == ["running"]
    with MapStore.open(tmp_path) as maps:
        assert end_interrupted(maps, time.time_ns()) == []  # it may not hold its lock yet
        assert end_interrupted(maps, later_ns) == [1]
        (job,) = maps.jobs()
        assert (job.state, job.report) == ("failed", {INTERRUPTED: True})
        assert "was interrupted" in job.message
        assert job.finished is not None
        assert end_interrupted(maps, later_ns) == []
    assert list(tmp_path.glob("job-*.lock")) == []


def test_the_next_job_ends_it_too(tmp_path: Path) -> None:
    """Without a server, which looks every few seconds."""
    with MapStore.open(tmp_path, create=True, clock_ns=lambda: time.time_ns() - MINUTES_NS) as maps:
        save_sample_draft(maps)
        maps.begin_job("lab", "build")
    with MapStore.open(tmp_path) as maps:
        with recorded_job(maps, "lab", "build"):
            assert [job.state for job in maps.jobs()] == ["running", "failed"]
        assert [job.state for job in maps.jobs()] == ["done", "failed"]
    assert list(tmp_path.glob("job-*.lock")) == []


def test_a_job_tells_how_far_it_is_until_it_ends(store: MapStore) -> None:
    """At most every two seconds, each stage at once; also for a site without a version."""
    now_s = [100.0]
    with recorded_job(store, "new", "build") as job:
        tell = JobProgress(store, job.number, lambda: now_s[0])
        told = []
        for step_s, stage, done in ((0, "odometry", 1), (1, "odometry", 5), (1.5, "odometry", 8), (0.1, "matching", 0)):
            now_s[0] += step_s
            tell(stage, done, 10)
            told.append([store.job(1).report["progress"][name] for name in ("stage", "done", "stage_s")])
        assert told == [["odometry", 1, 0.0], ["odometry", 1, 0.0], ["odometry", 8, 2.5], ["matching", 0, 0.0]]
        assert store.sites_with_jobs() == ["new"]
        job.report = {"version": 1}
    assert store.job(1).report == {"version": 1}
    store.tell_progress(1, {"stage": "late"})
    assert store.job(1).report == {"version": 1}
    JobProgress(store, None)("odometry", 1, 2)  # a build that no job stands for


def test_a_job_keeps_its_log(store: MapStore, capfd) -> None:
    """What it printed, and why it ended; of the last jobs alone."""
    (store.folder / "job-1.log").touch()
    with recorded_job(store, "new", "build") as job:
        plain_console(stderr=True).print("reading [red]monday")
    with pytest.raises(SurveyError), recorded_job(store, "new", "build"):
        raise SurveyError("too dark")
    assert (store.job(2).state, store.job(2).message) == ("failed", "too dark")
    assert log_path(store.folder, job.number or 0).read_text() == "reading [red]monday\n"
    assert log_path(store.folder, 2).read_text() == "too dark\n"
    with logged(store.folder, 202), pytest.raises(ZeroDivisionError), logged(store.folder, 201):
        1 / 0  # noqa: B018
    assert "ZeroDivisionError" in log_path(store.folder, 201).read_text()
    assert sorted(path.name for path in store.folder.glob("job-*.log")) == ["job-201.log", "job-202.log"]
    assert "reading [red]monday" in capfd.readouterr().err


def test_a_full_disk_under_the_output_does_not_stop_a_build(tmp_path: Path) -> None:
    """As of a build that an operator started, whose output lies in a temporary file."""
    full = os.fdopen(os.open("/dev/full", os.O_WRONLY), "w", 1)
    with redirect_stderr(full), logged(tmp_path, 1):
        plain_console(stderr=True).print("reading monday")
    assert log_path(tmp_path, 1).read_text() == "reading monday\n"
    with pytest.raises(OSError, match="No space"):
        full.close()


def test_a_busy_store_does_not_stop_a_build(tmp_path: Path, monkeypatch) -> None:
    with MapStore.open(tmp_path, create=True) as maps, recorded_job(maps, "new", "build") as job:
        monkeypatch.setattr(maps, "tell_progress", Mock(side_effect=StoreError("the store is busy")))
        JobProgress(maps, job.number)("odometry", 1, 2)
        job.report = {"version": 1}
    with MapStore.open(tmp_path) as maps:
        assert (maps.job(1).state, maps.job(1).report) == ("done", {"version": 1})
