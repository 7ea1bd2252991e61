"""How maps reach a fleet: bytes, time, what the server costs, and what no input can do; run by `make bench`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fleet import bench_bus_access, bench_delivery, bench_service, bench_trust
from benchmarks.maps import bench_map_budget, bench_map_fuzz
from support.recordings.realdata import real_data

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def test_three_hundred_robots_fetch_a_site_and_a_delta() -> None:
    rows = bench_service.bench(clients=300, site_mb=50, outage_s=60)
    print(json.dumps(rows))
    whole, delta, nothing = (rows[name] for name in ("whole", "delta", "nothing moved"))
    assert whole["robots"] == delta["robots"] == 300
    assert delta["bytes_per_robot"] <= 0.15 * whole["bytes_per_robot"]
    assert nothing["bytes_per_robot"] <= 0.01 * whole["bytes_per_robot"]
    assert whole["http_p99_ms"] < 50
    assert delta["http_p99_ms"] < 50
    # Once the server's caches are full, another 15 GB cost hardly more memory: what is freed is not all given back.
    assert rows["whole again"]["rss_max_mb"] < 1.25 * rows["whole again"]["rss_begin_mb"]
    assert rows["whole again"]["rss_max_mb"] < 500


def test_what_trust_costs_before_and_after(tmp_path: Path) -> None:
    found = bench_trust.bench(tmp_path)
    small = bench_delivery.bench(tmp_path / "delivery", clients=60, site_mb=5, pairs=2)
    print(json.dumps(found | {"60 robots x 5 MB": small}))
    print(bench_trust.table(found, small["sums"]))
    robot = found["robot"]["with"]
    assert robot["mib"] - found["robot"]["without"]["mib"] <= 20
    assert robot["first contact"]["bytes"] <= 4000
    assert max(costs["cpu_ms"] for costs in robot.values() if isinstance(costs, dict)) <= 10


def test_mutual_tls_delays_a_fleet_little(tmp_path: Path) -> None:
    found = bench_delivery.bench(tmp_path, clients=300, site_mb=50, pairs=1)
    print(json.dumps(found))
    assert found["ratio"]["wall_s"] <= 1.5


def test_a_thousand_enrolled_robots(tmp_path: Path) -> None:
    found = bench_bus_access.opening_and_revoking(tmp_path / "many", 1000, 12)
    print(json.dumps({"1000 robots": found}))
    assert found["open_s"] <= 1
    assert found["mib"] <= 100
    assert found["revoked_is_out_s"] <= 2
    assert found["others_again_s"] <= 2
    assert found["revoked_stays_out"]


def test_a_hundred_thousand_hostile_inputs() -> None:
    before_mb = bench_map_fuzz.peak_mb()
    found = bench_map_fuzz.fuzz(100_000, seed=0)
    bench_map_fuzz.show(found)
    assert sum(figures["inputs"] for figures in found.values()) >= 100_000
    assert max(figures["slowest_ms"] for figures in found.values()) < 2000
    assert bench_map_fuzz.peak_mb() - before_mb < 300


def test_the_default_budget_costs_little(tmp_path: Path) -> None:
    recording = real_data("euroc_v101_keyframes")
    program = "from mapserver.cli import main; main()"
    arguments = ["build", str(recording), "--site", "bench", "--store", str(tmp_path), "--frames", "0::2"]
    subprocess.run(
        [sys.executable, "-c", program, *arguments, "--frame-from-ground-truth"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, check=True,
    )  # fmt: skip
    default, full, *_ = bench_map_budget.measure(tmp_path, "bench", None, recording, "1::2")
    assert float(default["bytes_per_m"]) <= 3000  # type: ignore[arg-type]
    assert int(default["largest_tile_bytes"]) <= 256_000  # type: ignore[call-overload]
    assert float(default["localised_share"]) >= float(full["localised_share"]) - 0.02  # type: ignore[arg-type]
