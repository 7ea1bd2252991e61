"""A localizer on a scripted ride: the robot drives along x, odometry is exact, and what a frame's fixes say is where the robot truly
is, moved by the offsets that the script gives for that frame."""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Self
from unittest.mock import patch

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.messages import Status
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.map_view import ALIAS_STEP_M, LookAlikes
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import PositionPrior
from locclient.localization import localizer as module
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings, TrackSettings

BODY_FROM_CAM = se3(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.05, 0.3]))
MAP_FROM_ODOM = se3(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([12.0, -5.0, 1.0]))
FRAME_NS = 200_000_000  # as often as the localizer looks
CLONES = 8
NO_FIX: tuple[Array, ...] = ()
TRUE = (np.zeros(3),)


def off(*metres: float) -> Array:
    """A wrong place, so far from the true one."""
    return np.array([*metres, 0.0, 0.0])[:3]


class ScriptedOdometry:
    """Exact, with a covariance that grows with the way; forgets frames as the real one does."""

    def __init__(self) -> None:
        self.odom_from_body: list[Array] = []
        self.next_motion = np.eye(4)
        self.redefine: Array | None = None
        self.drift_share = 0.0
        self.breaks = self.lifts = False  # at the next frame
        self.lacks_imu = False

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        (change, self.redefine), (is_lifted, self.lifts) = (self.redefine, None), (self.lifts, False)
        status, self.breaks = OdometryStatus.DEGRADED if self.breaks else OdometryStatus.TRACKING, False
        if change is not None:
            self.odom_from_body = [change @ earlier for earlier in self.odom_from_body]
        last = self.odom_from_body[-1] if self.odom_from_body else np.eye(4)
        self.odom_from_body.append(last @ self.next_motion)
        return OdometryEstimate(
            frame.stamp_ns, len(self.odom_from_body) - 1, self.odom_from_body[-1], 1e-6 * np.eye(6), status, inertial=True,
            track_ids=np.arange(50), new_odom_from_old_odom=change, is_lifted=is_lifted, is_bridged=self.lacks_imu,
        )  # fmt: skip

    def will_forget(self, frame_index: int) -> bool:
        return frame_index <= max(0, len(self.odom_from_body) - CLONES)

    def handle_fix(self, *_: object, is_confirmed: bool) -> None:
        """It knows its scale."""

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        if frame_index < len(self.odom_from_body) - CLONES:
            return None
        motion = se3_inverse(self.odom_from_body[frame_index]) @ self.odom_from_body[-1]
        sigma_m = self.drift_share * float(np.linalg.norm(motion[:3, 3]))
        return motion, np.diag([1e-8] * 3 + [sigma_m**2 + 1e-8] * 3)


@dataclass
class ScriptedRelocalizer:
    """Offers the fixes of the present frame: near the prediction the one that lies there, anywhere all of them."""

    fixes: list[Fix] = field(default_factory=list)
    alias_ratio: float = 0.1

    @property
    def view(self) -> Any:
        return type("View", (), {"map_from_cam": np.tile(np.eye(4), (4, 1, 1))})

    def extract(self, frame: RectifiedFrame) -> Generator[None, None, list[Fix]]:
        seen = self.fixes
        yield
        return seen

    def near(self, seen: list[Fix], map_from_cam: Array, cov_rot_trans: Array, _: object = ()) -> Fix | None:
        return first_near(seen, map_from_cam, cov_rot_trans)

    def anywhere(self, seen: list[Fix], *_: object) -> Generator[None, None, list[Fix]]:
        yield
        return list(seen)


def first_near(fixes: list[Fix], map_from_cam: Array, cov_rot_trans: Array) -> Fix | None:
    """The first fix that a prediction with this covariance may be."""
    reach_m = 0.3 + 3 * np.sqrt(np.trace(cov_rot_trans[3:, 3:]))
    close = (f for f in fixes if np.linalg.norm(f.map_from_cam[:3, 3] - map_from_cam[:3, 3]) < reach_m)
    return next(close, None)


def scripted_localizer(odometry: ScriptedOdometry, track: dict[str, Any], imu: ImuNoise | None = None) -> Localizer:
    """With a pair of cameras, and this odometry in place of its own."""
    focal = np.array([400, 400, 320, 240.0])
    lens = CameraCalibration("radial-tangential", 640, 480, focal, np.zeros(4), BODY_FROM_CAM)
    mounted = MountedCamera(StereoCamera(400.0, 320.0, 240.0, 0.1, 640, 480), BODY_FROM_CAM)
    settings = LocalizerSettings(track=TrackSettings(**track))
    localizer = Localizer(MountedRig(RigCalibration((lens,), imu), (mounted,)), settings)
    localizer.perception.odometry = odometry  # type: ignore[assignment]
    return localizer


class Robot:
    """A localizer on a ride; `go` plays one frame."""

    def __init__(self, **track: Any) -> None:
        self.relocalizer = ScriptedRelocalizer()
        self.odometry = ScriptedOdometry()
        self.localizer = scripted_localizer(self.odometry, track)
        self.frames = 0
        self.inliers = 40
        self.landmark_recall = 1.0
        self.is_dark = False
        self.rng = np.random.default_rng(0)
        self.map_from_body = MAP_FROM_ODOM.copy()

    def load(self, lookalikes: LookAlikes | None = None, alias_step_m: float = ALIAS_STEP_M, version: int = 1) -> Self:
        with patch.object(module, "Relocalizer", lambda *_: self.relocalizer):
            self.localizer.handle_version(version, None, lookalikes, alias_step_m)  # type: ignore[arg-type]
        return self

    def go(self, step_m: float, offsets: Iterable[Array] = TRUE, turn_rad: float = 0.02) -> Estimate:
        """One frame after so much way along the body's x; the fixes are the true place moved by each offset."""
        motion = se3(so3_exp(np.array([0, 0, turn_rad])), np.array([step_m, 0, 0])) if self.frames else np.eye(4)
        self.map_from_body = self.map_from_body @ motion
        self.odometry.next_motion = motion
        self.relocalizer.fixes = [self._fix(offset) for offset in offsets]
        self.frames += 1
        picture = np.zeros((480, 640), np.uint8) if self.is_dark else self.rng.integers(0, 255, (480, 640), np.uint8)
        return self.localizer.handle_stereo(RectifiedFrame(self.frames * FRAME_NS, picture, None, None))

    def ride(self, steps: int, step_m: float, offsets: Sequence[Array] = TRUE) -> list[Estimate]:
        return [self.go(step_m, offsets) for _ in range(steps)]

    def _fix(self, offset: Array) -> Fix:
        moved = self.map_from_body.copy()
        moved[:3, 3] += offset
        covariance = np.diag([0.002**2] * 3 + [0.01**2] * 3)
        about = {"alias_ratio": self.relocalizer.alias_ratio, "landmark_recall": self.landmark_recall}
        return Fix(moved @ BODY_FROM_CAM, covariance, self.inliers, 20, **about)

    def knows(self, estimate: Estimate) -> bool:
        """True if it is tracking, and its true position."""
        return estimate.status is Status.TRACKING and self.error_m(estimate) < 1e-6

    def told(
        self, sigma_m: float, offset: Array = TRUE[0], *, is_whole: bool = False, is_revisable: bool = False
    ) -> None:
        """A prior at its own place displaced: of the position alone, or with heading and height."""
        map_from_base = self.map_from_body.copy()
        map_from_base[:3, 3] += offset
        unknown = 0.02**2 if is_whole else np.inf
        covariance = np.diag([unknown] * 3 + [sigma_m**2, sigma_m**2, sigma_m**2 if is_whole else np.inf])
        self.localizer.handle_prior(PositionPrior(self.frames * FRAME_NS, map_from_base, covariance, is_revisable))

    def error_m(self, estimate: Estimate) -> float:
        return float(np.linalg.norm(estimate.map_from_body[:3, 3] - self.map_from_body[:3, 3]))
