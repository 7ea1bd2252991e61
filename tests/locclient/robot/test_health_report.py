"""The figures of a health report: what the server counts with, and since when; a robot that drives without finding itself says so."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import se3_inverse
from fleetmap.messages import Cause, Flag, Status
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate
from locclient.localization.image_quality import GOOD_IMAGE
from locclient.robot.continuous_odom import ContinuousOdom
from locclient.robot.health_report import HealthFigures
from locclient.robot.robot import Outcome
from mapserver.fleet_statistics.health_stream import HealthStream
from mapserver.store import MapStore
from support.fleet.estimates import estimate
from support.worlds import robot_world

FIGURES = """speed_mps radius_95_m frame_ms_mean first_fix_s fix_innovation fix_innovation_m dock_error_m landmarks_expected
    landmarks_seen"""  # that the server evaluates, but those that the intake counts


def look(
    stamp_s: float, innovation: float, off_m: float, expected: int, seen: int, status: Status = Status.TRACKING
) -> Estimate:
    said = estimate(stamp_s, status, fix=True, innovation=innovation)
    assert said.fix is not None
    return replace(said, innovation_m=off_m, fix=replace(said.fix, expected=expected, seen=seen))


def handle(
    figures: HealthFigures, said: Estimate, dock_error_m: float | None = None, speed_mps: float | None = 0.0,
    may_be_mapped: bool = True,
) -> None:  # fmt: skip
    published = ContinuousOdom(np.eye(4)).handle(said)
    figures.handle(Outcome(said, published, 0.01, {}, None, dock_error_m, speed_mps, may_be_mapped))


def taken(figures: HealthFigures) -> dict[str, Any]:
    return figures.report("lab", "r1", 0, {}, silent=False).metrics


def test_the_largest_since_the_report_before_and_sums_since_the_beginning() -> None:
    figures = HealthFigures()
    for stamp_s, innovation, off_m in ((0.0, 1.0, 0.9), (0.2, 9.0, 0.02), (0.4, 2.0, 0.05)):
        handle(figures, look(stamp_s, innovation, off_m, 100, 60), 0.01 if stamp_s else None, speed_mps=1.0)
    first = taken(figures)
    # The very first frame's metres do not count: nothing had been claimed.
    assert (first["fix_innovation"], first["fix_innovation_m"], first["dock_error_m"]) == (9.0, 0.05, 0.01)
    assert (first["landmarks_expected"], first["landmarks_seen"]) == (300, 180)
    assert first["speed_mps"] == pytest.approx(1.0)
    handle(figures, estimate(0.6))
    second = taken(figures)
    assert second["fix_innovation"] is second["fix_innovation_m"] is second["dock_error_m"] is None
    assert (second["landmarks_expected"], second["landmarks_seen"]) == (300, 180)


@pytest.mark.parametrize(("before", "moved_m"), [(Status.DEGRADED, None), (Status.LOST, None), (Status.LOST, 0.6)])
def test_who_says_that_he_is_lost_is_wrong_where_he_is_found_elsewhere_alone(
    before: Status, moved_m: float | None
) -> None:
    figures = HealthFigures()
    handle(figures, estimate(0.0, before))
    handle(figures, replace(look(0.2, 3.0, 0.8, 10, 5), moved_m=moved_m))
    told = taken(figures)
    assert (told["fix_innovation"], told["fix_innovation_m"]) == (3.0, moved_m)


def test_a_robot_tells_all_that_the_server_counts_with(store: MapStore) -> None:
    """A drive through the room; at its end a dock stands 0.2 m from where it says."""
    robot, bundles, figures = robot_world.new_robot(store), list(robot_world.bundles(62)), HealthFigures()
    map_from_base = robot_world.truth(60) @ se3_inverse(robot.base_from_body)
    map_from_base[0, 3] += 0.2
    said = PositionPrior(bundles[60].frame.stamp_ns, map_from_base, 1e-4 * np.eye(6))
    bundles[60] = replace(bundles[60], priors=[said])
    for outcome in map(robot.handle, bundles):
        figures.handle(outcome)
    metrics = figures.report("hall", "r1", 5, {}, False).metrics
    assert all(metrics.get(name) is not None for name in FIGURES.split())
    assert metrics["dock_error_m"] == pytest.approx(0.2, abs=0.05)
    assert metrics["fix_innovation_m"] < 0.1
    assert 0 < metrics["landmarks_seen"] < metrics["landmarks_expected"]


def test_the_server_counts_what_a_robot_tells() -> None:
    figures, watch, sums = HealthFigures(), HealthStream(), []
    for number in range(50):
        said = look(0.1 * number, 4.0, 0.4 if number == 35 else 0.02, 50, 40)
        handle(figures, said, 0.5 if number == 25 else None)
        if number % 10 == 0 or number == 49:
            health = figures.report(robot_world.SITE, "r1", said.stamp_ns, {}, silent=False)
            sums.append(watch.take_health(health))
    assert (sum(s.docks for s in sums), sum(s.docks_wrong for s in sums), sum(s.jumps for s in sums)) == (1, 1, 1)
    assert sum(s.landmarks_expected for s in sums) == 49 * 50, "since the first report"
    assert sum(s.landmarks_seen for s in sums) == 49 * 40
    assert (health.metrics["exposure"], health.metrics["sharpness"]) == (said.image.exposure, said.image.sharpness)


@pytest.mark.parametrize(
    ("views", "words"),
    [((Cause.NONE,), None), ((Cause.DARK, Cause.NONE), "view 0: dark, view 1: good (compared with the map)")],
)
def test_a_rig_says_which_of_its_views_are_in_use_and_why_others_are_not(
    views: tuple[Cause, ...], words: str | None
) -> None:
    figures, seen = HealthFigures(), replace(estimate(0.0), view_causes=views, view=len(views) - 1)
    handle(figures, seen)
    assert taken(figures).get("views") == words


LOST, TRACKING, AMBIGUOUS = Status.LOST, Status.TRACKING, Status.AMBIGUOUS
MAPPED: dict[str, Any] = {"map_version": 3}
COVERED = MAPPED | {"cause": Cause.OCCLUDED, "image": replace(GOOD_IMAGE, cause=Cause.OCCLUDED)}
# Frames of 0.1 s, status, speed, the estimate, whether the map may cover.
Part = tuple[int, Status, float | None, dict[str, Any], bool]


@pytest.mark.parametrize(
    ("parts", "words", "flags", "is_lost_run"),
    [
        ([(220, LOST, 1.0, MAPPED, True)], "not localized over 21.9 m: nothing in the map agrees", {Flag.NOT_LOCALISED}, True),
        ([(220, LOST, None, MAPPED, True)], "not localized over 0.0 m and 22 s at an unknown speed: nothing", {Flag.NOT_LOCALISED}, True),
        ([(99, LOST, 1.0, COVERED, True)], "9.8 m: most pictures look occluded", {Flag.NOT_LOCALISED, Cause.OCCLUDED}, True),
        ([(99, AMBIGUOUS, 1.0, MAPPED, True)], "several places of the map look alike", {Flag.NOT_LOCALISED}, True),
        ([(99, LOST, 1.0, {"map_version": None}, True)], "no map is loaded", {Flag.NOT_LOCALISED, Cause.NO_MAP}, True),
        ([(99, LOST, 1.0, MAPPED, False)], "no tile where the robot believes to be", {Flag.OFF_MAP}, True),
        ([(20, LOST, 1.0, MAPPED, True)], "1.9 m in 1.9 s are too short to say why: drive 5 m", set(), False),
        ([(300, LOST, 0.0, MAPPED, True)], "0.0 m in 29.9 s are too short", set(), False),
        ([(99, LOST, 1.0, MAPPED, True), (20, TRACKING, 1.0, MAPPED, True)], "", set(), False),
        ([(20, TRACKING, 1.0, MAPPED, True), (99, LOST, 1.0, MAPPED, True)], "not localized over 9.9 m", {Flag.NOT_LOCALISED}, True),
        ([(20, TRACKING, 1.0, MAPPED, True), (99, LOST, 1.0, MAPPED, False)], "no tile where", {Flag.OFF_MAP}, False),
        ([(99, TRACKING, 1.0, MAPPED, True), (60, LOST, 1.0, MAPPED, True)], "not localized over 6.0 m", {Flag.NOT_LOCALISED}, False),
        ([(99, TRACKING, 1.0, MAPPED, True), (30, LOST, 1.0, MAPPED, True)], "", set(), False),
    ],
)  # fmt: skip
def test_how_far_it_drove_without_finding_itself(
    parts: list[Part], words: str, flags: set[str], is_lost_run: bool
) -> None:
    figures, moments = HealthFigures(), [moment for count, *moment in parts for _ in range(count)]
    for number, (status, speed_mps, fields, may_be_mapped) in enumerate(moments):
        handle(figures, replace(estimate(0.1 * number, status), **fields), None, speed_mps, may_be_mapped)
    assert words in figures.search.words
    assert bool(words) == bool(figures.search.words)
    assert figures.search.is_lost_run is is_lost_run
    assert set(figures.report("hall", "r1", 1, {}, False).flags) - {"blind"} == flags
