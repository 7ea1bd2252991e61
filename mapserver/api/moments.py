"""Times as text for operators, programs and pages: with an offset from UTC, or in a local time zone."""

import re
from datetime import UTC, date, datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from fleetmap.errors import UsageError

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

    A day alone is its beginning, or its end with `is_end`. Raises UsageError for other text, naming the parameter.
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
        raise UsageError(
            f"{name} {text[:40]!r} is an invalid time; write 2026-01-31T14:03, with +01:00 or Z if it is not local"
        )
    if at.tzinfo is None:
        at = at.replace(tzinfo=zone) if zone is not None else at.astimezone()
    whole_s, part_s = divmod(at.timestamp(), 1)
    return int(whole_s) * 1_000_000_000 + round(part_s * 1e6) * 1000


def read_range(since: str | None, until: str | None, zone: tzinfo | None = None) -> tuple[int | None, int | None]:
    """Return both ends of a range. Raises UsageError for an invalid time and for an end before the start."""
    start_ns, end_ns = read_moment(since, "since", zone), read_moment(until, "until", zone, is_end=True)
    if start_ns is not None and end_ns is not None and end_ns <= start_ns:
        raise UsageError(f"until {(until or '')[:40]!r} is not after since {(since or '')[:40]!r}; exchange them")
    return start_ns, end_ns
