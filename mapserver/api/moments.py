"""Times as text for operators, programs and pages: with an offset from UTC, or in a local time zone."""

import re
from datetime import UTC, date, datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from fleetmap.errors import InvalidValueError
from mapserver.fleet_statistics.kpis import HOUR_NS, hour_of

_LATEST_YEAR = 2200
_NAME = re.compile(r"[A-Za-z0-9_+\-/]{1,64}", re.ASCII)
_LOST_PLUS = re.compile(r"(T[\d:.]+) (\d\d:?\d\d)$")  # `+` in a URL means a space


def zone_of(name: str | None) -> tzinfo | None:
    """Return the zone of an IANA name; None, the machine's own zone, for None and for an unknown name."""
    if not name or not _NAME.fullmatch(name):
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def moment_text(stamp_ns: int | None, zone: tzinfo | None) -> str | None:
    """Return a stamp in a zone's local time with the zone's name; None for None."""
    if stamp_ns is None:
        return None
    at = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).astimezone(zone)
    return f"{at:%Y-%m-%d %H:%M:%S} {at.tzname()}"


def clock_text(stamp_ns: int, zone: tzinfo | None) -> str:
    """Return the local time of day of a stamp, to a tenth of a second."""
    at = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).astimezone(zone)
    return f"{at:%H:%M:%S}.{stamp_ns // 100_000_000 % 10}"


def read_moment(text: str | None, name: str, zone: tzinfo | None = None, *, is_end: bool = False) -> int | None:
    """Return nanoseconds since 1970 of ISO 8601 text; without an offset it is in the zone (None: the machine's). None for no text.

    A day alone is its beginning, or its end with `is_end`. A time that a clock change repeats is its first one, or its last with
    `is_end`. Raises InvalidValueError for other text, naming the parameter.
    """
    if not text:
        return None
    written = _LOST_PLUS.sub(r"\1+\2", text.strip())
    try:
        if len(written) == 10:
            day = date.fromisoformat(written) + timedelta(days=int(is_end))
            at = datetime(day.year, day.month, day.day)
        else:
            at = datetime.fromisoformat(written)
    except (ValueError, OverflowError):
        at = None
    if at is None or not 1970 < at.year < _LATEST_YEAR:
        raise InvalidValueError(
            f"{name} {text[:40]!r} is an invalid time; write 2026-01-31T14:03, with +01:00 or Z if it is not local"
        )
    if at.tzinfo is not None:
        return _stamp_ns(at)
    return (max if is_end else min)(_local_ns(at, zone))


def written(stamp_ns: int, zone: tzinfo | None) -> str:
    """Return a stamp as `read_moment` takes it, to the minute; with its offset where a clock change repeats the time of day."""
    at = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).astimezone(zone)
    local = at.replace(tzinfo=None, second=0, microsecond=0)
    return (local if len(set(_local_ns(local, zone))) == 1 else at).isoformat(timespec="minutes")


def steps(first_ns: int, end_ns: int, step_ns: int, zone: tzinfo | None) -> list[int]:
    """Return the edges of equal steps around a range, by the clock of the zone: days begin at midnight, also after a clock change."""
    offset = datetime.fromtimestamp(first_ns // 1_000_000_000, UTC).astimezone(zone).utcoffset() or timedelta()
    offset_ns = offset // timedelta(microseconds=1) * 1000
    begin_ns = (first_ns + offset_ns) // step_ns * step_ns  # as the clock shows it
    more = 3 + 24 * HOUR_NS // step_ns  # a zone that crosses the date line loses a day
    edges = [begin_ns + n * step_ns for n in range((end_ns + offset_ns - begin_ns) // step_ns + more)]
    if step_ns > HOUR_NS:
        shown = (datetime.fromtimestamp(edge // 1_000_000_000, UTC).replace(tzinfo=None) for edge in edges)
        edges = [_local_ns(at, zone)[0] for at in shown]
    else:
        edges = [edge - offset_ns for edge in edges]
    return edges[: next(n for n, edge in enumerate(edges) if edge >= end_ns) + 1]


def _local_ns(at: datetime, zone: tzinfo | None) -> tuple[int, int]:
    """Return both stamps of a local time, which differ only around a clock change."""
    both = (at.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
    first, last = (_stamp_ns(each if zone is not None else each.astimezone()) for each in both)
    return first, last


def _stamp_ns(at: datetime) -> int:
    whole_s, part_s = divmod(at.timestamp(), 1)
    return int(whole_s) * 1_000_000_000 + round(part_s * 1e6) * 1000


def read_range(since: str | None, until: str | None, zone: tzinfo | None = None) -> tuple[int | None, int | None]:
    """Return both ends of a range. Raises InvalidValueError for an invalid time and for an end before the start."""
    start_ns, end_ns = read_moment(since, "since", zone), read_moment(until, "until", zone, is_end=True)
    if start_ns is not None and end_ns is not None and end_ns <= start_ns:
        raise InvalidValueError(
            f"until {(until or '')[:40]!r} is not after since {(since or '')[:40]!r}; exchange them"
        )
    return start_ns, end_ns


def hours_within(since_ns: int | None, until_ns: int | None, now_ns: int, usual_h: int) -> tuple[int, int]:
    """Return the hours that a time lies in, the end excluded. usual_h: their number where the time has no beginning."""
    end = hour_of(now_ns if until_ns is None else until_ns - 1) + 1
    return (end - usual_h if since_ns is None else hour_of(since_ns)), end
