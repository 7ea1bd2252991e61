"""A fleet that reports to one server, counted at both ends; run by `make bench`."""

import json
from pathlib import Path

import pytest

from benchmarks.fleet import bench_canary, bench_failure_replay, bench_fleet, bench_flood

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def test_three_hundred_robots_report_and_nothing_is_lost() -> None:
    found = bench_fleet.bench(300, 600, month=True)
    print(json.dumps(found))
    load, month = found["load"], found["month"]
    assert load["health_heard"] == load["health_said"] == 300 * 600
    assert load["estimates_heard"] == load["estimates_said"]
    assert load["failures_kept"] == load["failures_said"] > 0
    assert load["server_cores"] < 1.0
    assert load["rss_end_mb"] < 1.1 * load["rss_begin_mb"]
    assert max(load["slowest_page_ms"].values()) < 1000
    assert month["size_mb"] < 500


def test_a_robot_that_floods_is_in_nobodys_way(tmp_path: Path) -> None:
    found = bench_flood.bench(tmp_path)
    print(json.dumps(found))
    for kind in bench_flood.KINDS:
        assert found[kind]["longest_wait_s"] <= 1.0, kind
        assert found[kind]["memory_mb"] <= 50, kind
        assert found[kind]["disk_mb"] <= 50, kind


def test_failures_are_repeated_from_their_recordings() -> None:
    found = bench_failure_replay.measure(50, seed=0)
    print(json.dumps(found))
    assert found["same_statuses"] == found["failures"] == 50
    assert len(found["causes"]) >= 3
    assert found["ring_ms_mean"] <= 0.3


def test_a_map_with_a_shifted_aisle_is_taken_back() -> None:
    found = bench_canary.bench(100, 0.05)
    print(json.dumps(found))
    assert found["members"] <= 10
    assert found["minutes"] < 60
    assert found["others_events"] == 0
