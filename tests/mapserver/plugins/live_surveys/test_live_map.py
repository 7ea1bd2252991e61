"""The map of a survey under way, against a room whose walls and motion are known in closed form."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, SensorSet
from mapserver.config import survey_settings
from mapserver.plugins.live_surveys.live_map import LiveMap
from mapserver.plugins.live_surveys.message import LiveRig, NewKeyframe
from mapserver.plugins.live_surveys.tracking import LiveTracking
from mapserver.survey.odometry_pass import SampleFeed
from mapserver.survey.survey_inputs import SurveyConfig
from support.worlds.inertial_motion import analytic_motion
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, HALF_SIZE_M, black_frame, rig, stereo_frame

IMU = ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)
FRAME_NS = 50_000_000
SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)


@dataclass
class Followed:
    """A map, the stamps of its keyframes and the tracking quality of every frame."""

    growing: LiveMap
    stamps_ns: list[int] = field(default_factory=list)
    qualities: list[float] = field(default_factory=list)

    def error_m(self) -> Array:
        """(K,) distance of each keyframe from the truth, the first one laid upon it."""
        truth = np.array([analytic_motion(s * 1e-9).map_from_body for s in self.stamps_ns])
        laid = self.truth_from_map() @ self.growing.map_from_body
        return np.asarray(np.linalg.norm(laid[:, :3, 3] - truth[:, :3, 3], axis=1))

    def truth_from_map(self) -> Array:
        first = analytic_motion(self.stamps_ns[0] * 1e-9).map_from_body
        return np.asarray(first @ se3_inverse(self.growing.map_from_body[0]))


def follow(frames: Iterable[RectifiedFrame], imu: ImuNoise | None) -> Followed:
    calibration = rig(imu)
    samples = ImuSamples.empty()
    if imu is not None:
        samples = noisy_imu(np.random.default_rng(1), 6.5, imu, np.array([0.01, -0.02, 0.015]), np.full(3, 0.03))
    mounting: Any = SimpleNamespace(camera=CAMERA, body_from_cam=BODY_FROM_CAM, imu_minus_cam_s=0.0, has_depth=False)
    tracking, feed = LiveTracking(calibration, mounting, SETTINGS), SampleFeed(samples, (), 0.0)
    followed = Followed(
        LiveMap(SurveyConfig(SETTINGS, default_vocabulary()), LiveRig(CAMERA, BODY_FROM_CAM, calibration.imu))
    )
    for frame in frames:
        tracked = tracking.handle(frame, *feed.until(frame.stamp_ns))
        followed.qualities.append(tracked.quality)
        if tracked.keyframe is not None:
            followed.growing.add(frame, tracked.keyframe)
            followed.stamps_ns.append(frame.stamp_ns)
    return followed


@pytest.fixture(scope="module", params=["stereo", "stereo-inertial"])
def followed(request: pytest.FixtureRequest) -> Followed:
    return follow((stereo_frame(k * FRAME_NS) for k in range(1, 81)), IMU if request.param != "stereo" else None)


def test_keyframes_are_where_the_camera_was(followed: Followed) -> None:
    truth = np.array([analytic_motion(s * 1e-9).map_from_body[:3, 3] for s in followed.stamps_ns])
    path_m = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert len(followed.growing) > 10
    assert followed.error_m().max() < 0.015 * path_m


def test_landmarks_lie_on_the_walls(followed: Followed) -> None:
    points = followed.growing.points_map()
    placed = points @ followed.truth_from_map()[:3, :3].T + followed.truth_from_map()[:3, 3]
    off_m = np.abs(HALF_SIZE_M - np.abs(placed)).min(axis=1)
    assert len(points) > 500
    assert np.median(off_m) < 0.05
    assert np.quantile(off_m, 0.9) < 0.2


def test_the_same_frames_make_the_same_map() -> None:
    first, second = (follow((stereo_frame(k * FRAME_NS) for k in range(1, 31)), IMU).growing for _ in range(2))
    assert first.map_from_body.tobytes() == second.map_from_body.tobytes()
    assert first.points_map().tobytes() == second.points_map().tobytes()


def test_a_covered_camera_has_no_quality_and_the_map_goes_on() -> None:
    dark = range(41, 47)
    frames = (black_frame(k * FRAME_NS) if k in dark else stereo_frame(k * FRAME_NS) for k in range(1, 71))
    followed = follow(frames, IMU)
    assert all(followed.qualities[k - 1] == 0.0 for k in list(dark)[1:])
    assert min(followed.qualities[50:]) > 0.0
    assert followed.stamps_ns[-1] > dark[-1] * FRAME_NS
    assert followed.error_m().max() < 0.15


def test_pictures_that_do_not_change_at_all_are_mapped() -> None:
    """A robot that stands, under a camera without noise: every point is seen first by the first of them."""
    growing = LiveMap(SurveyConfig(SETTINGS, default_vocabulary()), LiveRig(CAMERA, BODY_FROM_CAM))
    still, step = np.zeros(3), np.diag([1e-4] * 6)
    for number in range(3):
        frame = stereo_frame(FRAME_NS)
        frame = RectifiedFrame((number + 1) * FRAME_NS, frame.left, frame.right, None)
        new = NewKeyframe(number, np.eye(4), np.eye(3), step if number else None, still, still, still)
        growing.add(frame, new)
    assert len(growing.points_map()) > 100
    np.testing.assert_allclose(growing.map_from_body[:, :3, 3], 0.0, atol=0.01)
