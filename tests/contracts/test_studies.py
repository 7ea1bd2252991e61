"""Each study is a short script with a page, figures that are kept with seeds and versions, and a picture."""

import json
from functools import partial
from itertools import pairwise
from time import process_time

import numpy as np
import pytest

from benchmarks.common.looks import Answer, curve, right_at
from fleetmap.messages import Status
from locclient.replay.run_metrics import FrameRecord
from studies import dark_ladder, study
from studies.robot_days.closeness import closeness
from studies.robot_days.rates import Stratum, combined, day_rate
from studies.robot_days.tails import TailStratum, resampled_rates, tail_rate

PAGES = sorted(page for page in study.PAGES.glob("*.md") if page.stem != "README")
SCRIPTS = study.PAGES.parents[1] / "tests" / "studies"
TEXTBOOK = ("square", "doppelganger", "global_adjustment", "keyframe_policies", "monocular_odometry")
MOST_LINES = 150  # of those that teach


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_study_is_whole(page: study.Path) -> None:
    name = page.stem
    script = (SCRIPTS / f"{name}.py").read_text()
    assert name not in TEXTBOOK or len(script.splitlines()) <= MOST_LINES
    assert f"({name}.md)" in (study.PAGES / "README.md").read_text()
    assert (study.PAGES / f"{name}.png").stat().st_size > 1000
    kept = json.loads((study.PAGES / f"{name}.json").read_text())
    text = page.read_text()
    assert f"]({name}.png)" in text
    assert f"make study NAME={name}" in text
    assert all(f"{package} {version}" in text for package, version in kept["about"].items()), (
        "not the page of these figures"
    )
    assert all(str(seed) in text for seed in kept["seeds"])
    assert all(row["cpu_s"] >= 0 for row in kept["rows"])


def test_every_script_has_its_page() -> None:
    names = {script.stem for script in SCRIPTS.glob("*.py")} - {"__init__", "study"}
    assert names == {page.stem for page in PAGES}


def test_what_was_stopped_goes_on(tmp_path: study.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "PAGES", tmp_path)
    made: list[str] = []

    def case(name: str) -> study.Row:
        if name == "c" and made.count("c") == 0:
            made.append(name)
            raise KeyboardInterrupt
        made.append(name)
        return {"value": len(made)}

    cases = {name: lambda name=name: case(name) for name in "abc"}
    with pytest.raises(KeyboardInterrupt):
        study.results("counted", cases, [1])
    rows = study.results("counted", cases, [1])
    assert made == ["a", "b", "c", "c"]
    assert [row["value"] for row in rows] == [1, 2, 4]


def test_the_comparison_shows_the_table_of_public_sequences() -> None:
    page, comparison = ((study.PAGES / "public_sequences.md"), study.PAGES.parent / "comparison.md")
    table = (
        comparison.read_text().partition("<!-- begin of results -->")[2].partition("<!-- end of results -->")[0].strip()
    )
    assert table.startswith("| recording |")
    assert table in page.read_text()


def test_the_interval_of_a_robot_day_holds_the_true_rate() -> None:
    """Two situations with rates of their own, one simulated far more often than a day holds it; 95 % of such studies cover the truth."""
    rng, covered, studies = np.random.default_rng(5), 0, 2000
    for _ in range(studies):
        often, rarely = rng.poisson(0.02, 100), rng.poisson(0.3, 20)
        strata = [Stratum(16.0, 100.0, tuple(often.tolist())), Stratum(0.5, 20.0, tuple(rarely.tolist()))]
        found = day_rate(strata)
        covered += found.low <= 16.0 * 0.02 + 0.5 * 0.3 <= found.high
    assert 0.94 < covered / studies <= 1.0


def test_no_failure_is_not_a_rate_of_zero() -> None:
    found = day_rate([Stratum(16.0, 160.0, (0,) * 10), Stratum(1.0, 2.0, (0, 0))])
    assert (found.rate, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(3.0 * 0.5, rel=0.01)
    assert found.robot_days == found.least_days == 2.0


def test_failures_of_one_drive_tell_less_than_those_of_many() -> None:
    together, apart = (day_rate([Stratum(1.0, 10.0, n)]) for n in ((4, 0, 0, 0), (1, 1, 1, 1)))
    assert together.rate == apart.rate
    assert together.high > apart.high
    assert together.robot_days < apart.robot_days


def test_right_and_wrong_over_the_threshold() -> None:
    """Of five looks one is not answered, and the least sure answer is wrong: by place, or by direction."""
    right = [Answer("TRACKING", score, 0.1, 1.0) for score in (90.0, 60.0, 30.0)]
    silent = Answer("AMBIGUOUS", 0.0, None, None)
    for wrong in (Answer("INITIALISING", 20.0, 3.0, 0.0), Answer("INITIALISING", 20.0, 0.1, 90.0)):
        found = [*right, silent, wrong]
        assert curve(found) == [(90.0, 0.2, 0.0), (60.0, 0.4, 0.0), (30.0, 0.6, 0.0), (20.0, 0.6, 0.25)]
        assert right_at(found, 0.01) == 0.6
        assert right_at([*found, Answer("TRACKING", 99.0, 3.0, 0.0)], 0.01) == 0.0
    assert right_at([silent], 0.01) == 0.0


def test_the_ladder_goes_down() -> None:
    tables = [dark_ladder.darkening(level) for level in dark_ladder.LEVELS]
    assert tables[0].tolist() == list(range(256))
    assert all((below <= above).all() and below.sum() < above.sum() for above, below in pairwise(tables))
    a, gamma = dark_ladder.parameters(3)
    assert tables[3][100] == round(255 * a * (100 / 255) ** (1 / gamma))


def _situation(
    rng: np.random.Generator, drives: int, scale: float
) -> list[np.ndarray[tuple[int], np.dtype[np.float64]]]:
    return [rng.exponential(scale, 9) for _ in range(drives)]


def test_a_rate_beyond_what_was_seen_is_found_by_the_model() -> None:
    """Two situations with exponential figures; their true rate is far below one failure in all that was drawn."""
    rng, scale = np.random.default_rng(3), 0.08
    true, estimated, above = 9 * 40 * np.exp(-1 / scale) * (10.0 + 2.0), [], 0
    for _ in range(40):
        strata = [TailStratum(weight, _situation(rng, 40, scale)) for weight in (10.0, 2.0)]
        estimated.append(tail_rate(strata))
        above += float(np.percentile(resampled_rates(strata, 100, rng), 97.5)) >= true
    assert true < 0.02
    assert above >= 32, "the upper end lies above the truth in most samples; the bootstrap is a little short"
    assert np.median(estimated) < 20 * true


def test_heavier_tails_reach_a_failure_sooner() -> None:
    rng = np.random.default_rng(4)
    light = [TailStratum(1.0, [rng.exponential(0.05, 9) for _ in range(50)])]
    heavy = [TailStratum(1.0, [0.05 * rng.pareto(3.0, 9) for _ in range(50)])]
    assert tail_rate(light) < 1e-3 * tail_rate(heavy)


def test_what_was_counted_and_what_was_extrapolated_add_up() -> None:
    rng = np.random.default_rng(5)
    counted = [Stratum(0.2, 32.0, (1, *[0] * 31))]
    alone = combined(counted, [], 1)
    assert alone.rate == pytest.approx(0.2 / 32)
    assert alone.low < alone.rate < alone.high < 0.2 * 6 / 32
    tails = [[TailStratum(1.0, [0.05 * rng.pareto(3.0, 9) for _ in range(50)])]]
    both = combined(counted, tails, 1)
    assert both.rate == pytest.approx(alone.rate + tail_rate(tails[0]))
    assert both.high > alone.high


def _frames(count: int, status: Status, error_m: float, sigma_m: float = 0.02) -> list[FrameRecord]:
    cov = np.diag([1e-4] * 3 + [sigma_m**2] * 3)
    return [
        FrameRecord(k * 66_666_667, status, True, cov, np.array([error_m, 0.0, 0.0]), 0.0, 0.0, 0.0, {}, 1.0)
        for k in range(count)
    ]


def test_closeness_is_one_where_a_failure_begins() -> None:
    far = closeness(_frames(300, Status.TRACKING, 0.31, 0.5))
    assert far.wrong[0] == pytest.approx(0.31 / 0.30)
    near = closeness(_frames(300, Status.TRACKING, 0.02))
    assert near.wrong[0] == pytest.approx(0.02 / 0.30)
    assert near.outside[0] == pytest.approx(1.0 / np.sqrt(16.266), rel=1e-3)
    assert near.blind[0] == pytest.approx(2.796 * 0.02 / 0.30, rel=1e-3)
    blind = [
        *_frames(150, Status.TRACKING, 0.02),
        *_frames(15, Status.LOST, 0.02),
        *_frames(150, Status.TRACKING, 0.02),
    ]
    assert closeness(blind).blind.max() == pytest.approx(0.5, abs=0.04), "one second of the two that are a failure"
    short = [
        *_frames(150, Status.TRACKING, 0.02),
        *_frames(14, Status.TRACKING, 0.5),
        *_frames(150, Status.TRACKING, 0.02),
    ]
    assert closeness(short).wrong.max() == pytest.approx(0.02 / 0.30), "less than a second"


def test_a_study_that_may_take_so_long_shows_what_there_is(
    tmp_path: study.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "PAGES", tmp_path)
    monkeypatch.setenv("CPU_S", "0.05")

    def case() -> study.Row:
        begin_s = process_time()
        while process_time() < begin_s + 0.2:
            pass
        return {"value": 1}

    cases = dict.fromkeys("abc", case)
    assert [row["case"] for row in study.results("counted", cases)] == ["a"]
    monkeypatch.delenv("CPU_S")
    assert [row["case"] for row in study.results("counted", cases)] == ["a", "b", "c"]


def test_cases_in_processes_of_their_own_make_the_same_rows(
    tmp_path: study.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "PAGES", tmp_path)
    monkeypatch.setenv("JOBS", "2")
    rows = study.results("counted", {name: partial(dict, value=ord(name)) for name in "abc"})
    assert [(row["case"], row["value"]) for row in rows] == [("a", 97), ("b", 98), ("c", 99)]
    with pytest.raises(ZeroDivisionError):
        study.results("counted", {"a": partial(dict), "d": partial(divmod, 1, 0)})
