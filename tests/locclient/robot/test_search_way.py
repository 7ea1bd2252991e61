"""A robot that drives without finding itself says so, and why; one that cannot know yet says that."""

from dataclasses import replace

import pytest

from fleetmap.messages import Cause, Flag, Status
from locclient.localization.estimate import Estimate
from locclient.localization.image_quality import GOOD_IMAGE
from locclient.robot.continuous_odom import ContinuousOdom
from locclient.robot.health_report import HealthFigures
from locclient.robot.robot import Outcome
from support.fleet.estimates import estimate

LOST, TRACKING, AMBIGUOUS = Status.LOST, Status.TRACKING, Status.AMBIGUOUS
MAPPED, COVERED = (
    {"map_version": 3},
    {"map_version": 3, "cause": Cause.OCCLUDED, "image": replace(GOOD_IMAGE, cause=Cause.OCCLUDED)},
)
Part = tuple[
    int, Status, float | None, dict[str, object], bool
]  # frames of 0.1 s, status, speed, the estimate, whether the map may cover


def drive(*parts: Part) -> HealthFigures:
    figures, number = HealthFigures(), 0
    for count, status, speed_mps, fields, may_be_mapped in parts:
        for _ in range(count):
            said: Estimate = replace(estimate(0.1 * number, status), **fields)
            published = ContinuousOdom(said.odometry.odom_from_body).handle(said)
            figures.handle(Outcome(said, published, 0.0, {}, None, None, speed_mps, may_be_mapped))
            number += 1
    return figures


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
    figures = drive(*parts)
    assert words in figures.search.words
    assert bool(words) == bool(figures.search.words)
    assert figures.search.is_lost_run is is_lost_run
    assert set(figures.report("hall", "r1", 1, {}, False).flags) - {"blind"} == flags
