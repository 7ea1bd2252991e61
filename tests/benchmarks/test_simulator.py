"""The simulator's figures, asserted: cost against the prototype and against the site's size; run by `make bench`."""

import pytest

from benchmarks.simulator import bench_estimator, bench_simulator


def test_cost_of_a_pair() -> None:
    found = bench_simulator.bench()
    bench_simulator.show(found)
    assert found["44 aisles: ratio to 5"] <= 2.0
    assert found["44 aisles: start_s"] < 60.0
    ratios = {name: value for name, value in found.items() if "prototype (at most" in name}
    if not ratios:
        pytest.skip(f"no prototype at {bench_simulator.PROTOTYPE}: ratios to it were not measured")
    for name, limit in bench_simulator.LIMITS.items():
        assert ratios[f"{name}: ratio to the prototype (at most {limit})"] <= limit


def test_odometry_fares_alike_with_and_without_pictures() -> None:
    for robot, day in (("survey", 0), ("tote-1", 1)):
        rendered, simulated = bench_estimator.compare_odometry(robot, day, 150)
        assert simulated["inlier_share"] == pytest.approx(rendered["inlier_share"], rel=0.2)
        assert simulated["error_1s_mm_rms"] == pytest.approx(rendered["error_1s_mm_rms"], rel=0.2)


def test_generating_is_many_times_faster_than_real_time() -> None:
    assert bench_estimator.measure_speeds()["generate"] > 50.0
