"""Calibration faults for recordings of any format: a rig described wrongly, images exchanged or mirrored, foreign sensors.

A `RigFault` changes what is believed of the rig and nothing that was recorded, so it can be given to every program as `--calibration
FILE`. An `ImageFault` changes the stored images and needs a new recording (`copy_to_mcap`). All are
deterministic. Rotations are about the axes of the left camera (x right, y down, z forward) unless said otherwise.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.recordings import Recording
from fleetmap.recordings.images import StoredImage, decode_grey, png_image
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from support.recordings.spoiled_recording import with_frames

RigChange = Callable[[RigCalibration], RigCalibration]
AXES = {"pitch": (1.0, 0.0, 0.0), "yaw": (0.0, 1.0, 0.0), "roll": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, slots=True)
class RigFault:
    """One wrong parameter. kind: a key for tables; size in `unit`, with sign."""

    kind: str
    size: float
    unit: str
    change: RigChange

    @property
    def name(self) -> str:
        """Kind, size and unit in words."""
        return f"{self.kind} {self.size:+g} {self.unit}"

    def recording(self, good: Recording) -> Recording:
        """The good recording as it opens with the wrong calibration."""
        return replace(good, calibration=self.change(good.calibration))


def baseline(percent: float) -> RigFault:
    """Baseline too long by a percentage."""

    def change(rig: RigCalibration) -> RigCalibration:
        left, right, *rest = rig.cameras
        left_from_right = se3_inverse(left.body_from_cam) @ right.body_from_cam
        left_from_right[:3, 3] *= 1.0 + 0.01 * percent
        moved = replace(right, body_from_cam=left.body_from_cam @ left_from_right)
        return replace(rig, cameras=(left, moved, *rest))

    return RigFault("baseline", percent, "%", change)


def focal(percent: float, cameras: Iterable[int] | None = None) -> RigFault:
    """Focal lengths too large by a percentage, of all cameras or of those with the numbers `cameras`."""
    chosen = None if cameras is None else set(cameras)
    by = np.array([1 + 0.01 * percent, 1 + 0.01 * percent, 1, 1])
    kind = "focal" if chosen is None else "focal of cam" + ",".join(map(str, sorted(chosen)))
    scaled = partial(_with_cameras, lambda c: replace(c, intrinsics_px=c.intrinsics_px * by), chosen)
    return RigFault(kind, percent, "%", scaled)


def pair_turn(axis: str, degrees: float) -> RigFault:
    """A wrong rotation of the right camera against the left one (a key of AXES, the right camera's own axes)."""
    turn = se3(so3_exp(np.radians(degrees) * np.array(AXES[axis])), np.zeros(3))
    turned = partial(_with_cameras, lambda c: replace(c, body_from_cam=c.body_from_cam @ turn), {1})
    return RigFault(f"pair {axis}", degrees, "deg", turned)


def camera_imu_turn(axis: str, degrees: float) -> RigFault:
    """A wrong common rotation of all cameras against the IMU, about the left camera's axis; their positions stay."""

    def change(rig: RigCalibration) -> RigCalibration:
        axes = rig.cameras[0].body_from_cam[:3, :3]
        turn = axes @ so3_exp(np.radians(degrees) * np.array(AXES[axis])) @ axes.T
        centre = rig.cameras[0].body_from_cam[:3, 3]
        about_left = se3(turn, centre - turn @ centre)
        return _with_cameras(lambda c: replace(c, body_from_cam=about_left @ c.body_from_cam), None, rig)

    return RigFault(f"camera-imu {axis}", degrees, "deg", change)


def delay(milliseconds: float) -> RigFault:
    """A wrong delay of the IMU's stamps against the cameras'."""
    late = partial(_with_cameras, lambda c: replace(c, imu_minus_cam_s=c.imu_minus_cam_s + 1e-3 * milliseconds), None)
    return RigFault("delay", milliseconds, "ms", late)


def unlike_robot(rig: RigCalibration, seed: int) -> RigCalibration:
    """The rig of another robot of the same make: differences by tolerances of lenses and mounts.

    Focal lengths 1.5 %, principal points 4 px, the pair's angles 0.4 degrees, its baseline 1 %, the IMU's angles 1 degree (sigmas).
    """
    rng = np.random.default_rng(seed)

    def built(camera: CameraCalibration) -> CameraCalibration:
        lens = camera.intrinsics_px * (1 + 0.015 * rng.standard_normal()) * [1, 1, 0, 0]
        lens += camera.intrinsics_px * [0, 0, 1, 1] + 4.0 * rng.standard_normal(4) * [0, 0, 1, 1]
        own = se3(so3_exp(np.radians(0.4) * rng.standard_normal(3)), np.zeros(3))
        return replace(camera, intrinsics_px=lens, body_from_cam=camera.body_from_cam @ own)

    other = baseline(float(rng.standard_normal())).change(_with_cameras(built, None, rig))
    turned = se3(so3_exp(np.radians(1.0) * rng.standard_normal(3)), np.zeros(3))
    return _with_cameras(lambda c: replace(c, body_from_cam=turned @ c.body_from_cam), None, other)


def standard_faults() -> list[RigFault]:
    """Every size that the project states a figure for, both signs where the sign matters."""
    both = [(size, sign) for size in (1.0, 2.0, 5.0, 20.0) for sign in (1, -1)]
    return [
        *(baseline(sign * size) for size, sign in both),
        *(focal(sign * size) for size in (0.5, 1.0, 2.0, 5.0) for sign in (1, -1)),
        *(focal(size, (number,)) for size in (1.0, 2.0) for number in (0, 1)),
        *(pair_turn(axis, sign * size) for size in (0.05, 0.2, 0.5) for axis in AXES for sign in (1, -1)),
        *(camera_imu_turn(axis, 1.0) for axis in AXES),
        *(delay(sign * size) for size in (5.0, 20.0) for sign in (1, -1)),
    ]


def swapped(good: Recording) -> Recording:
    """Left images in the place of right ones."""
    return with_frames(good, np.arange(len(good)), lambda frame: replace(frame, left=frame.right, right=frame.left))


def mirrored(good: Recording) -> Recording:
    """All images mirrored."""

    def flipped(image: StoredImage) -> StoredImage:
        return png_image(np.ascontiguousarray(cv2.flip(decode_grey(image), 1)))

    every = np.arange(len(good))
    return with_frames(good, every, lambda frame: replace(frame, left=flipped(frame.left), right=flipped(frame.right)))


def _with_cameras(
    change: Callable[[CameraCalibration], CameraCalibration], chosen: set[int] | None, rig: RigCalibration
) -> RigCalibration:
    cameras = [change(c) if chosen is None or n in chosen else c for n, c in enumerate(rig.cameras)]
    return replace(rig, cameras=tuple(cameras))
