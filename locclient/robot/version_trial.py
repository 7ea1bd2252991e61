"""Trial of a new map version before it replaces the one that a robot runs. Pure."""

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from fleetmap.config import Section
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Status, WantedVersion
from locclient.localization.estimate import Estimate
from locclient.maps.loaded_map import LoadedMap

_DRIFT_SHARE = 0.02  # of the distance travelled, several times the odometry's drift


class TrialSettings(Section, frozen=True):
    """Limits for the confirmation or rejection of a new version."""

    confirming_fixes: int = 5
    contradicting_looks: int = 2
    agreement_m: float = 0.3
    patience_s: float = 20.0
    retry_s: float = 600.0


class Change(StrEnum):
    """Result of a version's trial."""

    ADOPTED = "adopted"
    REFUSED = "refused"
    POSTPONED = "postponed"


class VersionChange(NamedTuple):
    """A version that was adopted, refused for good, or postponed because of unusable images; reason: text."""

    wanted: WantedVersion
    change: Change
    reason: str = ""


class VersionTrial:
    """Counts the fixes of one version, from the first frame compared with it.

    A fix confirms the version if the robot tracks and is at the pose predicted by the previous version and odometry. A refused fix
    contradicts it; so does a pose elsewhere, which ends the trial at once, before the localizer could conclude that the robot was
    carried. Time without usable images counts against no version: the caller then tries the other one.
    """

    def __init__(self, settings: TrialSettings, begun: Estimate, odom_from_body: Array) -> None:
        """odom_from_body (4, 4): of the same frame, in an odometry frame that is not redefined once the robot is localized."""
        self._settings, self._begun_ns = settings, begun.stamp_ns
        self._map_from_odom: Array | None = None
        if begun.map_from_body is not None and begun.status is Status.TRACKING:
            self._map_from_odom = begun.map_from_body @ se3_inverse(odom_from_body)
        self._last_m = odom_from_body[:3, 3]
        self._path_m = 0.0
        self._fixes = self._contradictions = 0
        self.reason = "no frame was compared with it"

    def handle(self, estimate: Estimate, odom_from_body: Array) -> bool | None:
        """Return whether the version is confirmed or has failed with this frame, None while undecided; `reason` has its text."""
        off_m = self._off_m(estimate, odom_from_body)
        limit_m = self._settings.agreement_m + _DRIFT_SHARE * self._path_m
        age_s = (estimate.stamp_ns - self._begun_ns) * 1e-9
        if estimate.fix is not None and estimate.status is Status.TRACKING and off_m <= limit_m:
            self._fixes += 1
        elif estimate.fix is None and estimate.innovation is not None:
            self._contradictions += 1
        self.reason = f"{self._fixes} fixes and {self._contradictions} that contradict it in {age_s:.0f} s"
        if off_m > limit_m and estimate.status is Status.TRACKING:
            self.reason = f"it puts the robot {off_m:.1f} m from where it was"
            return False
        if self._contradictions >= self._settings.contradicting_looks and self._contradictions > self._fixes:
            return False
        if self._fixes >= self._settings.confirming_fixes:
            return True
        return False if age_s > self._settings.patience_s else None

    def _off_m(self, estimate: Estimate, odom_from_body: Array) -> float:
        """Return the distance from the initial pose as propagated by odometry; 0 if either is unknown."""
        self._path_m += float(np.linalg.norm(odom_from_body[:3, 3] - self._last_m))
        self._last_m = odom_from_body[:3, 3]
        if self._map_from_odom is None or estimate.map_from_body is None:
            return 0.0
        return float(np.linalg.norm(estimate.map_from_body[:3, 3] - (self._map_from_odom @ odom_from_body)[:3, 3]))


class VersionTrials:
    """Two versions while one of them is on trial.

    good: the confirmed version; candidate: the one on trial. If the candidate fails, the good version is tried again at the same
    place: the candidate is refused if that gives fixes, else postponed. changes: since the caller last cleared them.
    """

    def __init__(self, settings: TrialSettings, show: Callable[[LoadedMap], None]) -> None:
        """show: gives a version to the localizer."""
        self._settings, self._show = settings, show
        self._good: LoadedMap | None = None
        self._candidate: LoadedMap | None = None
        self._trial: VersionTrial | None = None
        self._failed_reason: str | None = None  # of the candidate, while the good version is tried again
        self._last: tuple[Estimate, Array] | None = None
        self.changes: list[VersionChange] = []

    @property
    def held(self) -> list[LoadedMap]:
        """Return the versions in memory, the confirmed one first."""
        return [loaded for loaded in (self._good, self._candidate) if loaded is not None]

    @property
    def running(self) -> LoadedMap | None:
        return self._good if self._candidate is None or self._failed_reason is not None else self._candidate

    def use(self, loaded: LoadedMap) -> None:
        """Use other tiles of a held version, or a new version."""
        if self._good is not None and self._good.wanted == loaded.wanted:
            self._good = loaded
        elif self._candidate is not None and self._candidate.wanted == loaded.wanted:
            self._candidate = loaded
        elif not loaded.is_offer:
            return  # the version was given up while its tiles were read
        elif self._good is None:
            self._good = loaded
            self.changes.append(VersionChange(loaded.wanted, Change.ADOPTED))
        else:
            self._candidate, self._failed_reason = loaded, None
            self._begin_trial()
        if self.running is loaded:
            self._show(loaded)

    def handle(self, estimate: Estimate, odom_from_body: Array) -> None:
        """Count a frame for the trial, if there is one; odom_from_body as of `VersionTrial`."""
        self._last = estimate, odom_from_body
        if self._candidate is None or self._good is None:
            return
        if self._trial is None:
            self._begin_trial()
        assert self._trial is not None
        is_confirmed = self._trial.handle(estimate, odom_from_body)
        if is_confirmed is None:
            return
        if self._failed_reason is not None:
            failed = f"of version {self._candidate.version} {self._failed_reason}"
            good = f"version {self._good.version}"
            change = Change.REFUSED if is_confirmed else Change.POSTPONED
            none = f"{failed}, and {good} gives no fixes either; it is tried again later"
            reason = f"{failed}, where {good} gives fixes" if is_confirmed else none
            self.changes.append(VersionChange(self._candidate.wanted, change, reason))
        elif is_confirmed:
            self.changes.append(VersionChange(self._candidate.wanted, Change.ADOPTED))
            self._good = self._candidate
        else:
            self._failed_reason = self._trial.reason
            self._show(self._good)
            self._begin_trial()
            return
        self._candidate = self._trial = self._failed_reason = None

    def pause(self) -> None:
        """Interrupt a trial while the robot is in another site's map; it begins again on its own."""
        self._last = self._trial = None

    def _begin_trial(self) -> None:
        """Begin the trial at the last frame of the previous version; without one, at the next frame."""
        self._trial = None if self._last is None else VersionTrial(self._settings, *self._last)
