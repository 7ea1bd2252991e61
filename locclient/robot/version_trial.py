"""Trial of a new map version before it replaces the one that a robot runs. Pure."""

from enum import StrEnum

import numpy as np

from fleetmap.config import Section
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Status
from locclient.localization.estimate import Estimate

_DRIFT_SHARE = 0.02  # of the distance travelled, several times the odometry's drift


class TrialSettings(Section, frozen=True):
    """Limits at which a new version is confirmed or given up."""

    confirming_fixes: int = 5
    contradicting_looks: int = 2
    agreement_m: float = 0.3
    patience_s: float = 20.0
    retry_s: float = 600.0


class TrialVerdict(StrEnum):
    """Result of a trial so far."""

    UNDECIDED = "UNDECIDED"
    CONFIRMED = "CONFIRMED"
    FAILED = "FAILED"


class VersionTrial:
    """Counts the fixes of one version, from the first frame that is compared with it.

    A fix confirms the version where the robot tracks and is where the version before and the odometry since predict. A refused fix
    contradicts it; so does a pose somewhere else, which ends the trial at once, before the localizer could conclude that the robot
    was carried there. Time in which nothing can be seen counts against no version: the caller then tries the other one.
    """

    def __init__(self, settings: TrialSettings, begun: Estimate) -> None:
        self._settings, self._begun_ns = settings, begun.stamp_ns
        self._map_from_odom: Array | None = None
        if begun.map_from_body is not None and begun.status is Status.TRACKING:
            self._map_from_odom = begun.map_from_body @ se3_inverse(begun.odometry.odom_from_body)
        self._last_m = begun.odometry.odom_from_body[:3, 3]
        self._path_m = 0.0
        self._fixes = self._contradictions = 0
        self.reason = "no frame was compared with it"

    def handle(self, estimate: Estimate) -> TrialVerdict:
        """The verdict with this frame; `reason` tells why, in words."""
        off_m = self._off_m(estimate)
        limit_m = self._settings.agreement_m + _DRIFT_SHARE * self._path_m
        age_s = (estimate.stamp_ns - self._begun_ns) * 1e-9
        if estimate.fix is not None and estimate.status is Status.TRACKING and off_m <= limit_m:
            self._fixes += 1
        elif estimate.fix is None and estimate.innovation is not None:
            self._contradictions += 1
        self.reason = f"{self._fixes} fixes and {self._contradictions} that contradict it in {age_s:.0f} s"
        if off_m > limit_m and estimate.status is Status.TRACKING:
            self.reason = f"it puts the robot {off_m:.1f} m from where it was"
            return TrialVerdict.FAILED
        if self._contradictions >= self._settings.contradicting_looks and self._contradictions > self._fixes:
            return TrialVerdict.FAILED
        if self._fixes >= self._settings.confirming_fixes:
            return TrialVerdict.CONFIRMED
        return TrialVerdict.FAILED if age_s > self._settings.patience_s else TrialVerdict.UNDECIDED

    def _off_m(self, estimate: Estimate) -> float:
        """Distance from the initial pose as propagated by odometry; 0 where either is unknown."""
        odometry = estimate.odometry
        if odometry.new_odom_from_old_odom is not None:
            change = odometry.new_odom_from_old_odom
            self._last_m = change[:3, :3] @ self._last_m + change[:3, 3]
            if self._map_from_odom is not None:
                self._map_from_odom = self._map_from_odom @ se3_inverse(change)
        self._path_m += float(np.linalg.norm(odometry.odom_from_body[:3, 3] - self._last_m))
        self._last_m = odometry.odom_from_body[:3, 3]
        if self._map_from_odom is None or estimate.map_from_body is None:
            return 0.0
        predicted = self._map_from_odom @ odometry.odom_from_body
        return float(np.linalg.norm(estimate.map_from_body[:3, 3] - predicted[:3, 3]))
