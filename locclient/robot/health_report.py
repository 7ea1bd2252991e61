"""Figures of a robot's health report, gathered frame by frame. Pure."""

from collections import deque
from collections.abc import Mapping

import numpy as np

from fleetmap.failure_definition import is_blind, radius_95_m
from fleetmap.messages import Cause, Flag, RobotHealth, Status
from locclient.localization.estimate import Estimate
from locclient.robot.robot import Outcome
from locclient.robot.search_way import SearchWay

_RECENT = 300
Figure = float | int | str | bool | None


class FixFigures:
    """Those of HEALTH_FIGURES that come from fixes, docks and odometry; the largest since the report before.

    Metres count only where the robot was TRACKING: one that says it is lost, and is found elsewhere, was not wrong. A claimed pose
    that later fixes disproved beyond its covariance counts too.
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
        """The figures of a report; the largest values are reset."""
        figures: dict[str, Figure] = {
            name: self._largest.get(name) for name in ("fix_innovation", "fix_innovation_m", "dock_error_m")
        }
        self._largest = {}
        figures |= {"landmarks_expected": self._expected, "landmarks_seen": self._seen}
        if self._last is not None:
            figures["speed_mps"] = self._speed_mps
            radius = radius_95_m(self._last.cov_rot_trans)
            figures["radius_95_m"] = radius if np.isfinite(radius) else None
        return figures

    def _note(self, name: str, value: float | None) -> None:
        if value is not None:
            self._largest[name] = max(self._largest.get(name, 0.0), float(value))


class HealthFigures:
    """Counts since the start, and the times of the last frames."""

    def __init__(self) -> None:
        self._all_frames = self._frames = self._localised = self._failures = 0
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

    def count_failure(self) -> None:
        self._failures += 1

    def report(
        self, site: str, robot: str, wall_ns: int | None, more: Mapping[str, Figure], silent: bool
    ) -> RobotHealth:
        """The message; more: figures of other parts. silent: whether the source has stopped sending frames."""
        last = None if self.last is None else self.last.estimate
        flags: list[Flag | Cause] = [Cause.NO_FRAMES] if silent else []
        figures: dict[str, Figure] = {
            "localised_share_of_all": self._localised / self._all_frames if self._all_frames else None,
            "localised_share": self._localised / self._frames if self._frames else None,
            "first_fix_s": self._first_fix_s,
            "first_frame_ms": self._first_frame_ms,
            "frame_ms_mean": float(np.mean(self._frame_ms)) if self._frame_ms else None,
            "frame_ms_p99": float(np.percentile(self._frame_ms, 99)) if self._frame_ms else None,
            "failures": self._failures,
            **self._fixes.take(),
        }
        if last is not None:
            figures["exposure"], figures["sharpness"] = last.image.exposure, last.image.sharpness
            figures |= last.calibration.figures
            flags += [Cause.CALIBRATION] if last.calibration.is_wrong else []
            flags += [Flag.BLIND] if is_blind(last.status, radius_95_m(last.cov_rot_trans)) else []
            flags += [last.image.cause] if last.image.cause else []
            flags += [] if self.last is None or self.last.may_be_mapped else [Flag.OFF_MAP]
            flags += [Flag.NOT_LOCALISED] if self.search.is_long and not self.search.is_off_map else []
            flags += [Cause.NO_MAP] if last.map_version is None else []
            figures["not_localised_m"] = self.search.metres
            flags += [] if self.last is None else self.last.left_out
        return RobotHealth(
            site=site,
            robot=robot,
            stamp_ns=0 if last is None else last.stamp_ns,
            wall_ns=wall_ns,
            version=None if last is None else last.map_version,
            status=Status.INITIALISING if last is None else last.status,
            flags=tuple(flags),
            metrics={**figures, **more},
        )
