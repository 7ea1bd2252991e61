"""Frames between keyframes: placed by what they see, whatever odometry says, and by odometry where they see nothing."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3_exp, se3_inverse, se3_log
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from mapserver.drafting.worker import Threads
from mapserver.survey.finish.frame_adjustment import PlacedFrames, frame_trajectory, place_frames
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import FrameTracks, OdometryPass, SurveyState
from support.worlds.corridor_scene import CAMERA, scene

FRAMES, FRAME_NS = 31, 100_000_000
KEYFRAMES = [3, 9, 15, 21, 27]  # with frames before the first one and after the last one
SPIKE = se3_exp(np.array([0.0, 0.006, 0.0, 0.0, 0.0, 0.095]))
KINDS = ("stereo", "stereo-inertial", "mono")
SETTINGS = SurveySettings()


@dataclass
class Drive:
    """A drive whose keyframes are where they were; odometry and what was followed may be wrong."""

    odometry: OdometryPass
    state: SurveyState
    truth: Array

    def errors_m(self, placed: PlacedFrames) -> Array:
        return np.linalg.norm(placed.map_from_body[:, :3, 3] - self.truth[:, :3, 3], axis=1)

    def carried(self) -> Array:
        stamps = np.arange(FRAMES, dtype=np.int64) * FRAME_NS
        return frame_trajectory(stamps, self.odometry.odom_from_body, KEYFRAMES, self.state.map_from_body)


def drive(kind: str = "stereo", blind: range = range(0), slipped: float = 0.0) -> Drive:
    """Odometry in a frame of its own; frames of `blind` follow nothing, and of all that is followed a share has slipped."""
    given = scene(FRAMES, 5, drift=0.0, outliers=slipped)
    marks, camera, pixels = given.state.landmarks, CAMERA, given.state.landmarks.obs_pixels.copy()
    if kind == "mono":
        camera, pixels[:, 2] = replace(CAMERA, baseline_m=0.0), np.nan
    rows = [np.flatnonzero((marks.obs_keyframe == f) & (f not in blind)) for f in range(FRAMES)]
    tracks = FrameTracks.joined(
        [FrameTracks.of_frame(SimpleNamespace(track_ids=marks.obs_landmark[r], track_pixels=pixels[r])) for r in rows]
    )
    motion = replace(given.state.motion, motions=np.zeros((len(KEYFRAMES), 9)))
    if kind == "stereo-inertial":
        motion = replace(motion, inertial=True, imu=felt(given.map_from_body), noise=ImuNoise())
    kept = marks.keep_observations(np.isin(marks.obs_keyframe, KEYFRAMES), 1)
    kept = replace(kept, obs_keyframe=np.searchsorted(KEYFRAMES, kept.obs_keyframe).astype(np.int32))
    changed = {"rig": replace(given.state.rig, camera=camera), "motion": motion, "landmarks": kept}
    state = replace(given.state, **changed, map_from_body=given.map_from_body[KEYFRAMES])
    odom_from_map = se3_exp(np.array([0.0, 0.0, 0.7, 3.0, -2.0, 1.0]))
    odometry = OdometryPass(
        [SimpleNamespace(stamp_ns=f * FRAME_NS) for f in range(FRAMES)],
        odom_from_map @ given.map_from_body,
        np.arange(FRAMES)[:, None, None] * 1e-6 * np.eye(6),
        np.ones(FRAMES, bool),
        [SimpleNamespace(frame_index=k) for k in KEYFRAMES],
        inertial=motion.inertial,
        tracks=tracks,
    )
    return Drive(odometry, state, given.map_from_body)


def felt(map_from_body: Array) -> ImuSamples:
    """What an IMU feels of a motion whose steps are all the same, about the vertical."""
    twist = se3_log(se3_inverse(map_from_body[0]) @ map_from_body[1]) / (FRAME_NS * 1e-9)
    stamps = np.arange(-20, 20 * FRAMES, dtype=np.int64) * (FRAME_NS // 20)
    gyro, accel = twist[:3], np.cross(twist[:3], twist[3:]) + np.array([0.0, 0.0, 9.81])
    return ImuSamples(stamps, np.tile(gyro, (len(stamps), 1)), np.tile(accel, (len(stamps), 1)))


def with_spikes(given: Drive, frames: list[int]) -> Drive:
    """Odometry jumps away at these frames and is back at the next ones."""
    wrong = given.odometry.odom_from_body.copy()
    wrong[frames] = wrong[frames] @ SPIKE
    return replace(given, odometry=replace(given.odometry, odom_from_body=wrong))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frames", [[11], [16, 17, 18, 19, 20], [0, 1], [30]])
def test_a_jump_of_odometry_between_keyframes_is_not_in_the_map(kind: str, frames: list[int]) -> None:
    """Seen: frames 9.5 cm off after a turn, between keyframes that were known to 1 cm."""
    given = with_spikes(drive(kind), frames)
    carried = np.linalg.norm(given.carried()[:, :3, 3] - given.truth[:, :3, 3], axis=1)
    assert (carried[frames] > 0.05).all()
    placed = place_frames(given.odometry, given.state, SETTINGS)
    assert placed.seen.all()
    assert given.errors_m(placed).max() < 0.01
    np.testing.assert_array_equal(placed.map_from_body[KEYFRAMES], given.state.map_from_body)


@pytest.mark.parametrize("kind", KINDS)
def test_where_frames_see_nothing_odometry_carries_them(kind: str) -> None:
    given = drive(kind, blind=range(16, 21))
    placed = place_frames(given.odometry, given.state, SETTINGS)
    assert np.flatnonzero(~placed.seen).tolist() == list(range(16, 21))
    np.testing.assert_array_equal(placed.map_from_body[16:21], given.carried()[16:21])
    assert given.errors_m(placed).max() < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_joins_blind_frames_to_those_that_see(kind: str) -> None:
    """Odometry is right from frame to frame, but as a whole it is off by centimetres at the frames that see."""
    given = with_spikes(drive(kind, blind=range(17, 20)), list(range(16, 21)))
    placed = place_frames(given.odometry, given.state, SETTINGS)
    assert np.flatnonzero(~placed.seen).tolist() == [17, 18, 19]
    assert given.errors_m(placed).max() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_tracks_pull_no_frame_away(kind: str) -> None:
    given = with_spikes(drive(kind, slipped=0.1), [11, 17])
    assert given.errors_m(place_frames(given.odometry, given.state, SETTINGS)).max() < 0.015


def test_what_another_scale_follows_is_not_touched() -> None:
    """Before one camera's longest run, and after it, odometry is in another frame."""
    given = drive("mono")
    tracked = np.ones(FRAMES, bool)
    tracked[[1, 29]] = False
    placed = place_frames(replace(given.odometry, tracked=tracked), given.state, SETTINGS)
    assert np.flatnonzero(~placed.seen).tolist() == [0, 1, 29, 30]
    np.testing.assert_array_equal(placed.map_from_body[[0, 1, 29, 30]], given.carried()[[0, 1, 29, 30]])


def test_threads_change_no_bit() -> None:
    given = with_spikes(drive("stereo-inertial", slipped=0.1), [11, 17])
    alone = place_frames(given.odometry, given.state, SETTINGS)
    with ThreadPoolExecutor(3) as pool:
        together = place_frames(given.odometry, given.state, SETTINGS, executor=Threads(pool, 3))
    assert alone.map_from_body.tobytes() == together.map_from_body.tobytes()


def test_a_correction_of_the_pair_holds_for_frames_too() -> None:
    """Disparities that are all too large by 0.5 px pull frames back; the survey has corrected those of its keyframes."""
    given = drive()
    tracks = given.odometry.tracks
    shift = 0.5 * (1 + ((tracks.pixels[:, 0] - CAMERA.cx_px) / CAMERA.focal_px) ** 2)
    wrong = replace(tracks, pixels=(tracks.pixels - np.column_stack([0 * shift, 0 * shift, shift])).astype(np.float32))
    odometry = replace(given.odometry, tracks=wrong)
    right = place_frames(given.odometry, given.state, SETTINGS)
    corrected = place_frames(odometry, given.state, SETTINGS, correction_px=0.5)
    np.testing.assert_allclose(corrected.map_from_body, right.map_from_body, atol=1e-4)


def test_tracks_give_what_frames_saw() -> None:
    rng = np.random.default_rng(1)
    seen = [(rng.integers(0, 99, n), rng.uniform(0, 500, (n, 3))) for n in (3, 0, 5, 2)]
    tracks = FrameTracks.joined([FrameTracks.of_frame(SimpleNamespace(track_ids=i, track_pixels=p)) for i, p in seen])
    ids, which, pixels = tracks.of(np.array([0, 1, 3]))
    assert ids.tolist() == [*seen[0][0], *seen[3][0]]
    assert which.tolist() == [0, 0, 0, 2, 2]
    np.testing.assert_allclose(pixels, np.concatenate([seen[0][1], seen[3][1]]), atol=1e-3)
