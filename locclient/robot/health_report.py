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

Figure = float | int | str | bool | None
_RECENT = 300  # frames
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
    frames: number of all, also before.
    """

    metres: float = 0.0
    unknown_s: float = 0.0
    seconds: float = 0.0
    was_found: bool = False
    frames: int = 0
    _lost_frames: int = 0
    _causes: Counter[str] = field(default_factory=Counter)
    _last_ns: int | None = None

    def handle(self, estimate: Estimate, speed_mps: float | None, *, may_be_mapped: bool) -> None:
        """Count a frame, which represents the time since the previous one unless that was a pause."""
        dt_ns = 0 if self._last_ns is None else max(0, estimate.stamp_ns - self._last_ns)
        dt_s = dt_ns * 1e-9 if dt_ns <= PAUSE_NS else 0.0  # a speed does not hold for a whole pause
        self._last_ns = estimate.stamp_ns
        self.frames += 1
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
        look = f"most pictures look {cause}: see to the camera; if it is well, is the map of this building?"
        words = _CAUSE_WORDS.get(cause, look)
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
        is_most = self._lost_frames > self.frames / 2 and not self.is_off_map
        return self.is_long and (is_most or not self.was_found)

    @property
    def words(self) -> str:
        """Return a text for users, empty while the robot is localized or was until recently."""
        unknown = f" and {self.unknown_s:.0f} s at an unknown speed" if self.unknown_s >= 1 else ""
        way = f"{self.metres:.1f} m{unknown}"
        if self.is_long:
            return f"not localized over {way}: {self._causes.most_common(1)[0][0]}"
        if self.was_found or not self.frames:
            return ""
        return (
            f"no frame was localized, but {way} in {self.seconds:.1f} s are too short to say why: drive {_ENOUGH_M:g} m"
        )


class HealthFigures:
    """Counts since the start, durations of the last frames, and the largest errors since the last report.

    Errors in metres count only while TRACKING: a robot that reports LOST and is found elsewhere was not wrong. A claimed pose
    disproved by later fixes beyond its covariance counts as well.
    """

    def __init__(self) -> None:
        self._frames = self._localised = self.failures = 0
        self._expected = self._seen = 0  # landmarks
        self._frame_ms: deque[float] = deque(maxlen=_RECENT)
        self._first_ns: int | None = None
        self._first_fix_s: float | None = None
        self._first_frame_ms: float | None = None
        self._largest: dict[str, float] = {}
        self.last: Outcome | None = None  # the last frame
        self.search = SearchWay()

    def handle(self, outcome: Outcome) -> None:
        estimate, last = outcome.estimate, self.last
        self.last = outcome
        self._frame_ms.append(1e3 * outcome.cpu_s)
        if self._first_ns is None:
            self._first_ns, self._first_frame_ms = estimate.stamp_ns, 1e3 * outcome.cpu_s
        if estimate.fix is not None:
            if self._first_fix_s is None:
                self._first_fix_s = (estimate.stamp_ns - self._first_ns) * 1e-9
            self._expected += estimate.fix.expected
            self._seen += estimate.fix.seen
        self._frames += self._first_fix_s is not None
        self._localised += estimate.status is Status.TRACKING
        was_tracking = last is not None and last.estimate.status is Status.TRACKING
        for name, value in (
            ("fix_innovation", estimate.innovation),
            ("fix_innovation_m", estimate.innovation_m if was_tracking else None),
            ("fix_innovation_m", estimate.moved_m),
            ("dock_error_m", outcome.dock_error_m),
        ):
            if value is not None:
                self._largest[name] = max(self._largest.get(name, 0.0), float(value))
        self.search.handle(estimate, outcome.speed_mps, may_be_mapped=outcome.may_be_mapped)

    def report(self, site: str, robot: str, wall_ns: int, more: Mapping[str, Figure], silent: bool) -> RobotHealth:
        """Return the message, and reset the largest errors; more: figures of other parts. silent: True if the source has stopped sending
        frames."""
        outcome, largest = self.last, self._largest
        self._largest = {}
        flags: list[Flag | Cause] = [Cause.NO_FRAMES] if silent else []
        figures: dict[str, Figure] = {
            "localised_share_of_all": self._localised / self.search.frames if self.search.frames else None,
            "localised_share": self._localised / self._frames if self._frames else None,
            "first_fix_s": self._first_fix_s,
            "first_frame_ms": self._first_frame_ms,
            "frame_ms_mean": float(np.mean(self._frame_ms)) if self._frame_ms else None,
            "frame_ms_p99": float(np.percentile(self._frame_ms, 99)) if self._frame_ms else None,
            "failures": self.failures,
            **{name: largest.get(name) for name in ("fix_innovation", "fix_innovation_m", "dock_error_m")},
            "landmarks_expected": self._expected,
            "landmarks_seen": self._seen,
        }
        last = None if outcome is None else outcome.estimate
        if outcome is not None:
            more = {**self._figures_of(outcome), **more}
            flags += self._flags_of(outcome)
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

    def _figures_of(self, outcome: Outcome) -> dict[str, Figure]:
        last = outcome.estimate
        named = {"views": last.views_in_words, "floor": last.floor}
        return {
            "speed_mps": outcome.speed_mps,
            "radius_95_m": known_radius_m(last.cov_rot_trans),
            **last.protection,
            "exposure": last.image.exposure,
            "sharpness": last.image.sharpness,
            **last.calibration.figures,
            "not_localised_m": self.search.metres,
            "frames_dropped_share": outcome.dropped_share,
            **{name: text for name, text in named.items() if text},
        }

    def _flags_of(self, outcome: Outcome) -> list[Flag | Cause]:
        last = outcome.estimate
        known: tuple[tuple[Flag | Cause, bool], ...] = (
            (Cause.CALIBRATION, last.calibration.is_wrong),
            (Flag.BLIND, is_blind(last.status, radius_95_m(last.cov_rot_trans))),
            (last.image.cause, bool(last.image.cause)),
            (Flag.OFF_MAP, not outcome.may_be_mapped),
            (Flag.NOT_LOCALISED, self.search.is_long and not self.search.is_off_map),
            (Cause.NO_MAP, last.map_version is None),
        )
        return [*(flag for flag, is_on in known if is_on), *outcome.left_out]
