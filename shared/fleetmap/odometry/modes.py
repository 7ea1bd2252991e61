"""The modes of the odometry, one class each: vision alone, starting (vision until gravity is known), and stereo-inertial."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.core import longest_gap_ns
from fleetmap.geometry import Array, interpolate_se3, length, rotation_angle_rad, se3_adjoint, se3_inverse
from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.filter.msckf import InitialState, NavState
from fleetmap.odometry.filter.sliding_window import OdometryRig, SlidingWindow
from fleetmap.odometry.gyro_clock import GyroClock
from fleetmap.odometry.init.imu_alignment import (
    LOOK_BACK_NS,
    dynamic_initialization,
    felt_part,
    is_steady,
    polynomial_rate,
    static_initialization,
)
from fleetmap.odometry.lift_check import LiftCheck
from fleetmap.odometry.odometry_checks import DivergenceMonitor, ZeroVelocityDetector
from fleetmap.odometry.sensor_buffer import IMU_GAP_NS, SensorBuffer, is_pause
from fleetmap.odometry.tracking.tracker import Earlier, Tracked
from fleetmap.sensors.samples import PAUSE_NS, Trajectory

_GATE_4, _GATE_6 = 18.47, 22.46  # 0.999 of chi-square with 4 and 6 degrees of freedom
_ROTATION_SIGMA_RAD = 0.01  # of a gyro's rotation over a gap of seconds
_FOLLOWED_SHARE = 0.5  # of the tracks
_NEAR_REST_MPS = 0.2  # a fifth of the tolerated error of the first speed: the filter corrects it
_STEP_SIGMAS, _STEP_M, _ACCEL_OFF_MPS2 = 4.0, 0.02, 0.3  # largest step by images off the prediction
_MAX_ELSEWHERE = 2  # consecutive frames whose descriptor matches contradict the IMU, until the matches are trusted
_EXTRAPOLATED_NS = 1_000_000_000  # during which a robot without visual tracking continues at its last speed
# Of the motion that all points show, where samples are missing: a ninth of what the tracks say once more by themselves.
_BRIDGED_SIGMAS = 3.0
_BY_IMU_NS = 1_000_000_000  # during which an IMU alone carries the speed of one camera
# Largest acceleration without an IMU to measure it: friction holds wheels and shoes to at most about their weight.
_MAX_ACCEL_MPS2 = GRAVITY_MPS2


class ImuInputs:
    """Inputs from an IMU: its samples, its noise, true and weighted, and the checks for its faults.

    accelerometer: None for one camera, which gets its scale from it.
    """

    def __init__(
        self, rig: OdometryRig, samples: SensorBuffer, clock: GyroClock, accelerometer: AccelerometerCheck | None = None
    ) -> None:
        settings, noise = rig.settings.filter, rig.imu
        assert noise is not None
        self.samples, self.noise, self.clock, self.accelerometer = samples, noise, clock, accelerometer
        self.weighing_noise = replace(  # wider than its data sheet says
            noise,
            gyro_noise_radps_rthz=noise.gyro_noise_radps_rthz * settings.gyro_noise_scale,
            accel_noise_mps2_rthz=noise.accel_noise_mps2_rthz * settings.accel_noise_scale,
        )
        self.monitor = DivergenceMonitor(settings.time_offset_sigma_s)

    @property
    def has_fault(self) -> bool:
        return self.clock.off_s is not None or bool(self.accelerometer and self.accelerometer.fault)


class Step(NamedTuple):
    """Result of one frame: the next mode, and the result of its update (see `InvariantFilter.update`).

    new_odom_from_old_odom, revised and is_lifted are as in OdometryEstimate. is_lost: no track is trusted, or none shows a length.
    """

    mode: "Mode"
    used: NDArray[np.int8] = np.zeros(0, np.int8)
    new_odom_from_old_odom: Array | None = None
    revised: tuple[tuple[int, Array], ...] = ()
    is_lost: bool = False
    is_lifted: bool = False


class Mode(ABC):
    """A way to estimate the body's motion. For each frame call `predict`, then `process` with the tracks found by the prediction."""

    inertial = False
    rotation_sigma_rad: float | None = None  # of `cam_from_earlier`, None if that is only a guess

    @property
    @abstractmethod
    def stamp_ns(self) -> int:
        """Time of the state, on the IMU's clock; 0 before the first frame."""

    def begin(self, stamp_ns: int) -> "Mode":
        """Return the mode for the first frame, at stamp_ns."""
        return self

    @abstractmethod
    def follow(self, rig: OdometryRig) -> None:
        """Follow another camera of the rig from the next frame on."""

    @abstractmethod
    def predict(self, stamp_ns: int) -> None:
        """Move the state to a frame."""

    @abstractmethod
    def cam_from_earlier(self, frame_index: int) -> Array | None:
        """(4, 4) predicted for the current frame; None if the earlier one is forgotten."""

    @abstractmethod
    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """Process the tracks of the predicted frame."""

    @abstractmethod
    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        """As `Odometry.motion_since`."""

    @abstractmethod
    def will_forget(self, frame_index: int) -> bool:
        """As `Odometry.will_forget`."""

    @abstractmethod
    def state(self, frame_index: int, tracked: Tracked, step: Step) -> dict[str, Any]:
        """Return the fields of the estimate at a frame that the mode knows by itself; `step` is the result of `process`."""

    def estimate(self, stamp_ns: int, frame_index: int, tracked: Tracked, step: Step) -> OdometryEstimate:
        """Return the estimate at a frame, stamped on the camera's clock."""
        fields: dict[str, Any] = {
            "track_ids": tracked.ids,
            "track_pixels": tracked.pixels,
            "inlier_share": tracked.inlier_share,
            "after_gap": tracked.by_descriptors,
            "cam_from_previous": _well_seen(tracked),
            "new_odom_from_old_odom": step.new_odom_from_old_odom,
            "revised": step.revised,
            "is_lifted": step.is_lifted,
        }
        return OdometryEstimate(stamp_ns, frame_index, **fields | self.state(frame_index, tracked, step))


class WindowMode(Mode):
    """A mode that estimates over a sliding window."""

    waits_for_gravity = False
    is_bridged = False  # the last step, without the samples of the IMU that a mode needs

    def __init__(self, window: SlidingWindow) -> None:
        self.window = window
        self._rig = window.rig

    def follow(self, rig: OdometryRig) -> None:
        self._rig = self.window.rig = rig

    @property
    def stamp_ns(self) -> int:
        return self.window.stamp_ns

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        return self.window.motion_since(frame_index)

    def will_forget(self, frame_index: int) -> bool:
        return frame_index not in self.window.filter.clone_ids[1:]

    def _show(self, imu: ImuInputs, stamp_ns: int, tracked: Tracked) -> bool:
        """Run the checks of the IMU on a frame; stamp_ns on its calibrated clock. Return True if they found a fault."""
        seen, samples = _well_seen(tracked), imu.samples
        moved = None if seen is None else self._body_from_next(seen)
        imu.clock.handle(stamp_ns, moved, samples.imu)
        if imu.accelerometer is not None:
            imu.accelerometer.handle(stamp_ns, moved, samples.imu, on_wheels=samples.on_wheels)
        return imu.has_fault

    def state(self, frame_index: int, tracked: Tracked, step: Step) -> dict[str, Any]:
        window_filter, used = self.window.filter, step.used
        state = window_filter.state
        status = OdometryStatus.INITIALISING if self.waits_for_gravity else OdometryStatus.TRACKING
        if frame_index > 0 and (tracked.lost or step.is_lost or self.window.contradicts_images):
            status = OdometryStatus.DEGRADED
        return {
            "odom_from_body": window_filter.odom_from_body(),
            "cov_rot_trans": window_filter.body_covariance(),
            "velocity_odom_mps": state.velocity_mps,
            "gyro_bias_radps": state.gyro_bias_radps,
            "accel_bias_mps2": state.accel_bias_mps2,
            "status": status,
            "scene_depth_m": self.window.scene_depth_m,
            "inlier_share": int((used == 1).sum()) / len(used) if len(used) else tracked.inlier_share,
            "inertial": self.inertial,
            "imu_minus_cam_s": self._rig.imu_minus_cam_s + window_filter.imu_minus_cam_s if self.inertial else 0.0,
            "imu_minus_cam_sigma_s": window_filter.offset_sigma_s if self.inertial else np.inf,
            "previous_from_body": self.window.previous_from_body,
            "is_bridged": self.is_bridged,
        }

    def _body_from_next(self, cam_from_previous: Array) -> Array:
        """Return the body's motion (4, 4) for one of the camera."""
        return np.asarray(self._rig.body_from_cam @ se3_inverse(cam_from_previous) @ self._rig.cam_from_body)

    def _seen_motion(self, tracked: Tracked, guess: Array) -> Array:
        """Return cam_from_previous (4, 4) by the images, before the state is moved from the last frame; `guess` without them."""
        if tracked.cam_from_previous is not None:
            return tracked.cam_from_previous
        seen = self.window.matched_body(tracked)
        if seen is None:
            return guess
        cam_from_odom = self._rig.cam_from_body @ se3_inverse(seen[1])
        return np.asarray(cam_from_odom @ self.window.filter.odom_from_body() @ self._rig.body_from_cam)

    def _measured_motion_cov(self, tracked: Tracked, sigmas: float) -> Array | None:
        """Covariance (6, 6), in body axes, that ties the state to the motion of all points of the last two frames.

        An update uses the few tracks that are due or ended. If they cluster or slip together, the state must not
        follow them further than all the others allow; it is so loose that it adds hardly any information.
        """
        if tracked.information is None:
            return None
        body_from_cam = se3_adjoint(self._rig.body_from_cam)
        wide = sigmas**2 * np.linalg.inv(tracked.information + 1e-9 * np.eye(6))
        return np.asarray(body_from_cam @ wide @ body_from_cam.T)


def _well_seen(tracked: Tracked) -> Array | None:
    """Return cam_from_previous (4, 4) unless images are tracked poorly: those are no evidence against a sensor."""
    return None if tracked.by_descriptors or tracked.inlier_share < _FOLLOWED_SHARE else tracked.cam_from_previous


def _with_matches(tracked: Tracked, kept: Iterable[Earlier]) -> Tracked:
    """The tracks with those of their descriptor matches."""
    earlier = tuple(kept)
    if len(earlier) == len(tracked.earlier):
        return tracked
    is_kept = any(each.cam_from_earlier is tracked.cam_from_previous for each in earlier)
    return replace(tracked, earlier=earlier, cam_from_previous=tracked.cam_from_previous if is_kept else None)


def _verified(tracked: Tracked) -> Tracked:
    """The tracks, none that no motion verifies: without an IMU nothing else reveals wrong observations."""
    return replace(tracked, ids=tracked.ids[:0], pixels=tracked.pixels[:0]) if tracked.lost else tracked


class VisualMode(WindowMode):
    """Vision alone: the state moves by the motion measured between frames, gravity is unknown."""

    def __init__(self, window: SlidingWindow, cam_from_previous: Array | None = None) -> None:
        """cam_from_previous (4, 4): the last motion, if known."""
        super().__init__(window)
        self._cam_from_previous = np.eye(4) if cam_from_previous is None else cam_from_previous
        self._step_ns = 0  # duration of that motion, 0 if unknown
        # Of the last frame whose motion was known from images: stamp, duration (0 without one) and variance of the motion.
        self._seen_ns, self._seen_step_ns, self._seen_var_m2 = window.stamp_ns, 0, 0.0

    def follow(self, rig: OdometryRig) -> None:
        """See Mode; the last motion becomes that of the other camera."""
        body_from_next = self._body_from_next(self._cam_from_previous)
        self._cam_from_previous = rig.cam_from_body @ se3_inverse(body_from_next) @ rig.body_from_cam
        super().follow(rig)

    def predict(self, stamp_ns: int) -> None:
        """See Mode; the state is known only after tracking of the frame."""
        step_ns, is_dark = stamp_ns - self.stamp_ns, self.stamp_ns - self._seen_ns > _EXTRAPOLATED_NS
        if is_dark or step_ns > PAUSE_NS:  # it did not continue at its last speed
            self._cam_from_previous = np.eye(4)
        elif self._step_ns:
            self._cam_from_previous = interpolate_se3(np.eye(4), self._cam_from_previous, step_ns / self._step_ns)
        self._step_ns = step_ns
        self.window.stamp_ns, self.window.rate_body_radps = stamp_ns, np.zeros(3)

    def cam_from_earlier(self, frame_index: int) -> Array | None:
        """See Mode: at the last speed."""
        return self._cam_from_previous if self.window.filter.clone_ids[-1:] == [frame_index] else None

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode. `odom` restarts if the images no longer show the motion; the covariance describes the error relative to this place."""
        change = None
        if self.window.filter.clone_ids:
            tracked = _with_matches(tracked, filter(self._is_reached, tracked.earlier))
            if tracked.lost:
                change = self.window.filter.begin_frame_anew()
            self._predict_random_walk(tracked)
            tracked = _verified(tracked)
        used = self.window.update(frame_index, tracked, self._rig.settings.filter.chunk_frames_without_imu, 4)
        return Step(self, used, change, is_lost=tracked.lost)

    def _predict_random_walk(self, tracked: Tracked) -> None:
        settings, window = self._rig.settings.filter, self.window
        self._cam_from_previous = self._seen_motion(tracked, self._cam_from_previous)
        body_from_next = self._body_from_next(self._cam_from_previous)
        duration_s = window.seconds_since(window.filter.clone_ids[-1])
        sigmas = self._rotation_sigma_rad(body_from_next, duration_s), self._translation_sigma_m()
        measured = self._measured_motion_cov(tracked, settings.seen_motion_scale)
        window.filter.predict_random_walk(body_from_next, *sigmas, duration_s, measured)
        if not tracked.lost:
            self._seen_ns, self._seen_step_ns, self._seen_var_m2 = self.stamp_ns, self._step_ns, 0.0
            if measured is not None:
                self._seen_var_m2 = float(np.trace(measured[3:, 3:])) / 3.0 / settings.seen_motion_scale**2

    def _translation_sigma_m(self) -> float:
        """Translation sigma of a predicted motion, without the images: each place within reach is as likely as another."""
        settings = self._rig.settings.filter
        if not self._seen_step_ns:
            return settings.free_translation_sigma_m
        before_m = self._reach_m(self.stamp_ns - self._step_ns, settings.seen_motion_scale)
        now_m = self._reach_m(self.stamp_ns, settings.seen_motion_scale)
        return min(settings.free_translation_sigma_m, float(np.sqrt((now_m**2 - before_m**2) / 3.0)))

    def _reach_m(self, stamp_ns: int, sigmas: float) -> float:
        """Largest distance from the place that the last seen speed, the mean over its step, predicts, with so many sigmas of that speed."""
        unseen_s, mean_s = max(stamp_ns - self._seen_ns, 0) * 1e-9, self._seen_step_ns * 1e-9
        by_speed_m = sigmas * np.sqrt(self._seen_var_m2) * unseen_s / mean_s
        return float(np.hypot(0.5 * _MAX_ACCEL_MPS2 * unseen_s * (unseen_s + mean_s), by_speed_m))

    def _is_reached(self, earlier: Earlier) -> bool:
        """True if a robot may have followed the motion since an earlier frame, given its last seen speed."""
        since = self.window.cam_from_earlier(earlier.frame_index)
        if since is None or not self._seen_step_ns:
            return True
        off_m = se3_inverse(earlier.cam_from_earlier) - se3_inverse(self._cam_from_previous @ since)
        return length(off_m[:3, 3]) <= self._reach_m(self.stamp_ns, _STEP_SIGMAS)

    def _rotation_sigma_rad(self, body_from_next: Array, duration_s: float) -> float:
        """Rotation sigma of a predicted motion (4, 4), without the images."""
        return self._rig.settings.filter.free_rotation_sigma_rad


class GyroMode(VisualMode):
    """Vision and the gyro of an IMU whose accelerometer is not used: the gyro measures the rotation."""

    def __init__(self, window: SlidingWindow, imu: ImuInputs, cam_from_previous: Array | None = None) -> None:
        super().__init__(window, cam_from_previous)
        self._imu = imu
        self._turned: Array | None = None

    def predict(self, stamp_ns: int) -> None:
        """See Mode; predicts the last motion with the gyro's rotation, because at the start of a turn the last motion is far off."""
        is_pause = stamp_ns - self.stamp_ns > PAUSE_NS
        self._turned = (
            None if is_pause else self._imu.samples.rotation_between(self.stamp_ns, stamp_ns, self._imu.noise)
        )
        super().predict(stamp_ns)
        if self._turned is not None:
            body_from_next = self._body_from_next(self._cam_from_previous)
            body_from_next[:3, :3] = self._turned
            self._cam_from_previous = self._rig.cam_from_body @ se3_inverse(body_from_next) @ self._rig.body_from_cam

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode; abandons a gyro that contradicts the images."""
        predicted, seen = None if self._turned is None else self._cam_from_previous, tracked.cam_from_previous
        if self._imu.monitor.is_wrong_imu(predicted, seen):
            return VisualMode(self.window, seen).process(frame_index, tracked)
        step = super().process(frame_index, tracked)
        self._show(self._imu, self.stamp_ns, tracked)
        return step if self._imu.clock.off_s is None else step._replace(mode=VisualMode(self.window, seen))

    def _rotation_sigma_rad(self, body_from_next: Array, duration_s: float) -> float:
        """The largest bias of a consistent gyro: few tracks that slip together may not rotate the state further."""
        settings = self._rig.settings
        free_rad = settings.filter.free_rotation_sigma_rad
        sigma_rad = max(settings.start.steady_gyro_mean_radps * duration_s, _ROTATION_SIGMA_RAD)
        if self._turned is None or rotation_angle_rad(self._turned.T @ body_from_next[:3, :3]) > 2.0 * sigma_rad:
            return free_rad
        return min(sigma_rad, free_rad)


def _without_fault(window: SlidingWindow, imu: ImuInputs, motion: Array) -> Mode:
    """The mode for a faulty IMU: without the IMU if its clock is wrong, else by its gyro; motion (4, 4): cam_from_previous."""
    return VisualMode(window, motion) if imu.clock.off_s is not None else GyroMode(window, imu, motion)


class StartingMode(GyroMode):
    """Vision and the gyro until gravity is known, from rest or motion."""

    waits_for_gravity = True

    def __init__(
        self,
        window: SlidingWindow,
        imu: ImuInputs,
        not_before_ns: int = -(2**62),
        cam_from_previous: Array | None = None,
    ) -> None:
        """not_before_ns: earlier samples led to a static start that was wrong."""
        super().__init__(window, imu, cam_from_previous)
        self.not_before_ns = not_before_ns
        self._trajectory: list[tuple[int, Array]] = []

    def begin(self, stamp_ns: int) -> Mode:
        """See Mode: stereo-inertial at once if the IMU rested before the first frame."""
        start = self._static_start(stamp_ns)
        return self if start is None else InertialMode(self.window.restarted(start), self._imu)

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode; switches to stereo-inertial once gravity is known, which redefines `odom`."""
        step = VisualMode.process(self, frame_index, tracked)
        if self._show(self._imu, self.stamp_ns, tracked):
            return step._replace(mode=_without_fault(self.window, self._imu, self._cam_from_previous))
        stamp_ns, old_odom_from_body = self.stamp_ns, self.window.filter.odom_from_body()
        if step.is_lost:
            self._trajectory.clear()
        self._trajectory = [seen for seen in self._trajectory if stamp_ns - seen[0] <= LOOK_BACK_NS]
        self._trajectory.append((stamp_ns, old_odom_from_body))
        start = self._static_start(stamp_ns) or self._dynamic_start()
        if start is None:
            return step
        mode = InertialMode(self.window.restarted(start), self._imu)
        mode.predict(stamp_ns)
        mode.window.seed(frame_index, tracked)
        change = np.asarray(mode.window.filter.odom_from_body() @ se3_inverse(old_odom_from_body))
        begun = step.new_odom_from_old_odom
        return Step(mode, step.used, change if begun is None else change @ begun)

    def _static_start(self, stamp_ns: int) -> InitialState | None:
        since = self._imu.samples.imu.between(self.not_before_ns, stamp_ns + 1)
        start = static_initialization(since, stamp_ns, self._rig.settings)
        return None if start is None else self._moving_evenly(start)

    def _moving_evenly(self, start: InitialState) -> InitialState | None:
        """The start with the speed by images in its steady window; None if that speed changed, or wheels alone show one: they may be wrong.

        Constant acceleration is as steady as rest: an IMU alone sees it as a tilt, of 5 degrees for 0.8 m/s^2. At a speed far from zero
        the measurements of it would be rejected as outliers.
        """
        settings = self._rig.settings.start
        begin_ns = start.stamp_ns - int(settings.steady_window_s * 1e9)
        seen = [(stamp, placed) for stamp, placed in self._trajectory if begin_ns <= stamp <= start.stamp_ns]
        places = [(stamp, placed[:3, 3]) for stamp, placed in seen]
        speeds = [(s.stamp_ns, s.velocity_base_mps) for s in self._imu.samples.wheel_between(begin_ns, start.stamp_ns)]
        rates = polynomial_rate(places, 2), polynomial_rate(speeds, 1)
        if any(rate is not None and np.linalg.norm(rate) > settings.steady_accel_sigma_mps2 for rate in rates):
            return None
        velocity_body, by_pictures = np.zeros(3), polynomial_rate(places, 1)
        if by_pictures is not None:
            velocity_body = seen[-1][1][:3, :3].T @ by_pictures
        elif speeds and np.linalg.norm(np.mean([speed for _, speed in speeds], axis=0)) > _NEAR_REST_MPS:
            return None
        if np.linalg.norm(velocity_body) <= _NEAR_REST_MPS:
            return start
        return replace(start, state=start.state._replace(velocity_mps=start.state.rotation @ velocity_body))

    def _dynamic_start(self) -> InitialState | None:
        settings = self._rig.settings.start
        least_ns = settings.moving_duration_s * 0.9e9  # a camera of 30 Hz needs more than `moving_frames` for it
        most = max(settings.moving_frames - 1, sum(self.stamp_ns - stamp <= least_ns for stamp, _ in self._trajectory))
        stamps, places = zip(*self._trajectory[-2 * most - 2 :], strict=True)
        seen, imu = Trajectory(np.array(stamps, np.int64), np.array(places)), self._imu.samples.imu
        vision, felt_ns = felt_part(seen, imu, most)
        is_short = len(felt_ns) < 4 or felt_ns.sum() < least_ns
        if is_short or felt_ns.max() > settings.moving_gap_s * 1e9:
            return None
        return dynamic_initialization(vision, imu, self._imu.weighing_noise, self._rig.settings)


class InertialMode(WindowMode):
    """Stereo-inertial: the IMU predicts the state; images, rest and wheels correct it."""

    inertial = True
    rotation_sigma_rad: float | None = _ROTATION_SIGMA_RAD

    def __init__(self, window: SlidingWindow, imu: ImuInputs) -> None:
        super().__init__(window)
        settings, self._imu = self._rig.settings.filter, imu
        self._zero_velocity = ZeroVelocityDetector(settings.still_window_s, settings.still_flow_px)
        self._frame_ns = window.stamp_ns
        self._last_odom_from_body = window.filter.odom_from_body()  # at the frame before
        self._seen: Array | None = None  # the last motion by images, of this duration
        self._step_s = 0.0
        self._lift = LiftCheck(self._rig.base_from_body)
        self._measured_ns = window.stamp_ns  # of the last frame with motion in the images, or at rest
        self._elsewhere_frames = 0  # consecutive frames whose descriptor matches contradicted the prediction
        self._is_pause = False
        self._guess: Array | None = None  # cam_from_previous of a bridged step until the state is moved

    def follow(self, rig: OdometryRig) -> None:
        super().follow(rig)
        self._seen = None  # of the other camera

    def predict(self, stamp_ns: int) -> None:
        window, imu = self.window, self._imu
        self._frame_ns, self._last_odom_from_body = stamp_ns, window.filter.odom_from_body()
        end_ns = stamp_ns + int(window.filter.imu_minus_cam_s * 1e9)
        if is_pause(imu.samples.imu.stamps_ns, window.stamp_ns, end_ns):
            self._is_pause, self.rotation_sigma_rad = True, None
            window.stamp_ns = end_ns
            return
        gap_ns = longest_gap_ns(imu.samples.imu.stamps_ns, window.stamp_ns, end_ns)
        self.is_bridged = gap_ns > IMU_GAP_NS and len(window.filter.clone_ids) > 1
        self.rotation_sigma_rad = None if self.is_bridged else _ROTATION_SIGMA_RAD
        if self.is_bridged:
            self._guess, window.rate_body_radps = self._last_motion(end_ns), np.zeros(3)
        else:
            window.rate_body_radps = window.filter.propagate(
                imu.samples.imu, window.stamp_ns, end_ns, imu.weighing_noise, imu.noise
            )
        self._step_s = max(end_ns - window.stamp_ns, 0) * 1e-9
        window.stamp_ns = max(end_ns, window.stamp_ns)

    def cam_from_earlier(self, frame_index: int) -> Array | None:
        since = self.window.cam_from_earlier(frame_index)
        if since is None or self._guess is None:
            return since
        # Not times the identity for the last frame, which would be a rotation but for rounding: that would grow from frame to frame.
        return self._guess if frame_index == self.window.filter.clone_ids[-1] else self._guess @ since

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode; abandons a gyro or accelerometer that contradicts the images, restarts a diverged filter."""
        window, monitor = self.window, self._imu.monitor
        if self._is_pause:
            return self._begin_again(frame_index, tracked)
        tracked = self._without_lookalikes(tracked)
        self._seen = seen = tracked.cam_from_previous
        if self._guess is not None:
            self._bridge_gap(tracked, self._guess)
            tracked = _verified(tracked)
        elif seen is not None and monitor.is_wrong_imu(self.cam_from_earlier(frame_index - 1), seen):
            window.filter.return_to_clone(frame_index - 1)  # vision moves the state from there, not once more
            return VisualMode(window, seen).process(frame_index, tracked)
        if self._show(self._imu, self._frame_ns, tracked):
            return self._begin_again(frame_index, tracked)
        matched = window.matched_body(tracked)
        if matched is not None:
            window.filter.inflate(matched[0], matched[1], window.seconds_since(matched[0]))
        elif window.contradicts_images and seen is not None:
            window.filter.inflate_velocity(self._off_mps(frame_index - 1, seen))  # it is stuck at a wrong speed
        self._update_zero_velocity(tracked)
        rolled = self._imu.samples.wheel_between(0, window.stamp_ns)
        wheel = self._imu.samples.take_wheel(window.stamp_ns)
        if wheel is not None:
            window.filter.correct_by_wheel_sample(*wheel, self._rig.base_from_body, _GATE_4)
        settings = self._rig.settings.filter
        is_unknown = window.filter.velocity_covariance[0, 0] > 0.5 * settings.initial_velocity_sigma_mps**2
        if is_unknown and not self.is_bridged and seen is not None:
            lacking_mps = self._lacking_mps(seen)
            # Images give a start in motion to who did not rest, if they are near enough to each other.
            is_start = len(window.filter.clone_ids) == 1 and self._step_s <= self._rig.settings.start.moving_gap_s
            if wheel is None and is_start and length(lacking_mps) > _NEAR_REST_MPS:
                return self._begin_again(frame_index, tracked)
            self._take_speed(lacking_mps, tracked)
        effort = (settings.chunk_frames_without_imu, 4) if self.is_bridged else (settings.chunk_frames, 1)
        used = window.update(frame_index, tracked, *effort)
        off_mps = 0.0 if seen is None else self._off_mps(frame_index - 1, seen)
        if monitor.is_wrong_start(window.filter.imu_minus_cam_s, off_mps):
            return self._begin_again(frame_index, tracked)._replace(used=used)
        moved = (
            window.filter.odom_from_body(),
            None if self.is_bridged else window.previous_from_body,
            float(np.sqrt(window.filter.velocity_covariance[2, 2])),
        )
        is_lifted = self._lift.is_lifted(window.stamp_ns, rolled, *moved)
        is_by_imu = self._rig.camera.baseline_m == 0 and window.stamp_ns - self._measured_ns > _BY_IMU_NS
        return Step(self, used, is_lost=tracked.lost or is_by_imu or monitor.is_in_doubt, is_lifted=is_lifted)

    def _lacking_mps(self, seen: Array) -> Array:
        """Speed (3,) in the axes of `odom` that the state lacks for the motion since the last frame, cam_from_previous (4, 4)."""
        window = self.window
        predicted = window.cam_from_earlier(window.filter.clone_ids[-1])
        assert predicted is not None
        since = self._body_from_next(predicted)
        off_m = self._body_from_next(seen)[:3, 3] - since[:3, 3]
        return np.asarray(window.filter.state.rotation @ since[:3, :3].T @ off_m / self._step_s)

    def _take_speed(self, lacking_mps: Array, tracked: Tracked) -> None:
        """Correct a speed that is unknown, after a start or a gap of the IMU, by the motion of all points of the last two frames.

        Else the few tracks of an update decide it, of which none is an outlier then.
        """
        measured = self._measured_motion_cov(tracked, _BRIDGED_SIGMAS)
        if measured is not None:
            sigma_m = np.sqrt(np.trace(measured[3:, 3:]) / 3.0)
            self.window.filter.correct_by_speed(
                self.window.filter.state.velocity_mps + lacking_mps, float(sigma_m) / self._step_s
            )

    def _off_mps(self, frame_index: int, seen: Array) -> float:
        """Difference in speed between cam_from_earlier (4, 4), by images since a frame, and the state; 0 within its covariance.

        Source: Bar-Shalom et al. 2001, section 5.4 (test of the innovation).
        """
        predicted = self.cam_from_earlier(frame_index)
        if predicted is None:
            return 0.0
        off_m, duration_s = length(seen[:3, 3] - predicted[:3, 3]), self.window.seconds_since(frame_index)
        sigma_mps = float(np.sqrt(np.trace(self.window.filter.velocity_covariance)))
        admitted_m = _STEP_SIGMAS * sigma_mps * duration_s + 0.5 * _ACCEL_OFF_MPS2 * duration_s**2
        return off_m / max(duration_s, 1e-3) if off_m > max(_STEP_M, admitted_m) else 0.0

    def _without_lookalikes(self, tracked: Tracked) -> Tracked:
        """Return the tracks, without descriptor matches after a gap that imply a motion impossible by the IMU.

        Bays of a rack look alike, and matches may agree on the next one. Repeated contradictions are trusted: the IMU is wrong then.
        """
        if not tracked.earlier:
            self._elsewhere_frames = self._elsewhere_frames if tracked.lost else 0
            return tracked
        possible = [e for e in tracked.earlier if not self._off_mps(e.frame_index, e.cam_from_earlier)]
        self._elsewhere_frames = 0 if possible else self._elsewhere_frames + 1
        return tracked if self._elsewhere_frames > _MAX_ELSEWHERE else _with_matches(tracked, possible)

    def _last_motion(self, end_ns: int) -> Array:
        """Return cam_from_previous (4, 4) to a moment, at the last speed."""
        window = self.window
        held = window.filter.clone_ids[-2:]
        seen, between_s = self._seen, self._step_s
        if seen is None:
            seen = self._rig.cam_from_body @ se3_inverse(window.filter.motion_between(*held)) @ self._rig.body_from_cam
            between_s = window.seconds_between(*held)
        return interpolate_se3(np.eye(4), seen, max(end_ns - window.stamp_ns, 0) * 1e-9 / max(between_s, 1e-3))

    def _bridge_gap(self, tracked: Tracked, guess: Array) -> None:
        """Move the state over a gap in the samples as without an IMU: by the motion of all points of the last two frames.

        Not by the difference of their estimates: the shift of an update would count as a speed, and grow from frame to frame.
        """
        window, settings = self.window, self._rig.settings.filter
        body_from_next = self._body_from_next(self._seen_motion(tracked, guess))
        off_m = length(body_from_next[:3, 3] - self._body_from_next(guess)[:3, 3])
        reach_m = float(np.hypot(_MAX_ACCEL_MPS2 * self._step_s**2, off_m))  # beside the last motion, of as long a step
        sigmas = settings.free_rotation_sigma_rad, min(settings.free_translation_sigma_m, reach_m)
        duration_s = window.seconds_since(window.filter.clone_ids[-1])
        measured = self._measured_motion_cov(tracked, _BRIDGED_SIGMAS)
        window.filter.predict_random_walk(body_from_next, *sigmas, duration_s, measured)
        window.filter.inflate_velocity(settings.initial_velocity_sigma_mps)
        self._guess = None

    def _update_zero_velocity(self, tracked: Tracked) -> None:
        """Apply zero velocity and rotation if neither images nor IMU moved for a while. Still images of one camera alone show no length:
        far points look the same, and what moves with the robot does."""
        now_ns, samples = self.window.stamp_ns, self._imu.samples.imu
        still = self._zero_velocity.since(now_ns, tracked.ids, tracked.pixels)
        if still is None:
            self._measured_ns = now_ns
            return
        window, since = samples.between(still[0], now_ns), samples.between(still[1], now_ns)
        if len(window) < 20 or not len(since) or not is_steady(window, self._rig.settings.start):
            return
        sigma_radps = self._imu.noise.gyro_noise_radps_rthz / np.sqrt((now_ns - still[1]) * 1e-9)
        if self.window.filter.correct_by_rest(since.gyro_radps.mean(axis=0), float(sigma_radps), _GATE_6) <= _GATE_6:
            self._measured_ns = now_ns

    def _begin_again(self, frame_index: int, tracked: Tracked) -> Step:
        """Continue from the last frame without the accelerometer, until gravity is known again.

        The frame `odom` continues, but earlier estimates are less accurate than reported.
        """
        rig, seen = self._rig, tracked.cam_from_previous
        motion = np.eye(4) if seen is None else seen
        odom_from_body = self._last_odom_from_body @ rig.body_from_cam @ se3_inverse(motion) @ rig.cam_from_body
        state = NavState(rotation=odom_from_body[:3, :3], position_m=odom_from_body[:3, 3])
        window = self.window.restarted(InitialState(state, np.diag([1e-10] * 15), self._frame_ns))
        window.seed(frame_index, tracked)
        self._imu.monitor.begin_again()
        if self._imu.has_fault:
            mode: Mode = _without_fault(window, self._imu, motion)
        else:
            mode = StartingMode(window, self._imu, self._frame_ns, motion)
        return Step(mode, new_odom_from_old_odom=np.eye(4))
