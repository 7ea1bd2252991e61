"""The odometry on pictures of a painted room, with exact truth."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, se3_log, so3_exp, transform_points
from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.odometry import modes
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus, is_away
from fleetmap.odometry.filter.msckf import InitialState
from fleetmap.odometry.filter.sliding_window import SlidingWindow
from fleetmap.odometry.init.imu_alignment import dynamic_initialization
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.odometry_checks import DivergenceMonitor
from fleetmap.odometry.settings import FilterSettings, OdometrySettings, TrackerSettings
from fleetmap.odometry.tracking.tracker import Earlier, Tracked, Tracker
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, WheelSample
from locclient.localization.place import ORIGIN
from locclient.localization.pose_hypothesis import Motion, PoseHypothesis
from locclient.localization.settings import TrackSettings
from mapserver.survey.odometry_pass import FrameChain
from support.worlds.inertial_motion import analytic_motion, moved_between
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import (
    BODY_FROM_CAM,
    CAMERA,
    FRAME_NS,
    IMU,
    black_frame,
    driven,
    mounted,
    pair,
    stereo_frame,
)


def run(
    frames: Iterable[RectifiedFrame], imu: ImuNoise | None, filtering: FilterSettings | None = None, **how: Any
) -> tuple[Odometry, list[OdometryEstimate]]:
    odometry = Odometry(mounted(imu), OdometrySettings(filter=filtering or FilterSettings()))
    biases = np.array([0.01, -0.02, 0.015]), np.array([0.03, -0.02, 0.04])
    return odometry, driven(odometry, frames, noisy_imu(np.random.default_rng(1), 6.5, IMU, *biases), **how)


def truth_between(first_ns: int, second_ns: int) -> Array:
    return moved_between(first_ns * 1e-9, second_ns * 1e-9)


def relative_error(a: OdometryEstimate, b: OdometryEstimate) -> Array:
    """(6,) error of the motion between two estimates of the same odom frame."""
    estimated = se3_inverse(a.odom_from_body) @ b.odom_from_body
    return se3_log(se3_inverse(truth_between(a.stamp_ns, b.stamp_ns)) @ estimated)


def step_error_m(before: OdometryEstimate, after: OdometryEstimate) -> float:
    """Error of the motion between two successive frames, whether `odom` restarted or not."""
    error = se3_inverse(truth_between(before.stamp_ns, after.stamp_ns)) @ after.previous_from_body
    return float(np.linalg.norm(error[:3, 3]))


def sigma_m(estimate: OdometryEstimate) -> float:
    return float(np.sqrt(np.trace(estimate.cov_rot_trans[3:, 3:])))


@pytest.fixture(scope="module")
def inertial() -> tuple[Odometry, list[OdometryEstimate]]:
    return run((stereo_frame(k * FRAME_NS) for k in range(1, 81)), IMU)


@pytest.fixture(scope="module")
def visual() -> tuple[Odometry, list[OdometryEstimate]]:
    return run((stereo_frame(k * FRAME_NS) for k in range(1, 41)), None)


def test_inertial_starts_in_motion_and_follows(inertial: tuple[Odometry, list[OdometryEstimate]]) -> None:
    _, estimates = inertial
    started = next(k for k, e in enumerate(estimates) if e.new_odom_from_old_odom is not None)
    assert started <= 25
    assert estimates[0].status is OdometryStatus.INITIALISING
    assert not estimates[started - 1].inertial
    assert all(e.status is OdometryStatus.TRACKING and e.inertial for e in estimates[started + 1 :])
    steps = (truth_between(a.stamp_ns, b.stamp_ns) for a, b in pairwise(estimates[started:]))
    path_m = sum(float(np.linalg.norm(step[:3, 3])) for step in steps)
    error = relative_error(estimates[started + 1], estimates[-1])
    assert np.linalg.norm(error[3:]) < 0.012 * path_m
    assert np.degrees(np.linalg.norm(error[:3])) < 0.8  # 0.2 to 0.7, by which corners are followed


def test_odom_is_level_and_the_velocity_right(inertial: tuple[Odometry, list[OdometryEstimate]]) -> None:
    _, estimates = inertial
    last = estimates[-1]
    truth = analytic_motion(last.stamp_ns * 1e-9)
    up_body, up_truth = last.odom_from_body[2, :3], truth.map_from_body[2, :3]
    assert np.degrees(np.linalg.norm(np.cross(up_body, up_truth))) < 0.4
    velocity_body = last.odom_from_body[:3, :3].T @ last.velocity_odom_mps
    np.testing.assert_allclose(velocity_body, truth.map_from_body[:3, :3].T @ truth.velocity_map_mps, atol=0.06)
    np.testing.assert_allclose(last.gyro_bias_radps, [0.01, -0.02, 0.015], atol=0.004)


def test_redefining_odom_carries_the_past_along(inertial: tuple[Odometry, list[OdometryEstimate]]) -> None:
    _, estimates = inertial
    started = next(k for k, e in enumerate(estimates) if e.new_odom_from_old_odom is not None)
    before, now = estimates[started - 1 : started + 1]
    carried = replace(before, odom_from_body=now.new_odom_from_old_odom @ before.odom_from_body)
    assert np.linalg.norm(relative_error(carried, now)[3:]) < 0.02


@pytest.mark.parametrize(
    ("from_ms", "lost_ms", "every_ms", "by"), [(2000, 0, 1, 60), (0, 60, 1000, 23), (0, 60, 400, 30)]
)
def test_a_start_in_motion_is_by_what_the_imu_felt(from_ms: int, lost_ms: int, every_ms: int, by: int) -> None:
    """Motion before its first sample, or lost, would count as a bias of the gyro, and the filter would leave the images."""
    felt = noisy_imu(np.random.default_rng(1), 6.5, IMU, np.array([0.01, -0.02, 0.015]), np.zeros(3))
    frames = (stereo_frame(k * FRAME_NS) for k in range(1, 81))
    stamps_ms = felt.stamps_ns // 10**6
    kept = (stamps_ms >= from_ms) & ((stamps_ms + 500) % every_ms >= lost_ms)
    part = ImuSamples(felt.stamps_ns[kept], felt.gyro_radps[kept], felt.accel_mps2[kept])
    said = driven(Odometry(mounted(IMU), OdometrySettings()), frames, part)
    started = next(n for n, e in enumerate(said) if e.inertial)
    assert from_ms // 50 + 17 <= started <= by
    np.testing.assert_allclose(said[started].gyro_bias_radps, [0.01, -0.02, 0.015], atol=0.005)
    assert not any(e.status is OdometryStatus.DEGRADED for e in said[started:])


def test_a_fast_camera_starts_in_motion_within_a_second() -> None:
    """Of 30 Hz, of which twenty frames are too short."""
    felt = noisy_imu(np.random.default_rng(1), 1.5, IMU, np.array([0.01, -0.02, 0.015]), np.zeros(3))
    frames = (stereo_frame(k * 33_000_000) for k in range(1, 33))
    started = next(e for e in driven(Odometry(mounted(IMU), OdometrySettings()), frames, felt) if e.inertial)
    np.testing.assert_allclose(started.gyro_bias_radps, [0.01, -0.02, 0.015], atol=0.005)


def test_stereo_alone_follows_too(visual: tuple[Odometry, list[OdometryEstimate]]) -> None:
    odometry, estimates = visual
    assert all(e.status is OdometryStatus.TRACKING and not e.inertial for e in estimates)
    error = relative_error(estimates[0], estimates[-1])
    assert np.linalg.norm(error[3:]) < 0.06
    assert np.degrees(np.linalg.norm(error[:3])) < 1.0
    assert sigma_m(estimates[-1]) < 0.2
    assert odometry.motion_since(-1) is None
    number = next(k for k in range(len(estimates)) if odometry.motion_since(k) is not None)
    since, oldest = odometry.motion_since(number), estimates[number]
    assert odometry.will_forget(number)
    assert not odometry.will_forget(len(estimates) - 1)
    off = se3_log(se3_inverse(truth_between(oldest.stamp_ns, estimates[-1].stamp_ns)) @ since[0])
    assert np.linalg.norm(off[3:]) < 0.06


def test_the_motion_since_a_frame_is_known_although_it_was_dropped_with_the_next() -> None:
    """Slowly: most frames are hardly elsewhere than the one before, and are not kept."""
    odometry = Odometry(mounted(None), OdometrySettings())
    first, *frames = [stereo_frame(k * FRAME_NS // 10) for k in range(1, 41)]
    odometry.handle_stereo(first)
    dropped = 0
    for number, frame in enumerate(frames):
        odometry.handle_stereo(frame)
        motion, covariance = odometry.motion_since(number)
        off = se3_log(se3_inverse(truth_between(frame.stamp_ns - FRAME_NS // 10, frame.stamp_ns)) @ motion)
        assert np.linalg.norm(off[3:]) < 0.01
        assert (np.abs(off) < 5.0 * np.sqrt(np.diag(covariance)) + 1e-3).all()
        dropped += number > 0 and odometry.will_forget(number)
    assert dropped > 10


def test_darkness_is_said_and_the_covariance_grows() -> None:
    """After 2.5 s the pictures go black for a second: DEGRADED, ever less certain, no jump that is not admitted."""
    frames = [stereo_frame(k * FRAME_NS) if k <= 50 else black_frame(k * FRAME_NS) for k in range(1, 71)]
    _, estimates = run(frames, IMU)
    assert estimates[49].status is OdometryStatus.TRACKING
    dark = estimates[50:]
    assert all(e.status is OdometryStatus.DEGRADED for e in dark)
    sigmas = [sigma_m(e) for e in dark]
    assert (np.diff(sigmas) > 0).all()
    assert sigmas[-1] > 2 * sigma_m(estimates[49])
    error = relative_error(estimates[49], dark[-1])
    assert np.linalg.norm(error[3:]) < 4 * sigmas[-1]


def test_a_gap_into_the_unknown_is_said() -> None:
    """Three quarters of a second later the walls are others: nothing ties the frames together, vision alone is lost."""
    before = [stereo_frame(k * FRAME_NS) for k in range(1, 16)]
    after = [stereo_frame((k + 15) * FRAME_NS, seed=2) for k in range(15, 18)]
    _, estimates = run([*before, *after], None)
    first = estimates[15]
    assert first.after_gap
    assert first.status is OdometryStatus.DEGRADED
    assert sigma_m(first) > sigma_m(estimates[14]) + 0.5
    # the walls that came are then followed, but the doubt stays
    assert estimates[16].status is OdometryStatus.TRACKING
    assert sigma_m(estimates[16]) > sigma_m(estimates[14]) + 0.5


def test_a_gap_over_known_walls_is_bridged() -> None:
    """Half a second without pictures, then the same room from elsewhere: matched by descriptors."""
    frames = [stereo_frame(k * FRAME_NS) for k in [*range(1, 12), *range(21, 26)]]
    _, estimates = run(frames, None)
    assert estimates[11].after_gap
    assert estimates[11].status is OdometryStatus.TRACKING
    error = relative_error(estimates[10], estimates[-1])
    assert np.linalg.norm(error[3:]) < 0.06


@pytest.mark.parametrize("imu", [None, IMU])
def test_a_filter_that_refuses_every_track_is_not_trusted(imu: ImuNoise | None) -> None:
    """Once each track was due and none was taken, the state goes on by prediction alone."""
    _, estimates = run((stereo_frame(k * FRAME_NS) for k in range(1, 41)), imu, FilterSettings(chi_square_share=1e-300))
    assert [e.inertial for e in estimates[-3:]] == [imu is not None] * 3
    assert [e.status for e in estimates[-3:]] == [OdometryStatus.DEGRADED] * 3


def test_a_filter_that_is_locked_in_a_wrong_speed_says_so_and_opens_it() -> None:
    """Carried with its IMU at rest, as it were: the pictures jump, and then move by 2 m/s otherwise than the IMU says."""
    jump_m, off_mps, at = 0.8, 2.0, 40

    def frame(k: int) -> RectifiedFrame:
        map_from_body = analytic_motion(k * FRAME_NS * 1e-9).map_from_body.copy()
        map_from_body[:2, 3] += [jump_m, off_mps * (k - at) * FRAME_NS * 1e-9] if k >= at else [0.0, 0.0]
        return pair(k * FRAME_NS, map_from_body)

    _, estimates = run((frame(k) for k in range(1, 66)), IMU)
    after = estimates[at:]
    contradicted = [e for e in estimates[at + 2 :] if e.inlier_share < 0.1]
    assert contradicted
    assert all(e.inertial for e in after)
    assert all(e.status is OdometryStatus.DEGRADED for e in contradicted)
    assert min(e.inlier_share for e in after[12:24]) > 0.7
    assert [e.status for e in after[12:24]] == [OdometryStatus.TRACKING] * 12
    moved_m = after[23].odom_from_body[:3, 3] - after[11].odom_from_body[:3, 3]
    begun, ended = (analytic_motion(k * FRAME_NS * 1e-9).map_from_body for k in (52, 64))
    world_m = ended[:3, 3] - begun[:3, 3] + [0.0, off_mps * 12 * FRAME_NS * 1e-9, 0.0]
    assert np.linalg.norm(moved_m) == pytest.approx(np.linalg.norm(world_m), abs=0.05)


@pytest.mark.parametrize("imu", [None, IMU])
def test_matches_with_the_next_bay_after_a_gap_are_no_motion(
    imu: ImuNoise | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starved of frames, a robot matches across 0.4 s, gap after gap, what agrees on a place one bay on, where no IMU felt to go, and
    where nobody can have driven without one."""
    bay = se3(np.eye(3), np.array([0.0, 0.0, -1.3]))
    rematch = Tracker._rematch

    def of_next_bay(tracker: Tracker, *inputs: Any) -> tuple[tuple[Earlier, ...], float]:
        found, share = rematch(tracker, *inputs)
        pixels = dict(zip(tracker._points.ids.tolist(), tracker._points.pixels, strict=True))
        moved = []
        for each in found:
            now = np.array([pixels[i] for i in each.ids.tolist()])
            points = CAMERA.point_from_pixel(now[:, :2], now[:, 0] - now[:, 2])
            motion = bay @ each.cam_from_earlier
            shown = CAMERA.pixel_from_point(transform_points(se3_inverse(motion), points))
            moved.append(replace(each, pixels=shown, cam_from_earlier=motion))
        return tuple(moved), share

    frames = [stereo_frame(k * FRAME_NS) for k in [*range(1, 41), *(k for k in range(48, 84) if k % 12 < 4)]]
    monkeypatch.setattr(Tracker, "_rematch", of_next_bay)
    _, estimates = run(frames, imu)
    gaps = [(before, after) for before, after in pairwise(estimates) if after.after_gap]
    assert [after.status for _, after in gaps] == [OdometryStatus.DEGRADED] * 3
    for before, after in gaps:
        assert step_error_m(before, after) < (0.05 if imu else 0.5)
    if imu:
        assert np.linalg.norm(relative_error(gaps[0][0], estimates[-1])[3:]) < 4 * sigma_m(estimates[-1])


def test_a_frame_without_motion_adds_what_a_robot_may_have_accelerated() -> None:
    """Without an IMU: its last speed is known, and friction bounds the rest, to decimetres in 0.15 s."""
    frames = [black_frame(k * FRAME_NS) if 20 < k <= 23 else stereo_frame(k * FRAME_NS) for k in range(1, 25)]
    _, estimates = run(frames, None)
    for before, lost in pairwise(estimates[19:23]):
        assert lost.status is OdometryStatus.DEGRADED
        assert step_error_m(before, lost) < 3 * sigma_m(lost)
        assert sigma_m(lost) < 0.5


def test_the_last_speed_holds_however_long_the_next_frame_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second or third frame lost on the way to the tracker: the guess is as good as with all of them."""
    off_m, track = [], Tracker.track

    def noted(tracker: Tracker, frame: RectifiedFrame, motion_since: Any, *inputs: Any) -> Tracked:
        found = track(tracker, frame, motion_since, *inputs)
        guess = motion_since(tracker._frame_index - 1)
        if tracker._frame_index > 2 and found.cam_from_previous is not None:
            off_m.append(float(np.linalg.norm((guess - found.cam_from_previous)[:3, 3])))
        return found

    monkeypatch.setattr(Tracker, "track", noted)
    run((stereo_frame(k * FRAME_NS) for k in range(1, 41) if k % 6 not in (2, 5, 0)), None)
    assert len(off_m) > 15
    assert max(off_m) < 0.05


def test_darkness_of_any_length_leaves_a_covariance() -> None:
    """Without an IMU: nobody goes on for minutes at the last speed, and what is seen afterwards is followed as ever."""
    dark = [black_frame(k * FRAME_NS) for k in range(11, 411)]
    light = [replace(stereo_frame((k - 400) * FRAME_NS), stamp_ns=k * FRAME_NS) for k in range(411, 431)]
    odometry = Odometry(mounted(None), OdometrySettings())
    way_m, hypothesis = 0.0, PoseHypothesis(0, 0, ORIGIN, ORIGIN)
    for frame in [*(stereo_frame(k * FRAME_NS) for k in range(1, 11)), *dark, *light]:
        estimate = odometry.handle_stereo(frame)
        motion, is_last = odometry.motion_since(hypothesis.frame_index), odometry.will_forget(hypothesis.frame_index)
        motions = {} if motion is None else {hypothesis.frame_index: Motion(*motion, is_last)}
        step = np.eye(4) if estimate.previous_from_body is None else estimate.previous_from_body
        hypothesis.propagate(motions, estimate, step, TrackSettings())
        if estimate.status is OdometryStatus.DEGRADED:
            way_m += float(np.linalg.norm(step[:3, 3]))
        since = odometry.motion_since(estimate.frame_index - 1)
        assert since is None or np.linalg.eigvalsh(since[1])[0] > 0
    assert way_m < 2.0, "a second at its last speed"
    assert np.sqrt(np.diag(hypothesis.start.cov_rot_trans)[:3]).max() < 1.001 * np.pi
    assert np.linalg.eigvalsh(hypothesis.now.cov_rot_trans)[0] > 0
    assert estimate.status is OdometryStatus.TRACKING
    assert estimate.inlier_share > 0.9


def test_tracks_are_where_the_points_went() -> None:
    """Followed pixels against the reprojection of their first stereo point; ids never repeat."""
    tracker = Tracker(CAMERA, TrackerSettings())
    first = tracker.track(stereo_frame(FRAME_NS), lambda _: None)
    assert len(first.ids) > 60
    known = np.isfinite(first.pixels[:, 2])
    assert known.mean() > 0.7
    points = CAMERA.point_from_pixel(first.pixels[:, :2], first.pixels[:, 0] - first.pixels[:, 2])
    for k in range(2, 6):
        tracked = tracker.track(stereo_frame(k * FRAME_NS), lambda _: None)
        assert len(set(tracked.ids.tolist())) == len(tracked.ids)
    moved = se3_inverse(truth_between(FRAME_NS, 5 * FRAME_NS))
    cam_from_first = se3_inverse(BODY_FROM_CAM) @ moved @ BODY_FROM_CAM
    both, at_first, at_last = np.intersect1d(first.ids, tracked.ids, return_indices=True)
    assert len(both) > 25
    expected = CAMERA.pixel_from_point(points[at_first] @ cam_from_first[:3, :3].T + cam_from_first[:3, 3])
    off = np.linalg.norm((expected - tracked.pixels[at_last])[:, :2], axis=1)
    assert np.nanmedian(off) < 0.5
    step = se3_inverse(BODY_FROM_CAM) @ se3_inverse(truth_between(4 * FRAME_NS, 5 * FRAME_NS)) @ BODY_FROM_CAM
    assert np.linalg.norm(se3_log(tracked.cam_from_previous @ se3_inverse(step))[3:]) < 0.01


def test_a_prediction_may_be_wrong() -> None:
    """Predicted well, points are followed from one level above the image; predicted badly, from all of them, and held all the same."""
    step = se3_inverse(se3_inverse(BODY_FROM_CAM) @ truth_between(FRAME_NS, 2 * FRAME_NS) @ BODY_FROM_CAM)
    # 14 px to the side: more than what one level above the picture can make good
    turned = se3(so3_exp(np.array([0.0, 14.0 / CAMERA.focal_px, 0.0])), np.zeros(3))
    held = []
    for predicted, sigma_rad in ((step, 0.01), (turned @ step, 0.01), (step, None)):
        tracker = Tracker(CAMERA, TrackerSettings())
        first = tracker.track(stereo_frame(FRAME_NS), lambda _: None, sigma_rad)
        tracked = tracker.track(stereo_frame(2 * FRAME_NS), lambda _, predicted=predicted: predicted, sigma_rad)
        held.append(int(np.isin(tracked.ids, first.ids).sum()))
        assert np.linalg.norm(se3_log(tracked.cam_from_previous @ se3_inverse(step))) < 0.02
    assert min(held) > 0.9 * max(held)


def test_a_guess_beyond_the_flow_is_mended_by_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points come to lie 100 px from where a guess has them: flow finds edges there that agree on another motion."""
    step = se3_inverse(se3_inverse(BODY_FROM_CAM) @ truth_between(FRAME_NS, 2 * FRAME_NS) @ BODY_FROM_CAM)
    turned = se3(so3_exp(np.array([0.0, 100.0 / CAMERA.focal_px, 0.0])), np.zeros(3))
    described, motions = [], [step, turned @ step]
    remember = Tracker._remember
    monkeypatch.setattr(Tracker, "_remember", lambda *of: described.append(of[-1]) or remember(*of))  # type: ignore[func-returns-value]
    for number, guess in enumerate(motions):
        tracker = Tracker(CAMERA, TrackerSettings())
        first = tracker.track(stereo_frame(FRAME_NS), lambda _: None)
        tracked = tracker.track(stereo_frame(2 * FRAME_NS), lambda _, guess=guess: guess)
        assert len(described) == 2 * number, "costs nothing where the flow holds"
        assert np.isin(first.ids, tracked.ids).mean() > 0.7
        assert not tracked.by_descriptors
        assert np.linalg.norm(se3_log(tracked.cam_from_previous @ se3_inverse(step))) < 0.02


def test_a_filter_that_is_wrong_at_once_goes_on_from_the_last_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not from where its start was valid, which may be long before the frame that it was found at."""

    def earlier(*inputs: Any) -> InitialState | None:
        start = dynamic_initialization(*inputs)
        return None if start is None else replace(start, stamp_ns=start.stamp_ns - 4 * FRAME_NS)

    monkeypatch.setattr(modes, "dynamic_initialization", earlier)
    monkeypatch.setattr(DivergenceMonitor, "is_wrong_start", lambda *_: True)
    _, estimates = run((stereo_frame(k * FRAME_NS) for k in range(1, 41)), IMU)
    started = next(n for n, estimate in enumerate(estimates) if estimate.inertial)
    last, now = estimates[started], estimates[started + 1]
    assert not now.inertial
    assert np.linalg.norm(relative_error(last, now)[3:]) < 0.02


def test_an_imu_that_is_given_up_moves_the_body_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame at which it is given up was predicted by it already; vision moves the body from the frame before."""
    calls, begun, update = iter(range(1000)), {}, SlidingWindow.update

    def recorded(window: SlidingWindow, frame_index: int, *inputs: Any) -> Any:
        begun[frame_index] = window.filter.odom_from_body()
        return update(window, frame_index, *inputs)

    monkeypatch.setattr(DivergenceMonitor, "is_wrong_imu", lambda *_: next(calls) == 2)
    monkeypatch.setattr(SlidingWindow, "update", recorded)
    odometry, estimates = run((stereo_frame(k * FRAME_NS) for k in range(1, 26)), IMU)
    given_up = next(n for n, estimate in enumerate(estimates) if estimate.inertial) + 3
    last, now = estimates[given_up - 1], estimates[given_up]
    assert last.inertial
    assert not now.inertial
    assert odometry.refuses_imu
    assert np.linalg.norm(relative_error(last, replace(now, odom_from_body=begun[given_up]))[3:]) < 0.02
    assert odometry.motion_since(given_up - 1) is not None, "the window goes on"


def test_tracks_that_no_motion_explains_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an IMU, as of a standing robot by night: what is followed in noise moved it by metres."""
    taken: list[int] = []
    track, update = Tracker.track, SlidingWindow.update

    def lost(tracker: Tracker, *inputs: Any) -> Tracked:
        found = track(tracker, *inputs)
        return replace(found, cam_from_previous=None, information=None) if tracker._frame_index > 2 else found

    def recorded(window: SlidingWindow, frame_index: int, tracked: Tracked, *inputs: Any) -> Any:
        taken.append(len(tracked.ids))
        return update(window, frame_index, tracked, *inputs)

    monkeypatch.setattr(Tracker, "track", lost)
    monkeypatch.setattr(SlidingWindow, "update", recorded)
    odometry = Odometry(mounted(None), OdometrySettings())
    said = [odometry.handle_stereo(stereo_frame(k * FRAME_NS)) for k in range(1, 7)]
    assert min(taken[:3]) > 50
    assert taken[3:] == [0, 0, 0]
    assert [e.status for e in said[3:]] == [OdometryStatus.DEGRADED] * 3
    assert sigma_m(said[-1]) > 0.5 * GRAVITY_MPS2 * (3 * FRAME_NS * 1e-9) ** 2


def test_wheels_of_a_rig_without_imu_are_not_collected() -> None:
    odometry = Odometry(mounted(None), OdometrySettings())
    period_ns = FRAME_NS // 5
    for k in range(1, 21):
        stamps_ns = (k * FRAME_NS - n * period_ns for n in range(4, -1, -1))
        odometry.handle_wheel([WheelSample(stamp_ns, np.zeros(3), 0.0, 0.02, 0.02) for stamp_ns in stamps_ns])
        odometry.handle_stereo(black_frame(k * FRAME_NS))
        assert len(odometry._samples._wheel) < 15


@pytest.mark.parametrize("broken", ["clocks", "velocity"])
def test_a_filter_that_leaves_the_pictures_begins_again(broken: str) -> None:
    """By sight alone for a while, then by the IMU; `odom` goes on, and says that it is less sure."""

    def spoil(odometry: Odometry, frame: RectifiedFrame) -> None:
        if frame.stamp_ns != 40 * FRAME_NS:
            return
        mode: Any = odometry._mode
        if broken == "clocks":
            mode.window.filter.imu_minus_cam_s = 0.09
        else:  # by a blow that no noise covers
            state, blow = mode.window.filter.state, np.array([0.0, 0.0, 14e3 + 9.81])
            force, rate = state.rotation.T @ blow + state.accel_bias_mps2, state.gyro_bias_radps
            blown = np.array([0, 1_000_000]), np.tile(rate, (2, 1)), np.tile(force, (2, 1))
            mode.window.filter.predict_inertial(*blown, 0, 1_000_000, (0.0,) * 4, (0.0,) * 4)

    _, said = run((stereo_frame(k * FRAME_NS) for k in range(1, 100)), IMU, before=spoil)
    assert said[38].inertial
    began = [n for n, estimate in enumerate(said) if estimate.new_odom_from_old_odom is not None and n > 38]
    assert 39 <= began[0] <= 42
    assert not said[began[0]].inertial
    np.testing.assert_array_equal(said[began[0]].new_odom_from_old_odom, np.eye(4))
    assert said[-1].inertial, "gravity was found again"
    again = next(n for n in range(began[0], len(said)) if said[n].inertial)
    assert np.linalg.norm(relative_error(said[again], said[-1])[3:]) < 0.05
    places_m = np.array([each.odom_from_body[:3, 3] for each in said[began[0] : again]])
    assert np.linalg.norm(np.diff(places_m, axis=0), axis=1).max() < 0.3


@pytest.mark.parametrize("imu", [IMU, None])
@pytest.mark.parametrize("is_elsewhere", [False, True])
def test_no_motion_is_carried_through_a_pause(imu: ImuNoise | None, is_elsewhere: bool) -> None:
    """The robot is off for five hours; then it stands where it was, or before a picture that shows nothing that it knows."""
    before, hours_ns = 40, 5 * 3600 * 10**9
    frames = [stereo_frame(k * FRAME_NS) for k in range(1, before + 1)]
    again = [black_frame((before + 1) * FRAME_NS) if is_elsewhere else stereo_frame((before + 1) * FRAME_NS)]
    _, estimates = run([*frames, *(replace(frame, stamp_ns=frame.stamp_ns + hours_ns) for frame in again)], imu)
    last, resumed = estimates[-2:]
    assert resumed.new_odom_from_old_odom is not None or not is_elsewhere
    change = np.eye(4) if resumed.new_odom_from_old_odom is None else resumed.new_odom_from_old_odom
    assert np.linalg.norm(resumed.odom_from_body[:3, 3] - (change @ last.odom_from_body)[:3, 3]) < 0.3
    assert not resumed.inertial
    assert (resumed.status is OdometryStatus.DEGRADED) == is_elsewhere
    assert is_away(last.stamp_ns, resumed) == is_elsewhere
    chain = FrameChain()
    for each in (last, resumed):
        chain.append(each)
    cov_before, cov_after = chain.covariances()
    if is_elsewhere:
        assert np.sqrt(np.trace((cov_after - cov_before)[3:, 3:])) > 1000
