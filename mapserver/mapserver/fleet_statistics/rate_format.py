"""Failure rates as text; none where too little was driven for a rate. Pure."""

from mapserver.fleet_statistics.kpis import ROBOT_DAY_S, Rate

LEAST_ROBOT_DAYS = 0.1
"""Below it (96 minutes of driving) one failure would read as ten or more per robot-day: counts are shown, no rate."""


def is_telling(found: Rate) -> bool:
    """Whether enough was driven to give a rate."""
    return found.robot_days >= LEAST_ROBOT_DAYS


def figure(value: float | None) -> str:
    """A rate with two digits, without exponent."""
    if value is None:
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def format_rate(found: Rate) -> str:
    """A rate with the interval that holds the true one with 95 %; a dash where too little was driven."""
    if not is_telling(found):
        return "–"
    return f"{figure(found.per_robot_day)} ({figure(found.low)} to {figure(found.high)})"


def driven_words(robot_days: float) -> str:
    """How much was driven: minutes, hours or robot-days."""
    hours = robot_days * ROBOT_DAY_S / 3600
    if hours < 1:
        return f"{hours * 60:.0f} min of driving"
    return f"{hours:.1f} h of driving" if robot_days < 1 else f"{figure(robot_days)} robot-days"
