"""Poses of markers in a map, by the pictures of its survey, and the scale of the map by known distances. Pure."""

from collections import defaultdict
from dataclasses import replace
from itertools import combinations

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3
from fleetmap.messages import Placement
from fleetmap.plugins.markers import CORNER_SIGMA_PX, Marker, MarkerList, corners_of, detector_of, poses_of
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier, StereoCamera
from fleetmap.sensors.samples import Trajectory

_MIN_RAYS, _MIN_ANGLE_RAD = 4, 0.1  # that meet in a marker, and between the outer ones
_LEAST_SIGMA_M = 0.005
_FARTHEST_M = 8.0

_Seen = tuple[Array, Array]  # map_from_cam (4, 4), corners (4, 2)


def measure_markers(recording: Recording, trajectory: Trajectory, size_m: float, dictionary: str) -> MarkerList:
    """Return the markers that the first camera saw from several sides. trajectory: map_from_body of the recording's frames.

    RecordingError if there are none.
    """
    rectifier, detector = Rectifier(recording.calibration), detector_of(dictionary)
    seen: dict[int, list[_Seen]] = defaultdict(list)
    for number, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
        map_from_body = trajectory.at(stamp_ns)
        if map_from_body is None:
            continue
        image = rectifier.rectify(recording.read_frame(number)).left
        for marker, corners in corners_of(image, detector).items():
            seen[marker].append((map_from_body @ rectifier.body_from_cam, corners))
    placed = (_placed(number, looks, size_m, rectifier.camera) for number, looks in sorted(seen.items()))
    found = tuple(marker for marker in placed if marker is not None)
    if not found:
        raise RecordingError(
            f"{recording.name}: no marker of {dictionary} was seen from several sides ({len(seen)} were seen at all); drive past them"
        )
    return MarkerList(markers=found, dictionary=dictionary)


def _placed(number: int, looks: list[_Seen], size_m: float, camera: StereoCamera) -> Marker | None:
    """Return a marker where the rays through its middle meet, which has the map's scale; None if they are too few or too parallel."""
    near = [(*look, *poses_of(look[1], size_m, camera)[0]) for look in looks]
    near = [look for look in near if look[2][2, 3] < _FARTHEST_M]
    if len(near) < _MIN_RAYS:
        return None
    origins = np.array([there[:3, 3] for there, *_ in near])
    rays = np.array([there[:3, :3] @ _ray(corners, camera) for there, corners, *_ in near])
    if np.arccos(np.clip(rays @ rays.T, -1, 1)).max() < _MIN_ANGLE_RAD:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weights = np.array([cam_from_marker[2, 3] ** -2 for _, _, cam_from_marker, _ in near])
    information = np.einsum("n,nij->ij", weights, across)
    middle_m = np.linalg.solve(information, np.einsum("n,nij,nj->i", weights, across, origins))
    sigma_rad = CORNER_SIGMA_PX / camera.focal_px
    sigma_m = sigma_rad * float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information))[-1]))
    turns = [weight * (there @ cam_from_marker)[:3, :3] for there, _, cam_from_marker, weight in near]
    u, _, vt = np.linalg.svd(sum(turns, np.zeros((3, 3))))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    placed = Placement.of(se3(turn, middle_m))
    return Marker(id=number, size_m=size_m, map_from_marker=placed, sigma_m=float(np.hypot(sigma_m, _LEAST_SIGMA_M)))


def _ray(corners: Array, camera: StereoCamera) -> Array:
    """Return the unit direction (3,) in the camera to a square's middle, where its diagonals meet."""
    a, b, c, d = np.c_[corners, np.ones(4)]
    middle = np.cross(np.cross(a, c), np.cross(b, d))
    ray = np.linalg.solve(camera.matrix, middle / middle[2])
    return np.asarray(ray / np.linalg.norm(ray))


def scale_by(measured: MarkerList, known: MarkerList) -> float:
    """Return true metres per metre of the map, by the distances between markers of both lists; RecordingError with fewer than two."""
    ours, theirs = measured.by_id, known.by_id
    pairs = list(combinations(sorted(ours.keys() & theirs.keys()), 2))
    if not pairs:
        raise RecordingError(
            f"the scale needs two of the known markers; the survey saw {sorted(ours)} of {sorted(theirs)}"
        )
    mine, true = (np.array([_distance_m(listed[a], listed[b]) for a, b in pairs]) for listed in (ours, theirs))
    return float(mine @ true / (mine @ mine))


def _distance_m(one: Marker, other: Marker) -> float:
    return float(np.linalg.norm(np.subtract(one.map_from_marker.position_m, other.map_from_marker.position_m)))


def scaled(rig: RigCalibration, scale: float) -> RigCalibration:
    """Return the rig with the baseline of every pair times `scale`, each about its first camera."""
    cameras = list(rig.cameras)
    for first, *others in rig.views:
        for number in others:
            at = cameras[number].body_from_cam.copy()
            at[:3, 3] = cameras[first].body_from_cam[:3, 3] + scale * (at[:3, 3] - cameras[first].body_from_cam[:3, 3])
            cameras[number] = replace(cameras[number], body_from_cam=at)
    return replace(rig, cameras=tuple(cameras))
