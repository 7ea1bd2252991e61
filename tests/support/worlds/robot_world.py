"""A robot that drives to and fro in a painted room for as long as wanted, and maps of that room in its truth. Made once."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleetmap.bow.vocabulary import decode_vocabulary
from fleetmap.features import orb
from fleetmap.features.extraction import extract
from fleetmap.geometry import Array, se3, se3_inverse, se3_log
from fleetmap.mapformat.manifest import CameraEntry
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import WantedVersion
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, Image, ImuSamples, WheelSample
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetmap.version_grid import TILE_CELLS, encode_grid, grid_report
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings
from mapserver import releases
from mapserver.store import DraftContent, MapStore
from support.recordings.recording_samples import FOCAL, HEIGHT, WIDTH, Sample, calibration, write_mcap
from support.storage.map_samples import draft_details
from support.worlds.box_room import out_and_back, points_seen, ride_sample
from support.worlds.vocabulary_training import encode_vocabulary, train_vocabulary

RIDE_S, STAND_S, FRAME_S = 6.0, 1.0, 0.1
CYCLE_NS = round((STAND_S + RIDE_S) * 1e9)
TILE_M = 16.0
SITE = "room"
SETTINGS = LocalizerSettings()
TRIAL = TrialSettings(confirming_fixes=3, patience_s=2.0)


@lru_cache(maxsize=1)
def cycle() -> Sample:
    """Standing for a second, then out and back; the next cycle begins where this one ends."""
    return ride_sample(out_and_back(RIDE_S), round((STAND_S + RIDE_S) / FRAME_S), FRAME_S, begin_s=-STAND_S)


@lru_cache(maxsize=1)
def rectifier() -> Rectifier:
    return Rectifier(calibration())


def bundles(frames: int, *, dark: range = range(0)) -> Iterator[SensorBundle]:
    """Frames with the IMU before each; those in `dark` are black."""
    sample, first_ns = cycle(), int(cycle().stamps_ns[0])
    once = ImuSamples(sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    for number in range(frames):
        turn, index = divmod(number, len(sample.stamps_ns))
        stamp_ns, shift_ns = int(sample.stamps_ns[index]), turn * CYCLE_NS
        imu = once.between(max(first_ns, stamp_ns - 90_000_000), stamp_ns + 10_000_000)
        imu = replace(imu, stamps_ns=imu.stamps_ns + shift_ns)
        rng = np.random.default_rng(number)  # a sensor's noise: a camera that repeats itself to the bit counts as stuck
        left, right = (_noisy(picture, rng) for picture in (sample.left[index], sample.right[index]))
        if number in dark:
            left, right = np.zeros_like(left), np.zeros_like(right)
        yield SensorBundle(CameraFrame(stamp_ns + shift_ns, left, right), imu)


def carried(frames: int, at: int) -> Iterator[SensorBundle]:
    """The ride until frame `at`, in the pause at the end of a cycle; then the robot stands where frame 40 was taken, as its IMU says."""
    sample, rng = cycle(), np.random.default_rng(at)
    for number, bundle in enumerate(bundles(frames)):
        if number < at:
            yield bundle
            continue
        gyro, accel = (rng.normal(0.0, sigma, bundle.imu.gyro_radps.shape) for sigma in (0.003, 0.02))
        still = ImuSamples(bundle.imu.stamps_ns, gyro, accel + np.array([0.0, 0.0, 9.81]))
        left, right = _noisy(sample.left[40], rng), _noisy(sample.right[40], rng)
        yield SensorBundle(CameraFrame(bundle.frame.stamp_ns, left, right), still)


def write(folder: Path, ride: Iterable[SensorBundle]) -> Path:
    """A ride as a recording."""
    bundles = list(ride)
    imu = [bundle.imu for bundle in bundles]
    sample = Sample(
        np.array([bundle.frame.stamp_ns for bundle in bundles]), [bundle.frame.left for bundle in bundles],
        [bundle.frame.right for bundle in bundles], np.concatenate([part.stamps_ns for part in imu]),
        np.concatenate([part.gyro_radps for part in imu]), np.concatenate([part.accel_mps2 for part in imu]),
        [truth(number) for number in range(len(bundles))],
    )  # fmt: skip
    return write_mcap(folder, sample)


def _noisy(picture: Image, rng: np.random.Generator) -> Image:
    """With a grey value more or less in every other pixel."""
    noise = rng.integers(-1, 2, picture.shape, dtype=np.int16)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def truth(number: int) -> Array:
    """map_from_body at frame `number`."""
    return cycle().world_from_body[number % len(cycle().world_from_body)]


def rolled(number: int, stamp_ns: int, factor: float = 1.0) -> list[WheelSample]:
    """The wheels on the way to a frame, fifty times a second; factor: on their speed."""
    moved = factor / FRAME_S * se3_log(se3_inverse(truth(number - 1)) @ truth(number))
    stamps_ns = range(stamp_ns - 80_000_000, stamp_ns + 1, 20_000_000)
    return [WheelSample(each_ns, moved[3:], float(moved[2]), 0.02, 0.02) for each_ns in stamps_ns]


@lru_cache(maxsize=1)
def tiles() -> tuple[Tile, ...]:
    """The room's map: features of some frames, where their rays meet the walls."""
    camera, sample = rectifier().camera, cycle()
    parts = []
    for index in range(0, len(sample.stamps_ns), 6):
        frame = rectifier().rectify(CameraFrame(int(sample.stamps_ns[index]), sample.left[index], sample.right[index]))
        features = extract(frame.left, SETTINGS.orb)
        map_from_cam = sample.world_from_body[index] @ rectifier().body_from_cam
        rays = (features.pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px
        points = points_seen(map_from_cam, rays * FOCAL + [WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])
        parts.append((map_from_cam, features, points))
    return tuple(_tile(cell, parts) for cell in ((-1, -1), (-1, 0), (0, -1), (0, 0)))


def _tile(cell: tuple[int, int], parts: list[tuple[Array, orb.Features, Array]]) -> Tile:
    rows, places, seen_at, begin = [], [], [], 0
    for number, (map_from_cam, features, points) in enumerate(parts):
        ids = np.arange(begin, begin + len(points), dtype=np.uint32)
        begin += len(points)
        inside = (np.floor(points[:, :2] / TILE_M) == cell).all(axis=1)
        towards = map_from_cam[:3, 3] - points
        distance = np.linalg.norm(towards, axis=1)
        reach = distance * orb.SCALE_FACTOR ** features.octaves.astype(float)
        columns = ids, points, features.descriptors, towards / distance[:, None], reach
        rows.append([values[inside] for values in columns])
        if (np.floor(map_from_cam[:2, 3] / TILE_M) == cell).all():
            places.append((number, map_from_cam))
            seen_at.append(ids)
    ids, points, descriptors, towards, reach = (np.concatenate(values) for values in zip(*rows, strict=True))
    return Tile(
        tile_x=cell[0], tile_y=cell[1], size_m=TILE_M, landmark_ids=ids, points_map=points,
        descriptors=descriptors, view_directions_map=towards.astype(np.float32),
        view_half_angle_rad=np.full(len(ids), 0.3, np.float32), max_distance_m=reach.astype(np.float32),
        sigma_m=np.full(len(ids), 0.01, np.float32), place_ids=np.array([n for n, _ in places], np.uint32),
        map_from_cam=np.array([m for _, m in places]).reshape(-1, 4, 4), place_landmark_ids=tuple(seen_at),
    )  # fmt: skip


@lru_cache(maxsize=1)
def vocabulary() -> bytes:
    descriptors = np.concatenate([tile.descriptors for tile in tiles()])
    return encode_vocabulary(train_vocabulary(descriptors, 8, 3, np.random.default_rng(0)))


def save(store: MapStore, *, site: str = SITE, of: tuple[Tile, ...] | None = None, has_grid: bool = False) -> int:
    """A version of the room, made current; has_grid: with three square metres for planners, one of them occupied."""
    camera = rectifier().camera
    entry = CameraEntry(
        focal_px=camera.focal_px, width_px=camera.width_px, height_px=camera.height_px, baseline_m=camera.baseline_m
    )
    grid: list[bytes] = []
    if has_grid:
        cells = np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
        cells[:20, :60, 1], cells[:20, :20, 0] = 0xFF, 1
        grid = encode_grid({(0, 0): cells})
    report = {"grid": msgspec.to_builtins(grid_report(grid, {}))} if has_grid else {}
    details = msgspec.structs.replace(draft_details(path_m=10.0, **report), tile_size_m=TILE_M, camera=entry)
    number = store.save(
        site,
        DraftContent(
            tiles=list(tiles() if of is None else of),
            vocabulary=vocabulary(),
            details=details,
            archive=b"archive",
            extras=[("grid", data) for data in grid],
        ),
    ).version
    releases.publish(store, site)
    return number


def stored(folder: Path, **about: Any) -> Path:
    """A store with a version of the room."""
    with MapStore.open(folder, create=True) as store:
        save(store, **about)
    return folder


def wanted(store: MapStore, site: str = SITE) -> WantedVersion:
    current = store.current(site)
    return WantedVersion(site=site, version=current.version, manifest_sha256=current.manifest_sha256)


def loaded(store: MapStore, of: tuple[Tile, ...] | None = None, *, site: str = SITE) -> LoadedMap:
    """The current version, in memory, with these tiles."""
    version = wanted(store, site)
    held = {(tile.tile_x, tile.tile_y): tile for tile in (tiles() if of is None else of)}
    return LoadedMap(version, store.manifest(site, version.version), decode_vocabulary(vocabulary()), held)


def moved(offset_m: Array) -> tuple[Tile, ...]:
    """The same map somewhere else: what a version would be whose frame has slipped."""
    shift = se3(np.eye(3), offset_m)
    return tuple(
        replace(tile, points_map=tile.points_map + offset_m, map_from_cam=shift @ tile.map_from_cam) for tile in tiles()
    )


def turned(cameras: Iterable[CameraCalibration]) -> tuple[CameraCalibration, ...]:
    """Cameras that look back."""
    back = se3(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    return tuple(replace(camera, body_from_cam=back @ camera.body_from_cam) for camera in cameras)


def new_robot(store: MapStore | None = None, rig: RigCalibration | None = None, **about: Any) -> Robot:
    """store: with its current version."""
    robot = Robot(rectifier() if rig is None else Rectifier(rig), SETTINGS, TRIAL, **about)
    if store is not None:
        robot.use(loaded(store))
    return robot
