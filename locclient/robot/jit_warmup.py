"""Compilation of the kernels before the first frame: a throwaway localizer drives past a painted wall and is localized in its map."""

import ctypes
import gc
import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.features import orb
from fleetmap.features.extraction import extract
from fleetmap.geometry import Array, se3
from fleetmap.mapformat import Tile
from fleetmap.odometry.init.static_initialization import is_steady
from fleetmap.odometry.settings import StartSettings
from fleetmap.relocalization.map_view import CovisibleLandmarks
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample
from locclient.localization.alias_disambiguation import ObservationHistory, log_odds, mark_shared
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings

_FRAMES, _STATIONARY = 40, 20
_FRAME_NS, _IMU_NS = 50_000_000, 5_000_000
_DISPARITY_PX, _STEP_PX = 12, 3
_WORDS = 10
_COMPILER = "libllvmlite"
_MAPPING = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) r-xp .*/(\S+)$")
_CHANGED = re.compile(r"^(?:Private_Dirty|Shared_Dirty|Anonymous): +[1-9]", re.MULTILINE)
_MAP_FROM_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([1.0, 1.0, 1.0]))


def warm_up_kernels(calibration: RigCalibration, rectifier: Rectifier, settings: LocalizerSettings) -> int:
    """Runs everything that a frame may need; returns for how many of its frames there was a fix."""
    camera = rectifier.camera
    localizer = Localizer(calibration, camera, rectifier.body_from_cam, rectifier.imu_minus_cam_s, settings)
    wall = _wall(camera)
    first = _view(wall, camera, 0)
    localizer.handle_version(1, [_tile_of(first.left, camera, settings)], _vocabulary(), camera.focal_px)
    own = calibration.cameras[0]
    blank = np.zeros((own.height_px, own.width_px), np.uint8)
    depth = np.ones(blank.shape, np.float32) if len(calibration.cameras) == 1 else None
    rectifier.rectify(CameraFrame(0, blank, None if depth is not None else blank.copy(), depth))
    upwards = rectifier.body_from_cam[:3, :3] @ np.array([0.0, -9.81, 0.0])
    glide_mps = calibration.base_from_body[:3, :3] @ rectifier.body_from_cam[:3, :3] @ _glide_mps(camera)
    found = 0
    for number in range(_FRAMES):
        stamps_ns = np.arange(number * _FRAME_NS, (number + 1) * _FRAME_NS, _IMU_NS, dtype=np.int64)
        if calibration.imu is not None:
            gyro_radps, accel_mps2 = np.zeros((len(stamps_ns), 3)), np.tile(upwards, (len(stamps_ns), 1))
            localizer.handle_imu(ImuSamples(stamps_ns, gyro_radps, accel_mps2))
        # Near the frame, or the filter would leave it out.
        driven_mps = glide_mps if number >= _STATIONARY else np.zeros(3)
        localizer.handle_wheel([WheelSample(int(stamps_ns[-1]), driven_mps, 0.0, 0.1, 0.1)])
        frame = _view(wall, camera, number)
        found += localizer.handle_stereo(frame).fix is not None
    _disambiguate()
    _rest()
    return found


@contextmanager
def gc_frozen() -> Iterator[None]:
    """Exempts present objects from garbage collection while it lasts: libraries hold some hundred thousand that are never dropped,
    and now and then a frame would have to wait until all of them were traversed."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def drop_compiler_code(smaps: Path = Path("/proc/self/smaps")) -> int:
    """Takes the compiler's code out of this process's memory once all kernels are loaded; returns the bytes of its mappings.

    It is read from its file again where a kernel is compiled later, so that nothing but that moment's time is lost. Pages that
    differ from the file stay: only mappings without one are dropped. 0 where the system tells of no mappings.
    """
    try:
        text = smaps.read_text()
    except OSError:
        return 0
    madvise, dropped = ctypes.CDLL(None).madvise, 0
    for entry in re.split(r"\n(?=[0-9a-f]+-[0-9a-f]+ )", text):
        head, _, figures = entry.partition("\n")
        mapping = _MAPPING.match(head)
        if mapping is None or not mapping[3].startswith(_COMPILER) or _CHANGED.search(figures):
            continue
        begin, end = int(mapping[1], 16), int(mapping[2], 16)
        if madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), mmap.MADV_DONTNEED) == 0:
            dropped += end - begin
    return dropped


def _disambiguate() -> None:
    """Runs what only competing hypotheses need."""
    one, other = ObservationHistory(), ObservationHistory()
    ids, descriptors = np.zeros(1, np.uint32), np.zeros((1, 32), np.uint8)
    observed = CovisibleLandmarks(ids, np.zeros((1, 3)), descriptors, np.ones(1, bool))
    for history in (one, other):
        history.add(np.eye(4), observed)
    shared = np.zeros(1, bool)
    mark_shared(one, other, shared, shared.copy())
    log_odds(one, other, shared, shared)


def _rest() -> None:
    """Runs what only a robot needs that has stood for a while."""
    stamps_ns = np.arange(0, _FRAME_NS, _IMU_NS, dtype=np.int64)
    is_steady(ImuSamples(stamps_ns, np.zeros((len(stamps_ns), 3)), np.ones((len(stamps_ns), 3))), StartSettings())


def _wall(camera: StereoCamera) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    shape = (camera.height_px, camera.width_px + _FRAMES * _STEP_PX + _DISPARITY_PX)
    layers = (cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma) for sigma in (1.5, 4.0, 12.0))
    grey = 128 + sum((25 * layer / layer.std() for layer in layers), np.zeros(shape))
    return np.asarray(np.clip(grey, 0, 255), np.uint8)


def _view(wall: NDArray[np.uint8], camera: StereoCamera, number: int) -> RectifiedFrame:
    """A frame that stands in front of the wall and then glides along it."""
    left = max(0, number - _STATIONARY) * _STEP_PX
    right = left + _DISPARITY_PX
    seen, beside = (np.ascontiguousarray(wall[:, begin : begin + camera.width_px]) for begin in (left, right))
    return RectifiedFrame((number + 1) * _FRAME_NS, seen, beside, None)


def _glide_mps(camera: StereoCamera) -> Array:
    """(3,) velocity of the camera of `_view` in its own axes."""
    depth_m = float(camera.point_from_pixel(np.zeros((1, 2)), np.array([float(_DISPARITY_PX)]))[0, 2])
    return np.array([_STEP_PX * depth_m / camera.focal_px / (_FRAME_NS * 1e-9), 0.0, 0.0])


def _tile_of(left: NDArray[np.uint8], camera: StereoCamera, settings: LocalizerSettings) -> Tile:
    """A map of the features of one picture."""
    features = extract(left, settings.orb)
    count = len(features)
    points_cam = camera.point_from_pixel(features.pixels, np.full(count, float(_DISPARITY_PX)))
    towards = -points_cam @ _MAP_FROM_CAM[:3, :3].T
    distance_m = np.linalg.norm(towards, axis=1)
    ids = np.arange(count, dtype=np.uint32)
    return Tile(
        tile_x=0,
        tile_y=0,
        size_m=16.0,
        landmark_ids=ids,
        points_map=points_cam @ _MAP_FROM_CAM[:3, :3].T + _MAP_FROM_CAM[:3, 3],
        descriptors=features.descriptors,
        view_directions_map=(towards / distance_m[:, None]).astype(np.float32),
        view_half_angle_rad=np.full(count, 0.5, np.float32),
        max_distance_m=(distance_m * orb.SCALE_FACTOR ** features.octaves.astype(float)).astype(np.float32),
        sigma_m=np.full(count, 0.01, np.float32),
        place_ids=np.zeros(1, np.uint32),
        map_from_cam=_MAP_FROM_CAM[None],
        place_landmark_ids=(ids,),
    )


def _vocabulary() -> Vocabulary:
    """A few random words."""
    rng = np.random.default_rng(0)
    centres = rng.integers(0, 2**63, (1 + _WORDS, 4), dtype=np.uint64)
    first_child, child_count = np.zeros(1 + _WORDS, np.int32), np.zeros(1 + _WORDS, np.int32)
    first_child[0], child_count[0] = 1, _WORDS
    return Vocabulary(centres, first_child, child_count, np.ones(_WORDS, np.float32))
