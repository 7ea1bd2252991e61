"""Perception of a robot: its samples and images, as one percept for each frame: measurements that do not depend on a map. Pure."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.messages import Cause
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.mono.mono_modes import make_odometry
from fleetmap.relocalization.relocalizer import FrameFeatures
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, WheelSample
from locclient.localization.calibration.parameters import NOT_JUDGED, CalibrationState
from locclient.localization.image_quality import UNUSABLE, ImageQuality, ImageQualityMonitor
from locclient.localization.pose_hypothesis import Motion
from locclient.localization.priors.ride_gauge import Ride, RideGauge
from locclient.localization.settings import LocalizerSettings

_DEAD_NS = 500_000_000  # without images, a camera is dead


@dataclass(slots=True)
class QueryInput:
    """Features of the frame of a map query, and the number of slices of their extraction; None until they are complete.

    view: number of the rig's view that they are of.
    """

    slices: int = 0
    features: FrameFeatures | None = None
    view: int = 0


@dataclass(slots=True)
class Percept:
    """Percept of one frame. Robots store them for replays of failures.

    motions: of the odometry, from start frames of hypotheses. is_reversed: images of a pair or of two cameras are exchanged, or mirrored.
    calibration: its state by the map before this frame. query: of a map query that begins with this frame. image: of the view that the
    odometry follows; view_causes: faults of the images of each view. ride: motion in a lift, None for a robot without a building.
    """

    odometry: OdometryEstimate
    image: ImageQuality
    motions: dict[int, Motion]
    is_reversed: bool = False
    calibration: CalibrationState = NOT_JUDGED
    query: QueryInput | None = None
    view_causes: tuple[Cause, ...] = (Cause.NONE,)
    ride: Ride | None = None

    @property
    def has_broken(self) -> bool:
        """True if tracks are lost in a good image: an object moved in front of the cameras, or the robot is elsewhere."""
        return self.odometry.status is OdometryStatus.DEGRADED and self.image.cause is Cause.NONE


class Perception:
    """Judges the images of every camera of a rig, and follows one of them by its odometry.

    gauges: whether the rise of a robot at rest is measured, which may ride a lift. percept: of the last frame. view: the followed camera.
    stage_s: seconds by stage of the last frame, by the given clock.
    """

    def __init__(self, rig: MountedRig, settings: LocalizerSettings, clock: Callable[[], float]) -> None:
        """Arguments as of `Localizer`."""
        self._clock, self._mounted = clock, rig.mounted
        self.odometry = make_odometry(rig, settings.odometry, settings.stereo, by_wheels=True)
        self.gauge, self.gauges = RideGauge(rig.calibration.imu), False
        self._imu_minus_cam_ns = int(rig.imu_minus_cam_s * 1e9)
        self.percept: Percept | None = None
        self.view = 0
        self.stage_s: dict[str, float] = {}
        self._images = [ImageQualityMonitor(settings.image_quality) for _ in self._mounted]
        self._judged: tuple[RectifiedFrame, list[ImageQuality]] | None = None  # the last frame
        self._last_frame: RectifiedFrame | None = None  # of a rig with several cameras

    def handle_imu(self, samples: ImuSamples) -> None:
        self.odometry.handle_imu(samples)
        if self.gauges:
            self.gauge.handle_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        self.odometry.handle_wheel(samples)
        if self.gauges:
            self.gauge.handle_wheel(samples)

    def awaits(self, frame: RectifiedFrame) -> bool:
        """Return True if a frame is to be left out: the followed camera, alone usable, has images at a lower rate and none in this one; or
        its last one is newer."""
        if self.percept is None or len(self._mounted) == 1:
            return False
        followed, since_ns = self.view, frame.stamp_ns - self.percept.odometry.stamp_ns
        is_missing = followed > 0 and frame.others[followed - 1 : followed] in ((), (None,)) and since_ns < _DEAD_NS
        return since_ns <= 0 or (is_missing and all(image.cause in UNUSABLE for image in self._judge(frame)))

    def perceive(self, frame: RectifiedFrame, motions_from: Iterable[int]) -> tuple[Percept, RectifiedFrame]:
        """Return the percept of `frame`, which must be newer than all before, and the frame without images that are stuck.

        motions_from: frames of the odometry from which motions to this one are wanted.
        """
        begun_s = self._clock()
        images = self._judge(frame)
        self._choose_view([image.cause for image in images])
        number = self.view
        image, followed = images[number], frame.view(number) or self._black(number, frame.stamp_ns)
        if image.cause is Cause.FROZEN:
            followed = self._images[number].without_frozen(followed)
        frame = frame if number else followed
        judged_s = self._clock()
        odometry = self.odometry.handle_stereo(followed)
        if image.cause is Cause.NONE:
            cause = self._images[number].judge_depth(odometry.scene_depth_m)
            image = image if cause is Cause.NONE else replace(image, cause=cause)
        self.stage_s = {"image_quality": judged_s - begun_s, "odometry": self._clock() - judged_s}
        causes = [image.cause if k == number else each.cause for k, each in enumerate(images)]
        last = self.percept
        self.percept = Percept(odometry, image, self._motions(motions_from), view_causes=tuple(causes))
        if self.gauges:
            if self.odometry.refuses_imu or self.odometry.accelerometer.fault:
                self.gauge.doubt()
            dt_s = 0.0 if last is None else (odometry.stamp_ns - last.odometry.stamp_ns) * 1e-9
            self.percept.ride = self.gauge.advance(odometry.stamp_ns + self._imu_minus_cam_ns, dt_s)
        self._last_frame = frame if frame.others else None
        return self.percept, frame

    def _judge(self, frame: RectifiedFrame) -> list[ImageQuality]:
        """Return the quality of the images of every camera; each frame is judged once."""
        if self._judged is None or self._judged[0] is not frame:
            self._judged = frame, [self._quality(frame, number) for number in range(len(self._mounted))]
        return self._judged[1]

    def _quality(self, frame: RectifiedFrame, number: int) -> ImageQuality:
        """Return the quality of a camera's images: of the first as rectified, of others as recorded, since few of them are rectified."""
        if number == 0:
            return self._images[0].judge(frame)
        other = frame.others[number - 1] if number <= len(frame.others) else None
        return ImageQuality(Cause.NO_FRAMES) if other is None else self._images[number].judge(other.recorded)

    def _black(self, number: int, stamp_ns: int) -> RectifiedFrame:
        """Return the frame of a camera without images."""
        camera = self._mounted[number].camera
        return RectifiedFrame(stamp_ns, np.zeros((camera.height_px, camera.width_px), np.uint8), None, None)

    def _choose_view(self, causes: Sequence[Cause]) -> None:
        """Let the odometry follow another camera that measures depth, or the first one, if the images of the present one are unusable."""
        present, last = self.view, self.percept
        is_occluded = last is not None and last.image.cause is Cause.OCCLUDED
        if not (causes[present] in UNUSABLE or is_occluded):
            return
        for number, cause in enumerate(causes):
            may_lead = number == 0 or self._mounted[number].camera.baseline_m > 0
            if number != present and cause not in UNUSABLE and may_lead:
                self.odometry.follow(number, None if self._last_frame is None else self._last_frame.view(number))
                self.view = number
                return

    def _motions(self, frames: Iterable[int]) -> dict[int, Motion]:
        return {
            index: Motion(*motion, self.odometry.will_forget(index))
            for index in frames
            if (motion := self.odometry.motion_since(index)) is not None
        }
