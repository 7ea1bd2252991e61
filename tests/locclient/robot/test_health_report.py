"""The figures of a health report: what the server counts with, and since when."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse
from fleetmap.messages import HEALTH_FIGURES, RobotHealth, Status
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate
from locclient.maps.connection import MapConnection
from locclient.maps.map_source import FetchedTiles
from locclient.replay.replay import frame_record
from locclient.replay.run_reporter import RunReporter
from locclient.replay.run_result import ReplayResult
from locclient.robot.continuous_odom import ContinuousOdom
from locclient.robot.failure_report import RobotProfile
from locclient.robot.health_report import FixFigures, HealthFigures
from locclient.robot.robot import Outcome
from mapserver.fleet_statistics.health_stream import HealthStream
from mapserver.store import MapStore
from support.fleet.estimates import estimate
from support.recordings.recording_samples import calibration
from support.worlds import robot_world

COUNTED_BY_THE_INTAKE = {"frames", "frames_dropped"}


def look(
    stamp_s: float, innovation: float, off_m: float, expected: int, seen: int, status: Status = Status.TRACKING
) -> Estimate:
    said = estimate(stamp_s, status, fix=True, innovation=innovation)
    assert said.fix is not None
    return replace(said, innovation_m=off_m, fix=replace(said.fix, expected=expected, seen=seen))


def test_the_largest_since_the_report_before_and_sums_since_the_beginning() -> None:
    figures = FixFigures()
    for stamp_s, innovation, off_m in ((0.0, 1.0, 0.9), (0.2, 9.0, 0.02), (0.4, 2.0, 0.05)):
        figures.handle(look(stamp_s, innovation, off_m, 100, 60), 0.01 if stamp_s else None, speed_mps=1.0)
    first = figures.take()
    # The very first frame's metres do not count: nothing had been claimed.
    assert (first["fix_innovation"], first["fix_innovation_m"], first["dock_error_m"]) == (9.0, 0.05, 0.01)
    assert (first["landmarks_expected"], first["landmarks_seen"]) == (300, 180)
    assert first["speed_mps"] == pytest.approx(1.0)
    figures.handle(estimate(0.6), None)
    second = figures.take()
    assert second["fix_innovation"] is second["fix_innovation_m"] is second["dock_error_m"] is None
    assert (second["landmarks_expected"], second["landmarks_seen"]) == (300, 180)


@pytest.mark.parametrize("before", [Status.DEGRADED, Status.LOST])
def test_who_says_that_he_is_lost_is_not_silently_wrong(before: Status) -> None:
    figures = FixFigures()
    figures.handle(estimate(0.0, before), None)
    figures.handle(look(0.2, 3.0, 0.8, 10, 5), None)
    taken = figures.take()
    assert (taken["fix_innovation"], taken["fix_innovation_m"]) == (3.0, None)


def test_a_robot_that_is_found_elsewhere_than_it_said_tells_how_far() -> None:
    figures = FixFigures()
    figures.handle(estimate(0.0, Status.LOST), None)
    figures.handle(replace(look(0.2, 3.0, 0.8, 10, 5), moved_m=0.6), None)
    assert figures.take()["fix_innovation_m"] == 0.6


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "store", create=True) as maps:
        robot_world.save(maps)
        yield maps


def test_a_robot_tells_all_that_the_server_counts_with(store: MapStore) -> None:
    """A drive through the room; at its end a dock stands 0.2 m from where it says."""
    robot, bundles, figures = robot_world.new_robot(), list(robot_world.bundles(62)), HealthFigures()
    robot.use(robot_world.loaded(store))
    for number, bundle in enumerate(bundles):
        if number == 60:
            map_from_base = robot_world.truth(number) @ se3_inverse(calibration().base_from_body)
            map_from_base[0, 3] += 0.2
            said = PositionPrior(bundle.frame.stamp_ns, map_from_base, 1e-4 * np.eye(6))
            bundles[number] = replace(bundle, priors=[said])
        outcome = robot.handle(bundles[number])
        assert outcome is not None
        figures.handle(outcome)
    metrics = figures.report("hall", "r1", 5, {}, False).metrics
    assert {name for name in HEALTH_FIGURES if metrics.get(name) is not None} == set(
        HEALTH_FIGURES
    ) - COUNTED_BY_THE_INTAKE
    assert metrics["dock_error_m"] == pytest.approx(0.2, abs=0.05)
    assert metrics["fix_innovation_m"] < 0.1
    assert 0 < metrics["landmarks_seen"] < metrics["landmarks_expected"]


class _Link:
    """Keeps what a replay tells."""

    def __init__(self) -> None:
        self.told: list[RobotHealth] = []

    word_hours = 0.5

    def publish_health(self, health: RobotHealth) -> None:
        self.told.append(health)

    def ack(self, *_: object, **__: object) -> None: ...
    def publish_pose(self, _: object) -> None: ...


def test_a_replay_tells_the_server_what_it_counts_with(store: MapStore) -> None:
    link, manifest = _Link(), store.manifest(robot_world.SITE, 1)
    result = ReplayResult([], [], [], manifest, FetchedTiles({}, {}))
    to: Any = link
    connection, rig = MapConnection(to, to, robot_world.SITE, "r1"), robot_world.rectifier()
    profile = RobotProfile(robot_world.SITE, "r1", np.eye(4), rig.body_from_cam, rig.camera, robot_world.SETTINGS)
    reporter, watch, sums = RunReporter(connection, result, profile), HealthStream(), []
    for number in range(50):
        said = look(0.1 * number, 4.0, 0.4 if number == 35 else 0.02, 50, 40)
        dock_error_m = 0.5 if number == 25 else None
        outcome = Outcome(said, ContinuousOdom(np.eye(4)).handle(said), 0.01, {}, None, dock_error_m)
        result.frames.append(frame_record(outcome, None, 0.01, 0.0))
        result.estimates.append(said)
        reporter.handle(outcome)
    for health in link.told:
        added = watch.take_health(health)
        assert added is not None
        sums.append(added)
    assert len(link.told) == 5
    assert [round(health.metrics["fix_innovation_m"] or 0.0, 2) for health in link.told[1:]] == [0.02, 0.02, 0.02, 0.4]
    assert (sum(s.docks for s in sums), sum(s.docks_wrong for s in sums), sum(s.jumps for s in sums)) == (1, 1, 1)
    assert sum(s.landmarks_expected for s in sums) == 40 * 50
    assert sum(s.landmarks_seen for s in sums) == 40 * 40
    own = HealthFigures()
    own.handle(outcome)
    as_run, last = own.report(robot_world.SITE, "r1", 5, {}, False), link.told[-1]
    assert last.flags == as_run.flags
    assert set(as_run.metrics) <= set(last.metrics), "what `run` tells, a replay tells"
    assert (last.metrics["exposure"], last.metrics["sharpness"]) == (said.image.exposure, said.image.sharpness)
