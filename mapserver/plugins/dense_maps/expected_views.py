"""Expected images of stored versions, one at a time, with the latest surfels in memory; and changes between two versions."""

import threading

import numpy as np

from fleetmap.errors import StateError, UsageError
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.mapformat.manifest import CameraEntry
from fleetmap.messages import CameraNote, FailureReport
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.rectification import StereoCamera
from mapserver.plugins.dense_maps.changes import Changes, SeenSite, changes_between
from mapserver.plugins.dense_maps.expected_view import FAR_M, ExpectedView, expected_view, pinhole, resized
from mapserver.plugins.dense_maps.surfel_map import TILE_SIZE_M, Surfels, surfels_of
from mapserver.store import MapStore

_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_FARTHEST_M = 1e5  # from the origin of a map: no site is larger
_PAIRS_KEPT = 4  # of versions
_REACH_M = min(FAR_M, 25.0)  # around the middle of a tile: limit for the reads of a request


class ExpectedViews:
    """Thread-safe."""

    def __init__(self, store: MapStore) -> None:
        self._store, self._lock = store, threading.Lock()
        self._kept: tuple[tuple[str, int, int], Surfels] | None = None

    def view(
        self, site: str, version: int, map_from_cam: Array, camera: CameraCalibration | None = None, width_px: int = 320
    ) -> ExpectedView:
        """Return the expected image at map_from_cam (4, 4), with this width; None: the camera of the version's survey.

        Raises StateError for a version without surfels; errors as of `MapStore.manifest` and `expected_view`.
        """
        manifest = self._store.manifest(site, version)
        lens = resized(camera or survey_camera(manifest.camera), width_px)
        x, y = np.floor(map_from_cam[:2, 3] / TILE_SIZE_M).astype(int).tolist()
        key = (self._store.version(site, version).manifest_sha256, x, y)
        with self._lock:
            if self._kept is None or self._kept[0] != key:
                middle = (np.array([x, y]) + 0.5) * TILE_SIZE_M
                self._kept = None
                self._kept = key, surfels_of(manifest, self._store.blob, (float(middle[0]), float(middle[1]), _REACH_M))
            return expected_view(self._kept[1], lens, map_from_cam)


class SurfelChanges:
    """Changes between versions, one pair at a time; the last pairs stay in memory. Thread-safe."""

    def __init__(self, store: MapStore, most_views: int | None = None) -> None:
        """most_views: limit per version; each costs 0.05 s of CPU. None: no limit."""
        self._store, self._most, self._lock = store, most_views, threading.Lock()
        self._kept: dict[tuple[str, str], Changes] = {}

    def between(self, site: str, before: int, after: int) -> Changes:
        """Return the changes from one version to another. StateError for one without surfels or with too many images."""
        key = self._store.version(site, before).manifest_sha256, self._store.version(site, after).manifest_sha256
        with self._lock:
            if key not in self._kept:
                found = changes_between(self._seen(site, before), self._seen(site, after))
                self._kept = dict([*self._kept.items()][1 - _PAIRS_KEPT :]) | {key: found}
            return self._kept[key]

    def _seen(self, site: str, version: int) -> SeenSite:
        manifest = self._store.manifest(site, version)
        surfels, camera = surfels_of(manifest, self._store.blob), manifest.camera
        if self._most is not None and len(surfels.exposures) > self._most:
            raise StateError(
                f"version {version} of site {site} was seen from {len(surfels.exposures)} places, more than the limit here: "
                f"use `mapserver map changes BEFORE AFTER FILE --site {site}` on the server"
            )
        return SeenSite(surfels, 0.5 * min(camera.width_px, camera.height_px) / camera.focal_px)


def failure_camera(report: FailureReport) -> tuple[int, Array, CameraCalibration]:
    """Return the robot's version at the start of a failure, its estimated map_from_cam (4, 4), and its camera.

    Raises UsageError if the report lacks them, or if the camera is invalid.
    """
    camera, believed = report.camera, report.map_from_base
    if report.version is None:
        raise UsageError("the robot had no map")
    if believed is None:
        raise UsageError("the robot had reported no position when the failure began")
    if camera is None:
        raise UsageError("the report lacks the robot's camera; update fleetmap on the robot")
    map_from_cam = believed.target_from_source @ camera.base_from_cam.target_from_source
    (width_px, height_px), centre_px = camera.size_px, camera.centre_px
    if not is_camera(camera):
        raise UsageError("the report's camera is invalid; check the robot's calibration")
    if not np.isfinite(map_from_cam).all() or np.abs(map_from_cam[:3, 3]).max() > _FARTHEST_M:
        raise UsageError("the reported position is invalid; check the robot's calibration")
    return report.version, map_from_cam, pinhole(StereoCamera(camera.focal_px, *centre_px, 0.0, width_px, height_px))


def is_camera(camera: CameraNote) -> bool:
    """True if a robot's reported camera is plausible."""
    width_px, height_px = camera.size_px
    is_size = 16 <= width_px <= 1 << 14 and 1 <= height_px <= 4 * width_px
    return bool(is_size and np.isfinite(camera.centre_px).all() and 0.1 < camera.focal_px / width_px < 50)


def survey_camera(entry: CameraEntry) -> CameraCalibration:
    """Return the rectified left camera of a version's survey, with its axis in the middle, which manifests do not store."""
    centre = (entry.width_px - 1) / 2, (entry.height_px - 1) / 2
    return pinhole(StereoCamera(entry.focal_px, *centre, entry.baseline_m, entry.width_px, entry.height_px))


def looking(position_map_m: tuple[float, float, float], yaw_deg: float, pitch_deg: float) -> Array:
    """Return map_from_cam (4, 4) of a level camera at a position: yaw counter-clockwise from x of the map, pitch downwards."""
    turn = so3_exp(np.array([0.0, 0.0, np.radians(yaw_deg)])) @ so3_exp(np.array([0.0, np.radians(pitch_deg), 0.0]))
    return se3(turn @ _OPTICAL, np.array(position_map_m))
