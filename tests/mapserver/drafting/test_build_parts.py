"""The parts of a build: moving a survey, its report, its stages, zones."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from fleetmap.errors import UsageError
from fleetmap.geometry import se3_exp, se3_inverse, transform_points
from fleetmap.sensors.samples import Trajectory
from mapserver.drafting.progress import ProgressView, StageTimes
from mapserver.drafting.survey_recordings import read_zones
from mapserver.evaluation.trajectory_error import accuracy
from support.storage.map_samples import random_survey

NEW_FROM_MAP = se3_exp(np.array([0.4, -1.2, 2.0, 3.0, -7.0, 1.0]))


def test_moving_a_survey_changes_nothing_that_was_measured() -> None:
    survey = random_survey(np.random.default_rng(1))
    there = survey.transformed(NEW_FROM_MAP)
    seen = [[transform_points(se3_inverse(body), s.points_map) for body in s.map_from_body] for s in (there, survey)]
    np.testing.assert_allclose(*seen, atol=1e-9)
    np.testing.assert_allclose(there.map_from_body[0], NEW_FROM_MAP @ survey.map_from_body[0], atol=1e-12)
    np.testing.assert_allclose(there.trajectory.frame_from_body, there.map_from_body, atol=1e-12)
    back = there.transformed(se3_inverse(NEW_FROM_MAP))
    np.testing.assert_allclose(back.points_map, survey.points_map, atol=1e-9)
    assert there.descriptors is survey.descriptors


def test_accuracy_is_over_all_estimated_frames_that_have_a_truth() -> None:
    """Ten frames: two are only guessed, and wrong by metres; one has no truth; the others are right."""
    rng = np.random.default_rng(2)
    frames = 10
    stamps = np.arange(frames, dtype=np.int64) * 100_000_000
    true = np.tile(np.eye(4), (frames, 1, 1))
    true[:, :3, 3] = rng.uniform(-5, 5, (frames, 3))
    estimate = NEW_FROM_MAP @ true
    estimate[[3, 7], :3, 3] += 4.0
    estimated = np.ones(frames, bool)
    estimated[[3, 7]] = False
    survey = replace(random_survey(rng), trajectory=Trajectory(stamps, estimate), trajectory_estimated=estimated)
    found = accuracy(survey.estimated_trajectory, frames, Trajectory(stamps[:-1], true[:-1]), stamps[::2])
    assert found.rigid.rmse_m < 1e-9
    assert found.evaluated_share == pytest.approx(0.7)
    assert found.worst_step["off_m"] < 1e-9
    np.testing.assert_allclose(found.rigid.frame_from_estimate, se3_inverse(NEW_FROM_MAP), atol=1e-9)
    assert accuracy(survey.estimated_trajectory, frames, None, stamps).evaluated_share is None
    few = accuracy(survey.estimated_trajectory, frames, Trajectory(stamps[:2], true[:2]), stamps)
    assert (few.rigid, few.evaluated_share) == (None, pytest.approx(0.2))


def test_the_time_before_a_call_goes_to_the_stage_that_used_it() -> None:
    times = StageTimes(iter([0.0, 1.0, 3.0, 3.5, 10.0, 10.5, 11.0, 14.0]).__next__)
    times("odometry", 1, 2)  # 1 s
    times("odometry", 2, 2)  # 2 s
    times("adjustment", 0, 1)  # 0.5 s: odometry is done, the adjustment not begun; never says when it is done
    times("loops", 1, 2)  # 6.5 s of adjustment
    times("loops", 2, 2)  # 0.5 s
    times("matching", 1, 1)  # 0.5 s: the first part of matching
    times.begin("storing")  # 3 s
    assert times.seconds == {"odometry": 3.5, "adjustment": 6.5, "loops": 0.5, "matching": 3.5}
    assert sum(times.seconds.values()) == 14.0


def test_progress_is_lines_in_a_log_and_bars_on_a_terminal() -> None:
    def printed(*, is_terminal: bool) -> str:
        console = Console(record=True, force_terminal=is_terminal, width=80, file=io.StringIO())
        with ProgressView(console) as view:
            for number in (1, 2):
                view("odometry", number, 2)
            for number in (0, 1):
                view("adjust", number, 1)
                view("match", number + 2, 3)
        return console.export_text()

    assert printed(is_terminal=False).splitlines() == ["odometry: 2", "adjust", "match: 3", "adjust", "match: 3"]
    shown = printed(is_terminal=True)
    assert "odometry" in shown
    assert "2/2" in shown
    assert "3/3" in shown


def test_zones_are_read(tmp_path: Path) -> None:
    file = tmp_path / "zones.toml"
    file.write_text('[zones]\n"cold store" = [[0, 0], [4, 0], [4, 4.5], [0, 4]]\nramp = [[9, 0], [10, 0], [10, 1]]\n')
    zones = read_zones(file)
    assert zones.at(np.array([1.0, 1.0, 0.0])) == {"cold store"}
    assert not zones.compatible(np.array([1.0, 1.0]), np.array([9.8, 0.2]))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("zones = 3", "zones"),
        ("[zones]", "empty"),
        ("[areas]\na = [[0, 0], [1, 0], [1, 1]]", "areas"),
        ("[zones]\nramp = [[0, 0], [1, 0]]", "'ramp' has 2 corner"),
        ("[zones]\nramp = [[0, 0], [1, 0], [1]]", "'ramp'"),
        ('[zones]\nramp = [[0, 0], [1, 0], [1, "b"]]', "'ramp'"),
        ("[zones]\nramp = [[0, 0], [1, 0], [1, nan]]", "'ramp' has a corner that is not finite"),
        ("[zones\n", "zones.toml"),
    ],
)
def test_bad_zones_are_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "zones.toml").write_text(text)
    with pytest.raises(UsageError, match=said):
        read_zones(tmp_path / "zones.toml")
