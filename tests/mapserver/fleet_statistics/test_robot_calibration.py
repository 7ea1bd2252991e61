"""What a robot reports of its calibration, as the server shows it."""

import pytest

from mapserver.dashboard import fleet_parts
from mapserver.fleet_statistics.robot_calibration import CalibrationFigure, calibration_figures

METRICS = {
    "calibration_focal_scale": -0.0102,
    "calibration_focal_scale_sigma": 0.0012,
    "calibration_pair_yaw_deg": 0.011,
    "calibration_pair_yaw_deg_sigma": 0.008,
    "calibration_time_offset_s": 0.0202,
    "calibration_time_offset_s_sigma": 0.0006,
    "calibration_drifts": "focal_scale,time_offset_s",
    "frames": 12,
}


def test_figures_of_a_report() -> None:
    found = calibration_figures({"metrics": METRICS})
    assert [figure.name for figure in found] == ["focal_scale", "pair_yaw_deg", "time_offset_s"]
    assert [figure.is_drifted for figure in found] == [True, False, True]
    assert [figure.words for figure in found] == ["-1.02 ± 0.12 %", "+0.011 ± 0.008 °", "+20.2 ± 0.6 ms"]


@pytest.mark.parametrize("health", [None, {}, {"metrics": None}, {"metrics": {"frames": 3}}])
def test_robots_that_do_not_report_it(health: dict[str, object] | None) -> None:
    assert calibration_figures(health) == ()


def test_what_no_program_of_ours_sends_is_left_out() -> None:
    strange = {"calibration_focal_scale": "wide", "calibration_focal_scale_sigma": True, "calibration_drifts": 3}
    assert calibration_figures({"metrics": strange}) == ()


def test_robots_that_drift_stand_first() -> None:
    good = (CalibrationFigure("focal_scale", 0.001, 0.001, False),)
    bad = (CalibrationFigure("focal_scale", 0.02, 0.001, True),)
    found = fleet_parts.cameras([("a", good), ("b", bad), ("c", good), ("none", ())])
    assert [robot for robot, _ in found] == ["b", "a", "c"]
