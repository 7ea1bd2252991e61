"""A run without pictures: the measurements of an estimator, landmark by landmark, at many times real time.

The world, its stock, the motion, IMU, wheels, priors and dropped frames are those of the rendered run; the landmarks
lie on the same surfaces and hide behind the same boxes, those of people and forklifts too. Of the pictures' faults darkness has its
effect here, over-exposure hides everything, and a smudge hides what lies behind it; light has none.
"""

from dataclasses import dataclass
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.sensors.rectification import RGBD_BASELINE_M, Rectifier, StereoCamera
from fleetsim.recorder import Order, Session, prepare
from fleetsim.scenarios import SCENARIOS, Scenario
from support.estimator.landmark_lattice import project
from support.estimator.landmarks import LandmarkField, Landmarks
from support.estimator.mover_landmarks import MoverLandmarks
from support.estimator.noise import clutter, detect, flow_noise
from support.estimator.statistics import PITCH_PX, FeatureStatistics, FlowStatistics

_STATION_M, _STATION_RAD = 0.5, 0.15
_CONE_MARGIN = 0.3  # of the tangent: what turning and moving within a station may bring into the picture
_TABLE = 1 << 16
_FLOW_BORDER_PX = 8.0
_FLOOR_M = 0.05
_DEPTH_DISPARITY_PX = 0.08 * RGBD_BASELINE_M / 0.05  # of fleetsim's depth camera, which matches over 50 mm
_FINEST_OCTAVES = 4.0  # what the flow's corners are found on

Ids = NDArray[np.uint64]


def unpictured(order: Order, scenario: Scenario | None = None) -> Session:
    """A session ready but for pictures, of which there are none; scenario: in the place of the one that the order names."""
    with patch.dict(SCENARIOS, {} if scenario is None else {order.scenario: lambda: scenario}):
        session = prepare(order)
    session.renderer.close()
    return session


class Smudge(NamedTuple):
    """Dirt on the left lens: a disc of the picture in which nothing is found, in pixels."""

    u_px: float
    v_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Sighting:
    """Landmarks in one picture, exactly, by rising id.

    ids (N,); points_map, normals_map (N, 3); keys (N, 3) as in Landmarks; pixels (N, 3): rectified u_left v u_right;
    octaves (N,): at which they appear, in fractions; distances_m (N,).
    """

    ids: Ids
    points_map: Array
    normals_map: Array
    keys: NDArray[np.uint64]
    pixels: Array
    octaves: Array
    distances_m: Array


@dataclass(frozen=True, slots=True)
class Found:
    """Features of one picture as a detector would report them.

    rows (N,): of the sighting, -1 for clutter; pixels (N, 3), the third NaN where the disparity is unknown; octaves
    (N,); descriptors (N, 32) uint8.
    """

    rows: NDArray[np.int32]
    pixels: Array
    octaves: NDArray[np.int8]
    descriptors: NDArray[np.uint8]


class EstimatorSession:
    """Measurements of a prepared session, frame by frame in any order; rising order is fastest.

    Equal arguments give equal bits. flow, features: statistics of the measurements. field: share it among sessions of
    one world to make its landmarks once.
    """

    def __init__(
        self,
        session: Session,
        *,
        flow: FlowStatistics | None = None,
        features: FeatureStatistics | None = None,
        field: LandmarkField | None = None,
        smudge: Smudge | None = None,
        view: int = 0,
        covered_s: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """view: of the rig, whose measurements these are. covered_s: from when to when something lies on its lenses."""
        self.session = session
        self._covered_s = covered_s
        self._movers, self._smudge = MoverLandmarks(session.renderer.movers), smudge
        self._flow, self._features = flow or FlowStatistics(), features or FeatureStatistics()
        self._field = field or LandmarkField(session.world)
        rectifier = Rectifier(session.nominal)
        numbers = session.nominal.views[view]
        if view:
            rectifier = rectifier.others[view - 1]
        self.camera: StereoCamera = rectifier.camera
        self.body_from_cam: Array = rectifier.body_from_cam
        self.stamps_ns = session.frame_stamps_ns()
        self.map_from_body = session.motion.map_from_body(np.array(session.frame_times_s))
        self._size_px = float(self.camera.width_px), float(self.camera.height_px)
        self._rect_from_body = [
            _rectified_from_body(
                session.nominal.cameras[k].body_from_cam, session.true.cameras[k].body_from_cam, self.body_from_cam
            )
            for k in (numbers[0], numbers[-1])
        ]
        self._least_disparity_px = 0.0 if len(numbers) > 1 else np.inf
        if session.nominal.cameras[numbers[0]].has_depth:
            self._least_disparity_px = self.camera.focal_px * self.camera.baseline_m / 10.0  # fleetsim's range, m
            shift = se3(np.eye(3), np.array([-self.camera.baseline_m, 0.0, 0.0]))
            self._rect_from_body[1] = shift @ self._rect_from_body[0]
            self._flow = self._flow._replace(disparity_px=_DEPTH_DISPARITY_PX)
            self._features = self._features._replace(disparity_px=_DEPTH_DISPARITY_PX)
        self._stations = _stations(self.map_from_body)
        self._seed = session.order.seed * 4096 + session.order.day + (view << 40)
        self._table = np.random.default_rng(98).standard_normal(_TABLE)
        self._held: tuple[int, Landmarks] | None = None
        self._sighting: tuple[int, Sighting] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def sighting(self, frame: int) -> Sighting:
        """The landmarks in a frame's left picture; none where the cameras are dark."""
        if self._sighting is None or self._sighting[0] != frame:
            self._sighting = frame, self._look(frame)
        return self._sighting[1]

    def follow(self, frame: int, ids: Ids, begun_px: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Landmarks followed by optical flow into a frame: pixels (N, 3) (NaN where lost), and which were not lost.

        begun_px (N, 2): exact pixels where each began to be followed, as `corners` gave them.
        """
        seen = self.sighting(frame)
        at = np.minimum(np.searchsorted(seen.ids, ids), max(len(seen.ids) - 1, 0))
        kept = seen.ids[at] == ids if len(seen.ids) else np.zeros(len(ids), bool)
        pixels = np.full((len(ids), 3), np.nan)
        exact, is_floor = seen.pixels[at[kept]], seen.points_map[at[kept], 2] < _FLOOR_M
        instant = (frame, self._seed, self._flow, self._table)
        pixels[kept], held = flow_noise(ids[kept], exact, begun_px[kept], is_floor, *instant)
        kept[kept] = held
        self._forget_disparities(pixels)
        return pixels, kept

    def _forget_disparities(self, pixels: Array) -> None:
        """Sets u_right of pixels (N, 3) to NaN where the view measures no depth."""
        if self._least_disparity_px > 0:
            pixels[~(pixels[:, 0] - pixels[:, 2] > self._least_disparity_px), 2] = np.nan

    def corners(self, frame: int, taken: Array, count: int, min_distance_px: float) -> tuple[Ids, Array]:
        """Up to `count` landmarks to follow from a frame on, and their exact pixels (N, 2).

        At least min_distance_px from each other and from `taken` (M, 2), in an order of their own: a strong corner is
        chosen in every frame.
        """
        seen = self.sighting(frame)
        pixels, camera = np.ascontiguousarray(seen.pixels[:, :2]), self.camera
        room = np.minimum(pixels, (camera.width_px - 1, camera.height_px - 1) - pixels).min(axis=1)
        order = np.flatnonzero((room > _FLOW_BORDER_PX) & (seen.octaves < _FINEST_OCTAVES))
        order = order[np.argsort(seen.keys[order, 0], kind="stable")]
        if len(taken):
            order = order[cKDTree(taken[:, :2]).query(pixels[order])[0] >= min_distance_px]
        chosen = list[int]()
        while len(order) and len(chosen) < count:
            chosen.append(int(order[0]))
            order = order[np.hypot(*(pixels[order] - pixels[order[0]]).T) >= min_distance_px]
        return seen.ids[chosen], pixels[chosen]

    def features(self, frame: int) -> Found:
        """Features that a detector finds in a frame's left picture: landmarks first, then clutter."""
        seen, model = self.sighting(frame), self._features
        centre = (self.map_from_body[frame] @ self.body_from_cam)[:3, 3]
        toward = centre - seen.points_map
        level = np.hypot(toward[:, 0], toward[:, 1])
        directions = np.stack([np.arctan2(toward[:, 1], toward[:, 0]), np.arctan2(toward[:, 2], level)], axis=1)
        instant = (frame, self._seed, model, self._table)
        found = detect(seen.keys, seen.pixels, seen.octaves, directions, *instant)
        total = model.total if len(seen.ids) else 0
        first, key = min(len(found[0]), total), (self._seed * 1000003 + frame) & ((1 << 63) - 1)
        others = clutter(first, total, key, self._size_px, model.disparity_known_share)
        columns = [np.concatenate([mine[:total], other]) for mine, other in zip(found, others, strict=True)]
        rows, pixels, octaves, words = columns
        self._forget_disparities(pixels)
        return Found(rows.astype(np.int32), pixels, octaves, words.view(np.uint8).reshape(total, 32))

    def _look(self, frame: int) -> Sighting:
        landmarks, camera, time_s = self._landmarks(frame), self.camera, self.session.frame_times_s[frame]
        landmarks = self._movers.around(time_s, (self.map_from_body[frame] @ self.body_from_cam)[:3, 3], landmarks)
        is_covered = self._covered_s[0] <= time_s < self._covered_s[1]
        if is_covered or any(
            self.session.renderer.faults.has(fault, time_s) for fault in ("camera-dark", "over-exposure")
        ):
            landmarks = landmarks.take(np.zeros(0, np.int64))
        body_from_map = se3_inverse(self.map_from_body[frame])
        rect_from_map = np.stack([(rect @ body_from_map)[:3] for rect in self._rect_from_body])
        pinhole = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px])
        view, reach_per_m = (rect_from_map, pinhole), camera.focal_px / PITCH_PX
        points, sizes = landmarks.points_map, landmarks.sizes_m
        rows, pixels, octaves, distances = project(points, sizes, *view, reach_per_m)
        inside = np.arange(len(rows))
        if self._smudge is not None:
            off_px = np.hypot(pixels[:, 0] - self._smudge.u_px, pixels[:, 1] - self._smudge.v_px)
            inside = np.flatnonzero(off_px > self._smudge.radius_px)
        seen = landmarks.take(rows[inside])
        columns = (pixels[inside], octaves[inside], distances[inside])
        return Sighting(seen.keys[:, 2], seen.points_map, seen.normals_map, seen.keys, *columns)

    def _landmarks(self, frame: int) -> Landmarks:
        """Those that the frame's station can see; a station is the middle of a short stretch of the drive."""
        station = int(self._stations[frame])
        if self._held is None or self._held[0] != station:
            half = (self.camera.width_px / 2, self.camera.height_px / 2)
            widest = np.array(half) / self.camera.focal_px + _CONE_MARGIN
            first, end = np.searchsorted(self._stations, [station, station + 1])
            middle = self.map_from_body[first + (end - first) // 2]
            seen = self._field.seen_from(middle @ self.body_from_cam, self.camera.focal_px, widest)
            self._held = station, seen
        return self._held[1]


def _rectified_from_body(body_from_nominal: Array, body_from_true: Array, body_from_rect: Array) -> Array:
    """(4, 4): a camera rectified as its calibration says, from where it really is.

    Its own centre, the rectified axes turned by the mounting's error.
    """
    nominal_from_rect = body_from_nominal[:3, :3].T @ body_from_rect[:3, :3]
    placed = np.eye(4)
    placed[:3, :3] = body_from_true[:3, :3] @ nominal_from_rect
    placed[:3, 3] = body_from_true[:3, 3]
    return se3_inverse(placed)


def _stations(map_from_body: Array) -> NDArray[np.int64]:
    """(F,) the station of each frame, its first frame: a new one after _STATION_M or _STATION_RAD."""
    stations, begun = np.zeros(len(map_from_body), np.int64), 0
    for frame in range(1, len(map_from_body)):
        since = se3_inverse(map_from_body[begun]) @ map_from_body[frame]
        turned = np.linalg.norm(since[:3, :3] - np.eye(3)) / np.sqrt(2.0)
        is_new = np.linalg.norm(since[:3, 3]) > _STATION_M or turned > _STATION_RAD
        begun = frame if is_new else begun
        stations[frame] = begun
    return stations
