"""Protection level of the published pose: what its error exceeds with at most a stated probability. Pure.

It reads the tracker, its fixes and the calibration's state; no estimate and no status depends on it. Method: docs/warranty.md.
"""

from dataclasses import replace
from math import log

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, length, se3_inverse, transform_points
from fleetmap.messages import Status
from fleetmap.pnp.pnp import REFINEMENT
from locclient.localization.alias_disambiguation import is_other_viewpoint
from locclient.localization.calibration.parameters import DRIFT_SIGMAS, HEIGHT, PARAMETERS, TILT, TIME_OFFSET
from locclient.localization.estimate import Estimate
from locclient.localization.place import ORIGIN
from locclient.localization.pose_tracker import PoseTracker, QueryResult
from locclient.localization.settings import TrackSettings

# Share of other places that match as one look does: of a map whose build did not measure it, and the least, since views of one rack are
# not independent. One that matches twice as well counts as two looks at most, by an exponential tail. Of starts, those beside the map.
_WRONG_SHARE, _LEAST_SHARE, _MOST_LOOKS, _OUTSIDE_SHARE = 0.05, 0.02, 2.0, 0.05
_LOOK_M = 0.5  # between looks
_LOW_M, _FEW_SHARE, _EVEN_SHARE = 1.0, 0.1, 0.8  # above the base; of all in view; of the share found
_MOVED_SIGMAS = 3.0  # of a parameter of the mounting, from which on it counts
_MOUNTING = PARAMETERS[TILT.start : HEIGHT]


def middle_of(points_map: Array, map_from_cam: Array) -> Array:
    """Return the medians (3,) of x / z, y / z and z, in the camera, of the points (N, 3) before it; zero without any."""
    x, y, z = transform_points(se3_inverse(map_from_cam), points_map).T
    places = np.array([x, y, z * z])[:, z > 0.0] / z[z > 0.0]
    return np.median(places, axis=1) if places.size else np.zeros(3)


def is_even(due_map: Array, found: int, base_z_m: float) -> bool:
    """Return False if of points (N, 3) that should be in view, the first ones found, low or high ones were missed much more than all."""
    low, is_found = due_map[:, 2] < base_z_m + _LOW_M, np.arange(len(due_map)) < found
    halves = [is_found[half] for half in (low, ~low) if half.mean() > _FEW_SHARE]
    return all(half.mean() > _EVEN_SHARE * is_found.mean() for half in halves)


class ProtectionMonitor:
    """Protection levels of a localizer's estimates, by a bank of filters of which each never used some of the measurements.

    A bank begins with the first fix of a confirmed pose and ends with that pose. Fixes from one viewpoint share their errors: the bank
    uses the first of them. The log odds that the robot is here, and not at a place that looks the same, grow with each other look.
    """

    def __init__(self, tracker: PoseTracker, settings: TrackSettings) -> None:
        self._tracker, self._settings = tracker, settings
        self._base_point = np.ascontiguousarray(se3_inverse(tracker.base_from_body)[:3, 3])  # in the body
        self.has_wheels = False
        self._reset()
        tracker.on_restart.append(self._reset)

    def _reset(self) -> None:
        self._bank, self._log_odds, self._fix_ns, self._tracker.followed = core.ProtectionBank(), 0.0, 0, None
        self._is_refused = False  # the last fix contradicts the pose
        self._cov_map = np.zeros((6, 6))  # of the map's own error at the last fix

    def handle(self, result: QueryResult) -> None:
        """Use the map query that finished with this frame, if any did."""
        tracker, settings, fix, way = self._tracker, self._settings, result.fix, self._tracker.followed
        confirmed, asked, stamp_ns = tracker.confirmed, tracker.asked, result.fix_stamp_ns
        if confirmed is None or way is None:  # all earlier evidence was of another pose
            self._reset()
        if confirmed is None or stamp_ns is None or asked is None:
            return
        lookalikes = tracker.maps.lookalikes
        share = _WRONG_SHARE if lookalikes is None else min(max(lookalikes.max_wrong_share, _LEAST_SHARE), 1.0)
        look = evidence = -log(share)
        if way is not None:
            evidence *= min(1.0, length(way.then.position_m) / _LOOK_M)
        if fix is None or fix.matched is None:
            self._is_refused |= result.innovation is not None
            self._log_odds -= 0.0 if way is None else evidence
            return
        place, self._fix_ns, self._is_refused = tracker.place_by(fix), stamp_ns, False
        self._cov_map = tracker.maps.map_cov(place)
        if way is not None and not is_other_viewpoint(way.then.map_from_body):
            self._bank.repeat()
            return
        matched, camera = fix.matched, fix.matched.camera
        measured = matched.points_source, matched.pixels, 1.0 / matched.sigmas_px
        others = [] if fix.covisible is None else [fix.covisible.points_map[~fix.covisible.is_found]]
        due = np.concatenate([matched.points_source, *others])  # should be in view
        middle = middle_of(due, place.map_from_body @ tracker.body_from_cam)
        points, pixels, weights = map(np.ascontiguousarray, measured)
        seen = points, pixels, weights, camera.lens, REFINEMENT, middle
        moved = map(np.ascontiguousarray, (ORIGIN if way is None else way.then)[:2])
        base_z_m = float((place.map_from_body[:3, :3] @ self._base_point)[2] + place.position_m[2])
        placed = place.map_from_body, tracker.body_from_cam, (camera.width_px, camera.height_px), base_z_m
        known = is_even(due, len(matched.points_source), base_z_m), 1e-9 * stamp_ns
        self._bank.update(*seen, *placed, *known, *moved)
        tracker.followed = asked
        looks = 1.0 if way is not None else min(confirmed.support, 1.0 + confirmed.travelled_m // _LOOK_M)
        if lookalikes is not None:
            is_telling = fix.landmark_recall > lookalikes.recall
            looks *= min(max(fix.inliers / max(lookalikes.inliers, 1.0), 1.0), _MOST_LOOKS) if is_telling else 0.0
        if way is None:
            self._log_odds = -log(_OUTSIDE_SHARE)
            if (prior := tracker.confirmed_by) is not None:
                self._log_odds -= log(settings.wrong_prior_share if prior.is_revisable else settings.protection_risk)
        # However much was seen before, as many failed looks as tell of a robot that was carried end the level.
        most = (settings.kidnap_fixes - 0.5) * look - log(settings.protection_risk)
        self._log_odds = min(self._log_odds + looks * evidence, most)

    def judged(self, estimate: Estimate) -> Estimate:
        """Return the estimate with its levels: infinite where no level holds."""
        tracker, settings, way = self._tracker, self._settings, self._tracker.followed
        map_from_body, confirmed, risk = estimate.map_from_body, tracker.confirmed, settings.protection_risk
        if estimate.status not in {Status.TRACKING, Status.DEGRADED} or map_from_body is None:
            return estimate
        if confirmed is None or way is None or confirmed.has_broken or confirmed.lost_imu:
            return estimate
        is_late = (estimate.stamp_ns - self._fix_ns) * 1e-9 > settings.degraded_after_s
        is_doubted = self._is_refused or any(h.speaks_against_others(settings) for h in tracker.candidates.hypotheses)
        if is_late or is_doubted or self._log_odds < -log(risk):
            return estimate
        here, since, cov_since = map(np.ascontiguousarray, (map_from_body, *way.now[:2]))
        cov_map = np.maximum(self._cov_map, tracker.maps.map_cov(confirmed.now))
        level_m, level_rad = self._bank.level(here, since, cov_since, cov_map, self._base_point, risk)
        drifts = [drift for drift in estimate.calibration.drifts if abs(drift.value) > _MOVED_SIGMAS * drift.sigma]
        moved = {drift.parameter: abs(drift.value) for drift in drifts}
        turned_rad = length(np.array([moved.get(parameter, 0.0) for parameter in _MOUNTING]))
        level_m += turned_rad * length(self._base_point) + moved.get(PARAMETERS[HEIGHT], 0.0)
        if self.has_wheels:  # whose stamps may be off by what the odometry does not find
            level_m += DRIFT_SIGMAS * TIME_OFFSET.least_sigma * length(estimate.odometry.velocity_odom_mps)
        if not level_m <= 0.5 * tracker.maps.alias_step_m:  # the next place that looks alike would be within
            return estimate
        return replace(estimate, protection_m=level_m, protection_deg=float(np.degrees(level_rad + turned_rad)))
