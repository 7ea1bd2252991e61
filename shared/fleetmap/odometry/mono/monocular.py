"""Odometry with one camera: metric once the IMU has shown the scale, up to scale, and labelled so, until then or without an IMU."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.stereo import StereoSettings
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.filter import msckf_kernels
from fleetmap.odometry.init.filter_initialization import Start, static_initialization
from fleetmap.odometry.init.mono_inertial_init import mono_inertial_initialization
from fleetmap.odometry.mono.mono_vo import Sight, VisualOdometry
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings, TrackerSettings
from fleetmap.odometry.tracking.tracker import MotionSince, Tracked, Tracker
from fleetmap.odometry.tracking.tracks import Observations, TrackBatch
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Trajectory

_STILL_S = 0.5
_STILL_SIGMA_MPS = 0.02
_FAR_M = 200.0  # points beyond it lie on almost parallel rays and say nothing of the scene's depth
_SEEN_FRAMES = 2400  # without metres that are kept to be placed anew once the IMU has shown them
_SIGHTINGS = 12  # of one track that are kept to place its point


def make_odometry(
    calibration: RigCalibration, camera: StereoCamera, body_from_cam: Array, imu_minus_cam_s: float, settings: OdometrySettings,
    stereo_settings: StereoSettings | None = None,
) -> Odometry:  # fmt: skip
    """The odometry for a rectified camera: `MonocularOdometry` for a single one without a depth sensor."""
    kind = MonocularOdometry if camera.baseline_m == 0 else Odometry
    return kind(calibration, camera, body_from_cam, imu_minus_cam_s, settings, stereo_settings)


class MonocularTracker(Tracker):
    """The tracker with points that were placed from several frames, where there is no second camera to place them from one."""

    def __init__(
        self, camera: StereoCamera, settings: TrackerSettings, points_in_camera: Callable[[NDArray[np.int64]], Array]
    ) -> None:
        super().__init__(camera, settings)
        self._points_in_camera = points_in_camera

    def track(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None = None
    ) -> Tracked:
        """As Tracker's; followed points are enough to go on, since without parallax none of them can be placed."""
        before = self._points.ids
        tracked = super().track(frame, motion_since, rotation_sigma_rad)
        followed = int(np.isin(tracked.ids, before).sum())
        if tracked.cam_from_previous is None and followed >= self._settings.min_inliers and not tracked.by_descriptors:
            guess = motion_since(self._frame_index - 1)
            return replace(tracked, cam_from_previous=np.eye(4) if guess is None else guess)
        return tracked

    def _points_cam(self, pixels: Array) -> Array:
        assert len(pixels) == len(self._points.ids)
        points = self._points_in_camera(self._points.ids)
        points[~(points[:, 2] > 0.0)] = np.nan
        return points


class MonocularObservations(Observations):
    """Observations whose points are looked for from the scene's usual depth, where no disparity tells."""

    def __init__(self, depth_m: Callable[[], float]) -> None:
        super().__init__()
        self._depth_m = depth_m

    def take(
        self, alive: NDArray[np.int64], held: NDArray[np.int64], due: NDArray[np.bool_], camera: StereoCamera
    ) -> TrackBatch:
        """As Observations'; first guesses of points along the newest ray."""
        batch = super().take(alive, held, due, camera)
        last = batch.starts[1:] - 1
        rays = (batch.pixels[last, :2] - [camera.cx_px, camera.cy_px]) / camera.focal_px
        points = self._depth_m() * np.column_stack([rays, np.ones(len(last))])
        return replace(batch, anchors=batch.clone_ids[last], points_cam=points)


class MonocularOdometry(Odometry):
    """The class `Odometry` for one camera; `scale_known` of its estimates says whether its metres are metres."""

    def __init__(
        self, calibration: RigCalibration, camera: StereoCamera, body_from_cam: Array, imu_minus_cam_s: float,
        settings: OdometrySettings, stereo_settings: StereoSettings | None = None,
    ) -> None:  # fmt: skip
        super().__init__(calibration, camera, body_from_cam, imu_minus_cam_s, settings, stereo_settings)
        self._tracker = MonocularTracker(camera, settings.tracker, self._points_before)
        self._observations = MonocularObservations(self._scene_depth_m)
        self._vision_odometry = VisualOdometry(camera, settings.monocular)
        self._lens = np.array([camera.focal_px, camera.cx_px, camera.cy_px, 0.0])
        self._sightings: dict[int, list[tuple[int, Array]]] = {}
        self._seen: list[tuple[int, int, Array | None]] = []  # frame index, IMU stamp, vision_from_cam
        self._newest_pixels: tuple[NDArray[np.int64], Array] = (np.zeros(0, np.int64), np.zeros((0, 2)))
        self._still_since_ns: int | None = None
        self._tried_ns = 0
        self._depth_m = settings.monocular.first_depth

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        """The estimate at `frame`, of one image in spite of the name; newer than any before."""
        if self._inertial:
            return super().handle_stereo(frame)
        self._filter = (
            None  # also where an IMU was dropped that contradicts the pictures: vision begins again without metres
        )
        self._absorb_imu(frame.stamp_ns)
        stamp_ns = frame.stamp_ns + int(self._offset_s * 1e9)
        tracked = self._tracker.track(frame, lambda _: self._vision_odometry.motion_guess(), None)
        self._watch(stamp_ns, tracked)
        sight = self._vision_odometry.add(self._frame_index, tracked.ids, tracked.pixels[:, :2])
        self._note(stamp_ns, sight)
        revised = self._revised(sight)
        self._state_ns = stamp_ns
        self._newest = (tracked.ids, tracked.pixels)
        start = None if self._noise is None else self._metric_start(stamp_ns, sight)
        if start is not None:
            revised = self._go_metric(stamp_ns, *start)
        self._depth_m = sight.depth * (1.0 if start is None or start[1] is None else start[1])
        estimate = self._sight_estimate(frame.stamp_ns, tracked, sight, revised)
        self._frame_index += 1
        return estimate

    # --- by pictures alone ---

    def _body(self, vision_from_cam: Array) -> Array:
        return np.asarray(self._body_from_cam @ vision_from_cam @ self._cam_from_body)

    def _note(self, stamp_ns: int, sight: Sight) -> None:
        """Keeps where vision put the frames, for the day when the IMU shows the metres."""
        if self._noise is None:
            return
        if sight.lost:
            self._seen.clear()
        stamps = {number: stamp for number, stamp, _ in self._seen}
        for number, there in sight.revised:
            if number in stamps:
                self._seen = [entry for entry in self._seen if entry[0] != number]
                self._seen.append((number, stamps[number], there))
        self._seen.append((self._frame_index, stamp_ns, sight.vision_from_cam))
        self._seen = sorted(self._seen, key=lambda entry: entry[0])[-_SEEN_FRAMES:]

    def _revised(self, sight: Sight) -> tuple[tuple[int, Array], ...]:
        return tuple((number, self._body(there)) for number, there in sight.revised)

    def _watch(self, stamp_ns: int, tracked: Tracked) -> None:
        """Keeps since when the picture stands still."""
        before, old = self._newest_pixels
        _, a, b = np.intersect1d(before, tracked.ids, return_indices=True)
        moved = np.linalg.norm(old[a] - tracked.pixels[b, :2], axis=1)
        still = len(a) >= self._settings.tracker.min_inliers and np.median(moved) < self._settings.monocular.still_px
        if not still:
            self._still_since_ns = None
        elif self._still_since_ns is None:
            self._still_since_ns = stamp_ns
        self._newest_pixels = (tracked.ids, tracked.pixels[:, :2].copy())

    def _sight_estimate(
        self, stamp_ns: int, tracked: Tracked, sight: Sight, revised: tuple[tuple[int, Array], ...]
    ) -> OdometryEstimate:
        if self._filter is not None:
            estimate = super()._estimate(stamp_ns, tracked, np.zeros(0, np.int8), None)
            return replace(estimate, revised=revised)
        there = np.eye(4) if sight.vision_from_cam is None else sight.vision_from_cam
        turn = np.kron(np.eye(2), self._body_from_cam[:3, :3])
        status = OdometryStatus.TRACKING
        if sight.vision_from_cam is None:
            status = OdometryStatus.DEGRADED if sight.lost else OdometryStatus.INITIALISING
        return OdometryEstimate(
            stamp_ns=stamp_ns, frame_index=self._frame_index, odom_from_body=self._body(there),
            cov_rot_trans=turn @ sight.cov_rot_trans @ turn.T + 1e-12 * np.eye(6), velocity_odom_mps=np.zeros(3),
            gyro_bias_radps=np.zeros(3), accel_bias_mps2=np.zeros(3), status=status, track_ids=tracked.ids,
            scene_depth_m=sight.depth, inlier_share=tracked.inlier_share, after_gap=tracked.by_descriptors, inertial=False,
            new_odom_from_old_odom=None, scale_known=False, revised=revised,
        )  # fmt: skip

    # --- the start with an IMU ---

    def _metric_start(self, stamp_ns: int, sight: Sight) -> tuple[Start, float | None] | None:
        """By rest, if picture and IMU agree on it, else by motion; with the metres in one unit of vision, which rest leaves open."""
        assert self._noise is not None
        if self._still_since_ns is not None and (stamp_ns - self._still_since_ns) * 1e-9 > _STILL_S:
            resting = static_initialization(self._imu, stamp_ns, self._settings.start, self._settings.filter)
            if resting is not None and stamp_ns - resting.stamp_ns < int(0.1e9):
                covariance = resting.covariance
                covariance[3:6, 3:6] = _STILL_SIGMA_MPS**2 * np.eye(3)
                return replace(resting, covariance=covariance), None
        s = self._settings.monocular
        if not self._vision_odometry.started or sight.vision_from_cam is None:
            return None
        if stamp_ns - self._tried_ns < s.sample_interval_s * 1e9:
            return None
        self._tried_ns = stamp_ns
        chosen = self._samples()
        if len(chosen) < s.metric_samples:
            return None
        vision = Trajectory(np.array([c[1] for c in chosen], np.int64), np.array([c[2] for c in chosen]))
        found = mono_inertial_initialization(
            vision, self._imu, self._noise, self._body_from_cam, s, self._settings.start, self._settings.filter
        )
        return None if found is None else (found.start, found.metres_per_unit)

    def _samples(self) -> list[tuple[int, int, Array]]:
        """Placed frames far enough apart in time, the newest among them; in order of time."""
        s = self._settings.monocular
        chosen: list[tuple[int, int, Array]] = []
        for number, stamp_ns, there in reversed(self._seen):
            if there is None:
                break
            entry = (number, stamp_ns, there)
            if not chosen or chosen[-1][1] - entry[1] >= s.sample_interval_s * 1e9:
                if chosen and chosen[-1][1] - entry[1] > self._settings.start.moving_gap_s * 2e9:
                    break
                chosen.append(entry)
            if len(chosen) == s.metric_max_samples:
                break
        return chosen[::-1]

    def _go_metric(self, stamp_ns: int, start: Start, metres_per_unit: float | None) -> tuple[tuple[int, Array], ...]:
        """Switches to the filter; the earlier frames that this places, in metres and in the frame that gravity levels.

        After motion these are all since vision began, after rest those since the picture stands still.
        """
        self._install(start)
        rate = self._predict(stamp_ns)
        assert self._filter is not None
        self._filter.add_clone(self._frame_index, rate)
        self._clone_stamps[self._frame_index] = self._state_ns
        self._seed_tracks()
        here, newest = self._filter.state.odom_from_body, self._seen[-1][2]
        revised: list[tuple[int, Array]] = []
        for number, seen_ns, there in self._seen[:-1]:
            if metres_per_unit is None:
                if self._still_since_ns is not None and seen_ns >= self._still_since_ns:
                    revised.append((number, here))
            elif newest is not None and there is not None:
                newest_from_there = se3_inverse(newest) @ there
                newest_from_there[:3, 3] *= metres_per_unit
                revised.append((number, here @ self._body(newest_from_there)))
        self._seen.clear()
        return tuple(revised)

    # --- with the filter ---

    def _doubt(self, tracked: Tracked) -> None:
        """Notes what is seen besides, so that points can be placed for the tracker."""
        super()._doubt(tracked)
        alive = set(tracked.ids.tolist())
        self._sightings = {i: seen[-_SIGHTINGS:] for i, seen in self._sightings.items() if i in alive}
        for track_id, pixel in zip(tracked.ids.tolist(), tracked.pixels, strict=True):
            self._sightings.setdefault(track_id, []).append((self._frame_index, pixel))

    def _points_before(self, ids: NDArray[np.int64]) -> Array:
        """(N, 3) tracked points in the camera of the frame before, NaN where they cannot be placed."""
        if not self._inertial:
            return self._vision_odometry.points_in_camera(ids)
        return self._placed(ids)

    def _placed(self, ids: NDArray[np.int64]) -> Array:
        assert self._filter is not None
        held = {clone: k for k, clone in enumerate(self._filter.clone_ids)}
        out = np.full((len(ids), 3), np.nan)
        if not held:
            return out
        odom_from_cam = np.array([self._filter.odom_from_clone(c) for c in held]) @ self._body_from_cam
        rotations = np.ascontiguousarray(odom_from_cam[:, :3, :3])
        positions = np.ascontiguousarray(odom_from_cam[:, :3, 3])
        weights = np.array([1.0 / self._settings.filter.pixel_sigma_px, 1.0])
        least = np.cos(np.radians(self._settings.monocular.point_angle_deg))
        for n, track_id in enumerate(ids.tolist()):
            seen = [(held[c], p) for c, p in self._sightings.get(track_id, []) if c in held]
            if len(seen) < 2:
                continue
            views, pixels = np.array([k for k, _ in seen], np.int64), np.array([p for _, p in seen])
            rays = np.column_stack([(pixels[[0, -1], :2] - self._lens[1:3]) / self._lens[0], np.ones(2)])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            if (rotations[views[0]] @ rays[0]) @ (rotations[views[-1]] @ rays[1]) > least:
                continue
            point = positions[views[-1]] + self._depth_m * rotations[views[-1]] @ rays[1]
            if msckf_kernels.triangulate(rotations, positions, views, pixels, self._lens, weights, point):
                out[n] = point
        points = transform_points(se3_inverse(odom_from_cam[-1]), out)
        with np.errstate(invalid="ignore"):
            known = (points[:, 2] > 0) & (points[:, 2] < _FAR_M)
        if known.sum() >= self._settings.monocular.min_points:
            self._depth_m = float(np.median(points[known, 2]))
        return points

    def _scene_depth_m(self) -> float:
        return self._depth_m
