"""Key performance indicators of a fleet: additive counters, and rates, shares and intervals of them, also as text. Pure.

A robot-day is 16 h of driving. Intervals hold the true value with 95 %.
"""

from dataclasses import dataclass, fields
from typing import Self

import scipy

ROBOT_DAY_S = 16 * 3600.0
HOUR_NS = 3_600_000_000_000
_TAIL = 0.05
TOO_MANY_PER_ROBOT_DAY = 5.0
"""Rate of failures that operators are told of by default. Driving is enough for a rate once none in it would show less than this."""


@dataclass(slots=True)
class Counters:
    """Additive sums over reports. Times in milliseconds, so that sums are exact.

    observed: time covered by reports; driving: the part with wheels turning; after_fix: since the run's first fix; localised: the part
    TRACKING; usable: with a reliable position. failures: reported ones; suspected: reported estimates of silent ones;
    blind_failures: reported ones that statuses show too; blind_seen: such failures seen by the server in the statuses.
    exceeded: innovations beyond their 99.9 % bound; jumps: fixes more than 0.30 m from the estimated position; docks_wrong:
    arrivals with the same error. judged: driving time, also at an unknown speed, with known localisation; found: the localised part
    of it. continued: failures from an earlier hour still running at the start of the hour; of sums over several hours the first one.
    """

    reports: int = 0
    observed_ms: int = 0
    driving_ms: int = 0
    after_fix_ms: int = 0
    localised_ms: int = 0
    usable_ms: int = 0
    first_fixes: int = 0
    first_fix_ms: int = 0
    innovations: int = 0
    innovation_sum: float = 0.0
    innovation_m_sum: float = 0.0
    exceeded: int = 0
    jumps: int = 0
    docks: int = 0
    docks_wrong: int = 0
    cpu_reports: int = 0
    cpu_ms_sum: float = 0.0
    frames: int = 0
    frames_dropped: int = 0
    landmarks_expected: int = 0
    landmarks_seen: int = 0
    failures: int = 0
    suspected: int = 0
    blind_failures: int = 0
    blind_seen: int = 0
    judged_ms: int = 0
    found_ms: int = 0
    continued: int = 0

    def add(self, other: Self) -> None:
        for name in COUNTER_COLUMNS:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def robot_days(self) -> float:
        return self.driving_ms / 1e3 / ROBOT_DAY_S

    @property
    def silent_estimated(self) -> int:
        """Estimated silent failures: those suspected by robots or shown by their fixes, and docks at the wrong place.

        Robots suspect what their fixes show, so only the larger of the two counts.
        """
        return max(self.suspected, self.jumps) + self.docks_wrong

    @property
    def unreported_blindness(self) -> int:
        """Failures in the statuses (blindness, unsuccessful search for a position) that were not reported (yet)."""
        return max(0, self.blind_seen - self.blind_failures)

    @property
    def position_failures(self) -> int:
        """Failures that began: reported ones, and those shown only by the statuses."""
        return self.failures + self.unreported_blindness

    @property
    def events(self) -> int:
        """All evidence against a map: failures, unreported blindness, estimated silent failures."""
        return self.position_failures + self.silent_estimated


COUNTER_COLUMNS = tuple(field.name for field in fields(Counters))


@dataclass(frozen=True, slots=True)
class Rate:
    """Events per robot-day with the 95 % interval of the true rate; None with too little driving to say, as of `is_enough`."""

    events: int
    robot_days: float
    per_robot_day: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Share:
    """`hits` of `tries`, with the 95 % interval of the true share; None without tries."""

    hits: int
    tries: int
    share: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Kpis:
    """Key performance indicators of some counters; None without counts.

    localised_share_of_all: of all driving time; localised_share: of the time since each run's first fix. not_localised_h: driving.
    failures: those that began, reported or seen in the statuses; failures_running: those still running at the start of the period.
    silent_estimated is an estimate, not a count: robots do not know the truth. unreported_blindness: failures that no robot reported (yet).
    """

    observed_h: float
    driving_h: float
    localised_share_of_all: float | None
    not_localised_h: float
    failures: Rate
    failures_running: int
    silent_estimated: Rate
    docks_wrong: Share
    unreported_blindness: int
    availability: float | None
    localised_share: float | None
    first_fix_mean_s: float | None
    fix_innovation_mean: float | None
    fix_innovation_mean_m: float | None
    fix_innovation_exceeded: Share
    frame_ms_mean: float | None
    frame_drop_share: float | None
    landmarks_seen_share: float | None


def kpis(counts: Counters) -> Kpis:
    """Return the indicators of some counters."""
    return Kpis(
        observed_h=counts.observed_ms / 3.6e6,
        driving_h=counts.driving_ms / 3.6e6,
        localised_share_of_all=_over(counts.found_ms, counts.judged_ms),
        not_localised_h=(counts.judged_ms - counts.found_ms) / 3.6e6,
        failures=rate(counts.position_failures, counts.robot_days),
        failures_running=counts.continued,
        silent_estimated=rate(counts.silent_estimated, counts.robot_days),
        docks_wrong=share(counts.docks_wrong, counts.docks),
        unreported_blindness=counts.unreported_blindness,
        availability=_over(counts.usable_ms, counts.observed_ms),
        localised_share=_over(counts.localised_ms, counts.after_fix_ms),
        first_fix_mean_s=_over(counts.first_fix_ms / 1e3, counts.first_fixes),
        fix_innovation_mean=_over(counts.innovation_sum, counts.innovations),
        fix_innovation_mean_m=_over(counts.innovation_m_sum, counts.innovations),
        fix_innovation_exceeded=share(counts.exceeded, counts.innovations),
        frame_ms_mean=_over(counts.cpu_ms_sum, counts.cpu_reports),
        frame_drop_share=_over(counts.frames_dropped, counts.frames),
        landmarks_seen_share=_over(counts.landmarks_seen, counts.landmarks_expected),
    )


def rate(events: int, robot_days: float) -> Rate:
    """Return events per robot-day with their interval."""
    if not is_enough(robot_days):
        return Rate(events, max(0.0, robot_days), None, None, None)
    low, high = poisson_interval(events)
    return Rate(events, robot_days, events / robot_days, low / robot_days, high / robot_days)


def poisson_interval(events: int) -> tuple[float, float]:
    """Return the exact 95 % interval of the mean of a Poisson count; one-sided (0 to 3.0, the rule of three) for zero events.

    Source: Garwood 1936, by quantiles of the gamma distribution.
    """
    if events == 0:
        return 0.0, float(scipy.special.gammaincinv(1, 1 - _TAIL))
    low, high = scipy.special.gammaincinv([events, events + 1], [_TAIL / 2, 1 - _TAIL / 2]).tolist()
    return low, high


def share(hits: int, tries: int) -> Share:
    """Return a share with its exact interval; one-sided if no try or every try hit.

    Source: Clopper and Pearson 1934, by quantiles of the beta distribution.
    """
    if tries <= 0:
        return Share(hits, tries, None, None, None)
    one_sided = hits in {0, tries}
    tail = _TAIL if one_sided else _TAIL / 2
    low = 0.0 if hits == 0 else float(scipy.special.betaincinv(hits, tries - hits + 1, tail))
    high = 1.0 if hits == tries else float(scipy.special.betaincinv(hits + 1, tries - hits, 1 - tail))
    return Share(hits, tries, hits / tries, low, high)


def is_enough(robot_days: float) -> bool:
    """True after enough driving to say a rate, 9.6 h: no failure in it would show, by the interval's end, less than TOO_MANY_PER_ROBOT_DAY.

    After less no count could, and a few failures of one cause would seem to be hundreds per robot-day.
    """
    return robot_days * TOO_MANY_PER_ROBOT_DAY >= poisson_interval(0)[1]


def figure(value: float | None) -> str:
    """Return a rate with two digits, without exponent."""
    if value is None:
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def format_rate(found: Rate) -> str:
    """Return a rate with its 95 % interval as text; a dash with too little driving."""
    if found.per_robot_day is None:
        return "–"
    return f"{figure(found.per_robot_day)} ({figure(found.low)} to {figure(found.high)})"


def driven_words(robot_days: float) -> str:
    """Return the driving time as text: minutes, hours or robot-days."""
    hours = robot_days * ROBOT_DAY_S / 3600
    if hours < 1:
        return f"{hours * 60:.0f} min of driving"
    return f"{hours:.1f} h of driving" if robot_days < 1 else f"{figure(robot_days)} robot-days"


def hour_of(stamp_ns: int) -> int:
    """Return hours since 1970, the unit of stored sums."""
    return stamp_ns // HOUR_NS


def _over(part: float, whole: float) -> float | None:
    return part / whole if whole > 0 else None
