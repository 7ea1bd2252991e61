"""The rig of a survey: its cameras, with one pinhole and, after conversion of their disparities, one baseline. Pure."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import RGBD_BASELINE_M, RectifiedFrame, Rectifier, StereoCamera

_SAME_MOMENT_NS = 2_000_000  # in which a robot moves by 2 mm, as uncertain as a step of its odometry is at least


class CameraKind(StrEnum):
    """What measures the disparities of a camera's features: a second camera, a depth sensor, or its own motion."""

    STEREO = "stereo"
    DEPTH = "depth"
    SINGLE = "single"


@dataclass(frozen=True, slots=True)
class Rig:
    """V cameras on one body: body_from_cam (V, 4, 4), kinds (V,). `camera`: the pinhole and baseline to which all are converted."""

    camera: StereoCamera
    body_from_cam: Array
    kinds: tuple[CameraKind, ...]

    @classmethod
    def of_one(cls, camera: StereoCamera, body_from_cam: Array, kind: CameraKind = CameraKind.STEREO) -> "Rig":
        """Return a rig of one camera mounted at body_from_cam (4, 4)."""
        return cls(camera, body_from_cam[None], (kind,))

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def first(self) -> "Rig":
        """The first camera alone."""
        return self.of_one(self.camera, self.body_from_cam[0], self.kinds[0])

    def map_from_cams(self, map_from_body: Array) -> Array:
        """Return (K, V, 4, 4) of all cameras on bodies at map_from_body (K, 4, 4)."""
        return np.asarray(map_from_body[:, None] @ self.body_from_cam)

    def as_bodies(self, map_from_body: Array) -> Array:
        """Return (K, V, 4, 4): bodies whose first camera would be where the cameras of the bodies at map_from_body (K, 4, 4) are."""
        body_from_other = self.body_from_cam @ se3_inverse(self.body_from_cam[0])
        body_from_other[0] = np.eye(4)
        return np.asarray(map_from_body[:, None] @ body_from_other)


def used_cameras(rectifier: Rectifier) -> list[tuple[int, StereoCamera]]:
    """Return numbers in a frame and models of the first camera and those with its pinhole; a single camera comes alone."""
    first, *others = (mounted.camera for mounted in rectifier.mounted)
    alike = [
        (number, camera)
        for number, camera in enumerate(others, 1)
        if first.baseline_m > 0 and replace(camera, baseline_m=first.baseline_m) == first
    ]
    return [(0, first), *alike]


def rig_of(rectifier: Rectifier) -> Rig:
    """Return the rig of the `used_cameras`. A single camera gets a baseline, so that depths have disparities, as with a depth sensor."""
    cameras = [(rectifier, *rectifier.others)[number] for number, _ in used_cameras(rectifier)]
    kinds = [
        CameraKind.DEPTH if each.has_depth else CameraKind.STEREO if each.camera.baseline_m > 0 else CameraKind.SINGLE
        for each in cameras
    ]
    return Rig(survey_camera(rectifier.camera), np.array([each.body_from_cam for each in cameras]), tuple(kinds))


def survey_camera(camera: StereoCamera) -> StereoCamera:
    """Return the camera model of a survey: a single camera gets a baseline, so that depths have disparities, as with a depth sensor."""
    return camera if camera.baseline_m > 0 else replace(camera, baseline_m=RGBD_BASELINE_M)


def scaled_bodies(map_from_body: Array, body_from_cam: Array, scale: float) -> Array:
    """Return bodies (K, 4, 4) whose cameras, mounted at body_from_cam (4, 4), are `scale` times as far from the origin."""
    map_from_cam = map_from_body @ body_from_cam
    map_from_cam[:, :3, 3] *= scale
    return np.asarray(map_from_cam @ se3_inverse(body_from_cam))


def projection_by_point(camera: StereoCamera, points_cam: Array) -> Array:
    """Return (M, 3, 3) derivatives of u, v and disparity by points (M, 3) in the camera."""
    x, y, z = points_cam.T
    rows, focal_px = np.zeros((len(z), 3, 3)), camera.focal_px
    rows[:, 0, 0] = rows[:, 1, 1] = focal_px / z
    rows[:, 0, 2], rows[:, 1, 2] = -focal_px * x / z**2, -focal_px * y / z**2
    rows[:, 2, 2] = -focal_px * camera.baseline_m / z**2
    return rows


def frame_of_camera(frame: RectifiedFrame, number: int) -> RectifiedFrame | None:
    """Return the frame of a camera; None if it has no images at this moment."""
    seen = frame.view(number)
    if seen is None or abs(seen.stamp_ns - frame.stamp_ns) > _SAME_MOMENT_NS:
        return None
    return replace(seen, stamp_ns=frame.stamp_ns)
