"""How far a robot has driven without finding itself, and why. Pure."""

from collections import Counter
from dataclasses import dataclass, field

from fleetmap.failure_definition import FIND_DRIVING_S, is_driving, is_usable, radius_95_m
from fleetmap.messages import Cause, Status
from fleetmap.sensors.samples import PAUSE_NS
from locclient.localization.estimate import Estimate
from locclient.robot.failure_monitor import failure_cause

_ENOUGH_M = 5.0  # of driving: tens of looks from places apart, any of which finds a robot that drives in its map
_OFF_MAP_WORDS = "the map has no tile where the robot believes to be: is its prior right, and the map of this building?"
_MAP_WORDS = (
    "nothing in the map agrees with the pictures: is it the map of this building, and is the calibration the camera's?"
)
_CAUSE_WORDS = {
    Cause.NO_MAP: "no map is loaded: the log says why; has the site a published version with tiles?",
    Cause.NO_MATCH: _MAP_WORDS,
    Cause.FIX_REFUSED: _MAP_WORDS,
    Cause.AMBIGUOUS: "several places of the map look alike: give it a prior",
    Cause.ODOMETRY: "the odometry is lost: are camera and IMU connected, and is the calibration theirs?",
}


@dataclass
class SearchWay:
    """The way since a robot was last found, tracking or with a fix and a usable position, or since its start.

    metres: by wheels or odometry; unknown_s: seconds of driving whose speed neither knows. seconds: all of its duration. was_found: ever.
    """

    metres: float = 0.0
    unknown_s: float = 0.0
    seconds: float = 0.0
    was_found: bool = False
    _frames: int = 0
    _lost_frames: int = 0
    _causes: Counter[str] = field(default_factory=Counter)
    _last_ns: int | None = None

    def handle(self, estimate: Estimate, speed_mps: float | None, *, may_be_mapped: bool) -> None:
        """Counts a frame, which speaks for the time since the one before unless that was a pause."""
        dt_ns = 0 if self._last_ns is None else max(0, estimate.stamp_ns - self._last_ns)
        dt_s = dt_ns * 1e-9 if dt_ns <= PAUSE_NS else 0.0  # no speed is that of a whole pause
        self._last_ns = estimate.stamp_ns
        self._frames += 1
        is_fixed = estimate.fix is not None and is_usable(estimate.status, radius_95_m(estimate.cov_rot_trans))
        if estimate.status is Status.TRACKING or is_fixed:
            self.metres = self.unknown_s = self.seconds = 0.0
            self.was_found = True
            self._causes.clear()
            return
        self._lost_frames += 1
        self.seconds += dt_s
        if speed_mps is None:
            self.unknown_s += dt_s
        elif is_driving(speed_mps):
            self.metres += abs(speed_mps) * dt_s
        cause = failure_cause(estimate)
        words = _CAUSE_WORDS.get(
            cause,
            f"most pictures look {cause}: see to the camera; if it is well, is the map of this building?",
        )
        self._causes[words if may_be_mapped else _OFF_MAP_WORDS] += 1

    @property
    def is_long(self) -> bool:
        """True once a robot in its map would have found itself."""
        return self.metres >= _ENOUGH_M or self.unknown_s >= FIND_DRIVING_S

    @property
    def is_off_map(self) -> bool:
        """True if the robot knows that the map does not cover most of this way."""
        return bool(self._causes) and self._causes.most_common(1)[0][0] == _OFF_MAP_WORDS

    @property
    def is_lost_run(self) -> bool:
        """True if a run that ends here did not find itself: not once, or no longer for more than half of its frames."""
        is_most = self._lost_frames > self._frames / 2 and not self.is_off_map
        return self.is_long and (is_most or not self.was_found)

    @property
    def words(self) -> str:
        """What a user should know, empty while the robot is found or has been until just now."""
        way = f"{self.metres:.1f} m" + (
            f" and {self.unknown_s:.0f} s at an unknown speed" if self.unknown_s >= 1 else ""
        )
        if self.is_long:
            return f"not localised over {way}: {self._causes.most_common(1)[0][0]}"
        if self.was_found or not self._frames:
            return ""
        return (
            f"no frame was localised, but {way} in {self.seconds:.1f} s are too short to say why: drive {_ENOUGH_M:g} m"
        )
