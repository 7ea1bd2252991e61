"""Whether a new map version may replace the one that a robot runs. Pure."""

from enum import StrEnum

from fleetmap.config import Section
from locclient.localizer import Estimate, Status


class TrialSettings(Section, frozen=True):
    """When a new version is believed, and when it is given up."""

    confirming_fixes: int = 5
    patience_s: float = 20.0
    retry_s: float = 600.0


class Verdict(StrEnum):
    """What a trial has come to."""

    UNDECIDED = "UNDECIDED"
    CONFIRMED = "CONFIRMED"
    FAILED = "FAILED"


class VersionTrial:
    """Fixes that one version gives, counted from the moment it came into use, frame after frame.

    Only fixes of a tracking robot count: they agreed with where the odometry, and so the version before, says that it is. Time in
    which nothing could be seen by any version counts against none: it is the caller who compares with the other version.
    """

    def __init__(self, settings: TrialSettings, begun_ns: int) -> None:
        self._settings = settings
        self._begun_ns = begun_ns
        self._fixes = 0

    @property
    def fixes(self) -> int:
        """Fixes so far."""
        return self._fixes

    def handle(self, estimate: Estimate) -> Verdict:
        """The verdict with this frame."""
        if estimate.fix is not None and estimate.status is Status.TRACKING:
            self._fixes += 1
        if self._fixes >= self._settings.confirming_fixes:
            return Verdict.CONFIRMED
        late = (estimate.stamp_ns - self._begun_ns) * 1e-9 > self._settings.patience_s
        return Verdict.FAILED if late else Verdict.UNDECIDED
