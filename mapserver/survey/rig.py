"""The rig of a survey: its cameras, with one pinhole and, after conversion of their disparities, one baseline. Pure."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

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
    camera = rectifier.camera
    if camera.baseline_m <= 0:
        camera = replace(camera, baseline_m=RGBD_BASELINE_M)
    return Rig(camera, np.array([each.body_from_cam for each in cameras]), tuple(kinds))


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


@dataclass(frozen=True, slots=True)
class Looks:
    """M observations of points by known cameras: map_from_cam (M, 4, 4), landmark (M,), pixels (M, 3), sigmas_px (M, 2)."""

    camera: StereoCamera
    map_from_cam: Array
    landmark: NDArray[np.int32]
    pixels: Array
    sigmas_px: Array

    def seen(self, points_map: Array) -> Array:
        """Return the points (M, 3) in the cameras, of points (N, 3), each at least 5 cm before its camera."""
        cam_from_map = se3_inverse(self.map_from_cam)
        seen = np.einsum("mij,mj->mi", cam_from_map[:, :3, :3], points_map[self.landmark]) + cam_from_map[:, :3, 3]
        seen[:, 2] = np.maximum(seen[:, 2], 0.05)
        return np.asarray(seen)

    def information(self, points_map: Array) -> Array:
        """Return (N, 3, 3) of points (N, 3), in map axes: sum of J^T J."""
        rows = projection_by_point(self.camera, self.seen(points_map))
        rows[~np.isfinite(self.pixels[:, 2]), 2, 2] = 0.0
        jacobian = (rows / self.sigmas_px[:, [0, 0, 1], None]) @ se3_inverse(self.map_from_cam)[:, :3, :3]
        information = np.zeros((len(points_map), 3, 3))
        np.add.at(information, self.landmark, jacobian.transpose(0, 2, 1) @ jacobian)
        return information

    def residuals(self, points_map: Array) -> tuple[Array, Array]:
        """Return (M, 3) of u, v and disparity, NaN without a right match, and the points `seen` (M, 3)."""
        seen = self.seen(points_map)
        predicted, pixels = self.camera.pixel_from_point(seen), self.pixels
        disparity = pixels[:, 0] - pixels[:, 2] - predicted[:, 0] + predicted[:, 2]
        return np.column_stack([pixels[:, :2] - predicted[:, :2], disparity]), seen

    def squared(self, points_map: Array) -> Array:
        """Return (M,) squared residuals in sigmas."""
        residual, _ = self.residuals(points_map)
        return np.asarray(np.square(np.nan_to_num(residual / self.sigmas_px[:, [0, 0, 1]])).sum(axis=1))

    def triangulated(self, points_map: Array) -> Array:
        """Return points (N, 3) with the best fit to their observations: some steps of Gauss-Newton from points_map (N, 3)."""
        points, cam_from_map = points_map.copy(), se3_inverse(self.map_from_cam)
        for _ in range(4):
            residual, seen = self.residuals(points)
            weight = np.where(np.isfinite(residual), 1.0 / self.sigmas_px[:, [0, 0, 1]], 0.0)
            jacobian = (projection_by_point(self.camera, seen) * weight[:, :, None]) @ cam_from_map[:, :3, :3]
            hessian, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
            np.add.at(hessian, self.landmark, jacobian.transpose(0, 2, 1) @ jacobian)
            np.add.at(pull, self.landmark, np.einsum("mij,mi->mj", jacobian, np.nan_to_num(residual) * weight))
            step = np.linalg.solve(hessian + 1e-6 * np.eye(3), pull[:, :, None])[:, :, 0]
            points += np.clip(step, -0.5, 0.5)
        return points


def frame_of_camera(frame: RectifiedFrame, number: int) -> RectifiedFrame | None:
    """Return the frame of a camera; None if it has no images at this moment."""
    seen = frame.view(number)
    if seen is None or abs(seen.stamp_ns - frame.stamp_ns) > _SAME_MOMENT_NS:
        return None
    return replace(seen, stamp_ns=frame.stamp_ns)
