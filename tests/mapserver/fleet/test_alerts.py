"""Alerts: what holds is named, and nothing else."""

import re

import msgspec
import pytest
import yaml

from fleetmap.messages import RobotHealth
from mapserver import releases
from mapserver.api.metrics import Metrics
from mapserver.fleet.alerts import AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.store import DiskSpace, MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.fleet.reports import blindness
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples

HOUR_NS = 3_600_000_000_000
RULES = REPOSITORY / "deploy" / "prometheus-alerts.yml"


@pytest.fixture
def clock() -> Clock:
    return Clock(1_900_000_000_000_000_000)


@pytest.fixture
def store(store: MapStore) -> MapStore:
    publish_samples(store, 2)
    return store


def health(status: str, number: int = 1) -> RobotHealth:
    about = {"status": status, "metrics": {"speed_mps": 1.0}}
    return RobotHealth(site="lab", robot="r1", stamp_ns=number * 10**9, version=1, **about)


def test_what_holds_is_named_and_nothing_else(store: MapStore, clock: Clock) -> None:
    fleet, settings = Fleet(store, clock_ns=clock), AlertSettings()

    def names() -> list[tuple[str, str]]:
        return [(alert.name, alert.about) for alert in active_alerts(store, fleet, settings, clock())]

    for number in range(3600):  # an hour of driving, well localised
        clock.now_ns += 10**9
        fleet.take_health("lab", "r1", health("TRACKING", number))
    fleet.flush()
    assert names() == []
    for number in range(10):
        fleet.take_health("lab", "r1", health("LOST" if number % 2 else "AMBIGUOUS", 4000 + 30 * number))
        clock.now_ns += 30 * 10**9
        assert (names() == []) == (number < 9)
    (alert,) = active_alerts(store, fleet, settings, clock())
    assert (alert.name, alert.about) == ("FleetmapRobotLost", "r1")
    assert alert.words == "r1 of lab has had no known position for 5 min: it is lost"
    clock.now_ns += 61 * 10**9
    assert names() == [], "a robot that is off is not lost"
    store.update_job(store.begin_job("lab", "nightly"), "failed", "the disk is full", {})
    assert names() == [("FleetmapNightFailed", "job 1")]
    store.begin_job("lab", "nightly")
    failed_ns, clock.now_ns = clock(), clock.now_ns + HOUR_NS
    (alert,) = active_alerts(store, fleet, settings, clock())
    assert (alert.name, alert.about, alert.since_ns) == ("FleetmapNightFailed", "job 1", failed_ns), "until one ended"
    store.update_job(2, "done", "nothing to do", {})
    assert names() == []
    releases.start_canary(store, "lab", 1, 0.5)
    releases.roll_back(store, "lab")
    assert names() == [], "who did it by hand knows it"
    canary = releases.start_canary(store, "lab", 1, 0.5)
    releases.end_canary(store, canary, promote=False, outcome="it fails more often")
    assert names() == [("FleetmapCanaryRolledBack", "version 1")]
    clock.now_ns += 25 * HOUR_NS
    assert names() == []


def test_a_rate_is_too_high_only_when_chance_does_not_explain_it(store: MapStore, clock: Clock) -> None:
    fleet, number = Fleet(store, clock_ns=clock), 0
    for minutes, failures, wanted in ((5, 2, 0), (120, 7, 0), (600, 7, 0), (600, 8, 1)):
        while number < 15 * minutes:
            number, clock.now_ns = number + 1, clock.now_ns + 4 * 10**9
            fleet.take_health("lab", "r1", health("TRACKING", 4 * number))
        for failure in range(failures):
            assert not fleet.take_failure("lab", "r1", blindness(f"f{failure}", wall_ns=clock())).refused
        fleet.flush()
        found = active_alerts(store, fleet, AlertSettings(), clock())
        assert len(found) == wanted, f"after {failures} failures in {minutes} minutes"
    assert found[0].name == "FleetmapFailureRate"
    assert "failed 8 times in 24 h: 13 (5.5 to 25) per robot-day" in found[0].words


def test_the_rules_of_prometheus_are_those_of_the_webhook() -> None:
    (group,) = yaml.safe_load(RULES.read_text("utf-8"))["groups"]
    told = {rule["alert"] for rule in group["rules"]}
    expected = "FailureRate RobotLost RobotCopied RobotOverloaded NightFailed CanaryRolledBack DiskFills TrustFault"
    # A server cannot tell that it is down; days left are in the sentence of FleetmapTrustFault.
    assert told == {f"Fleetmap{name}" for name in [*expected.split(), "ServerDown", "CertificateEnds", "ListEnds"]}


def lost(clock: Clock, fleet: Fleet, names: list[str], minutes: int) -> None:
    """Robots that report every half minute that they are lost."""
    for number in range(2 * minutes + 1):
        for name in names:
            fleet.take_health("lab", name, msgspec.structs.replace(health("LOST", number), robot=name))
        clock.now_ns += 30 * 10**9 if number < 2 * minutes else 0


def test_metrics_name_the_robots_that_are_lost_for_longest(store: MapStore, clock: Clock) -> None:
    fleet = Fleet(store, clock_ns=clock)

    def named() -> dict[str, float]:
        text = Metrics(store, fleet).text().decode()
        rows = re.findall(r'fleetmap_site_robot_lost_seconds{.*robot="(.*?)".*} (.*)', text)
        return {name: float(lost_s) for name, lost_s in rows}

    lost(clock, fleet, ["r1"], 4)
    assert named() == {}, "for less than five minutes"
    lost(clock, fleet, ["r1"], 4)
    assert named() == {"r1": 480.0}
    lost(clock, fleet, [f"r{number}" for number in range(1, 60)], 6)
    assert len(named()) == 20, "robots cannot make any number of series"
    assert max(named().items(), key=lambda item: item[1])[0] == "r1"
    assert 'fleetmap_site_robots_lost{site="lab"} 59.0' in Metrics(store, fleet).text().decode()
    fleet.take_health("lab", "r1", health("TRACKING", 99))
    assert "r1" not in named()


def test_a_disk_that_fills_is_told(store: MapStore, clock: Clock, monkeypatch) -> None:
    for total_gb, free_gb, is_told in ((500, 60, False), (500, 49, True), (20_000, 60, False), (20_000, 49, True)):
        space = DiskSpace(total_gb * 10**9, free_gb * 10**9)
        monkeypatch.setattr(store, "disk_space", lambda space=space: space)
        found = active_alerts(store, Fleet(store), AlertSettings(), clock())
        assert [alert.name for alert in found] == ["FleetmapDiskFills"] * is_told, (total_gb, free_gb)
