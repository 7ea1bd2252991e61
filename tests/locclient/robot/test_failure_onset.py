"""What a robot believed when a failure began, the pictures from before, and the cause that both speak for."""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from fleetmap import failure_definition
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import se3
from fleetmap.messages import Cause, FailureKind, FailureReport, Status
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate, Hypothesis
from locclient.localization.image_quality import ImageQuality
from locclient.robot.failure_onset import Evidence, OnsetRecorder, refined_cause
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.robot import Robot
from mapserver.store import MapStore
from support.fleet.estimates import estimate
from support.worlds import robot_world
from support.worlds.building import strange

BLIND, NOT_FOUND = FailureKind.BLIND, FailureKind.NOT_FOUND


def left(number: int) -> RectifiedFrame:
    """A frame whose image says which one it is."""
    return RectifiedFrame(number, np.full((48, 64), number, np.uint8), None, None)


def played(recorder: OnsetRecorder, estimates: Iterable[Estimate], begun_s: float | None = None) -> None:
    """Frames at 10 Hz; from begun_s on, the robot is blind."""
    for moment in estimates:
        number = round(moment.stamp_ns * 1e-8)
        begun = {} if begun_s is None or number < 10 * begun_s else {BLIND: round(begun_s * 1e9)}
        recorder.handle(moment, left(number), moment.odometry.odom_from_body, begun)


def broken(moment: Estimate, image: ImageQuality | None = None) -> Estimate:
    odometry = replace(moment.odometry, status=OdometryStatus.DEGRADED)
    return replace(moment, odometry=odometry, image=image or moment.image)


def test_pictures_are_from_two_seconds_and_half_a_second_before_and_the_beginning() -> None:
    recorder = OnsetRecorder()
    played(recorder, (estimate(0.1 * n) for n in range(100)), begun_s=6.0)
    onset = recorder.onset(BLIND, 6 * 10**9, left(99))
    assert [int(picture[0, 0]) for _, picture in onset.pictures] == pytest.approx([40, 55, 60], abs=2)
    assert [stamp_ns for stamp_ns, _ in onset.pictures] == [10**8 * int(p[0, 0]) for _, p in onset.pictures]
    assert onset.left[0, 0] == 60
    early = OnsetRecorder()
    played(early, (estimate(0.1 * n) for n in range(20)), begun_s=0.0)
    pictures = early.onset(BLIND, 0, left(19)).pictures
    assert [int(picture[0, 0]) for _, picture in pictures] == [0], "there was none before"


def test_pictures_cost_little_memory() -> None:
    recorder, large = OnsetRecorder(), np.zeros((1200, 1920), np.uint8)
    for number in range(200):
        moment = estimate(0.05 * number)
        frame = RectifiedFrame(moment.stamp_ns, large, None, None)
        recorder.handle(moment, frame, moment.odometry.odom_from_body, {})
    held = recorder._pictures
    assert sum(picture.nbytes for _, picture in held) <= 10 * 240 * 150


def test_the_belief_is_that_of_the_beginning() -> None:
    """Ambiguous then found elsewhere, very surely: the report tells of the pose and radius before."""
    recorder = OnsetRecorder()
    before = [estimate(0.1 * n, x_m=0.1 * n, sigma_m=0.03, fix=True) for n in range(30)]
    blind = [estimate(0.1 * n, Status.AMBIGUOUS, x_m=0.1 * n, known=False, hypotheses=2) for n in range(30, 50)]
    found = [replace(estimate(5.0, Status.LOST, x_m=5.0, sigma_m=0.001), hypotheses=(Hypothesis(np.eye(4), 5),))]
    played(recorder, [*before, *blind, *found], begun_s=3.0)
    onset = recorder.onset(BLIND, 3 * 10**9, left(50))
    assert radius_95_m(onset.belief.cov_rot_trans) == pytest.approx(2.796 * 0.03)
    assert onset.belief.map_from_body[0, 3] == pytest.approx(3.0), "carried on by odometry from 2.9 m"


@pytest.mark.parametrize("breaks", [False, True])
def test_a_robot_found_elsewhere_was_carried_where_its_tracks_broke(breaks: bool) -> None:
    recorder = OnsetRecorder()
    played(recorder, [estimate(0.1 * n, fix=True) for n in range(30)])
    places = (Hypothesis(se3(np.eye(3), np.array([5.0, 0.0, 0.0])), 3),)
    first, *rest = (replace(estimate(0.1 * n, Status.AMBIGUOUS, known=False), hypotheses=places) for n in range(30, 60))
    played(recorder, [broken(first) if breaks else first, *rest], begun_s=3.5)
    now = rest[-1]
    evidence = recorder.evidence(now, BLIND, 3_500_000_000, now.odometry.odom_from_body)
    assert evidence.wrong_by_m == pytest.approx(5.0)
    cause = refined_cause(Cause.AMBIGUOUS, evidence)
    assert cause is (Cause.CARRIED if breaks else Cause.ALIASED)
    onset = recorder.onset(BLIND, 3_500_000_000, left(59), was_carried=breaks)
    assert onset.stamp_ns == (3_000_000_000 if breaks else 3_500_000_000), "a carried robot failed when it was carried"


@pytest.mark.parametrize(
    ("stamp_s", "cause", "is_sign"), [(3.0, Cause.NONE, True), (3.0, Cause.DARK, False), (3.1, Cause.NONE, False)]
)
def test_tracks_that_end_in_the_dark_or_where_frames_are_missing_are_no_sign_of_hands(
    stamp_s: float, cause: Cause, is_sign: bool
) -> None:
    recorder, last = OnsetRecorder(), broken(estimate(stamp_s, Status.DEGRADED), ImageQuality(cause))
    played(recorder, [*(estimate(0.1 * n, fix=True) for n in range(30)), last])
    assert recorder.evidence(last, BLIND, last.stamp_ns, last.odometry.odom_from_body).broke is is_sign


@pytest.mark.parametrize(
    ("cause", "evidence", "refined"),
    [
        (Cause.DARK, Evidence(wrong_by_m=5.0, broke=True), Cause.DARK),
        (Cause.CALIBRATION, Evidence(wrong_by_m=5.0, had_fix=True), Cause.CALIBRATION),
        (Cause.MOVED, Evidence(wrong_by_m=5.0, broke=True), Cause.CARRIED),
        (Cause.MOVED, Evidence(wrong_by_m=5.0, had_fix=True), Cause.ALIASED),
        (Cause.MOVED, Evidence(wrong_by_m=5.0), Cause.MOVED),  # long without a fix: it drifted
        (Cause.NO_MATCH, Evidence(broke=True), Cause.NO_MATCH),
        (Cause.ODOMETRY, Evidence(wrong_by_m=5.0, broke=True), Cause.CARRIED),
        (Cause.AMBIGUOUS, Evidence(places=2), Cause.ALIASED),
        (Cause.AMBIGUOUS, Evidence(places=1), Cause.AMBIGUOUS),
    ],
)
def test_causes_by_their_evidence(cause: Cause, evidence: Evidence, refined: Cause) -> None:
    assert refined_cause(cause, evidence) is refined


def reported(robot: Robot, bundles: Iterable[SensorBundle]) -> list[FailureReport]:
    contexts = [outcome.failure for outcome in map(robot.handle, bundles)]
    profile = RobotProfile("room", "r1", robot_world.rectifier().rig, robot_world.SETTINGS, "full")
    return [failure_report(context, profile, report_id="ab" * 16, wall_ns=7) for context in contexts if context]


def test_a_carried_robot_says_what_it_believed_and_that_this_was_wrong(store: MapStore) -> None:
    """Put down 2.4 m away while it stood: the pose and radius of that moment, pictures from before it, and the error."""
    at = 75
    (report,) = reported(robot_world.new_robot(store), robot_world.carried(110, at))
    assert report.cause == "carried"
    assert report.wrong_by_m == pytest.approx(2.4, abs=0.1)
    np.testing.assert_allclose(report.map_from_base.position_m, robot_world.truth(74)[:3, 3], atol=0.1)
    assert report.radius_95_m < 0.3
    assert report.stamp_ns == [bundle.frame.stamp_ns for bundle in robot_world.bundles(at + 1)][-1]
    frames = [picture for picture in report.thumbnails if picture.kind == "frame"]
    ages_s = [(picture.stamp_ns - report.stamp_ns) * 1e-9 for picture in frames]
    assert ages_s == pytest.approx([-2.0, -0.5, 0.0], abs=0.15)
    shown = [cv2.imdecode(np.frombuffer(p.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).astype(float) for p in frames]
    left = robot_world.rectifier().rectify(list(robot_world.bundles(75))[-1].frame).left
    there = cv2.resize(left, shown[1].shape[::-1], interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(shown[1] - shown[2]).mean() > 3 * np.abs(shown[1] - there).mean(), "half a second before it was there"


@pytest.mark.parametrize(("last", "flags"), [(0, ("imu_silent",)), (62, ("imu_silent",)), (110, ())])
def test_a_silent_imu_is_evidence(store: MapStore, last: int, flags: tuple[str, ...]) -> None:
    """A robot in the dark, whose IMU sends its last samples with one of the frames."""
    bundles = list(robot_world.bundles(110))
    black, none = np.zeros_like(bundles[0].frame.left), ImuSamples.empty()
    dark = [replace(each, frame=replace(each.frame, left=black, right=black)) for each in bundles[62:]]
    sent = [*bundles[:62], *dark]
    sent = [each if n < last else replace(each, imu=none) for n, each in enumerate(sent)]
    assert [report.evidence.flags for report in reported(robot_world.new_robot(store), sent)] == [flags]


def test_a_changed_map_is_named(store: MapStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every landmark's surroundings look otherwise from some frame on; odometry and images are sound."""
    monkeypatch.setattr(failure_definition, "FIND_DRIVING_S", 1.5)  # twenty would be three times this room's cycle
    robot, bundles = robot_world.new_robot(store), list(robot_world.bundles(110))
    assert not reported(robot, bundles[:62])
    robot.use(robot_world.loaded(store, strange(robot_world.tiles())))
    (report,) = reported(robot, bundles[62:])
    assert report.cause == "map_changed"
    assert report.landmarks_expected > 10 * report.landmarks_seen
