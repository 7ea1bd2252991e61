"""The picture of a replay: drawn for every kind of run, with colours that say what happened."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.messages import Status
from locclient.replay.plots import RunPlot, draw_run, ticks
from locclient.replay.run_metrics import FrameRecord

FRAMES = 60
RED, VIOLET = (47, 52, 209), (168, 60, 190)


def plot(**about: object) -> RunPlot:
    """Ten metres in six seconds past two walls, 10 mm off."""
    x = np.linspace(0.0, 10.0, FRAMES)
    truths = np.column_stack([x, 0 * x, 0 * x])
    error = np.array([0.0, 0.01, 0.0])
    frames = [
        FrameRecord(k * 10**8, Status.TRACKING, True, 1e-4 * np.eye(6), error, 0.01, 0.005, 0.006, {})
        for k in range(FRAMES)
    ]
    walls = np.column_stack([np.tile(x, 2), np.repeat([-2.0, 2.0], FRAMES), np.ones(2 * FRAMES)])
    return replace(RunPlot("hall, version 3", frames, truths + error, truths, walls), **about)


def count(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> int:
    return int((picture == colour).all(axis=2).sum())


def test_a_good_run_shows_no_alarm() -> None:
    picture = draw_run(plot())
    assert picture.shape[1:] == (2040, 3)
    assert picture.shape[0] >= 700
    assert count(picture, RED) < 500, "the end's mark alone"
    assert count(picture, VIOLET) < 200, "its entry in the legend alone"


def test_large_errors_and_frames_that_are_not_localised_stand_out() -> None:
    run = plot()
    frames, places = list(run.frames), run.positions_map_m.copy()
    for k in range(10, 20):
        frames[k] = replace(frames[k], error_map_m=np.array([0.0, 0.8, 0.0]))
    for k in range(30, 40):
        frames[k] = replace(frames[k], status=Status.AMBIGUOUS)
    frames[50], places[50] = replace(frames[50], status=Status.LOST, error_map_m=None, cov_rot_trans=None), np.nan
    picture = draw_run(replace(run, frames=frames, positions_map_m=places))
    assert count(picture, RED) > 1000
    assert count(picture, VIOLET) > 500


@pytest.mark.parametrize("frames", [0, 1, FRAMES])
@pytest.mark.parametrize("landmarks", [0, 1, 2 * FRAMES])
def test_runs_without_truth_or_pose_are_drawn(frames: int, landmarks: int) -> None:
    run, nowhere = plot(), np.full((frames, 3), np.nan)
    lost = [
        replace(frame, status=Status.LOST, has_fix=False, cov_rot_trans=None, error_map_m=None, error_rad=None)
        for frame in run.frames[:frames]
    ]
    assert draw_run(RunPlot("x", lost, nowhere, nowhere, run.landmarks_map_m[:landmarks])).shape[1] == 2040
    untold = [replace(frame, error_map_m=None, error_rad=None) for frame in run.frames[:frames]]
    shown = RunPlot("x", untold, run.positions_map_m[:frames], nowhere, run.landmarks_map_m[:landmarks])
    assert draw_run(shown).shape[1] == 2040


def test_ticks_are_round() -> None:
    assert ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10]
    assert ticks(-0.013, 0.031) == [-0.01, 0.0, 0.01, 0.02, 0.03]
    assert ticks(3.0, 290.0) == [50, 100, 150, 200, 250]
