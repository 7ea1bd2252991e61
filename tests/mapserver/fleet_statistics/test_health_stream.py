"""One robot's stream: what it adds, at the edges too."""

from typing import Any

import msgspec
import pytest

from fleetmap.messages import Flag, PoseMessage, RobotHealth
from mapserver.fleet_statistics.health_stream import ClockSkew, HealthStream, server_time_ns
from mapserver.fleet_statistics.kpis import Counters, kpis

NS = 1_000_000_000


def health(second: float, status: str = "TRACKING", *, wall_ns: int | None = None, **metrics: Any) -> RobotHealth:
    about = {"wall_ns": wall_ns, "status": status, "metrics": metrics}
    return RobotHealth(site="lab", robot="r1", stamp_ns=round(second * NS), version=1, **about)


def total(reports: list[RobotHealth], stream: HealthStream | None = None) -> Counters:
    stream, found = stream or HealthStream(), Counters()
    for report in reports:
        counts = stream.take_health(report)
        if counts is not None:
            found.add(counts)
    return found


def statuses(text: str) -> list[RobotHealth]:
    """One report a second: t tracking, l lost, a ambiguous, i initialising, d degraded, D degraded and wide."""
    names = {"t": "TRACKING", "l": "LOST", "a": "AMBIGUOUS", "i": "INITIALISING", "d": "DEGRADED", "D": "DEGRADED"}
    return [health(n, names[sign], radius_95_m=2.0 if sign in "lD" else 0.05) for n, sign in enumerate(text)]


@pytest.mark.parametrize(
    ("text", "failures"),
    [
        ("tttttttt", 0),
        ("iiilllliiaaaaa", 0),  # before the first fix nothing fails
        ("tttlltttttttt", 0),  # two seconds are not more than two
        ("tttllllttttttttt", 1),
        ("tttaaaattttttttt", 1),
        ("tttDDDDttttttttt", 1),
        ("tttddddddddddddt", 0),  # odometry carries, and says so
        ("tttlllltttllllttttttt", 1),  # not five seconds good in between
        ("tttllllttttttttllllttt", 2),
        ("tttlldllldlll", 1),
    ],
)
def test_blindness_as_failures_are_defined(text: str, failures: int) -> None:
    assert total(statuses(text)).blind_seen == failures


@pytest.mark.parametrize(
    ("text", "speed_mps", "failures"),
    [
        ("i" * 20, 1.0, 0),  # nineteen seconds of driving: each report speaks for the second before it
        ("i" * 22, 1.0, 1),
        ("i" * 1200, 1.0, 1),  # one that lasts is one
        ("i" * 60, 0.0, 0),
        ("i" * 62, 0.0, 1),  # standing
        ("i" * 22, None, 1),  # a speed that nobody knows counts as driving
        ("i" * 22 + "t" * 8 + "i" * 22, 1.0, 2),
        ("i" * 22 + "ttt" + "i" * 22, 1.0, 1),  # not five seconds good in between
        ("ttt" + "l" * 1200, 1.0, 1),  # blind from the third second on, and not found from the twentieth: one failure
    ],
)
def test_a_robot_that_does_not_find_itself_fails(text: str, speed_mps: float | None, failures: int) -> None:
    """Availability and failures agree: a robot without a position for twenty minutes has failed."""
    speed = {} if speed_mps is None else {"speed_mps": speed_mps}
    found = total([msgspec.structs.replace(report, metrics={**report.metrics, **speed}) for report in statuses(text)])
    assert found.blind_seen == failures
    assert kpis(found).failures.events == failures
    if "t" not in text:
        assert kpis(found).availability == 0.0


def test_what_no_map_covers_is_no_failure() -> None:
    reports = [msgspec.structs.replace(report, flags=(Flag.OFF_MAP,)) for report in statuses("i" * 100)]
    assert total(reports).blind_seen == 0


def test_the_share_that_leads_is_of_all_driving_time() -> None:
    """Twenty seconds without a fix, ten with one, all driven, and ten of standing lost: a third, not everything."""
    reports = [health(n, "INITIALISING" if n <= 20 else "TRACKING", speed_mps=1.0) for n in range(31)]
    reports += [health(n, "LOST", speed_mps=0.0) for n in range(31, 41)]
    found = kpis(total(reports))
    assert found.localised_share_of_all == pytest.approx(1 / 3)
    assert found.not_localised_h == pytest.approx(20 / 3600)
    assert kpis(total(reports[:11])).localised_share_of_all == 0.0, "never localised is none of it, not unknown"
    assert kpis(total(reports[:11])).localised_share is None


def test_time_is_counted_where_it_belongs() -> None:
    found = total(statuses("iittddDDtt"))
    assert found.observed_ms == 9000
    assert found.after_fix_ms == 8000  # each report speaks for the second before it
    assert found.localised_ms == 4000
    assert found.usable_ms == 6000


def test_silence_is_not_observed() -> None:
    found = total([health(0), health(1), health(100), health(101)])
    assert (found.observed_ms, found.reports) == (2000, 4)


def test_a_status_without_frames_is_of_the_past() -> None:
    """A camera that is torn off: the last status was TRACKING, and is repeated."""
    found = total([health(min(n, 10), wall_ns=n * NS, speed_mps=1.0) for n in range(31)])
    assert (found.observed_ms, found.after_fix_ms) == (30_000, 30_000)
    assert found.localised_ms == found.usable_ms == 12_000  # two seconds of silence are not yet one
    assert found.blind_seen == 1
    assert total([health(n, wall_ns=n * NS) for n in range(31)]).blind_seen == 0


def test_driving_by_speed_else_by_poses_else_not_at_all() -> None:
    assert total([health(n, speed_mps=1.0) for n in range(5)]).driving_ms == 4000
    assert total([health(n, speed_mps=0.0) for n in range(5)]).driving_ms == 0
    assert total([health(n) for n in range(5)]).driving_ms == 0
    stream, found = HealthStream(), Counters()
    for n in range(5):
        stream.take_pose(
            PoseMessage(
                stamp_ns=n * NS, position_map_m=(0.5 * n, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0),
                cov_rot_trans=(0.0,) * 36, status="TRACKING", map_version=1,
            )
        )  # fmt: skip
        found.add(stream.take_health(health(n)))
    assert found.driving_ms == 4000


def test_counters_are_differences_and_a_run_begins_anew() -> None:
    first = [health(n, frames=100 + 20 * n, frames_dropped=2 * n, first_fix_s=2.0) for n in range(4)]
    second = [health(10 + n, frames=20 * n, first_fix_s=4.0) for n in range(3)]
    found = total(first + second)
    assert (found.frames, found.frames_dropped) == (60 + 40, 6)
    assert (found.first_fixes, found.first_fix_ms) == (2, 6000)


def test_repeated_and_replayed_reports() -> None:
    stream = HealthStream()
    assert total([health(5, wall_ns=5 * NS), health(5, wall_ns=5 * NS), health(4, wall_ns=4 * NS)], stream).reports == 1
    assert total([health(3, wall_ns=60 * NS)], stream).reports == 1  # the same recording, played again


def test_nonsense_counts_nothing() -> None:
    nonsense = {"frames": "many", "fix_innovation": float("nan"), "speed_mps": True, "landmarks_seen": 1e300}
    found = total([health(0, **nonsense), health(1, **nonsense)])
    times = dict.fromkeys(("observed_ms", "after_fix_ms", "localised_ms", "usable_ms", "judged_ms", "found_ms"), 1000)
    assert found == Counters(reports=2, **times)


def test_docks_and_innovations() -> None:
    fix = health(0, fix_innovation=30.0, fix_innovation_m=0.2)
    found = total([fix, health(1, dock_error_m=0.5), health(2, dock_error_m=0.1)])
    assert (found.innovations, found.exceeded, found.innovation_m_sum) == (1, 1, 0.2)
    assert (found.docks, found.docks_wrong) == (2, 1)


def test_fixes_far_from_where_the_robot_took_itself_to_be() -> None:
    far = dict.fromkeys((3, 4, 7, 13), 0.5)
    found = total([health(n, fix_innovation=3.0, fix_innovation_m=far.get(n, 0.02)) for n in range(20)])
    assert found.jumps == 2  # seconds 3 to 7 are one
    start = [health(n, "INITIALISING", fix_innovation_m=5.0) for n in range(3)]
    assert total(start).jumps == 0  # before the first fix nothing was known
    lost = [health(n, "TRACKING" if n < 3 or n > 6 else "LOST", fix_innovation_m=5.0 * (n == 7)) for n in range(20)]
    assert (total(lost).blind_seen, total(lost).jumps) == (1, 0)  # a carried robot: one failure, not two
    assert Counters(jumps=2, suspected=3).silent_estimated == 3
    assert Counters(jumps=4, suspected=3, docks_wrong=1).silent_estimated == 5


def test_skew_is_that_of_the_fastest_message_and_follows() -> None:
    skew = ClockSkew()
    assert skew.ahead_s is None
    for second, delay_ms in enumerate([80, 5, 300]):
        skew.take(second * NS + 3 * NS, second * NS + delay_ms * 1_000_000)
    assert skew.ahead_s == pytest.approx(2.995)
    for second in range(10, 200):  # the robot's clock was set
        skew.take(second * NS, second * NS + 5_000_000)
    assert skew.ahead_s == pytest.approx(-0.005)
    year = 365 * 86_400 * NS
    skew.take(200 * NS, 200 * NS - year)  # the server's clock is set back; the robot's follows
    skew.take(201 * NS - year, 201 * NS - year)
    assert skew.ahead_s == pytest.approx(year / NS)
    for second in range(300, 500):
        skew.take(second * NS - year, second * NS - year)
    assert skew.ahead_s == 0.0


def test_impossible_times_become_now() -> None:
    now = 100 * NS
    assert server_time_ns(90 * NS, 5.0, now, 0) == 85 * NS
    assert server_time_ns(900 * NS, None, now, 0) == now
    assert server_time_ns(3 * NS, None, now, 50 * NS) == now


@pytest.mark.parametrize(("back_s", "reports"), [(5.0, 15), (12.0, 19), (3600.0, 19)])
def test_a_robots_clock_that_was_set_back_is_not_waited_for(back_s: float, reports: int) -> None:
    """Ten reports, then ten of a clock that is back_s behind: those that may have come twice are not counted, for 5 s at most."""
    seconds = [100_000.0 + n for n in range(10)]
    seconds += [second + 10.0 - back_s for second in seconds]
    assert total([health(second, wall_ns=round(second * NS)) for second in seconds]).reports == reports
