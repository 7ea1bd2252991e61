"""Figures of a robot's health report, collected frame by frame; distance driven without localization, and its cause. Pure."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fleetmap.failure_definition import FIND_DRIVING_S, is_blind, is_driving, is_usable, known_radius_m, radius_95_m
from fleetmap.messages import Cause, Flag, RobotHealth, Status
from fleetmap.sensors.samples import PAUSE_NS
from locclient.localization.estimate import Estimate
from locclient.robot.failure_monitor import failure_cause
from locclient.robot.robot import Outcome

_ENOUGH_M = 5.0  # of driving: tens of queries from different places, enough to localize a robot in its map
_OFF_MAP_WORDS = "the map has no tile where the robot believes to be: is its prior right, and the map of this building?"
_MAP_WORDS = (
    "nothing in the map agrees with the pictures: is it the map of this building, and is the calibration the camera's?"
)
_CAUSE_WORDS = {
    Cause.NO_MAP: "no map is loaded: the log says why; has the site a published version with tiles?",
    Cause.NO_MATCH: _MAP_WORDS,
    Cause.FIX_REFUSED: _MAP_WORDS,
    Cause.AMBIGUOUS: "several places of the map look alike: give it a prior",
    Cause.OVERLOADED: "most frames are dropped: this computer is too slow for them",
    Cause.ODOMETRY: "the odometry is lost: are camera and IMU connected, and is the calibration theirs?",
}


@dataclass
class SearchWay:
    """Path since a robot was last localized, tracking or with a fix and a usable position, or since its start.

    metres: by wheels or odometry; unknown_s: seconds of driving at unknown speed. seconds: total duration. was_found: localized before.
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
        """Count a frame, which represents the time since the previous one unless that was a pause."""
        dt_ns = 0 if self._last_ns is None else max(0, estimate.stamp_ns - self._last_ns)
        dt_s = dt_ns * 1e-9 if dt_ns <= PAUSE_NS else 0.0  # a speed does not hold for a whole pause
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
        """True once a robot in its map would have been localized."""
        return self.metres >= _ENOUGH_M or self.unknown_s >= FIND_DRIVING_S

    @property
    def is_off_map(self) -> bool:
        """True if the robot knows that the map does not cover most of this path."""
        return bool(self._causes) and self._causes.most_common(1)[0][0] == _OFF_MAP_WORDS

    @property
    def is_lost_run(self) -> bool:
        """True if a run that ends here was not localized: never, or not any more for more than half of its frames."""
        is_most = self._lost_frames > self._frames / 2 and not self.is_off_map
        return self.is_long and (is_most or not self.was_found)

    @property
    def words(self) -> str:
        """Return a text for users, empty while the robot is localized or was until recently."""
        way = f"{self.metres:.1f} m" + (
            f" and {self.unknown_s:.0f} s at an unknown speed" if self.unknown_s >= 1 else ""
        )
        if self.is_long:
            return f"not localized over {way}: {self._causes.most_common(1)[0][0]}"
        if self.was_found or not self._frames:
            return ""
        return (
            f"no frame was localized, but {way} in {self.seconds:.1f} s are too short to say why: drive {_ENOUGH_M:g} m"
        )


_RECENT = 300
Figure = float | int | str | bool | None


class FixFigures:
    """Figures of HEALTH_FIGURES from fixes, docks and odometry; the largest since the last report.

    Errors in metres count only while TRACKING: a robot that reports LOST and is found elsewhere was not wrong. A claimed pose
    disproved by later fixes beyond its covariance counts as well.
    """

    def __init__(self) -> None:
        self._expected = self._seen = 0
        self._largest: dict[str, float] = {}
        self._last: Estimate | None = None
        self._speed_mps: float | None = None

    def handle(self, estimate: Estimate, dock_error_m: float | None, speed_mps: float | None = None) -> None:
        self._speed_mps = speed_mps
        was_tracking = self._last is not None and self._last.status is Status.TRACKING
        self._last = estimate
        self._note("fix_innovation", estimate.innovation)
        self._note("fix_innovation_m", estimate.innovation_m if was_tracking else None)
        self._note("fix_innovation_m", estimate.moved_m)
        self._note("dock_error_m", dock_error_m)
        if estimate.fix is not None:
            self._expected += estimate.fix.expected
            self._seen += estimate.fix.seen

    def take(self) -> dict[str, Figure]:
        """Return the figures of a report, and reset the largest values."""
        figures: dict[str, Figure] = {
            name: self._largest.get(name) for name in ("fix_innovation", "fix_innovation_m", "dock_error_m")
        }
        self._largest = {}
        figures |= {"landmarks_expected": self._expected, "landmarks_seen": self._seen}
        if self._last is not None:
            figures["speed_mps"] = self._speed_mps
            figures["radius_95_m"] = known_radius_m(self._last.cov_rot_trans)
        return figures

    def _note(self, name: str, value: float | None) -> None:
        if value is not None:
            self._largest[name] = max(self._largest.get(name, 0.0), float(value))


class HealthFigures:
    """Counts since the start, and durations of the last frames."""

    def __init__(self) -> None:
        self._all_frames = self._frames = self._localised = self.failures = 0
        self._frame_ms: deque[float] = deque(maxlen=_RECENT)
        self._first_ns: int | None = None
        self._first_fix_s: float | None = None
        self._first_frame_ms: float | None = None
        self._fixes = FixFigures()
        self.last: Outcome | None = None  # the last frame
        self.search = SearchWay()

    def handle(self, outcome: Outcome) -> None:
        estimate = outcome.estimate
        self.last = outcome
        self._frame_ms.append(1e3 * outcome.cpu_s)
        if self._first_ns is None:
            self._first_ns, self._first_frame_ms = estimate.stamp_ns, 1e3 * outcome.cpu_s
        if estimate.fix is not None and self._first_fix_s is None:
            self._first_fix_s = (estimate.stamp_ns - self._first_ns) * 1e-9
        self._all_frames += 1
        self._frames += self._first_fix_s is not None
        self._localised += estimate.status is Status.TRACKING
        self._fixes.handle(estimate, outcome.dock_error_m, outcome.speed_mps)
        self.search.handle(estimate, outcome.speed_mps, may_be_mapped=outcome.may_be_mapped)

    def report(self, site: str, robot: str, wall_ns: int, more: Mapping[str, Figure], silent: bool) -> RobotHealth:
        """Return the message; more: figures of other parts. silent: True if the source has stopped sending frames."""
        last = None if self.last is None else self.last.estimate
        flags: list[Flag | Cause] = [Cause.NO_FRAMES] if silent else []
        figures: dict[str, Figure] = {
            "localised_share_of_all": self._localised / self._all_frames if self._all_frames else None,
            "localised_share": self._localised / self._frames if self._frames else None,
            "first_fix_s": self._first_fix_s,
            "first_frame_ms": self._first_frame_ms,
            "frame_ms_mean": float(np.mean(self._frame_ms)) if self._frame_ms else None,
            "frame_ms_p99": float(np.percentile(self._frame_ms, 99)) if self._frame_ms else None,
            "failures": self.failures,
            **self._fixes.take(),
        }
        if last is not None:
            figures["exposure"], figures["sharpness"] = last.image.exposure, last.image.sharpness
            figures |= last.calibration.figures
            figures |= {"views": last.views_in_words} if last.views_in_words else {}
            flags += [Cause.CALIBRATION] if last.calibration.is_wrong else []
            flags += [Flag.BLIND] if is_blind(last.status, radius_95_m(last.cov_rot_trans)) else []
            flags += [last.image.cause] if last.image.cause else []
            flags += [] if self.last is None or self.last.may_be_mapped else [Flag.OFF_MAP]
            flags += [Flag.NOT_LOCALISED] if self.search.is_long and not self.search.is_off_map else []
            flags += [Cause.NO_MAP] if last.map_version is None else []
            figures["not_localised_m"] = self.search.metres
            figures["frames_dropped_share"] = 0.0 if self.last is None else self.last.dropped_share
            flags += [] if self.last is None else self.last.left_out
            figures |= {"floor": last.floor} if last.floor else {}
        return RobotHealth(
            site=site,
            robot=robot,
            stamp_ns=0 if last is None else last.stamp_ns,
            wall_ns=wall_ns,
            version=last.map_version if last is not None and last.is_at_home else None,
            status=Status.INITIALISING if last is None else last.status,
            flags=tuple(flags),
            metrics={**figures, **more},
        )
