"""The dashboard's promise: with 300 robots that drive, every page within a second, a map that moves, and the server far from a whole
core.
"""

import json

import pytest

from benchmarks.fleet import bench_dashboard

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_pages_load_within_a_second_and_cost_the_server_little() -> None:
    figures = bench_dashboard.measure(robots=300, seconds=30.0, pages=5)
    print(json.dumps(figures))
    assert all(loads["cold_median_ms"] < 1000 for loads in figures["loads"].values())
    assert min(figures["map_frames_per_s"].values()) >= 10
    assert figures["server_with_5_fleet_pages"]["cores"] < 1.0
    assert figures["server_with_5_fleet_pages"]["rss_mb"] < figures["server_without_pages"]["rss_mb"] + 30
