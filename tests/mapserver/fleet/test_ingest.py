"""What robots report is counted once, in the right place, and stays what it was: the counts of made-up robots are known."""

import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct

from fleetmap.errors import StoreError, UnknownOutcomeError
from fleetmap.messages import FailureReport, RobotHealth, encode_message
from mapserver.dashboard.fleet_health import HealthData
from mapserver.fleet.fleet import Fleet
from mapserver.fleet.ingest import IngestSettings
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, kpis
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.store import FailureFilter, FleetBatch, FleetRetention, MapStore
from support.fleet.made_fleet import NS, SPEED_MPS, Known, MadeRobot, drive, hear
from support.storage.map_samples import publish_samples

START_NS = 490_000 * HOUR_NS + 1700 * NS  # an hour ends in the middle
LOST = RobotHealth(site="lab", robot="r0", stamp_ns=1, version=1, status="LOST")


@dataclass
class Site:
    store: MapStore
    fleet: Fleet
    set_ns: Callable[[int], None]
    known: Known = field(default_factory=Known)

    def run(self, robots: list[MadeRobot], seconds: int, start_ns: int = START_NS) -> list[FailureReport]:
        """Everything that they say is taken; the failures among it."""
        return hear(self.fleet, drive(robots, seconds, start_ns), self.set_ns)


@pytest.fixture
def site(metadata_folder: Path) -> Iterator[Site]:
    clock = {"ns": START_NS}
    with MapStore.open(metadata_folder, create=True, clock_ns=lambda: clock["ns"]) as store:
        publish_samples(store, 1)
        yield Site(store, Fleet(store, clock_ns=lambda: clock["ns"]), lambda ns: clock.update(ns=ns))


def made(site: Site, count: int, **options: object) -> list[MadeRobot]:
    rng = np.random.default_rng(5)
    return [MadeRobot("lab", f"r{n}", rng, site.known, **options) for n in range(count)]


def test_a_clock_that_is_set_back_freezes_no_robot(site: Site) -> None:
    """A year ahead, then right: what is silent is soon known, what reports is traced, and who is lost is lost since now."""
    year, health = 365 * 24 * HOUR_NS, replace_struct(LOST, robot="r1")
    site.set_ns(START_NS + year)
    for robot in ("r1", "r2"):
        site.fleet.take_health("lab", robot, replace_struct(health, robot=robot))
    for second in (0, 90):
        site.set_ns(START_NS + second * NS)
        for stamp_ns in range(2, 4):
            site.set_ns(START_NS + second * NS + stamp_ns * NS)
            site.fleet.take_health("lab", "r1", replace_struct(health, stamp_ns=stamp_ns * NS + second * NS))
        first, second_robot = site.fleet.robots("lab")
        if second == 0:
            since_ns = first.state_since_ns
    site.fleet.flush()
    assert since_ns == START_NS + 2 * NS
    assert first.seconds_since == 0
    assert second_robot.seconds_since > 60
    assert site.store.fleet.trace("lab", "r1", since_hour=START_NS // HOUR_NS)


@pytest.mark.parametrize("metadata_folder", ["sqlite"], indirect=True)  # nothing of it is kept
@pytest.mark.parametrize("ahead_s", [0.0, 0.02, 0.5, 0.97, -3600.0, 0.3 * 86400])
def test_two_robots_of_one_name_are_told(site: Site, caplog, ahead_s: float) -> None:
    """Whatever the other one's clock says; one alone is not, with a late network, restarts and a clock that is set."""

    def hear(at_s: float, wall_s: float) -> bool:
        site.set_ns(START_NS + round(at_s * NS))
        wall_ns = START_NS + round(wall_s * NS)
        health = RobotHealth(site="lab", robot="r1", stamp_ns=wall_ns, wall_ns=wall_ns, version=1, status="TRACKING")
        site.fleet.take_health("lab", "r1", health)
        return site.fleet.robots("lab")[0].is_copied

    for second in range(300):
        late_s = 10 - second % 10 if second > 200 else 0  # ten come at once
        assert not hear(second + late_s, second * 1.001 - (40 if second > 100 else 0)), second
    told = [hear(300 + half / 2, 300 + half // 2 + half % 2 * (0.5 + ahead_s)) for half in range(120)]
    assert told.index(True) <= 80
    assert caplog.text.count("two programs report as robot r1") == 1
    assert hear(400, 400), "for an hour"
    assert not any(hear(4100 + second, 4100 + second) for second in range(60))


def test_the_store_counts_what_the_robots_know(site: Site) -> None:
    site.run(made(site, 5, rate_per_robot_day=300.0, bad_tile=1, suspected_share=0.3, ahead_s=-7.0), 600)
    known = site.known
    assert known.failures["site", ""] >= 10
    assert known.suspected["site", ""] >= 5
    for axis in ("site", "robot", "version", "tile", "cause"):
        counted = {key: counts for (_, key), counts in site.store.fleet.counters("lab", axis).items()}
        failures = {key: t.failures for key, t in counted.items() if t.failures}
        assert failures == {key: n for (a, key), n in known.failures.items() if a == axis}, axis
        suspected = {key: t.suspected for key, t in counted.items() if t.suspected}
        assert suspected == {key: n for (a, key), n in known.suspected.items() if a == axis}, axis
        if axis != "cause":
            driven = {key: t.driving_ms / 1e3 for key, t in counted.items() if t.driving_ms}
            assert driven == {key: s for (a, key), s in known.driving_s.items() if a == axis}, axis
    total = site.store.fleet.counters("lab", "site")["lab", ""]
    assert total.reports == known.health
    assert total.blind_seen == total.blind_failures == total.failures
    found = kpis(total)
    assert found.failures.events == known.failures["site", ""]
    assert found.failures.robot_days == known.driving_s["site", ""] / 57600
    assert found.landmarks_seen_share == pytest.approx(0.7)
    assert found.first_fix_mean_s == 1.5
    assert sorted(site.store.fleet.hours("lab", "site")) == [490_000]
    assert len(site.store.fleet.failures(FailureFilter(site="lab"))) == known.reports


def test_hours_add_up_to_the_whole(site: Site) -> None:
    site.run(made(site, 2), 120, START_NS + 1840 * NS)
    hours = site.store.fleet.hours("lab", "site")
    assert sorted(hours) == [490_000, 490_001]
    whole = Counters()
    for counts in hours.values():
        whole.add(counts)
    assert whole == site.store.fleet.counters("lab", "site")["lab", ""]
    assert site.store.fleet.counters("lab", "site", since_hour=490_001)["lab", ""] == hours[490_001]


@pytest.mark.parametrize("first", ["TRACKING", "INITIALISING"], ids=["lost", "never found"])
def test_a_robot_that_is_lost_for_long_fails_in_every_window(site: Site, first: str) -> None:
    """Twenty minutes from the last quarter of an hour on: one failure as long as it lasts, seen in the next hour too."""
    status = {True: first, False: "LOST" if first == "TRACKING" else first}
    for second in range(1200):
        now_ns = START_NS + (1900 - 600 + second) * NS
        site.set_ns(now_ns)
        about = {"status": status[second < 5], "metrics": {"speed_mps": 1.0, "radius_95_m": 5.0}}
        health = replace_struct(LOST, stamp_ns=now_ns, wall_ns=now_ns, **about)
        site.fleet.take_health("lab", "r0", health)
    site.fleet.flush()

    def window(**hours: int) -> Counters:
        return site.store.fleet.counters("lab", "robot", **hours)["lab", "r0"]

    assert (window().position_failures, window().continued) == (1, 0)
    begun, after = window(until_hour=490_001), window(since_hour=490_001)
    assert (begun.position_failures, begun.continued) == (1, 0)
    assert (after.position_failures, after.continued) == (0, 1)
    assert kpis(after).failures_running == 1
    assert kpis(after).localised_share_of_all == 0.0
    assert kpis(window()).availability == pytest.approx(0.0, abs=0.01)
    shown = HealthData(site.store, CanarySettings(), ResurveySettings(), lambda: now_ns, lambda _: ()).site("lab")
    assert shown.robots["r0"].failures.events == 1


def test_what_comes_again_is_counted_once(site: Site) -> None:
    reports = site.run(made(site, 2, rate_per_robot_day=2000.0), 120)
    assert reports
    before = site.store.fleet.counters("lab", "robot")
    for report in reports * 2:
        assert site.fleet.take_failure("lab", report.robot, report).id == report.id
    site.fleet.take_health("lab", "r0", replace_struct(LOST, stamp_ns=START_NS + 120 * NS, wall_ns=START_NS))
    site.fleet.flush()
    assert site.store.fleet.counters("lab", "robot") == before
    rows = site.store.fleet.failures(FailureFilter())
    assert len(rows) == len({(row.robot, row.failure_id) for row in rows}) == len(reports)


@pytest.mark.parametrize("fault", [StoreError("full"), UnknownOutcomeError("lost at the end of a change")])
def test_counts_come_again_unless_the_store_may_have_them(site: Site, monkeypatch, fault: StoreError) -> None:
    site.run(made(site, 2), 120)
    before = site.store.fleet.counters("lab", "robot")
    add = type(site.store.fleet).add

    def cut(*given: object) -> None:
        if isinstance(fault, UnknownOutcomeError):
            add(*given)
        raise fault

    for second in range(4):
        site.set_ns(START_NS + (121 + second) * NS)
        health = replace_struct(LOST, stamp_ns=(500 + second) * NS, status="TRACKING")
        site.fleet.take_health("lab", "r0", health)
    with monkeypatch.context() as patch:
        patch.setattr(type(site.store.fleet), "add", cut)
        with pytest.raises(StoreError):
            site.fleet.flush()
    site.fleet.flush()
    counted = site.store.fleet.counters("lab", "robot")["lab", "r0"].reports - before["lab", "r0"].reports
    assert counted == 4


def test_failures_happen_when_the_servers_clock_says(site: Site) -> None:
    """A report that waited for an hour in a robot whose clock is wrong by a day belongs to its own hour."""
    (robot,) = made(site, 1, rate_per_robot_day=5000.0, ahead_s=86400.0)
    site.run([robot], 30)
    assert site.fleet.robots("lab")[0].clock_ahead_s == pytest.approx(86400.0)
    late = next(m for _, _, m in drive([robot], 3000, START_NS + 30 * NS) if isinstance(m, FailureReport))
    site.set_ns(START_NS + 10_000 * NS)
    again = Fleet(site.store, clock_ns=lambda: START_NS + 10_000 * NS)  # the server was started again meanwhile
    again.take_failure("lab", "r0", late)
    row = site.store.fleet.failures(FailureFilter(), limit=1)[0]
    assert row.happened_ns == late.stamp_ns
    assert row.received_ns == START_NS + 10_000 * NS


def test_what_cannot_be_is_refused_for_good(site: Site) -> None:
    (report, *_) = site.run(made(site, 1, rate_per_robot_day=5000.0), 100)
    wrong = [replace_struct(report, robot="r7"), replace_struct(report, id="x", site="nowhere")]
    count = len(site.store.fleet.failures(FailureFilter()))
    for message in wrong:
        sender = "nowhere" if message.site == "nowhere" else "lab"
        assert site.fleet.take_failure(sender, "r0", message).refused
    negative = encode_message(replace_struct(report, id="x", duration_s=-1.0))
    assert "duration_s" in site.fleet.take_failure_bytes("lab", "r0", negative).refused
    assert len(site.store.fleet.failures(FailureFilter())) == count


def test_names_that_robots_make_up_do_not_make_keys(site: Site) -> None:
    (report, *_) = site.run(made(site, 1, rate_per_robot_day=5000.0), 100)
    for number in range(200):
        about = {"id": f"n{number}", "cause": f"c{number}", "version": 5 + number, "tile": (number, 9)}
        site.fleet.take_failure("lab", "r0", replace_struct(report, **about))
    for axis, most in (("cause", 66), ("version", 2), ("tile", 3)):
        assert len(site.store.fleet.counters("lab", axis)) <= most, axis


def test_a_trace_shows_the_way_and_every_change(site: Site) -> None:
    site.run(made(site, 1, rate_per_robot_day=3000.0), 300)
    trace = site.store.fleet.trace("lab", "r0")
    assert site.known.failures["robot", "r0"] >= 3
    assert {row.status for row in trace} == {"TRACKING", "LOST"}
    assert all(0 <= row.x_map_m <= 32 for row in trace)
    assert all(0.9 * NS < after.heard_ns - before.heard_ns < 2.1 * NS for before, after in pairwise(trace))
    assert max(abs(after.x_map_m - before.x_map_m) for before, after in pairwise(trace)) < 2 * SPEED_MPS


def test_the_rows_of_a_trace_are_bounded(site: Site) -> None:
    """A robot that goes on driving has farther and farther steps, to the end; one that stands has a row in each interval."""
    every_s = 864.0  # 100 rows a day
    site.fleet = Fleet(site.store, clock_ns=site.store.now_ns, settings=IngestSettings(trace_every_s=every_s))
    site.run(made(site, 1, rate_per_robot_day=0.0), 600)
    trace = site.store.fleet.trace("lab", "r0")
    gaps_s = [(after.heard_ns - before.heard_ns) / NS for before, after in pairwise(trace)]
    assert 50 <= len(trace) <= 102
    assert fmean(gaps_s[:20]) < 2
    assert fmean(gaps_s[-5:]) > 5
    site.run([robot := MadeRobot("lab", "r1", np.random.default_rng(1), site.known, rate_per_robot_day=0.0)], 1)
    for second in range(1, 2000):
        site.set_ns(START_NS + second * NS)
        site.fleet.take_health("lab", "r1", replace_struct(robot.second(START_NS)[-1], stamp_ns=START_NS + second * NS))
    site.fleet.flush()
    assert len(site.store.fleet.trace("lab", "r1")) <= 4


def test_old_and_many_things_go(site: Site) -> None:
    reports = site.run(made(site, 2, rate_per_robot_day=3000.0), 200)
    fleet = site.store.fleet
    size = sum(len(t.jpeg) for r in reports for t in r.thumbnails)
    usual = FleetRetention()
    assert fleet.prune(usual) == 0
    fleet.prune(replace(usual, picture_bytes=size // 2))
    kept = [fleet.failure(row.number).pictures for row in fleet.failures(FailureFilter())]
    assert kept[0] and not kept[-1]  # the newest keep theirs
    site.set_ns(START_NS + 31 * 24 * HOUR_NS)
    pictured = fleet.expired(usual)
    assert pictured["pictures of failures"] == sum(map(len, kept))
    assert (pictured["failures"], pictured["figures by the hour"]) == (0, 0)
    fleet.prune(usual)
    assert not any(fleet.expired(usual).values())
    assert not any(fleet.failure(row.number).pictures for row in fleet.failures(FailureFilter())), "failures stay"
    site.set_ns(START_NS)
    site.run(made(site, 1), 20, START_NS + 10 * HOUR_NS)
    fleet.prune(replace(usual, trace_rows=3))
    assert {row.hour for row in fleet.trace("lab", "r0")} == {490_010}
    assert fleet.trace("lab", "r0", until_hour=490_010) == fleet.trace("lab", "r0", since_hour=490_011) == []
    site.set_ns(START_NS + 500 * 24 * HOUR_NS)
    assert fleet.prune(usual) > 0
    assert fleet.counters("lab", "site") == {}
    assert fleet.failures(FailureFilter()) == []
    assert fleet.trace("lab", "r0") == []
    assert site.store.verify().faults == []


def test_sums_of_a_month_are_small(site: Site, tmp_path: Path) -> None:
    """30 days of 300 robots below 500 MB: measured on a tenth of the robots for a tenth of the hours, which is a hundredth."""
    counts = Counters(*range(10**6, 10**6 + len(Counters.__slots__)))
    before = _size(tmp_path)
    for hour in range(72):
        batch = FleetBatch()
        for number in range(30):
            batch.add("lab", "robot", f"robot-{number}", hour, counts)
        for number in range(60):  # a site of 600 tiles, all of them driven through every hour
            batch.add("lab", "tile", f"{number % 25},{number // 25}", hour, counts)
        site.store.fleet.add(batch)
    assert (_size(tmp_path) - before) * 100 < 500e6


def _size(folder: Path) -> int:
    connection = sqlite3.connect(folder / "store.sqlite3")
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return (folder / "store.sqlite3").stat().st_size
