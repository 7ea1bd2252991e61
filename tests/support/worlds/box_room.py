"""Rides through a textured box of a room: pairs, IMU and truth that agree; nothing here uses the code under test.

A ride is a function from seconds to map_from_body; it stands still before 0 and after its end.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, so3_exp, so3_log
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from mapserver.survey.keyframes.keyframes import make_keyframe
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Keyframe
from support.recordings.recording_samples import (
    BASELINE_M,
    BODY_FROM_CAM0,
    FOCAL,
    HEIGHT,
    START_NS,
    WIDTH,
    Sample,
    calibration,
)
from support.worlds.painted_walls import pixel_rays, reach, view

ROOM_M = np.array([[-4.0, -3.0, -1.5], [4.0, 3.0, 1.5]])
GRAVITY_MPS2 = 9.81
TEXEL_M, TEXELS = 0.01, 800
_WALL = 3  # the face at y = 3
RAYS = pixel_rays(WIDTH, HEIGHT, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
Ride = Callable[[float], Array]


def out_and_back(
    duration_s: float,
    *,
    reach_m: float = 2.4,
    start_m: tuple[float, float, float] = (-1.2, 0.6, 0.0),
    yaw_rad: float = np.pi / 2,
) -> Ride:
    """Along x and back to the start while looking at the wall at y = 3 (yaw pi/2), swaying a little about all axes."""

    def map_from_body(t_s: float) -> Array:
        share = min(max(t_s / duration_s, 0.0), 1.0)
        phase = 2 * np.pi * share**3 * (10 - 15 * share + 6 * share**2)  # no jerk at either end
        moved = np.array([reach_m * (1 - np.cos(phase)) / 2, 0.15 * np.sin(phase), 0.1 * np.sin(2 * phase)])
        sway = np.array([0.06 * np.sin(2 * phase), 0.05 * np.sin(phase), yaw_rad + 0.25 * np.sin(phase)])
        return se3(so3_exp(np.array([0, 0, sway[2]])) @ so3_exp(np.array([sway[0], sway[1], 0])), moved + start_m)

    return map_from_body


def ride_sample(ride: Ride, frames: int, frame_s: float, *, seed: int = 0, begin_s: float = 0.0) -> Sample:
    """Recording of the rig of recording_samples from `begin_s` on: pairs, and an IMU at 200 Hz from 1 s before."""
    shift = se3(np.eye(3), np.array([BASELINE_M, 0, 0]))
    times = begin_s + frame_s * np.arange(frames)
    stamps = START_NS + np.rint(times * 1e9).astype(np.int64)
    truth = [ride(float(t)) for t in times]
    left = [_render(map_from_body @ BODY_FROM_CAM0) for map_from_body in truth]
    right = [_render(map_from_body @ BODY_FROM_CAM0 @ shift) for map_from_body in truth]
    imu_times = np.arange(times[0] - 1.0, times[-1] + 0.1, 0.005)
    rng = np.random.default_rng(seed)
    gyro, _, accel = (np.array(values) for values in zip(*(motion(ride, float(t)) for t in imu_times), strict=True))
    gyro += rng.normal([0.003, -0.002, 0.001], 2e-3, gyro.shape)
    accel += rng.normal([0.02, -0.01, 0.03], 2e-2, accel.shape)
    imu_stamps = START_NS + np.rint(imu_times * 1e9).astype(np.int64)
    return Sample(stamps, left, right, imu_stamps, gyro, accel, truth)


@lru_cache(maxsize=1)
def there_and_back() -> Sample:
    """Six seconds along the wall and back, by 61 frames."""
    return ride_sample(out_and_back(6.0), 61, 0.1)


def motion(ride: Ride, t_s: float, h_s: float = 1e-3) -> tuple[Array, Array, Array]:
    """Angular rate, velocity and specific force in body axes, by central differences."""
    before, now, after = ride(t_s - h_s), ride(t_s), ride(t_s + h_s)
    axes, rate = now[:3, :3].T, so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h_s)
    velocity = (after[:3, 3] - before[:3, 3]) / (2 * h_s)
    acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h_s**2
    return rate, axes @ velocity, axes @ (acceleration + np.array([0, 0, GRAVITY_MPS2]))


def _render(map_from_cam: Array) -> NDArray[np.uint8]:
    """One grey image."""
    return view(map_from_cam, RAYS, ROOM_M, _textures(), ROOM_M[0], TEXEL_M, cv2.BORDER_REFLECT)


@lru_cache(maxsize=1)
def _textures() -> NDArray[np.uint8]:
    """800 x 800 texels for each face, one under another."""
    return np.concatenate([_texture(face) for face in range(6)])


def _texture(face: int) -> NDArray[np.uint8]:
    """Soft noise under hard-edged patches, different on each face."""
    rng = np.random.default_rng(100 + face)
    noise = sum(
        (cv2.resize(rng.random((n, n)), (800, 800), interpolation=cv2.INTER_CUBIC) for n in (10, 40, 110)),
        np.zeros((800, 800)),
    )
    canvas = 60 + 40 * noise
    for _ in range(500):
        x, y, w, h = (int(v) for v in (*rng.integers(0, 800, 2), *rng.integers(6, 45, 2)))
        canvas[y : y + h, x : x + w] = rng.uniform(20, 235)
    return np.asarray(np.clip(cv2.GaussianBlur(canvas, (0, 0), 1.2), 0, 255), np.uint8)


@contextmanager
def poster(seed: int, corners_m: Array, shift_m: float = 0.0) -> Iterator[None]:
    """Another picture on part of the wall at y = 3 for as long as this lasts, shifted sideways in its frame as on a screen.

    corners_m: x and z of the lower left and the upper right one.
    """
    texture = _textures()[_WALL * TEXELS : (_WALL + 1) * TEXELS]
    before = texture.copy()
    (left, low), (right, high) = np.rint((corners_m - ROOM_M[0, [0, 2]]) / TEXEL_M).astype(int)
    rng = np.random.default_rng(seed)
    patch = np.full((high - low, right - left), 120.0)
    for _ in range(patch.size * 120 // (160 * 140)):
        at, (w, h) = rng.integers(0, np.array(patch.shape[::-1]) - 10), rng.integers(6, 30, 2)
        patch[at[1] : at[1] + h, at[0] : at[0] + w] = rng.uniform(20, 235)
    shifted = np.roll(cv2.GaussianBlur(patch, (0, 0), 1.2), round(shift_m / TEXEL_M), axis=1)
    texture[low:high, left:right] = shifted
    try:
        yield
    finally:
        texture[:] = before


def points_seen(map_from_cam: Array, pixels: Array) -> Array:
    """(N, 3) where the room's surface is hit by the rays of pixels (N, 2)."""
    rays_cam = np.column_stack([(pixels - [WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5]) / FOCAL, np.ones(len(pixels))])
    rays = rays_cam @ map_from_cam[:3, :3].T
    origin = map_from_cam[:3, 3]
    return origin + rays * reach(rays, origin, ROOM_M).min(axis=1)[:, None]


def depth_of(map_from_cam: Array) -> NDArray[np.float32]:
    """(H, W) metres along the camera's axis."""
    return reach(RAYS @ map_from_cam[:3, :3].T, map_from_cam[:3, 3], ROOM_M).min(axis=2).astype(np.float32)


def stereo_pair(map_from_body: Array, stamp_ns: int) -> CameraFrame:
    """Images of the rig from one place."""
    map_from_cam = map_from_body @ BODY_FROM_CAM0
    shift = se3(np.eye(3), np.array([BASELINE_M, 0, 0]))
    return CameraFrame(stamp_ns, _render(map_from_cam), _render(map_from_cam @ shift))


def rendered_keyframes(places: Array, settings: SurveySettings, period_ns: int = 1) -> tuple[list[Keyframe], Rectifier]:
    """Keyframes of bodies in the room at places (K, 4, 4), and the rig that sees them."""
    rectifier = Rectifier(calibration())
    frames = [rectifier.rectify(stereo_pair(there, k * period_ns)) for k, there in enumerate(places)]
    return [make_keyframe(frame, k, rectifier.camera, settings) for k, frame in enumerate(frames)], rectifier
