"""The watch over a drive: what drifts is named, nothing else is, and repaired cameras are sound again."""

from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import Cause, Status
from fleetmap.relocalization.relocalizer import Fix, FrameFeatures, Relocalizer
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame
from locclient.localization.calibration import monitor as monitor_module
from locclient.localization.calibration.monitor import CalibrationMonitor, PairOrder, with_calibration
from locclient.localization.calibration.parameters import BASELINE, FOCAL, IMAGE, TILT, YAW
from locclient.localization.calibration.watch import CalibrationWatch
from locclient.localization.estimate import Estimate
from locclient.localization.map_query import FinishedQuery
from support.fleet.estimates import estimate
from support.worlds.pinhole_pair import seen_with

RIG = MountedRig(RigCalibration((), None, np.eye(4)), (MountedCamera(cast("Any", None), np.eye(4)),))
NO_IMAGE = np.zeros((480, 640), np.uint8)
LEVEL = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # map_from_cam of a camera that looks along the map's x


def look(number: int, parameters: Array, turn: Array | None = None, yaw_rad: float = 0.2) -> FinishedQuery:
    """The fix of one frame, a metre after the one before, by cameras whose true parameters differ so much from the calibration."""
    matched, map_from_cam, _ = seen_with(parameters, 1000 + number)
    level = se3(so3_exp(np.array([0, 0, yaw_rad * number])) @ LEVEL, np.array([1.1 * number, 0.0, 0.4]))
    points_map = (matched.points_source - map_from_cam[:3, 3]) @ map_from_cam[:3, :3] @ level[:3, :3].T + level[:3, 3]
    ids = np.arange(120) + 60 * number  # half of what is seen was seen from the place before
    fix = Fix(level, np.diag([1e-6] * 3 + [1e-4] * 3), 120, 20, matched=replace(matched, points_source=points_map))
    fix = replace(fix, matches=np.column_stack([np.arange(120), np.arange(120)]))
    body = level[:3, :3] @ so3_exp(-(np.zeros(3) if turn is None else turn))
    place = se3(body, np.zeros(3))
    odometry = replace(estimate(float(number)).odometry, odom_from_body=place, inertial=turn is not None)
    view = SimpleNamespace(landmark_ids=ids, points_map=points_map)
    frame, relocalizer = RectifiedFrame(number, NO_IMAGE, NO_IMAGE, None), cast(Relocalizer, SimpleNamespace(view=view))
    return FinishedQuery(frame, odometry, cast(FrameFeatures, None), fix, relocalizer, is_confirmed=False)


def parameters(**sizes: float) -> Array:
    out = np.zeros(IMAGE)
    for name, size in sizes.items():
        out[{"focal": FOCAL, "baseline": BASELINE, "yaw": YAW}[name]] = size
    return out


def after(
    numbers: Iterable[int], wrong: Array, turn: Array | None = None, watch: CalibrationWatch | None = None, *,
    is_confirmed: bool = False, yaw_rad: float = 0.2,
) -> CalibrationWatch:  # fmt: skip
    """The watch, a new one by default, after these looks."""
    watch = watch or CalibrationWatch(RIG, StereoSettings())
    for number in numbers:
        watch.handle(replace(look(number, wrong, turn, yaw_rad), is_confirmed=is_confirmed))
    return watch


def drifted(watch: CalibrationWatch) -> list[str]:
    return [drift.parameter.figure for drift in watch.state.drifts if drift.is_drifted]


def test_good_cameras_are_left_alone() -> None:
    watch = CalibrationWatch(RIG, StereoSettings())
    assert not any(after([number], parameters(), watch=watch).state.is_wrong for number in range(60))
    assert watch.state.figures["calibration_focal_scale"] == pytest.approx(0.0, abs=0.005)


@pytest.mark.parametrize(
    ("figure", "wrong"),
    [
        ("focal_scale", parameters(focal=-0.01)),
        ("baseline_scale", parameters(baseline=0.04)),
        ("pair_yaw_deg", parameters(yaw=0.0035)),
    ],
)
def test_what_drifts_is_named_with_its_size(figure: str, wrong: Array) -> None:
    watch = after(range(25), wrong)
    assert drifted(watch) == [figure]
    told = watch.state.figures
    value = told[f"calibration_{figure}"]
    size = np.abs(wrong).max() * np.sign(wrong.sum()) * (np.degrees(1.0) if figure.endswith("deg") else 1.0)
    assert abs(value - size) < 4 * told[f"calibration_{figure}_sigma"]
    assert "from what the calibration says" in watch.state.text


def test_a_knock_is_found_and_a_repair_too() -> None:
    watch = after(range(40, 55), parameters(yaw=0.003), watch=after(range(40), parameters()))
    assert drifted(watch) == ["pair_yaw_deg"]
    assert not after(range(55, 75), parameters(), watch=watch).state.is_wrong


def test_a_robot_that_stands_learns_nothing() -> None:
    assert not after([3] * 50, parameters(focal=0.03)).state.drifts


def stood() -> CalibrationWatch:
    """A watch after half a second at the first place."""
    watch, first = CalibrationWatch(RIG, StereoSettings()), look(0, parameters())
    watch.handle(first)
    watch.handle(replace(first, odometry=replace(first.odometry, stamp_ns=first.odometry.stamp_ns + 500_000_000)))
    return watch


def test_gravity_is_not_believed_before_the_robot_has_stood() -> None:
    assert not after(range(30), parameters(), np.radians([2.0, 0.0, 0.0])).state.is_wrong


def test_turned_cameras_are_told_from_a_tilted_map() -> None:
    watch = after(range(30), parameters(), np.radians([2.0, 0.0, 0.0]), stood())
    said = {drift.parameter.figure: drift for drift in watch.state.drifts}
    assert TILT.start == IMAGE
    assert said["camera_roll_deg"].is_drifted
    assert abs(np.degrees(said["camera_roll_deg"].value) - 2.0) < 0.6


@pytest.mark.parametrize(("roll_deg", "is_held"), [(0.2, False), (1.2, True)])
def test_a_tilt_that_a_straight_drive_does_not_explain_is_held_by_the_covariance(
    roll_deg: float, is_held: bool
) -> None:
    turn = np.array([np.radians(roll_deg), 0.0, 0.0])
    watch = after(range(25), parameters(), turn, stood(), is_confirmed=True, yaw_rad=0.0)
    assert not watch.state.is_wrong  # the map may be tilted as well
    assert (watch.state.cov_bias_cam is not None) == is_held
    if watch.state.cov_bias_cam is not None:
        in_bends_m = 0.5 * 9.81 * np.radians(roll_deg) * 0.9**2
        assert np.sqrt(watch.state.cov_bias_cam[5, 5]) == pytest.approx(in_bends_m, rel=0.2)


def published(watch: CalibrationMonitor, before: Estimate, last_fix_ns: int | None) -> Estimate:
    judged = replace(before, calibration=watch.state)
    return with_calibration(judged, RIG, last_fix_ns, was_localized=True)


def test_one_view_of_a_confirmed_pose_finds_what_is_large() -> None:
    wrong = parameters(focal=-0.05)
    watch = after([0], wrong)
    assert not watch.state.drifts  # at a wrong place anything would show
    for before in (watch, None):
        assert drifted(after([0], wrong, watch=before, is_confirmed=True)) == ["focal_scale"]


def test_what_one_view_does_not_exclude_is_held_by_the_covariance() -> None:
    watch = after([0], parameters(focal=-0.012), is_confirmed=True)
    assert not watch.state.is_wrong
    (focal,) = [drift for drift in watch.state.drifts if drift.parameter.figure == "focal_scale"]
    assert np.trace(watch.state.cov_bias_cam[3:, 3:]) > focal.bias_m**2 > 0.015**2


def test_the_covariance_of_good_cameras_is_what_it_was_once_they_are_known() -> None:
    watch = after([0], parameters(), is_confirmed=True)
    for number in range(1, 40):
        assert not after([number], parameters(), watch=watch, is_confirmed=True).state.is_wrong
    assert watch.state.cov_bias_cam is None


def test_the_first_confirmed_pose_is_judged_before_it_is_published() -> None:
    monitor = CalibrationMonitor(RIG, RelocalizerSettings())
    monitor.add(replace(look(0, parameters(focal=-0.05)), is_confirmed=True))
    tracking = estimate(0.0)
    assert published(monitor, tracking, tracking.stamp_ns).status is Status.DEGRADED


def test_a_wrong_calibration_is_published() -> None:
    monitor = CalibrationMonitor(RIG, RelocalizerSettings())
    tracking = estimate(5.0)
    assert published(monitor, tracking, tracking.stamp_ns).status is Status.TRACKING
    after(range(25), parameters(focal=-0.02), watch=monitor.watch)
    wrong = published(monitor, tracking, tracking.stamp_ns)
    assert (wrong.status, wrong.cause) == (Status.DEGRADED, Cause.CALIBRATION)
    assert np.sqrt(wrong.cov_rot_trans[5, 5]) > 0.03 > np.sqrt(tracking.cov_rot_trans[5, 5])
    lost = published(monitor, tracking, tracking.stamp_ns - 2_000_000_000)
    assert (lost.status, lost.cause, lost.map_from_body) == (Status.LOST, Cause.CALIBRATION, None)
    dark = published(monitor, replace(tracking, cause=Cause.DARK), tracking.stamp_ns)
    assert dark.cause is Cause.DARK
    lost = published(monitor, replace(tracking, cause=Cause.ODOMETRY), tracking.stamp_ns)
    assert lost.cause is Cause.CALIBRATION, "it ends tracks, too"


def test_an_exchanged_pair_is_never_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = [PairOrder.UNKNOWN, PairOrder.REVERSED]
    monkeypatch.setattr(monitor_module, "pair_order", lambda *_: said.pop(0))
    monitor = CalibrationMonitor(RIG, RelocalizerSettings())
    answers = [
        monitor.is_reversed(RectifiedFrame(stamp, NO_IMAGE, NO_IMAGE, None), is_localized=False)
        for stamp in (0, 100_000_000, 600_000_000, 700_000_000)
    ]
    assert answers == [False, False, True, True]
    refused = published(monitor, estimate(1.0), None)
    assert (refused.status, refused.cause, refused.map_from_body) == (Status.LOST, Cause.CALIBRATION, None)
    assert "exchanged" in refused.calibration.text


def test_a_wrong_time_is_reported_and_costs_nothing() -> None:
    watch = CalibrationWatch(RIG._replace(imu_minus_cam_s=0.002), StereoSettings())
    for number in range(4):
        query = look(number, parameters())
        odometry = replace(query.odometry, imu_minus_cam_s=0.022, imu_minus_cam_sigma_s=0.0005)
        watch.handle(replace(query, odometry=odometry))
    assert watch.state.figures["calibration_time_offset_s"] == pytest.approx(0.020)
    assert watch.state.figures["calibration_drifts"] == "time_offset_s"
    assert not watch.state.is_wrong
