"""Odometry with one camera: metric once the IMU has determined the scale; before that, or without an IMU, up to scale and marked so."""

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_exp, so3_log, transform_points
from fleetmap.inertial import preintegrate
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.filter.msckf import InitialState, InvariantFilter, NavState
from fleetmap.odometry.filter.sliding_window import OdometryRig, SlidingWindow
from fleetmap.odometry.init.imu_alignment import felt_part, mono_inertial_initialization, static_initialization
from fleetmap.odometry.modes import ImuInputs, InertialMode, Mode, StartingMode, Step, VisualMode, WindowMode
from fleetmap.odometry.mono.mono_vo import VisualEstimate, VisualOdometry
from fleetmap.odometry.mono.wheel_mode import WheelMode
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.sensor_buffer import IMU_GAP_NS
from fleetmap.odometry.settings import FilterSettings, OdometrySettings
from fleetmap.odometry.tracking.tracker import Tracked
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame
from fleetmap.sensors.samples import Trajectory

_STILL_S = 0.5
_STILL_SIGMA_MPS = 0.02
_FAR_M = 200.0  # points beyond it lie on almost parallel rays and carry no information on the scene's depth
_UNSCALED_FRAMES = 2400  # kept for new poses once the IMU has determined the scale
_SIGHTINGS = 12  # of one track that are kept to place its point
_ANY_SPEED_MPS = 10.0  # sigma, of a robot that has one fix
_MOVES_3, _GATE_6 = 16.266, 22.458  # 0.999 of chi-square with 3 and 6 degrees of freedom
Ids = NDArray[np.int64]


class MonocularWindow(SlidingWindow):
    """The window of one camera: depth comes from points triangulated from several frames."""

    first_depth_m = None

    def __init__(self, rig: OdometryRig, start: InitialState) -> None:
        super().__init__(rig, start)
        self.is_blind = False  # its speed is not known well enough to place points by its way
        self._sightings: dict[int, list[tuple[int, Array]]] = {}

    def points_in_camera(self, ids: Ids) -> Array:
        """(N, 3) tracked points in the newest frame's camera, NaN if they cannot be triangulated; updates the depth."""
        held = {clone: k for k, clone in enumerate(self.filter.clone_ids)}
        out = np.full((len(ids), 3), np.nan)
        if not held:
            return out
        lens, settings = self.rig.camera.lens, self.rig.settings
        odom_from_cam = np.array([self.filter.odom_from_clone(c) for c in held]) @ self.rig.body_from_cam
        lenses = np.tile(lens, (len(held), 1))
        rotations, positions = odom_from_cam[:, :3, :3], odom_from_cam[:, :3, 3]
        max_cosine = np.cos(np.radians(settings.monocular.point_angle_deg))
        for n, track_id in enumerate(ids.tolist()):
            seen = [(held[c], p) for c, p in self._sightings.get(track_id, []) if c in held]
            if len(seen) < 2:
                continue
            frames, pixels = np.array([k for k, _ in seen], np.int64), np.array([p for _, p in seen])
            rays = np.column_stack([(pixels[[0, -1], :2] - lens[1:3]) / lens[0], np.ones(2)])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            if (rotations[frames[0]] @ rays[0]) @ (rotations[frames[-1]] @ rays[1]) > max_cosine:
                continue
            point = positions[frames[-1]] + self.scene_depth_m * rotations[frames[-1]] @ rays[1]
            out[n] = core.triangulate(
                odom_from_cam, frames, pixels, lenses, 1.0 / settings.filter.pixel_sigma_px, 1.0, point
            )
        points = transform_points(se3_inverse(odom_from_cam[-1]), out)
        with np.errstate(invalid="ignore"):
            known = (points[:, 2] > 0) & (points[:, 2] < _FAR_M)
        if known.sum() >= settings.monocular.min_points:
            self.scene_depth_m = float(np.median(points[known, 2]))
        return points

    def update(self, frame_index: int, tracked: Tracked, chunk_frames: int, iterations: int) -> NDArray[np.int8]:
        """As SlidingWindow's."""
        if self.is_blind:
            tracked = replace(tracked, ids=tracked.ids[:0], pixels=tracked.pixels[:0], earlier=())
        return super().update(frame_index, tracked, chunk_frames, iterations)

    def _depth_of(self, pixels: Array) -> float:
        return self.scene_depth_m

    def _observe(self, frame_index: int, tracked: Tracked) -> None:
        super()._observe(frame_index, tracked)
        alive = set(tracked.ids.tolist())
        self._sightings = {i: seen[-_SIGHTINGS:] for i, seen in self._sightings.items() if i in alive}
        for track_id, pixel in zip(tracked.ids.tolist(), tracked.pixels, strict=True):
            self._sightings.setdefault(track_id, []).append((frame_index, pixel))


class _UnscaledFrame(NamedTuple):
    """A frame of unknown scale; vision_from_cam (4, 4) is None if vision could not locate it."""

    frame_index: int
    stamp_ns: int
    vision_from_cam: Array | None


class MonocularMode(Mode):
    """One camera alone, up to scale, until an IMU determines the scale and the direction of gravity."""

    stamp_ns = 0

    def __init__(self, rig: OdometryRig, imu: ImuInputs | None) -> None:
        self._rig, self.imu = rig, imu
        self.is_in_map = False  # a robot's, whose motion counts in metres
        self._stamps_ns = deque[int](maxlen=_UNSCALED_FRAMES)  # of all frames
        self.visual_odometry = VisualOdometry(rig.camera, rig.settings.monocular)
        self._visual = VisualEstimate(None, np.zeros((6, 6)))
        self._unscaled: list[_UnscaledFrame] = []
        self._newest_pixels: tuple[Ids, Array] = (np.zeros(0, np.int64), np.zeros((0, 3)))
        self._still_since_ns: int | None = None
        self._still_from, self._frame_index = 1, 0  # the first frame of the standstill; the present one
        self._tried_ns = 0
        self._not_before_ns = -(2**62)

    def resume(self, mode: Mode) -> None:
        """Continue after the filter was abandoned; vision restarts without scale.

        Without the IMU if that was abandoned, else by those of its samples that caused no wrong start.
        """
        self.stamp_ns, self._still_since_ns = mode.stamp_ns, None
        self._stamps_ns.clear()
        self._unscaled.clear()
        if isinstance(mode, StartingMode):
            self._not_before_ns = mode.not_before_ns
        elif isinstance(mode, VisualMode):
            self.imu = None

    def follow(self, rig: OdometryRig) -> None:
        """See Mode; vision begins anew with the other camera, without scale even if that is a pair."""
        self._rig, self.visual_odometry = rig, VisualOdometry(rig.camera, rig.settings.monocular)
        self._unscaled.clear()

    def predict(self, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns
        self._stamps_ns.append(stamp_ns)

    def cam_from_earlier(self, frame_index: int) -> Array | None:
        """See Mode: repeats the last motion, for the frame before."""
        return se3_inverse(self.visual_odometry.step)

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        """See Mode: none while the image stands still, of any scale. Else the gyro's turn, and a way of unknown direction and speed."""
        if self._still_from <= frame_index <= self._frame_index:
            sigma_rad = self._rig.settings.monocular.still_px / self._rig.camera.focal_px
            sigmas = np.repeat([sigma_rad, sigma_rad * self.visual_odometry.depth], 3)
            return np.eye(4), (self._frame_index - frame_index) * np.diag(sigmas**2)
        number = frame_index - self._frame_index - 1
        if self.imu is None or not self.is_in_map or -number > len(self._stamps_ns):
            return None
        since_ns, settings = self._stamps_ns[number], self._rig.settings
        duration_s = (self.stamp_ns - since_ns) * 1e-9
        turned = self.imu.samples.rotation_between(since_ns, self.stamp_ns, self.imu.noise)
        sigma_rad = np.pi if turned is None else settings.start.steady_gyro_mean_radps * duration_s
        sigma_m = settings.filter.initial_velocity_sigma_mps * duration_s
        covariance = np.diag(np.square(np.repeat([min(sigma_rad, np.pi), sigma_m], 3)))
        return np.eye(4) if turned is None else se3(turned, np.zeros(3)), covariance

    def will_forget(self, frame_index: int) -> bool:
        oldest = self._frame_index + 1 - _UNSCALED_FRAMES if self.is_in_map else self._still_from - 1
        return frame_index <= oldest

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode; switches to the filter once the scale is known, and revises earlier frames then."""
        self._detect_standstill(frame_index, tracked)
        visual = self._visual = self.visual_odometry.add(frame_index, tracked.ids, tracked.pixels[:, :2])
        if self.imu is not None:
            if visual.lost:
                self._unscaled.clear()
            revised = dict(visual.revised)
            kept = [f._replace(vision_from_cam=revised.get(f.frame_index, f.vision_from_cam)) for f in self._unscaled]
            kept.append(_UnscaledFrame(frame_index, self.stamp_ns, visual.vision_from_cam))
            self._unscaled = kept[-_UNSCALED_FRAMES:]
            found = self._metric_start(self.imu, visual)
            if found is not None:
                return self._go_metric(frame_index, tracked, self.imu, *found)
        return Step(self, revised=tuple((number, self._body(there)) for number, there in visual.revised))

    def state(self, frame_index: int, tracked: Tracked, step: Step) -> dict[str, Any]:
        """See Mode; velocity and biases are unknown."""
        visual = self._visual
        there = np.eye(4) if visual.vision_from_cam is None else visual.vision_from_cam
        turn = np.kron(np.eye(2), self._rig.body_from_cam[:3, :3])
        status = OdometryStatus.TRACKING
        if visual.vision_from_cam is None and self._still_since_ns is None:
            status = OdometryStatus.DEGRADED if visual.lost else OdometryStatus.INITIALISING
        return {
            "odom_from_body": self._body(there),
            "cov_rot_trans": turn @ visual.cov_rot_trans @ turn.T + 1e-12 * np.eye(6),
            "status": status,
            "scene_depth_m": self.visual_odometry.depth,
            "scale_known": False,
        }

    def _body(self, vision_from_cam: Array) -> Array:
        return np.asarray(self._rig.body_from_cam @ vision_from_cam @ self._rig.cam_from_body)

    def _detect_standstill(self, frame_index: int, tracked: Tracked) -> None:
        """Track since when the image stands still."""
        self._frame_index = frame_index
        limit_px = self._rig.settings.monocular.still_px
        if not core.is_image_still(*self._newest_pixels, tracked.ids, tracked.pixels, limit_px):
            self._still_since_ns, self._still_from = None, frame_index
        elif self._still_since_ns is None:
            self._still_since_ns = self.stamp_ns
        self._newest_pixels = (tracked.ids, tracked.pixels)

    def _metric_start(self, imu: ImuInputs, visual: VisualEstimate) -> tuple[InitialState, float | None] | None:
        """Start by rest, if image and IMU agree on it, else by motion; with the metres per unit of vision, unknown after rest."""
        stamp_ns, settings = self.stamp_ns, self._rig.settings
        if self._still_since_ns is not None and (stamp_ns - self._still_since_ns) * 1e-9 > _STILL_S:
            since = imu.samples.imu.between(self._not_before_ns, stamp_ns + 1)
            resting = static_initialization(since, stamp_ns, settings)
            if resting is not None and stamp_ns - resting.stamp_ns < int(0.1e9):
                covariance = resting.covariance
                covariance[3:6, 3:6] = _STILL_SIGMA_MPS**2 * np.eye(3)
                return replace(resting, covariance=covariance), None
        if not self.visual_odometry.started or visual.vision_from_cam is None:
            return None
        if stamp_ns - self._tried_ns < settings.monocular.sample_interval_s * 1e9:
            return None
        self._tried_ns = stamp_ns
        vision, _ = felt_part(self._spaced_trajectory(), imu.samples.imu, settings.monocular.metric_max_samples)
        if len(vision) < settings.monocular.metric_samples:
            return None
        noise, body_from_cam = imu.weighing_noise, self._rig.body_from_cam
        return mono_inertial_initialization(vision, imu.samples.imu, noise, body_from_cam, settings)

    def _spaced_trajectory(self) -> Trajectory:
        """vision_from_cam of located frames far enough apart in time, including the newest, in order of time."""
        settings = self._rig.settings
        stamps: list[int] = []
        vision_from_cams: list[Array] = []
        for _, stamp_ns, there in reversed(self._unscaled):
            if there is None or len(stamps) == settings.monocular.metric_max_samples:
                break
            gap_ns = stamps[-1] - stamp_ns if stamps else 0
            if stamps and gap_ns < settings.monocular.sample_interval_s * 1e9:
                continue
            if gap_ns > settings.start.moving_gap_s * 2e9:
                break
            stamps.append(stamp_ns)
            vision_from_cams.append(there)
        return Trajectory(np.array(stamps[::-1], np.int64), np.array(vision_from_cams[::-1]).reshape(-1, 4, 4))

    def _go_metric(
        self, frame_index: int, tracked: Tracked, imu: ImuInputs, start: InitialState, metres_per_unit: float | None
    ) -> Step:
        """Switch to the filter and revise earlier frames: in metres, in a gravity-aligned frame.

        After motion: all frames since vision began; after rest: those since the image stands still.
        """
        window = MonocularWindow(self._rig, start)
        window.scene_depth_m = self.visual_odometry.depth * (1.0 if metres_per_unit is None else metres_per_unit)
        mode = InertialMode(window, imu)
        mode.predict(self.stamp_ns)
        window.seed(frame_index, tracked)
        here, newest = window.filter.odom_from_body(), self._unscaled[-1].vision_from_cam
        revised: list[tuple[int, Array]] = []
        for number, seen_ns, there in self._unscaled[:-1]:
            if metres_per_unit is None:
                if self._still_since_ns is not None and seen_ns >= self._still_since_ns:
                    revised.append((number, here))
            elif newest is not None and there is not None:
                newest_from_there = se3_inverse(newest) @ there
                newest_from_there[:3, 3] *= metres_per_unit
                revised.append((number, here @ self._body(newest_from_there)))
        self._unscaled.clear()
        return Step(mode, revised=tuple(revised))


def _knows_speed(covariance: Array, settings: FilterSettings) -> bool:
    """Return True if the speed, by the covariance of a state, is as certain as those of other starts."""
    return bool(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1] <= settings.initial_velocity_sigma_mps**2)


class MapStart:
    """Scale, speed and gravity of one camera with an IMU, by its fixes in a map: its metres and vertical in place of a second camera.

    Inertial navigation by fixes alone. The first fix gives the pose, the second the speed, each further one is tested.

    Sources: Groves 2013, section 14.1 (loosely coupled integration); Barrau and Bonnabel 2017 (the error).
    """

    def __init__(self, rig: OdometryRig, imu: ImuInputs) -> None:
        self._rig, self._imu = rig, imu
        self._start: InitialState | None = None
        self._tested = 0  # fixes that agreed with those before

    def handle(self, stamp_ns: int, map_from_body: Array, cov_rot_trans: Array, *, needed: int) -> InitialState | None:
        """Return the state at a fix, map_from_body (4, 4), in axes of the map; None until `needed` fixes agree and show the speed.

        stamp_ns: on the IMU's clock, whose samples must be known until then. cov_rot_trans (6, 6) includes the error of the map.
        """
        samples, before = self._imu.samples.imu, self._start
        if before is None or core.longest_gap_ns(samples.stamps_ns, before.stamp_ns, stamp_ns) > IMU_GAP_NS:
            self._begin(stamp_ns, map_from_body, cov_rot_trans)
            return None
        if not self._tested:
            before = self._with_gyro_bias(before, stamp_ns, map_from_body)
        moved = InvariantFilter(before.state, before.covariance, self._rig.settings.filter, self._rig.mounted)
        moved.propagate(samples, before.stamp_ns, stamp_ns, self._imu.weighing_noise)
        state, covariance = moved.state, moved.covariance[:15, :15]
        # right-invariant errors: a rotation from the left turns the position about the origin of the map
        shown = np.zeros((6, 15))
        shown[:3, :3] = shown[3:, 6:9] = np.eye(3)
        shown[3:, :3] = -skew(state.position_m)
        off = np.concatenate(
            [so3_log(map_from_body[:3, :3] @ state.rotation.T), map_from_body[:3, 3] - state.position_m]
        )
        of_off = shown @ covariance @ shown.T + cov_rot_trans
        if off @ np.linalg.solve(of_off, off) > _GATE_6:
            self._begin(stamp_ns, map_from_body, cov_rot_trans)
            return None
        gain = np.linalg.solve(of_off, shown @ covariance).T
        error, rest = gain @ off, np.eye(15) - gain @ shown
        turn = so3_exp(error[:3])
        state = NavState(
            turn @ state.rotation,
            turn @ state.velocity_mps + error[3:6],
            turn @ state.position_m + error[6:9],
            state.gyro_bias_radps + error[9:12],
            state.accel_bias_mps2 + error[12:],
        )
        self._start = InitialState(state, rest @ covariance @ rest.T + gain @ cov_rot_trans @ gain.T, stamp_ns)
        self._tested += 1
        is_known = self._tested + 1 >= needed and _knows_speed(self._start.covariance, self._rig.settings.filter)
        return self._start if is_known else None

    def _begin(self, stamp_ns: int, map_from_body: Array, cov_rot_trans: Array) -> None:
        """Begin at a fix, of any speed and with the biases that sensors may have."""
        settings, position_m = self._rig.settings, map_from_body[:3, 3]
        jacobian = np.zeros((15, 6))
        jacobian[:3, :3] = jacobian[6:9, 3:] = np.eye(3)
        jacobian[6:9, :3] = skew(position_m)
        gyro, accel = settings.start.steady_gyro_mean_radps, settings.filter.initial_accel_bias_sigma_mps2
        own = np.diag(np.square(np.repeat([0.0, _ANY_SPEED_MPS, 0.0, gyro, accel], 3)))
        state = NavState(rotation=map_from_body[:3, :3], position_m=position_m)
        self._start = InitialState(state, own + jacobian @ cov_rot_trans @ jacobian.T, stamp_ns)
        self._tested = 0

    def _with_gyro_bias(self, start: InitialState, stamp_ns: int, map_from_body: Array) -> InitialState:
        """Return the first state with the gyro's bias that explains the turn until the second fix, about which errors are small."""
        bias, seen = np.zeros(3), start.state.rotation.T @ map_from_body[:3, :3]
        for _ in range(3):
            term = preintegrate(
                self._imu.samples.imu, start.stamp_ns, stamp_ns, bias, np.zeros(3), self._imu.weighing_noise
            )
            bias = bias + np.linalg.lstsq(term.d_rotation_d_gyro, so3_log(term.delta_rotation.T @ seen), rcond=None)[0]
        return replace(start, state=start.state._replace(gyro_bias_radps=bias))


def make_odometry(
    rig: MountedRig,
    settings: OdometrySettings,
    stereo_settings: StereoSettings | None = None,
    *,
    by_wheels: bool = False,
) -> Odometry:
    """Create the odometry of a rig: `MonocularOdometry` for a single camera without a depth sensor; by_wheels: `WheelOdometry` if that has
    no IMU either, for a robot, whose map has the scale."""
    of_one_camera = WheelOdometry if by_wheels and rig.calibration.imu is None else MonocularOdometry
    kind = Odometry if rig.mounted[0].camera.baseline_m else of_one_camera
    made = kind(rig, settings, stereo_settings)
    if isinstance(made, MonocularOdometry):
        made.vision.is_in_map = by_wheels
    return made


class MonocularOdometry(Odometry):
    """The class `Odometry` for one camera; its estimates are metric if `scale_known`."""

    _new_odom_from_old_odom: Array | None = None  # by a fix since the last frame
    _last: OdometryEstimate | None = None

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        """Return the estimate at `frame`, which has one image in spite of the name and must be newer than any before."""
        mode, blind, settings = self._mode, self._blind, self._rig.settings.filter
        # the IMU was abandoned, or its filter diverged, or no fix came any more
        if isinstance(mode, VisualMode) or (blind is not None and not _knows_speed(blind.filter.covariance, settings)):
            self.vision.resume(mode)
            self._mode = self.vision
        change, self._new_odom_from_old_odom = self._new_odom_from_old_odom, None
        estimate = super().handle_stereo(frame)
        if change is not None:
            later = estimate.new_odom_from_old_odom
            estimate = replace(estimate, new_odom_from_old_odom=change if later is None else later @ change)
        self._last = estimate
        return estimate

    def follow(self, number: int, before: RectifiedFrame | None) -> None:
        """As Odometry's, also for vision while it waits to resume."""
        super().follow(number, before)
        self.vision.follow(self._rig)

    def handle_fix(
        self, at: OdometryEstimate, map_from_body: Array, cov_rot_trans: Array, *, is_confirmed: bool
    ) -> None:
        """See Odometry: take scale, speed and gravity from fixes as long as images do not show them."""
        last, imu = self._last, self.vision.imu
        if imu is None or last is None or self._by_map is None:
            return
        offset_ns = int(self._rig.imu_minus_cam_s * 1e9)
        needed = 2 if is_confirmed else 3
        start = self._by_map.handle(at.stamp_ns + offset_ns, map_from_body, cov_rot_trans, needed=needed)
        if start is None or (last.scale_known and last.status is not OdometryStatus.DEGRADED and self._blind is None):
            return
        window = MonocularWindow(self._rig, start)
        window.filter = InvariantFilter(start.state, start.covariance, self._rig.settings.filter, self._rig.mounted)
        # Before it is certainly in motion, its images cannot place points, whose distance its step measures.
        velocity_mps = start.state.velocity_mps
        window.is_blind = not velocity_mps @ np.linalg.solve(start.covariance[3:6, 3:6], velocity_mps) > _MOVES_3
        ids, pixels, self._mode = last.track_ids, last.track_pixels, InertialMode(window, imu)
        assert pixels is not None
        if at.frame_index < last.frame_index:
            window.seed(at.frame_index, Tracked(ids[:0], pixels[:0], (), None, 0.0, by_descriptors=False))
            self._mode.predict(last.stamp_ns + offset_ns)
        window.seed(last.frame_index, Tracked(ids, pixels, (), None, 0.0, by_descriptors=False))
        self._new_odom_from_old_odom = window.filter.odom_from_body() @ se3_inverse(last.odom_from_body)

    @property
    def refuses_imu(self) -> bool:
        """As Odometry's, also after vision continues without the IMU."""
        return super().refuses_imu or (self._rig.imu is not None and self.vision.imu is None)

    def _first_mode(self) -> Mode:
        rig = self._rig
        imu = None if rig.imu is None else ImuInputs(rig, self._samples, self.clock)
        self.vision = MonocularMode(rig, imu)
        self._by_map = None if imu is None else MapStart(rig, imu)
        return self.vision

    @property
    def _blind(self) -> MonocularWindow | None:
        window = self._mode.window if isinstance(self._mode, WindowMode) else None
        return window if isinstance(window, MonocularWindow) and window.is_blind else None

    def _points_in_camera(self, ids: Ids) -> Array:
        if isinstance(self._mode, WindowMode) and isinstance(self._mode.window, MonocularWindow):
            return self._mode.window.points_in_camera(ids)
        return self.vision.visual_odometry.points_in_camera(ids)


class WheelOdometry(Odometry):
    """The class `Odometry` for one camera and wheels, see `WheelMode`."""

    def _first_mode(self) -> Mode:
        self.wheels = WheelMode(self._rig, self._samples)
        return self.wheels

    def _points_in_camera(self, ids: Ids) -> Array:
        return np.full((len(ids), 3), np.nan)
