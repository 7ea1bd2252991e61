"""Check whether the images of a moving rig fit the lens of its calibration, or another lens far better.

Points are tracked from a frame to a later one. With the right lens one rigid motion explains them; a wrong lens bends the
scene. An error of the focal length alone stretches it, which shows in turns, but hardly in straight drives.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Mask, midpoints, se3_inverse
from fleetmap.sensors.calibration import CameraCalibration, Polygon, RigCalibration, hidden_pixels
from fleetmap.sensors.cameras import LENSES
from fleetmap.sensors.samples import CameraFrame, Image, Stamps

_CORNERS, _LEAST_POINTS, _LEAST_ALL, _LEAST_MOTION_PX = 300, 20, 150, 1.0
_MOST_ERROR_PX = 3.0  # errors are clipped to this: wrongly tracked or moving points
_NEAR_M, _FAR_M = 0.2, 60.0
_GOOD_PX2, FITS_PX2 = 0.25, 2.0  # mean squared errors: of a perfect fit; of an acceptable fit
DOUBTFUL_RATIO = 1.7  # of squared errors: with a right calibration other lenses reach 1.5, on straight drives
_PAIRS, _APART_S, _TOO_FAR_S = 8, 0.2, 0.6
_MORE_OFTEN = 0.75  # of the pairs of frames
Points = NDArray[np.float32]
_FACTORS = (0.5, 0.6, 0.7, 0.77, 0.85, 1.18, 1.3, 1.43, 1.67, 2.0)


@dataclass(frozen=True, slots=True)
class FollowedPoints:
    """Points (N, 2) in pixels as recorded: in a left image, in the right one (or their depth_m (N,)), and in a later left image."""

    left: Array
    right: Array | None
    depth_m: Array | None
    later: Array


@dataclass(frozen=True, slots=True)
class LensFit:
    """Residuals of a lens: mean squared errors in px^2, each at most 9. other: description of the lens with best_px2."""

    given_px2: float
    best_px2: float
    other: str

    @property
    def ratio(self) -> float:
        """Ratio of the residuals of the given lens and the best one; 1 if none is better."""
        return self.given_px2 / max(self.best_px2, 1e-9)

    @property
    def is_doubtful(self) -> bool:
        """True if another lens fits clearly better."""
        return self.ratio > DOUBTFUL_RATIO

    def words(self, camera: CameraCalibration) -> str:
        """A sentence on the camera's lens, with advice if another one fits better."""
        given = f"{camera.model}, fx {camera.intrinsics_px[0]:.1f} px at {camera.width_px}x{camera.height_px}"
        if not self.is_doubtful:
            return f"the images fit the given lens ({given}; {np.sqrt(self.given_px2):.2f} px), no other one clearly better"
        return (
            f"the images fit {self.other} (error {np.sqrt(self.best_px2):.2f} px) better than the given lens ({given}; "
            f"{np.sqrt(self.given_px2):.2f} px); pass this camera's calibration with --calibration FILE, or calibrate it again"
        )


def lens_of_frames(rig: RigCalibration, stamps_ns: Stamps, read: Callable[[int], CameraFrame | None]) -> LensFit | None:
    """As `fit_lens`, on at most eight pairs of frames, 0.2 s apart. read: a frame as recorded, None for a damaged one."""
    pairs = []
    for index in np.unique(np.linspace(0, max(len(stamps_ns) - 2, 0), _PAIRS).astype(int)):
        later = int(np.searchsorted(stamps_ns, stamps_ns[index] + int(_APART_S * 1e9)))
        if later >= len(stamps_ns) or stamps_ns[later] - stamps_ns[index] > _TOO_FAR_S * 1e9:
            continue
        before, after = read(int(index)), read(later)
        points = None if before is None or after is None else follow_points(before, after, rig.cameras[0].mask)
        if points is not None:
            pairs.append(points)
    return fit_lens(rig, pairs)


def follow_points(frame: CameraFrame, later: CameraFrame, mask: tuple[Polygon, ...] = ()) -> FollowedPoints | None:
    """Track corners of the left image, outside its mask, to the later one and, for a pair, to the right one; None if there are too few."""
    seen = (~hidden_pixels(mask, frame.left.shape[::-1])).astype(np.uint8)
    best = cv2.goodFeaturesToTrack(frame.left, _CORNERS, 0.01, 10, mask=seen)
    if best is None or (frame.right is None and frame.depth_m is None):
        return None
    corners = np.asarray(best, np.float32)
    found, is_good = _followed(frame.left, later.left, corners)
    left, right, depth_m = corners.reshape(-1, 2), None, None
    if frame.right is not None:
        right, is_seen = _followed(frame.left, frame.right, corners)
        is_good &= is_seen
    elif frame.depth_m is not None:
        columns, rows = left.round().astype(int).T
        depth_m = frame.depth_m[rows, columns].astype(np.float64)
        is_good &= np.nan_to_num(depth_m) > 0
    if is_good.sum() < _LEAST_POINTS:
        return None
    right, depth_m = (None if values is None else values[is_good] for values in (right, depth_m))
    return FollowedPoints(left[is_good].astype(np.float64), right, depth_m, found[is_good])


def fit_lens(rig: RigCalibration, pairs: Sequence[FollowedPoints]) -> LensFit | None:
    """Compare the given lens with others (focal lengths, models, resolutions); None without enough motion."""
    if sum(len(points.left) for points in pairs) < _LEAST_ALL:
        return None
    motions_px = np.concatenate([np.linalg.norm(points.later - points.left, axis=1) for points in pairs])
    if np.median(motions_px) < _LEAST_MOTION_PX:
        return None
    given = np.array([_error_px2(rig, points) for points in pairs])
    best, words = given, ""
    if given.mean() > _GOOD_PX2:
        for lens, other in _other_lenses(rig):
            errors = _smaller_errors_px2(other, pairs, given)
            if errors is not None and errors.mean() < best.mean():
                best, words = errors, lens
    if best.mean() > FITS_PX2:
        best, words = given, ""
    return LensFit(float(given.mean()), float(best.mean()), words)


def _followed(image: Image, other: Image, corners: Points) -> tuple[Array, Mask]:
    """Pixels (N, 2) in the other image, and a mask of those that pass the backward check."""

    def follow(first: Image, second: Image, points: Points) -> tuple[Points, Mask]:
        guess = np.empty(0, np.float32)
        found, status, _ = cv2.calcOpticalFlowPyrLK(first, second, points, guess, winSize=(15, 15), maxLevel=4)
        return np.asarray(found, np.float32), np.asarray(status.ravel() == 1)

    found, is_there = follow(image, other, corners)
    again, is_back = follow(other, image, found)
    returned = np.linalg.norm((again - corners).reshape(-1, 2), axis=1) < 0.5
    return found.reshape(-1, 2).astype(np.float64), is_there & is_back & returned


def _other_lenses(rig: RigCalibration) -> Iterator[tuple[str, RigCalibration]]:
    first = rig.cameras[0]
    for factor in _FACTORS:
        focal_px = first.intrinsics_px[0]
        words = f"a focal length of {factor * focal_px:.0f} px, {factor:g} times the {focal_px:.0f} px given"
        yield words, _scaled(rig, np.array([factor, factor, 1.0, 1.0]))
    for factor, size in ((2.0, "half"), (0.5, "twice")):
        other = _scaled(rig, np.full(4, factor))
        words = f"this camera matrix times {factor:g}: it is of images of {size} the size"
        if all((c.intrinsics_px[2:] < [c.width_px, c.height_px]).all() for c in other.cameras[:2]):
            yield words, other
    zeros = np.zeros(4)
    if first.model == "radial-tangential":
        yield "an equidistant (fisheye) lens", _with_lens(rig, "equidistant", None)
    elif first.model not in LENSES:
        yield "a plumb_bob (radtan) lens", _with_lens(rig, "radial-tangential", None)
    yield "an equidistant lens without coefficients", _with_lens(rig, "equidistant", zeros)
    yield "a lens without distortion", _with_lens(rig, "radial-tangential", zeros)


def _scaled(rig: RigCalibration, factors: Array) -> RigCalibration:
    cameras = tuple(replace(camera, intrinsics_px=camera.intrinsics_px * factors) for camera in rig.cameras)
    return replace(rig, cameras=cameras)


def _with_lens(rig: RigCalibration, model: str, distortion: Array | None) -> RigCalibration:
    """distortion: None to keep the rig's coefficients under the other name."""
    cameras = []
    for camera in rig.cameras:
        own = np.zeros(4)
        own[: min(4, len(camera.distortion))] = camera.distortion[:4]
        intrinsics_px = np.concatenate([camera.focal_px, camera.intrinsics_px[2:]])
        given = own if distortion is None else distortion
        cameras.append(replace(camera, model=model, intrinsics_px=intrinsics_px, distortion=given))
    return replace(rig, cameras=tuple(cameras))


def _smaller_errors_px2(rig: RigCalibration, pairs: Sequence[FollowedPoints], given: Array) -> Array | None:
    """(K,) errors of all pairs; None as soon as too few of them can be smaller than `given`."""
    errors = np.zeros(len(pairs))
    for number, points in enumerate(pairs, 1):
        errors[number - 1] = _error_px2(rig, points)
        worse = np.count_nonzero(errors[:number] >= given[:number])
        if (len(pairs) - worse) / len(pairs) < _MORE_OFTEN:
            return None
    return errors


def _error_px2(rig: RigCalibration, points: FollowedPoints) -> float:
    """Mean squared error of a pair of frames: pixels of the first frame's points in the later one, and in their own."""
    camera = rig.cameras[0]
    rays, later = camera.ray_from_pixel(points.left), camera.ray_from_pixel(points.later)
    with np.errstate(divide="ignore", invalid="ignore"):
        if points.right is not None:
            cam0_from_cam1 = se3_inverse(rig.cameras[0].body_from_cam) @ rig.cameras[1].body_from_cam
            right = rig.cameras[1].ray_from_pixel(points.right) @ cam0_from_cam1[:3, :3].T
            scene, _ = midpoints(rays, right, cam0_from_cam1[:3, 3])
        else:
            assert points.depth_m is not None
            scene = rays / rays[:, 2:] * points.depth_m[:, None]
        seen = later[:, :2] / later[:, 2:]
    known = np.isfinite(scene).all(axis=1) & np.isfinite(seen).all(axis=1) & (later[:, 2] > 0.1)
    known &= (scene[:, 2] > _NEAR_M) & (scene[:, 2] < _FAR_M)
    errors = np.full(len(scene), _MOST_ERROR_PX)
    if known.sum() >= _LEAST_POINTS:
        moved = _moved(scene[known], seen[known], _MOST_ERROR_PX / camera.focal_px[0])
        if moved is not None:
            there = camera.pixel_from_ray(moved) - points.later[known]
            here = camera.pixel_from_ray(scene[known]) - points.left[known]
            found = np.sqrt((there**2).sum(axis=1) + 2.0 * (here**2).sum(axis=1))
            errors[known] = np.minimum(np.nan_to_num(found, nan=_MOST_ERROR_PX), _MOST_ERROR_PX)
    return float((errors**2).mean())


def _moved(scene: Array, seen: Array, within: float) -> Array | None:
    """(N, 3) the scene in the later camera's axes; seen: (N, 2) on the plane z = 1. None if no motion explains it."""
    lens = np.eye(3)
    found, rotvec, shift, inliers = cv2.solvePnPRansac(
        scene, np.ascontiguousarray(seen), lens, None, iterationsCount=100, reprojectionError=0.7 * within
    )
    if not found or inliers is None or len(inliers) < _LEAST_POINTS:
        return None
    kept = inliers.ravel()
    rotvec, shift = cv2.solvePnPRefineLM(scene[kept], seen[kept], lens, np.zeros(0), rotvec, shift)
    return np.asarray(scene @ cv2.Rodrigues(rotvec)[0].T + np.asarray(shift).ravel())
