"""Counters of one robot's message stream, and the offset of its wall clock against the server's. Pure: time comes with the messages."""

import math

from fleetmap import failure_definition as definition
from fleetmap.messages import Flag, PoseMessage, RobotHealth, Status
from mapserver.fleet_statistics.kpis import Counters
from mapserver.fleet_statistics.robot_calibration import number_of

_WINDOW_NS = 60_000_000_000  # of the clock's offset
MAX_GAP_S = 5.0  # during a longer silence a robot counts as unobserved
_MAX_COUNT = 1 << 40
_MAX_FIGURE = 1e15


class HealthStream:
    """Follows one robot: runs, driving, first fixes, blindness. Reports must come in the order of their stamps."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._wall_ns: int | None = None
        self._older_wall_ns: int | None = None
        self._figures: dict[str, float] = {}
        self._has_fix = False
        self._fix_counted = False
        self._blind_since_ns: int | None = None
        self._good_since_ns: int | None = None
        self._jump_ns: int | None = None
        self._silent_ms = 0
        self._watched_ns = 0  # observed time since the first fix, used to measure blindness
        self.in_failure = False  # blind, or lost for too long, and no 5 s of good tracking since
        self._search = definition.SearchClock()
        self._search_ns = 0  # observed time, used to measure the search
        self._place: tuple[int, float, float] | None = None
        self._pose_mps: float | None = None

    def take_pose(self, message: PoseMessage) -> None:
        """Update the speed from estimates, for robots that do not report it."""
        x_m, y_m, _ = message.position_map_m
        if self._place is not None:
            dt_s = (message.stamp_ns - self._place[0]) * 1e-9
            moved_m = math.hypot(x_m - self._place[1], y_m - self._place[2])
            self._pose_mps = moved_m / dt_s if 0 < dt_s <= MAX_GAP_S and math.isfinite(moved_m) else None
        self._place = (message.stamp_ns, x_m, y_m)

    def take_health(self, health: RobotHealth) -> Counters | None:
        """Return the increments of this report; None for a duplicate."""
        if self._is_known(health):
            return None
        figures = _figures(health)
        went_back = figures.get("frames", math.inf) < self._figures.get("frames", -math.inf)
        if self._stamp_ns is None or went_back or health.stamp_ns < self._stamp_ns:
            self._stamp_ns, self._figures = None, {}
            self._has_fix = self._fix_counted = self.in_failure = False
            self._search, self._search_ns = definition.SearchClock(), 0
            self._blind_since_ns = self._good_since_ns = self._jump_ns = None
        # Since the last report by the robot's wall clock, which runs while its cameras are silent; else by stamps
        dt_ms = 0 if self._stamp_ns is None else (health.stamp_ns - self._stamp_ns) // 1_000_000
        if self._stamp_ns is not None and health.wall_ns is not None and self._wall_ns is not None:
            dt_ms = (health.wall_ns - self._wall_ns) // 1_000_000
        dt_ms = dt_ms if 0 < dt_ms <= MAX_GAP_S * 1e3 else 0
        counts = Counters(reports=1, observed_ms=dt_ms)
        speed_mps = figures.get("speed_mps", self._pose_mps)
        counts.driving_ms = dt_ms if speed_mps is not None and definition.is_driving(speed_mps) else 0
        self._count_status(counts, health, figures, dt_ms, speed_mps)
        self._count_fixes(counts, health.stamp_ns, figures)
        if "frame_ms_mean" in figures:
            counts.cpu_reports, counts.cpu_ms_sum = 1, figures["frame_ms_mean"]
        for name in ("frames", "frames_dropped", "landmarks_expected", "landmarks_seen"):
            if name in figures:
                grown = figures[name] - self._figures.get(name, 0.0 if self._figures else figures[name])
                setattr(counts, name, int(min(max(0.0, grown), _MAX_COUNT)))
        self._stamp_ns, self._wall_ns, self._figures = health.stamp_ns, health.wall_ns, figures
        return counts

    def _is_known(self, health: RobotHealth) -> bool:
        """True for a report already counted. A replayed recording has old stamps, but later sending times."""
        if self._stamp_ns is None or health.stamp_ns > self._stamp_ns:
            return False
        if health.wall_ns is None or self._wall_ns is None:
            return health.stamp_ns == self._stamp_ns
        if health.wall_ns > self._wall_ns:
            return False
        # Two consecutive reports from far before: the robot's clock was set back.
        before_ns, self._older_wall_ns = self._older_wall_ns, health.wall_ns
        is_set_back = before_ns is not None and 0 < health.wall_ns - before_ns <= MAX_GAP_S * 1e9
        return not (is_set_back and self._wall_ns - health.wall_ns > MAX_GAP_S * 1e9)

    def _count_status(
        self, counts: Counters, health: RobotHealth, figures: dict[str, float], dt_ms: int, speed_mps: float | None
    ) -> None:
        self._silent_ms = self._silent_ms + dt_ms if health.stamp_ns == self._stamp_ns else 0
        is_stale = self._silent_ms > definition.BLIND_S * 1e3  # the last frame is so old that the status is outdated
        is_tracking = health.status == Status.TRACKING and not is_stale
        radius_m = figures.get("radius_95_m", math.inf)
        self._has_fix = self._has_fix or is_tracking or "first_fix_s" in figures
        counts.usable_ms = dt_ms if not is_stale and definition.is_usable(health.status, radius_m) else 0
        counts.judged_ms = dt_ms if definition.is_driving(speed_mps) else 0
        counts.found_ms = counts.judged_ms if is_tracking else 0
        self._search_ns += dt_ms * 1_000_000
        is_new = self._search.handle(
            self._search_ns,
            is_found=is_tracking,
            is_driving=definition.is_driving(speed_mps),
            may_be_mapped=Flag.OFF_MAP not in health.flags,
        )
        if self._has_fix:
            counts.after_fix_ms = dt_ms
            counts.localised_ms = dt_ms if is_tracking else 0
            self._watched_ns += dt_ms * 1_000_000
            is_blind_now = is_stale or definition.is_blind(health.status, radius_m)
            if dt_ms == 0:
                self._blind_since_ns = None  # the time in between is unknown
            since_ns = self._blind_since_ns
            is_new |= since_ns is not None and self._watched_ns - since_ns > definition.BLIND_S * 1e9
            if not is_blind_now:  # blindness lasts until the next better report
                self._blind_since_ns = None
            elif since_ns is None:
                self._blind_since_ns = self._watched_ns
        counts.blind_seen = int(is_new and not self.in_failure)
        self.in_failure |= is_new
        if not is_tracking:  # a failure ends after 5 s of good tracking
            self._good_since_ns = None
        elif self._good_since_ns is None or dt_ms == 0:
            self._good_since_ns = self._search_ns
        if self._good_since_ns is not None and self._search_ns - self._good_since_ns >= definition.GOOD_S * 1e9:
            self.in_failure = False

    def _count_fixes(self, counts: Counters, stamp_ns: int, figures: dict[str, float]) -> None:
        if "first_fix_s" in figures and not self._fix_counted:
            self._fix_counted = True
            counts.first_fixes, counts.first_fix_ms = 1, round(min(abs(figures["first_fix_s"]), 1e6) * 1e3)
        innovation = figures.get("fix_innovation")
        if innovation is not None:
            counts.innovations, counts.innovation_sum = 1, innovation
            counts.innovation_m_sum = figures.get("fix_innovation_m", 0.0)
            counts.exceeded = int(innovation > definition.CHI2_6_0999)
        if self._has_fix and definition.is_wrong(figures.get("fix_innovation_m", 0.0)):
            # The estimate was wrong before, or is now. Jumps within 5 s count once; a jump within a failure belongs to it.
            is_new = self._jump_ns is None or stamp_ns - self._jump_ns >= definition.GOOD_S * 1e9
            counts.jumps = int(is_new and not self.in_failure)
            self._jump_ns = stamp_ns
        dock_m = figures.get("dock_error_m")
        if dock_m is not None:
            counts.docks, counts.docks_wrong = 1, int(definition.is_wrong(dock_m))


def _figures(health: RobotHealth) -> dict[str, float]:
    numbers = {name: number_of(value) for name, value in health.metrics.items()}
    return {name: number for name, number in numbers.items() if number is not None and abs(number) < _MAX_FIGURE}


class ClockSkew:
    """The largest of (robot's stamp - server's clock) over the last one to two minutes: the message with the least delay.

    The remaining error is that delay, a few milliseconds on a local network.
    """

    def __init__(self, ahead_s: float | None = None) -> None:
        """ahead_s: earlier estimate, used until the first message."""
        self._known_s = ahead_s if isinstance(ahead_s, int | float) else None
        self._begun_ns: int | None = None
        self._best_ns: list[int | None] = [None, None]

    def take(self, robot_ns: int, server_ns: int) -> None:
        ahead_ns = robot_ns - server_ns
        if self._begun_ns is None or not 0 <= server_ns - self._begun_ns < _WINDOW_NS:
            # Differences to a clock that was set back are invalid.
            is_set_back = self._begun_ns is not None and server_ns < self._begun_ns
            self._begun_ns = server_ns
            self._best_ns = [None, None if is_set_back else self._best_ns[0]]
        newest = self._best_ns[0]
        self._best_ns[0] = ahead_ns if newest is None else max(newest, ahead_ns)

    @property
    def ahead_s(self) -> float | None:
        """Seconds that the robot's clock is ahead; negative if it is late, None if unknown."""
        known = [best for best in self._best_ns if best is not None]
        return max(known) / 1e9 if known else self._known_s


def server_time_ns(robot_ns: int, ahead_s: float | None, now_ns: int, oldest_ns: int) -> int:
    """Return a robot's stamp on the server's clock: at most now; now if the robot's clock cannot be right."""
    happened_ns = robot_ns - round((ahead_s or 0.0) * 1e9)
    return min(now_ns, happened_ns) if happened_ns >= oldest_ns else now_ns
