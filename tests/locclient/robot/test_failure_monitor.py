"""A failure is told once, when it is old enough, with its cause; what is not one is not told."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.messages import Status
from locclient.robot.failure_monitor import Failure, FailureMonitor, Picture, PictureJudge
from support.fleet.estimates import estimate

GOOD, DARK = Picture(0.4, 1.0, False), Picture(0.01, 0.0, False)


def play(
    monitor: FailureMonitor, begin_s: float, end_s: float, picture: Picture = GOOD, **about: object
) -> list[Failure]:
    told = []
    for stamp_s in np.arange(begin_s, end_s - 1e-9, 0.1):
        failure = monitor.handle(estimate(float(stamp_s), **about), picture)  # type: ignore[arg-type]
        if failure is not None:
            told.append(failure)
    return told


def test_blindness_is_told_after_two_seconds_and_once() -> None:
    monitor = FailureMonitor()
    assert play(monitor, 0, 3, fix=True) == []
    told = play(monitor, 3, 9, DARK, status=Status.LOST, known=False)
    assert [(failure.kind, failure.cause, failure.stamp_ns) for failure in told] == [("blind", "dark", 3 * 10**9)]
    assert 2.0 < told[0].duration_s < 2.3
    assert told[0].fixes[-1].inliers == 40
    assert play(monitor, 9, 13, fix=True) == []
    assert play(monitor, 13, 16, status=Status.LOST) == [], "less than five good seconds: the same failure goes on"
    assert play(monitor, 16, 22, fix=True) == []
    assert not monitor.is_running
    assert len(play(monitor, 22, 26, status=Status.AMBIGUOUS)) == 1


@pytest.mark.parametrize(
    ("about", "picture", "cause"),
    [
        ({"status": Status.AMBIGUOUS}, GOOD, "ambiguous"),
        ({"status": Status.LOST, "version": None}, GOOD, "no_map"),
        ({"status": Status.LOST, "refused": "nothing agrees"}, GOOD, "no_match"),
        ({"status": Status.LOST, "refused": "far off", "innovation": 99.0}, GOOD, "fix_refused"),
        ({"status": Status.DEGRADED, "sigma_m": 0.5}, Picture(0.4, 1.0, True), "frozen"),
        ({"status": Status.DEGRADED, "sigma_m": 0.5}, Picture(0.4, 0.1, False), "blurred"),
    ],
)
def test_the_cause_is_named(about: dict[str, object], picture: Picture, cause: str) -> None:
    monitor = FailureMonitor()
    play(monitor, 0, 1, fix=True)
    assert [failure.cause for failure in play(monitor, 1, 4, picture, **about)] == [cause]


def test_what_is_no_failure_is_not_told() -> None:
    assert play(FailureMonitor(), 0, 20, status=Status.LOST, known=False) == [], "never had a fix"
    monitor = FailureMonitor()
    play(monitor, 0, 1, fix=True)
    assert play(monitor, 1, 2.9, status=Status.LOST) == [], "shorter than two seconds"
    assert play(monitor, 2.9, 20, status=Status.DEGRADED, sigma_m=0.05) == [], "degraded but well known"
    assert monitor.handle_silence(1.0) is None


def test_fixes_that_contradict_are_a_suspicion() -> None:
    monitor = FailureMonitor()
    play(monitor, 0, 3, fix=True)
    told = play(monitor, 3, 6, refused="the fix is 2.00 m off", innovation=400.0)
    assert [(failure.kind, failure.cause) for failure in told] == [("suspected", "fix_refused")]
    assert told[0].fixes[-1].innovation == 400.0


def test_a_place_that_turns_out_to_be_another_is_told_once() -> None:
    """Half a metre is a failure, a decimetre is not, and what belongs to a failure that was told is not told again."""
    monitor = FailureMonitor()
    play(monitor, 0, 3, fix=True)
    near, far = (replace(estimate(t, fix=True), moved_m=m) for t, m in ((3.0, 0.1), (3.2, 0.5)))
    assert monitor.handle(near, GOOD) is None
    told = monitor.handle(far, GOOD)
    assert told is not None
    assert (told.kind, told.cause) == ("suspected", "moved")
    assert monitor.handle(replace(estimate(3.4, fix=True), moved_m=0.6), GOOD) is None
    assert not play(monitor, 3.6, 9, fix=True)
    assert not monitor.is_running
    assert play(monitor, 9, 12, status=Status.LOST)[0].kind == "blind"
    assert monitor.handle(replace(estimate(12.1, fix=True), moved_m=7.0), GOOD) is None


def test_silence_is_a_failure_of_its_own() -> None:
    monitor = FailureMonitor()
    assert monitor.handle_silence(10.0) is None, "nothing has come yet"
    play(monitor, 0, 3, fix=True)
    failure = monitor.handle_silence(2.5)
    assert failure is not None
    assert (failure.cause, failure.duration_s, failure.picture) == ("no_frames", 2.5, None)
    assert monitor.handle_silence(3.0) is None


def test_pictures_are_measured() -> None:
    rng = np.random.default_rng(0)
    judge = PictureJudge()
    sharp = [np.asarray(rng.integers(0, 255, (120, 160)), np.uint8) for _ in range(3)]
    assert [judge.judge(picture).fault for picture in sharp] == ["", "", ""]
    assert judge.judge(sharp[-1]).fault == "frozen"
    assert judge.judge(np.zeros((120, 160), np.uint8)).fault == "dark"
    flat = np.asarray(np.tile(np.linspace(60, 160, 160), (120, 1)), np.uint8)
    assert judge.judge(flat).fault == "blurred"
    assert judge.judge(sharp[0]).sharpness == pytest.approx(1.0, abs=0.1)
