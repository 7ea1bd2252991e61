"""What a robot perceives by its sensors, before a map says where that is: quality of images, motion, features, calibration. Pure.

It is all that the localizer takes from images and samples. The replay of a failure has it without them.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Cause
from fleetmap.numerics.time_sliced import TimeSliced
from fleetmap.odometry import Odometry, OdometryEstimate
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples, WheelSample
from locclient.localization.calibration.monitor import CalibrationMonitor, FinishedQuery
from locclient.localization.calibration.watch import Mounting
from locclient.localization.estimate import Estimate
from locclient.localization.image_quality import ImageQuality, ImageQualityMonitor
from locclient.localization.pose_hypothesis import Motion
from locclient.localization.settings import LocalizerSettings


class Perception(Motion, Protocol):
    """What the localizer asks for with each frame."""

    def handle_imu(self, samples: ImuSamples) -> None:
        """As `Odometry.handle_imu`."""

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """As `Odometry.handle_wheel`."""

    def judge(self, frame: RectifiedFrame) -> tuple[RectifiedFrame, ImageQuality]:
        """The frame without what a stuck camera repeats, and the quality of its images."""

    def follow(self, frame: RectifiedFrame, image: ImageQuality) -> tuple[OdometryEstimate, ImageQuality]:
        """The odometry at the frame that was judged, and the quality by its depth, too."""

    def is_reversed(self, frame: RectifiedFrame, *, is_localized: bool) -> bool:
        """As `CalibrationMonitor.is_reversed`, after a slice of that monitor's work."""

    def may_query(self, *, is_due: bool) -> bool:
        """Whether a map query begins with this frame. is_due: by the time since the last one."""

    def extract(self, relocalizer: Relocalizer, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        """The features of a frame for a map query, in slices."""

    def add(self, query: FinishedQuery) -> None:
        """As `CalibrationMonitor.add`."""

    def give_up(self) -> None:
        """As `CalibrationMonitor.give_up`."""

    def judged(self, estimate: Estimate, last_fix_ns: int | None, *, was_localized: bool) -> Estimate:
        """As `CalibrationMonitor.judged`."""


class SensorPerception:
    """Perception by images and samples as they come."""

    def __init__(
        self,
        calibration: RigCalibration,
        camera: StereoCamera,
        body_from_cam: Array,
        imu_minus_cam_s: float,
        settings: LocalizerSettings,
    ) -> None:
        rig = (calibration, camera, body_from_cam, imu_minus_cam_s)
        self.odometry = Odometry(*rig, settings.odometry, settings.stereo)
        self._images = ImageQualityMonitor(settings.image_quality)
        mounting = Mounting(se3_inverse(body_from_cam), calibration.base_from_body)
        self._calibration = CalibrationMonitor(mounting, settings.relocalizer, imu_minus_cam_s)
        self.add, self.give_up, self.judged = (
            self._calibration.add,
            self._calibration.give_up,
            self._calibration.judged,
        )

    def handle_imu(self, samples: ImuSamples) -> None:
        self.odometry.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self.odometry.handle_wheel(samples)
        self._calibration.watch.handle_wheel(samples)

    def judge(self, frame: RectifiedFrame) -> tuple[RectifiedFrame, ImageQuality]:
        image = self._images.judge(frame)
        return (self._images.without_frozen(frame) if image.cause is Cause.FROZEN else frame), image

    def follow(self, frame: RectifiedFrame, image: ImageQuality) -> tuple[OdometryEstimate, ImageQuality]:
        odometry = self.odometry.handle_stereo(frame)
        if image.cause is Cause.NONE:
            image = replace(image, cause=self._images.judge_depth(odometry.scene_depth_m))
        return odometry, image

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        return self.odometry.motion_since(frame_index)

    def will_forget(self, frame_index: int) -> bool:
        return self.odometry.will_forget(frame_index)

    def is_reversed(self, frame: RectifiedFrame, *, is_localized: bool) -> bool:
        self._calibration.work()
        return self._calibration.is_reversed(frame, is_localized=is_localized)

    def may_query(self, *, is_due: bool) -> bool:
        return is_due

    def extract(self, relocalizer: Relocalizer, frame: RectifiedFrame) -> TimeSliced[FrameFeatures]:
        return relocalizer.extract(frame)
