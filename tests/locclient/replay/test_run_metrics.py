"""What a run was worth, against sequences small enough to judge by hand, and its picture, with colours that say what happened."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_exp
from fleetmap.messages import Status
from locclient.replay import run_metrics
from locclient.replay.plots import RunPlot, draw_protection, draw_run, ticks
from locclient.replay.run_metrics import METRICS, FrameRecord
from locclient.replay.run_result import ReplayResult

T, D, A, L, I = Status.TRACKING, Status.DEGRADED, Status.AMBIGUOUS, Status.LOST, Status.INITIALISING  # noqa: E741


def frame(
    t_s: float, status: Status = T, *, fix: bool = True, error_m: float | None = 0.0, error_deg: float = 0.0,
    sigma_m: float | None = 0.05, cpu_s: float = 0.01, wall_s: float = 0.02, stage_s: dict[str, float] | None = None,
    speed_mps: float | None = None, may_be_mapped: bool = True,
) -> FrameRecord:  # fmt: skip
    error = None if error_m is None else error_m * np.array([0.6, -0.8, 0.0])
    covariance = None if sigma_m is None else np.diag([1e-4] * 3 + [sigma_m**2] * 3)
    stages = {} if stage_s is None else stage_s
    angle = None if error_m is None else float(np.radians(error_deg))
    about = (speed_mps, may_be_mapped)
    return FrameRecord(round(t_s * 1e9), status, fix, covariance, error, angle, cpu_s, wall_s, stages, *about)


def sequence(*stretches: tuple[float, dict[str, object]]) -> list[FrameRecord]:
    """Frames at 10 Hz, so many seconds of each kind; what is not said is good tracking."""
    frames: list[FrameRecord] = []
    for seconds, kind in stretches:
        for _ in range(round(seconds / 0.1)):
            frames.append(frame(len(frames) * 0.1, **kind))  # type: ignore[arg-type]
    return frames


GOOD: dict[str, object] = {}
WRONG: dict[str, object] = {"error_m": 0.31, "sigma_m": 0.5}  # honest about its doubt, and still wrong
LOST: dict[str, object] = {"status": L, "fix": False, "error_m": None, "sigma_m": None}


def counts(frames: list[FrameRecord]) -> tuple[object, object]:
    """(silent, position) failures."""
    return METRICS["silent_failures"](frames), METRICS["position_failures"](frames)


def test_errors_are_compared_with_their_levels() -> None:
    levels = [(0.01, 0.1), (0.02, 0.1), (0.3, 0.2), (0.0, 0.6), (0.0, np.inf)]
    frames = [frame(0.1 * k, error_m=e)._replace(protection_m=level) for k, (e, level) in enumerate(levels)]
    found = run_metrics.protection(frames)
    assert found is not None and found["available_share"] == 0.6 and found["beyond_share"] == 0.25
    assert found["error_of_level"] == {"median": pytest.approx(0.15), "max": pytest.approx(1.5)}
    drawn, without = (draw_protection(shown) for shown in (frames, frames[:2]))
    assert (drawn[510:530, 534:554] == (47, 52, 209)).all(axis=2).any()  # of the error beyond its level, red
    assert not (without[510:530, 534:554] == (47, 52, 209)).all(axis=2).any()
    assert run_metrics.protection([frame(0.0, L)]) is None


def test_dense_frames_are_localised_by_status() -> None:
    frames = [frame(0.0, I), frame(0.1, T, fix=False), frame(0.2, D), frame(0.3, A), frame(0.4, L)]
    assert run_metrics.localised(frames) == [False, True, False, False, False]


def test_sparse_frames_are_localised_by_their_own_fix() -> None:
    frames = [frame(0.0, I), frame(1.5, L, fix=False), frame(3.0, D), frame(4.5, T, fix=False)]
    assert run_metrics.localised(frames) == [True, False, True, True]
    assert run_metrics.localised([frame(0.0, I), frame(1.0, I)]) == [False, False]  # not more than a second apart
    assert run_metrics.localised([frame(0.0, I)]) == [False]


def test_the_share_counts_from_the_first_fix() -> None:
    frames = [frame(0.1 * k, I, fix=False) for k in range(4)]
    frames += [frame(0.4, I), frame(0.5, T), frame(0.6, D, fix=False), frame(0.7, T)]
    assert METRICS["localised_share"](frames) == pytest.approx(2 / 4)
    assert METRICS["first_fix_s"](frames) == pytest.approx(0.4)
    assert METRICS["localised_share"](frames[:4]) is None
    assert METRICS["first_fix_s"](frames[:4]) is None


def test_errors_are_those_of_localised_frames_with_a_truth() -> None:
    errors = [0.1, 0.2, 0.3, 0.4, 0.5]
    frames = [frame(0.1 * k, error_m=e, error_deg=10 * e) for k, e in enumerate(errors)]
    frames += [frame(0.5, D, error_m=9.0, error_deg=90.0), frame(0.6, T, error_m=None)]
    # linear interpolation between the sorted values: rank 0.95 * 4 = 3.8, 0.99 * 4 = 3.96
    assert METRICS["error_m"](frames) == pytest.approx({"median": 0.3, "p95": 0.48, "p99": 0.496, "max": 0.5})
    assert METRICS["error_deg"](frames) == pytest.approx({"median": 3.0, "p99": 4.96})
    assert METRICS["error_m"](frames[5:]) is None
    assert METRICS["error_deg"](frames[5:]) is None


def test_times_leave_out_the_warm_up() -> None:
    slow = [frame(0.1 * k, cpu_s=9.0, wall_s=9.0, stage_s={"map": 9.0}) for k in range(20)]
    rest = [frame(2.0 + 0.1 * k, cpu_s=0.001 * k, wall_s=0.002 * k, stage_s={"map": 0.01}) for k in range(1, 4)]
    rest[0].stage_s["decode"] = 0.003
    assert METRICS["frame_ms"](slow + rest) == pytest.approx({"mean": 2.0, "p50": 2.0, "p99": 2.98, "max": 3.0})
    assert METRICS["frame_wall_ms"](slow + rest) == pytest.approx({"mean": 4.0, "p50": 4.0, "p99": 5.96, "max": 6.0})
    assert METRICS["stage_ms"](slow + rest) == pytest.approx({"decode": 1.0, "map": 10.0})
    assert METRICS["frame_ms"](slow) is None


def test_status_shares() -> None:
    shares = METRICS["status_share"]([frame(0, T), frame(1, T), frame(2, L), frame(3, A)])
    assert shares == {"INITIALISING": 0.0, "TRACKING": 0.5, "DEGRADED": 0.0, "AMBIGUOUS": 0.25, "LOST": 0.25}


def test_nothing_recorded_is_nothing_claimed() -> None:
    for name, metric in METRICS.items():
        if name != "silent_failures":
            assert metric([]) in (None, 0, {}), name


HALF: dict[str, object] = {"status": D, "fix": False, "sigma_m": 0.05}
# 0.20 m off; the 99.9 % bound of three dimensions is 4.033 sigmas.
INSIDE: dict[str, object] = {"error_m": 0.2, "sigma_m": 0.0501}
OUTSIDE: dict[str, object] = {"error_m": 0.2, "sigma_m": 0.049}
BOTH: dict[str, object] = {"error_m": 0.5, "sigma_m": 0.01}
SEARCH = LOST | {"status": I}
FAILURES: dict[str, tuple[list[tuple[float, dict[str, object]]], object, object]] = {
    # what happens, for how many seconds each: silent failures, and all failures
    "good tracking": ([(20, GOOD)], 0, 0),
    # a stretch lasts to the first good frame: eleven frames at 10 Hz last 1.1 s
    "wrong for 1.0 s": ([(2, GOOD), (1.0, WRONG), (8, GOOD)], 0, 0),
    "wrong for 1.1 s": ([(2, GOOD), (1.1, WRONG), (8, GOOD)], 1, 1),
    "wrong for 4 s": ([(2, GOOD), (4.0, WRONG), (8, GOOD)], 1, 1),
    "wrong by less than the limit": ([(2, GOOD), (3, {"error_m": 0.29, "sigma_m": 0.5}), (2, GOOD)], 0, 0),
    "turned by 5.1 degrees": ([(2, GOOD), (3, {"error_deg": 5.1, "sigma_m": 0.5}), (2, GOOD)], 1, 1),
    "turned by 4.9 degrees": ([(2, GOOD), (3, {"error_deg": 4.9, "sigma_m": 0.5}), (2, GOOD)], 0, 0),
    "wrong and DEGRADED": ([(2, GOOD), (3, {"error_m": 5.0, "sigma_m": 5.0, "status": D}), (2, GOOD)], 0, 1),
    "wrong and INITIALISING": ([(2, GOOD), (3, {"error_m": 5.0, "sigma_m": 5.0, "status": I}), (2, GOOD)], 0, 0),
    "no truth for a while": ([(2, GOOD), (3, {"error_m": None}), (2, GOOD)], 0, 0),
    "no truth at all": ([(3, {"error_m": None})], None, 0),
    "four good seconds between": ([(1, GOOD), (2, WRONG), (4, GOOD), (2, WRONG), (1, GOOD)], 1, 1),
    "six good seconds between": ([(1, GOOD), (2, WRONG), (6, GOOD), (2, WRONG), (1, GOOD)], 2, 2),
    "lost for 2.0 s": ([(1, GOOD), (2.0, LOST), (2, GOOD)], 0, 0),
    "lost for 2.2 s": ([(1, GOOD), (2.2, LOST), (2, GOOD)], 0, 1),
    "ambiguous for 2.2 s": ([(1, GOOD), (2.2, LOST | {"status": A}), (2, GOOD)], 0, 1),
    "a radius of 0.336 m": ([(1, GOOD), (2.2, HALF | {"sigma_m": 0.12}), (2, GOOD)], 0, 1),  # 2.796 sigmas
    "a radius of 0.280 m": ([(1, GOOD), (5.0, HALF | {"sigma_m": 0.10}), (2, GOOD)], 0, 0),
    "searching for 5 s": ([(1, GOOD), (5.0, SEARCH), (2, GOOD)], 0, 0),
    "lost before the first fix": ([(9, LOST), (2, GOOD)], 0, 0),
    "a search after blindness": ([(1, GOOD), (60, LOST), (6, GOOD)], 0, 1),
    "a search, and another soon": ([(25, SEARCH), (3, GOOD), (25, LOST), (6, GOOD)], 0, 1),
    "a search, and another later": ([(25, SEARCH), (6, GOOD), (25, LOST), (6, GOOD)], 0, 2),
    "within the bound": ([(1, GOOD), (3, INSIDE), (1, GOOD)], 0, 0),
    "beyond the bound": ([(1, GOOD), (3, OUTSIDE), (1, GOOD)], 0, 1),
    "beyond the bound for 0.9 s": ([(1, GOOD), (0.9, OUTSIDE), (1, GOOD)], 0, 0),
    "two kinds at once": ([(1, GOOD), (3, BOTH), (8, GOOD)], 1, 1),
    "two kinds in a row": ([(1, GOOD), (3, LOST), (3, WRONG), (8, GOOD)], 1, 1),
    "two kinds apart": ([(1, GOOD), (3, LOST), (8, GOOD), (3, WRONG)], 1, 2),
    "half-trust between": ([(2, GOOD), (3, LOST), (6, HALF), (3, LOST), (6, GOOD)], 0, 1),
}


@pytest.mark.parametrize("what", FAILURES)
def test_failures(what: str) -> None:
    stretches, silent, failures = FAILURES[what]
    assert counts(sequence(*stretches)) == (silent, failures)


@pytest.mark.parametrize(
    ("kind", "seconds", "failures"),
    [
        ({"status": I}, 20.0, 0),
        ({"status": I}, 20.2, 1),
        ({"status": I}, 1200.0, 1),
        ({"status": I, "speed_mps": 1.0}, 20.2, 1),
        ({"status": I, "speed_mps": 0.0}, 60.0, 0),
        ({"status": I, "speed_mps": 0.0}, 60.2, 1),
        ({"status": I, "may_be_mapped": False}, 100.0, 0),
        ({"status": L}, 20.2, 1),
    ],
)
def test_a_robot_that_never_finds_itself_fails(kind: dict[str, object], seconds: float, failures: int) -> None:
    frames = sequence((seconds, LOST | kind))
    assert counts(frames) == (None, failures)
    assert METRICS["localised_share_of_all"](frames) == 0.0
    assert METRICS["localised_share"](frames) is None
    assert METRICS["not_localised_share"](frames) in ({None} if kind.get("speed_mps") == 0.0 else {1.0})


@pytest.mark.parametrize("share", [0.809, 0.336, 0.0])
def test_the_share_that_leads_is_of_all_frames(share: float) -> None:
    """Seen: 99.6 %, 100 % and nothing at all for runs in which 80.9 %, 33.6 % and none of the frames were localised."""
    found = round(1000 * share)
    frames = [frame(0.1 * k, I, fix=False) for k in range(1000 - found)]
    frames += [frame(0.1 * k) for k in range(1000 - found, 1000)]
    assert METRICS["localised_share_of_all"](frames) == pytest.approx(share)
    assert METRICS["localised_share"](frames) == (1.0 if found else None)
    assert list(METRICS)[:2] == ["frames", "localised_share_of_all"]


def test_time_not_localised_is_a_share_of_the_driving() -> None:
    stands = {"status": L, "fix": False, "speed_mps": 0.0}
    frames = sequence((10, GOOD | {"speed_mps": 1.0}), (10, LOST | {"speed_mps": 1.0}), (30, stands))
    assert METRICS["not_localised_share"](frames) == pytest.approx(0.5, abs=0.01)


def test_between_sparse_frames_nothing_better_is_known() -> None:
    """2.5 s apart: one lost frame is 2.5 s without a place, one wrong fix 2.5 s in the wrong place."""
    frames = [frame(2.5 * k, L) for k in range(5)]
    frames[2] = frame(5.0, **LOST)
    assert METRICS["localised_share"](frames) == pytest.approx(0.8)
    assert counts(frames) == (0, 1)
    frames[2] = frame(5.0, L, error_m=0.4, sigma_m=0.5)
    assert counts(frames) == (0, 1), "whoever is lost claims nothing"
    frames[2] = frame(5.0, L, error_m=0.4, sigma_m=0.1)
    assert counts(frames) == (1, 1)


def result(truths: list[Array | None], frames: list[FrameRecord], *, scale: float = 1.0) -> ReplayResult:
    """A run through a bend of which the truth is known in another frame, `truths` alone and 1 cm off, up and down by turns."""
    places = np.array([[np.cos(k / 40), np.sin(k / 40), 0.0] for k in range(len(frames))])
    truth_from_map = se3_exp(np.array([0.3, -2.0, 1.0, 40.0, -7.0, 3.0]))
    estimates = []
    for number, place in enumerate(places):
        off_m = [0.0, 0.0, 0.01 * (-1) ** number]
        estimates.append(SimpleNamespace(map_from_body=se3(np.eye(3), place / scale + off_m)))
        if truths[number] is not None:
            truths[number] = truth_from_map @ se3(np.eye(3), place)
    return ReplayResult(frames, estimates, truths, None, truth_in_map=False)  # type: ignore[arg-type]


def test_errors_against_a_truth_in_another_frame_are_aligned() -> None:
    """The fit is of the localised frames that have a truth: neither lost ones nor gaps of the truth count."""
    frames = sequence((4.0, GOOD), (2.0, LOST), (4.0, GOOD))
    truths: list[Array | None] = [np.eye(4)] * 100
    truths[10:20] = [None] * 10
    run = result(truths, frames)
    run.estimates[50].map_from_body[:3, 3] += 3.0  # while it is lost
    found = run.aligned_error_m()
    assert found["frames"] == 70
    assert [found[name] for name in ("median", "max", "scale")] == pytest.approx([0.01, 0.01, 1.0], abs=1e-3)
    assert "another frame" in run.alignment_note()
    assert "70 localized frames" in run.alignment_note()


def test_a_truth_of_another_scale_shows_and_one_of_few_frames_is_no_truth() -> None:
    frames = sequence((10.0, GOOD))
    twice = result([np.eye(4)] * 100, frames, scale=2.0).aligned_error_m()
    assert twice["scale"] == pytest.approx(2.0, abs=0.01)
    assert twice["median"] > 0.1
    few = result([np.eye(4)] * 2 + [None] * 98, frames)
    assert few.aligned_error_m() is None
    assert "fewer than 3 localized frames" in few.alignment_note()


FRAMES = 60
RED, VIOLET = (47, 52, 209), (168, 60, 190)


def plot() -> RunPlot:
    """Ten metres in six seconds past two walls, 10 mm off."""
    x = np.linspace(0.0, 10.0, FRAMES)
    truths = np.column_stack([x, 0 * x, 0 * x])
    error = np.array([0.0, 0.01, 0.0])
    about = Status.TRACKING, True, 1e-4 * np.eye(6), error, 0.01, 0.005, 0.006, {}
    frames = [FrameRecord(k * 10**8, *about) for k in range(FRAMES)]
    walls = np.column_stack([np.tile(x, 2), np.repeat([-2.0, 2.0], FRAMES), np.ones(2 * FRAMES)])
    return RunPlot("hall, version 3", frames, truths + error, truths, walls)


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
        frames[k] = frames[k]._replace(error_map_m=np.array([0.0, 0.8, 0.0]))
    for k in range(30, 40):
        frames[k] = frames[k]._replace(status=Status.AMBIGUOUS)
    frames[50], places[50] = frames[50]._replace(status=Status.LOST, error_map_m=None, cov_rot_trans=None), np.nan
    picture = draw_run(run._replace(frames=frames, positions_map_m=places))
    assert count(picture, RED) > 1000
    assert count(picture, VIOLET) > 500


@pytest.mark.parametrize("frames", [0, 1, FRAMES])
@pytest.mark.parametrize("landmarks", [0, 1, 2 * FRAMES])
def test_runs_without_truth_or_pose_are_drawn(frames: int, landmarks: int) -> None:
    run, nowhere = plot(), np.full((frames, 3), np.nan)
    untold = [frame._replace(error_map_m=None, error_rad=None) for frame in run.frames[:frames]]
    lost = [frame._replace(status=Status.LOST, has_fix=False, cov_rot_trans=None) for frame in untold]
    for shown, places in ((lost, nowhere), (untold, run.positions_map_m[:frames])):
        assert draw_run(RunPlot("x", shown, places, nowhere, run.landmarks_map_m[:landmarks])).shape[1] == 2040


def test_ticks_are_round() -> None:
    assert ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10]
    assert ticks(-0.013, 0.031) == [-0.01, 0.0, 0.01, 0.02, 0.03]
    assert ticks(3.0, 290.0) == [50, 100, 150, 200, 250]
