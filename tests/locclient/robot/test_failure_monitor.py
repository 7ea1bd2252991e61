"""A failure is told once, when it is old enough, with its cause; what is not one is not told."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.messages import Cause, Status
from locclient.localization.image_quality import GOOD_IMAGE, ImageQuality
from locclient.robot.failure_monitor import Failure, FailureMonitor, failure_cause
from support.fleet.estimates import estimate

GOOD, DARK = GOOD_IMAGE, ImageQuality(Cause.DARK, 0.01, 0.0)


def play(
    monitor: FailureMonitor, begin_s: float, end_s: float, image: ImageQuality = GOOD, **about: object
) -> list[Failure]:
    moments = (estimate(float(stamp_s), **about) for stamp_s in np.arange(begin_s, end_s - 1e-9, 0.1))  # type: ignore[arg-type]
    told = [monitor.handle(replace(moment, cause=image.cause, image=image)) for moment in moments]
    return [failure for failure in told if failure is not None]


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
    ("about", "image", "cause"),
    [
        ({"status": Status.AMBIGUOUS}, GOOD, "ambiguous"),
        ({"status": Status.LOST, "version": None}, GOOD, "no_map"),
        ({"status": Status.LOST, "refused": "nothing agrees"}, GOOD, "no_match"),
        ({"status": Status.LOST, "refused": "far off", "innovation": 99.0}, GOOD, "fix_refused"),
        ({"status": Status.DEGRADED, "sigma_m": 0.5}, ImageQuality(Cause.FROZEN), "frozen"),
        ({"status": Status.DEGRADED, "sigma_m": 0.5}, ImageQuality(Cause.BLURRED), "blurred"),
    ],
)
def test_the_cause_is_named(about: dict[str, object], image: ImageQuality, cause: str) -> None:
    monitor = FailureMonitor()
    play(monitor, 0, 1, fix=True)
    assert [failure.cause for failure in play(monitor, 1, 4, image, **about)] == [cause]


def test_between_sparse_frames_a_fix_counts_as_far_as_its_position_is_known() -> None:
    for sigma_m, told in ((0.02, []), (0.5, ["not_found"])):
        monitor = FailureMonitor()
        frames = [estimate(2.0 * k, Status.INITIALISING, fix=True, sigma_m=sigma_m) for k in range(15)]
        found = [monitor.handle(replace(frame, image=GOOD)) for frame in frames]
        assert [failure.kind for failure in found if failure is not None] == told


def test_what_is_no_failure_is_not_told() -> None:
    assert play(FailureMonitor(), 0, 20, status=Status.LOST, known=False) == [], "never had a fix"
    monitor = FailureMonitor()
    play(monitor, 0, 1, fix=True)
    assert play(monitor, 1, 2.9, status=Status.LOST) == [], "shorter than two seconds"
    assert play(monitor, 2.9, 20, status=Status.DEGRADED, sigma_m=0.05) == [], "degraded but well known"
    assert monitor.handle_silence(1.0) is None


@pytest.mark.parametrize(
    ("speed_mps", "after_s"), [(1.0, 20.0), (None, 20.0), (0.0, 60.0)], ids=["driving", "unknown", "standing"]
)
def test_a_robot_that_never_finds_itself_fails_once(speed_mps: float | None, after_s: float) -> None:
    """Also where it goes on for twenty minutes, and again after it had found itself."""
    monitor, told = FailureMonitor(), []
    for tenth in range(12000):
        searching = estimate(0.1 * tenth, Status.INITIALISING, known=False, refused="nothing agrees")
        told.append(monitor.handle(searching, speed_mps))
    failures = [failure for failure in told if failure is not None]
    assert [(failure.kind, failure.cause, failure.stamp_ns) for failure in failures] == [("not_found", "no_match", 0)]
    assert failures[0].duration_s == pytest.approx(after_s, abs=0.11)
    assert play(monitor, 1200, 1206, fix=True) == []
    assert [failure.kind for failure in play(monitor, 1206, 1240, status=Status.LOST, known=False)] == ["blind"]


def test_where_the_map_has_no_tile_nobody_fails_to_find_itself() -> None:
    monitor = FailureMonitor()
    outside = (estimate(float(n), Status.DEGRADED, sigma_m=0.5) for n in range(200))
    assert not any(monitor.handle(moment, 1.0, may_be_mapped=False) for moment in outside)


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
    assert monitor.handle(near) is None
    told = monitor.handle(far)
    assert (told.kind, told.cause) == ("suspected", "moved")
    assert monitor.handle(replace(estimate(3.4, fix=True), moved_m=0.6)) is None
    assert not play(monitor, 3.6, 9, fix=True)
    assert not monitor.is_running
    assert play(monitor, 9, 12, status=Status.LOST)[0].kind == "blind"
    assert monitor.handle(replace(estimate(12.1, fix=True), moved_m=7.0)) is None


def test_silence_is_a_failure_of_its_own() -> None:
    monitor = FailureMonitor()
    assert monitor.handle_silence(10.0) is None, "nothing has come yet"
    starting = FailureMonitor()
    play(starting, 0, 1, status=Status.INITIALISING, known=False)
    assert starting.handle_silence(19.0) is None
    never = starting.handle_silence(20.0)
    assert (never.kind, never.cause) == ("not_found", "no_frames")
    play(monitor, 0, 3, fix=True)
    failure = monitor.handle_silence(2.5)
    assert (failure.cause, failure.duration_s) == ("no_frames", 2.5)
    assert monitor.handle_silence(3.0) is None


@pytest.mark.parametrize("status", [status for status in Status if status is not Status.TRACKING])
@pytest.mark.parametrize("cause", Cause)
def test_estimate_and_failure_agree_on_the_cause(status: Status, cause: Cause) -> None:
    """An estimate's cause is the failure's; `nothing in the map agrees` and no cause at all are told in more detail."""
    told = failure_cause(replace(estimate(1.0, status), cause=cause, image=ImageQuality(cause)))
    if cause in {Cause.NONE, Cause.UNMATCHED}:
        assert told in {Cause.NO_MAP, Cause.AMBIGUOUS, Cause.NO_MATCH, Cause.FIX_REFUSED}
    else:
        assert told is cause
