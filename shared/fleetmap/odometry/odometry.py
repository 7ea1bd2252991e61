"""The odometry of robot and survey: samples in, one estimate for each frame out.

Never touches a file, a socket or a clock.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.stereo import StereoSettings
from fleetmap.geometry import Array, interpolate_se3, se3_adjoint, se3_inverse, skew
from fleetmap.odometry.checks.divergence_monitor import DivergenceMonitor
from fleetmap.odometry.checks.imu_faults import joined, longest_gap_ns, without_spikes
from fleetmap.odometry.checks.zero_velocity import ZeroVelocityDetector, middle
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.odometry.filter.msckf import InvariantFilter, NavState
from fleetmap.odometry.init.filter_initialization import Start, dynamic_initialization, is_steady, static_initialization
from fleetmap.odometry.settings import FilterSettings, OdometrySettings
from fleetmap.odometry.tracking.tracker import Tracked, Tracker
from fleetmap.odometry.tracking.tracks import Observations
from fleetmap.sensors.calibration import ImuNoise, RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples, Trajectory, WheelSample

_IMU_MEMORY_S = 25.0
_IMU_MEMORY_INERTIAL_S = 4.0  # with a state to go on from no start is looked for in it
_WHEEL_REACH_NS = 30_000_000  # a sample serves a frame within half the period of slow wheel odometry
_GATE_4, _GATE_6 = 18.47, 22.46  # 0.999 of chi-square with 4 and 6 degrees of freedom
_ROTATION_SIGMA_RAD = 0.01  # of a gyro's rotation over a gap of seconds
_IMU_GAP_NS = 50_000_000  # longer without samples than this, and the IMU says nothing of the motion


class Odometry:
    """Stereo-inertial, or stereo alone where the rig has no IMU."""

    def __init__(
        self,
        calibration: RigCalibration,
        camera: StereoCamera,
        body_from_cam: Array,
        imu_minus_cam_s: float,
        settings: OdometrySettings,
        stereo_settings: StereoSettings | None = None,
    ) -> None:
        self._doubts = DivergenceMonitor(settings.filter.time_offset_sigma_s)
        self._still = ZeroVelocityDetector(settings.filter.still_window_s, settings.filter.still_flow_px)
        self._base_from_body = calibration.base_from_body
        self._wheel: list[WheelSample] = []
        self._real_noise = calibration.imu
        self._noise = None if calibration.imu is None else _widened(calibration.imu, settings.filter)
        self._camera, self._body_from_cam = camera, body_from_cam
        self._cam_from_body = se3_inverse(body_from_cam)
        self._offset_s = imu_minus_cam_s
        self._settings = settings
        self._tracker = Tracker(camera, settings.tracker, stereo_settings)
        self._imu = ImuSamples.empty()
        self._pending: list[ImuSamples] = []
        self._filter: InvariantFilter | None = None
        self._inertial = False
        self._state_ns = 0
        self._frame_index = 0
        self._observations = Observations()
        self._vision: list[tuple[int, Array]] = []
        self._last_motion = np.eye(4)
        self._clone_stamps: dict[int, int] = {}
        # Frames dropped with the newest: a frame that is kept, and kept_from_dropped.
        self._merged: dict[int, tuple[int, Array]] = {}
        self._last_odom_from_body = np.eye(4)
        self._not_before_ns = -(2**62)  # the IMU of before led to a start that was wrong

    def handle_imu(self, samples: ImuSamples) -> None:
        """Takes samples newer than any before; ignored by a rig without IMU noise figures."""
        self._pending.append(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Takes wheel odometry newer than any before, on the IMU's clock; of use once gravity is known."""
        if self._settings.filter.use_wheels:
            self._wheel.extend(samples)

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        """The estimate at `frame`, which must be newer than any before.

        IMU samples up to its stamp should have come.
        """
        self._absorb_imu(frame.stamp_ns)
        stamp_ns = frame.stamp_ns + int(self._offset_s * 1e9)
        if self._filter is None:
            self._begin(stamp_ns)
        assert self._filter is not None
        rate = self._predict(stamp_ns)
        tracked = self._tracker.track(frame, self._predicted_since, _ROTATION_SIGMA_RAD if self._inertial else None)
        before = self._predicted_since(self._frame_index - 1)
        if self._inertial and self._doubts.is_wrong_imu(before, tracked.cam_from_previous):
            self._give_up_imu(tracked)
        if not self._inertial:
            self._displace(tracked)
        else:
            self._doubt(tracked)
            self._apply_zero_velocity(tracked)
            self._feel_wheels()
        self._filter.add_clone(self._frame_index, rate)
        self._clone_stamps[self._frame_index] = self._state_ns
        self._remember(tracked)
        used = self._consume(tracked)
        self._prune()
        change = None
        if self._inertial and self._is_wrong_start(tracked):
            change = self._begin_again(stamp_ns, tracked)
        elif not self._inertial and self._noise is not None:
            change = self._try_start(stamp_ns, tracked)
        estimate = self._estimate(frame.stamp_ns, tracked, used, change)
        self._last_odom_from_body = estimate.odom_from_body
        self._frame_index += 1
        return estimate

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        """earlier_from_now (4, 4) since a frame (counted from 0) as known now, and its covariance.

        None where the frame is forgotten; one that was dropped with this very frame is not yet. The covariance (6, 6) is that
        of a left perturbation in the earlier body's axes, rotation first. Sparse pictures can revise where earlier frames were:
        what two estimates differ by is then not the motion between them, this is.
        """
        kept_from_frame = np.eye(4)
        while frame_index in self._merged:
            frame_index, kept_from_earlier = self._merged[frame_index]
            kept_from_frame = kept_from_earlier @ kept_from_frame
        if self._filter is None or frame_index not in self._filter.clone_ids:
            return None
        kept_from_now, covariance = self._filter.motion_since(frame_index)
        frame_from_kept = se3_inverse(kept_from_frame)
        carry = se3_adjoint(frame_from_kept)
        return frame_from_kept @ kept_from_now, carry @ covariance @ carry.T

    def will_forget(self, frame_index: int) -> bool:
        """Whether `motion_since` may not know a frame any more after the next one: the oldest that it knows, and what was dropped."""
        return self._filter is None or frame_index not in self._filter.clone_ids[1:]

    # --- start ---

    def _absorb_imu(self, stamp_ns: int) -> None:
        if self._pending:
            self._imu = without_spikes(self._imu, joined(self._pending))
            self._pending.clear()
        memory_s = _IMU_MEMORY_INERTIAL_S if self._inertial else _IMU_MEMORY_S
        oldest = min(stamp_ns, self._state_ns or stamp_ns) - int(memory_s * 1e9)
        if len(self._imu) and self._imu.stamps_ns[0] < oldest - int(0.4e9 * memory_s):
            self._imu = self._imu.between(oldest, int(self._imu.stamps_ns[-1]) + 1)

    def _begin(self, stamp_ns: int) -> None:
        start = None
        if self._noise is not None:
            start = static_initialization(self._imu, stamp_ns, self._settings.start, self._settings.filter)
        if start is not None:
            self._install(start)
            return
        self._filter = self._new_filter(NavState(), np.diag([1e-10] * 15))
        self._state_ns = stamp_ns

    def _new_filter(self, state: NavState, covariance: Array) -> InvariantFilter:
        budget = self._settings.filter.real_start_share**2 * covariance
        if self._noise is not None:  # the mean of a steady gyro is far better than what it is weighed by
            budget[9:12, :], budget[:, 9:12] = 0.0, 0.0
            budget[range(9, 12), range(9, 12)] = self._settings.filter.real_gyro_bias_sigma_radps**2
        return InvariantFilter(state, covariance, self._settings.filter, self._camera, self._body_from_cam, budget)

    def _install(self, start: Start) -> None:
        self._filter = self._new_filter(start.state, start.covariance)
        self._inertial = True
        self._state_ns = start.stamp_ns
        self._observations.clear()

    def _try_start(self, stamp_ns: int, tracked: Tracked) -> Array | None:
        """Switches to the inertial filter once gravity is known, by rest or by motion.

        Returns new_odom_from_old_odom (4, 4) then, else None.
        """
        assert self._filter is not None
        assert self._noise is not None
        seen = self._filter.state.odom_from_body
        s = self._settings.start
        since = self._imu.between(self._not_before_ns, stamp_ns + 1)
        start = static_initialization(since, stamp_ns, s, self._settings.filter)
        if start is None:
            if tracked.lost:
                self._vision.clear()
            self._vision.append((stamp_ns, seen))
            recent = self._vision[-s.moving_frames :]
            stamps = np.array([t for t, _ in recent], np.int64)
            if (
                len(recent) < 5
                or stamps[-1] - stamps[0] < s.moving_duration_s * 0.9e9
                or np.diff(stamps).max() > s.moving_gap_s * 1e9
            ):
                return None
            vision = Trajectory(stamps, np.array([m for _, m in recent]))
            start = dynamic_initialization(vision, self._imu, self._noise, s, self._settings.filter)
            if start is None:
                return None
        self._install(start)
        rate = self._predict(stamp_ns)
        self._filter.add_clone(self._frame_index, rate)
        self._seed_tracks()
        return np.asarray(self._filter.state.odom_from_body @ se3_inverse(seen))

    def _is_wrong_start(self, tracked: Tracked) -> bool:
        assert self._filter is not None
        now = self._predicted_since(self._frame_index - 1)
        return self._doubts.is_wrong_start(self._filter.imu_minus_cam_s, now, tracked.cam_from_previous)

    def _begin_again(self, stamp_ns: int, tracked: Tracked) -> Array:
        """By sight alone from where the last frame was, until gravity is known anew; returns new_odom_from_old_odom (4, 4).

        That is the identity: what was called `odom` goes on, but nothing of before is known as well as it was said to be.
        """
        self._last_motion = np.eye(4) if tracked.cam_from_previous is None else tracked.cam_from_previous
        seen = self._last_odom_from_body @ self._body_from_cam @ se3_inverse(self._last_motion) @ self._cam_from_body
        state = NavState(rotation=seen[:3, :3], position_m=seen[:3, 3])
        self._filter = self._new_filter(state, np.diag([1e-10] * 15))
        self._filter.add_clone(self._frame_index, np.zeros(3))
        self._inertial, self._state_ns, self._not_before_ns = False, stamp_ns, stamp_ns
        self._doubts.begin_again()
        self._clone_stamps = {self._frame_index: stamp_ns}
        self._vision.clear()
        self._still.forget()
        self._observations.clear()
        self._seed_tracks()
        return np.eye(4)

    def _seed_tracks(self) -> None:
        """After a restart the tracks go on from the newest frame alone."""
        self._observations.add(self._frame_index, *self._newest)

    # --- one frame ---

    def _predict(self, stamp_ns: int) -> Array:
        assert self._filter is not None
        rate = np.zeros(3)
        if self._inertial and self._noise is not None:
            target = stamp_ns + int(self._filter.imu_minus_cam_s * 1e9)
            if longest_gap_ns(self._imu, self._state_ns, target) > _IMU_GAP_NS and len(self._filter.clone_ids) > 1:
                self._guess_motion(target)
                return rate
            rate = self._filter.propagate(self._imu, self._state_ns, target, self._noise, self._real_noise)
            stamp_ns = max(target, self._state_ns)
        self._state_ns = stamp_ns
        return rate

    def _guess_motion(self, target_ns: int) -> None:
        """Without samples: as fast as between the last two frames that are held, as uncertain as without an IMU."""
        assert self._filter is not None
        settings, held = self._settings.filter, self._filter.clone_ids[-2:]
        earlier, last = (self._filter.odom_from_clone(clone) for clone in held)
        duration_s = max(target_ns - self._state_ns, 0) * 1e-9
        between_s = (self._clone_stamps[held[1]] - self._clone_stamps[held[0]]) * 1e-9
        motion = interpolate_se3(np.eye(4), se3_inverse(earlier) @ last, duration_s / max(between_s, 1e-3))
        self._filter.predict_random_walk(
            motion, settings.free_rotation_sigma_rad, settings.free_translation_sigma_m, duration_s
        )
        self._filter.doubt_velocity(settings.initial_velocity_sigma_mps)
        self._state_ns = max(target_ns, self._state_ns)

    def _give_up_imu(self, tracked: Tracked) -> None:
        """The estimates go on as without an IMU."""
        assert tracked.cam_from_previous is not None
        self._inertial, self._noise = False, None
        self._last_motion = tracked.cam_from_previous

    def _predicted_since(self, frame_index: int) -> Array | None:
        """cam_from_earlier (4, 4): from the propagated state, or the last motion again without an IMU."""
        assert self._filter is not None
        if not self._inertial:
            return self._last_motion if frame_index == self._frame_index - 1 else None
        if frame_index not in self._filter.clone_ids:
            return None
        earlier = self._filter.odom_from_clone(frame_index)
        return np.asarray(
            self._cam_from_body @ se3_inverse(self._filter.state.odom_from_body) @ earlier @ self._body_from_cam
        )

    def _displace(self, tracked: Tracked) -> None:
        assert self._filter is not None
        if self._frame_index == 0:
            return
        s = self._settings.filter
        if tracked.cam_from_previous is not None:
            self._last_motion = tracked.cam_from_previous
        elif (seen := self._seen_body(tracked)) is not None:
            self._last_motion = (
                self._cam_from_body @ se3_inverse(seen[1]) @ self._filter.state.odom_from_body @ self._body_from_cam
            )
        body_from_next = self._body_from_cam @ se3_inverse(self._last_motion) @ self._cam_from_body
        duration_s = (self._state_ns - self._clone_stamps[self._frame_index - 1]) * 1e-9
        self._filter.predict_random_walk(
            body_from_next, s.free_rotation_sigma_rad, s.free_translation_sigma_m, duration_s, self._loosely(tracked)
        )

    def _loosely(self, tracked: Tracked) -> Array | None:
        """Covariance (6, 6), in the body's axes, that holds the state near the motion from all points of the last two frames.

        An update takes the few tracks that are due or ended. Where they cluster or slip together the state must not
        follow them further than all the others allow; so loose, it adds no information to speak of.
        """
        if tracked.cov_rot_trans is None:
            return None
        body_from_cam = np.zeros((6, 6))
        rotation = self._body_from_cam[:3, :3]
        body_from_cam[:3, :3] = body_from_cam[3:, 3:] = rotation
        body_from_cam[3:, :3] = skew(self._body_from_cam[:3, 3]) @ rotation
        wide = self._settings.filter.seen_motion_scale**2 * tracked.cov_rot_trans
        return np.asarray(body_from_cam @ wide @ body_from_cam.T)

    def _seen_body(self, tracked: Tracked) -> tuple[int, Array] | None:
        """After a gap: the best matched clone and odom_from_body (4, 4) as vision measured it since then."""
        assert self._filter is not None
        best = next((e for e in tracked.earlier if e.frame_index in self._filter.clone_ids), None)
        if best is None:
            return None
        now = self._filter.odom_from_clone(best.frame_index) @ self._body_from_cam @ se3_inverse(best.cam_from_earlier)
        return best.frame_index, np.asarray(now @ self._cam_from_body)

    def _doubt(self, tracked: Tracked) -> None:
        assert self._filter is not None
        seen = self._seen_body(tracked)
        if seen is not None:
            self._filter.inflate(seen[0], seen[1], (self._state_ns - self._clone_stamps[seen[0]]) * 1e-9)

    def _apply_zero_velocity(self, tracked: Tracked) -> None:
        """Zero velocity and turn where for a while neither pictures nor IMU moved."""
        assert self._filter is not None
        assert self._real_noise is not None
        now_ns = self._state_ns
        still = self._still.since(now_ns, tracked.ids, tracked.pixels)
        if still is None:
            return
        window, since = self._imu.between(still[0], now_ns), self._imu.between(still[1], now_ns)
        if len(window) < 20 or not len(since) or not is_steady(window, self._settings.start):
            return
        duration_s = (now_ns - still[1]) * 1e-9
        sigma_radps = self._real_noise.gyro_noise_radps_rthz / np.sqrt(duration_s)
        self._filter.zero_velocity_update(since.gyro_radps.mean(axis=0), float(sigma_radps), _GATE_6)

    def _feel_wheels(self) -> None:
        assert self._filter is not None
        if not self._wheel:
            return
        stamps = np.array([sample.stamp_ns for sample in self._wheel])
        nearest = int(np.abs(stamps - self._state_ns).argmin())
        sample = self._wheel[nearest]
        around = self._imu.between(sample.stamp_ns - 5_000_000, sample.stamp_ns + 5_000_001)
        self._wheel = [s for s in self._wheel if s.stamp_ns > self._state_ns]
        if abs(sample.stamp_ns - self._state_ns) <= _WHEEL_REACH_NS and len(around):
            self._filter.roll(sample, around.gyro_radps.mean(axis=0), self._base_from_body, _GATE_4)

    def _remember(self, tracked: Tracked) -> None:
        for earlier in tracked.earlier:
            self._observations.add(earlier.frame_index, earlier.ids, earlier.pixels)
        self._observations.add(self._frame_index, tracked.ids, tracked.pixels)
        self._newest = (tracked.ids, tracked.pixels)
        self._newest_depth_m = self._depth_of(tracked.pixels)

    def _consume(self, tracked: Tracked) -> NDArray[np.int8]:
        """Uses tracks that ended, that are due in their turn, or (after a gap) all.

        Every observation serves exactly once.
        """
        assert self._filter is not None
        settings = self._settings.filter
        chunk = settings.chunk_frames if self._inertial else settings.chunk_frames_without_imu
        due = (self._frame_index + tracked.ids) % chunk == 0
        held = np.array(self._filter.clone_ids)
        chosen = self._observations.take(tracked.ids, held, due | tracked.by_descriptors, self._camera)
        seen = self._seen_body(tracked)
        if seen is None:
            return self._filter.update(chosen, iterations=1 if self._inertial else 4)
        return self._filter.update(
            chosen, 4, newest_odom_from_body=seen[1], sigma_scale=settings.descriptor_sigma_scale
        )

    def _prune(self) -> None:
        """Drops the second newest clone where the robot hardly moved since the one before, else the oldest."""
        assert self._filter is not None
        settings = self._settings.filter
        self._merged.clear()
        while len(self._filter.clone_ids) >= settings.clones:
            ids = self._filter.clone_ids
            earlier, candidate = self._filter.odom_from_clone(ids[-3]), self._filter.odom_from_clone(ids[-2])
            moved = se3_inverse(earlier) @ candidate
            angle = np.arccos(np.clip(0.5 * (np.trace(moved[:3, :3]) - 1), -1, 1))
            parallax = float(np.linalg.norm(moved[:3, 3])) / self._scene_depth_m()
            still = angle < settings.keyframe_rotation_rad and parallax < settings.keyframe_parallax
            gone = ids[-2] if still else ids[0]
            if still:
                self._merged[gone] = ids[-3], moved
            self._filter.remove_clone(gone)
            self._clone_stamps.pop(gone, None)

    def _scene_depth_m(self) -> float:
        return self._newest_depth_m

    def _depth_of(self, pixels: Array) -> float:
        disparities = pixels[:, 0] - pixels[:, 2]
        known = disparities[np.isfinite(disparities)]
        return self._camera.focal_px * self._camera.baseline_m / middle(known) if len(known) else 5.0

    def _estimate(
        self, stamp_ns: int, tracked: Tracked, used: NDArray[np.int8], change: Array | None
    ) -> OdometryEstimate:
        assert self._filter is not None
        state = self._filter.state
        lost = self._frame_index > 0 and tracked.lost
        waiting = self._noise is not None and not self._inertial
        status = (
            OdometryStatus.DEGRADED if lost else OdometryStatus.INITIALISING if waiting else OdometryStatus.TRACKING
        )
        taken = int((used == 1).sum())
        share = taken / len(used) if len(used) else tracked.inlier_share
        return OdometryEstimate(
            stamp_ns=stamp_ns,
            frame_index=self._frame_index,
            odom_from_body=state.odom_from_body,
            cov_rot_trans=self._filter.body_covariance(),
            velocity_odom_mps=state.velocity_mps.copy(),
            gyro_bias_radps=state.gyro_bias_radps.copy(),
            accel_bias_mps2=state.accel_bias_mps2.copy(),
            status=status,
            track_ids=tracked.ids,
            scene_depth_m=self._scene_depth_m(),
            inlier_share=share,
            after_gap=tracked.by_descriptors,
            inertial=self._inertial,
            new_odom_from_old_odom=change,
            imu_minus_cam_s=self._offset_s + self._filter.imu_minus_cam_s if self._inertial else 0.0,
        )


def _widened(noise: ImuNoise, settings: FilterSettings) -> ImuNoise:
    return replace(
        noise,
        gyro_noise_radps_rthz=noise.gyro_noise_radps_rthz * settings.gyro_noise_scale,
        accel_noise_mps2_rthz=noise.accel_noise_mps2_rthz * settings.accel_noise_scale,
    )
