"""What a robot was at which time: its traces as stretches of one state. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from mapserver.store import TraceRow

GAP_NS = 45_000_000_000
"""Robots report every second, of which one in ten seconds is kept: after so long without one it was silent."""

SILENT = "SILENT"


@dataclass(frozen=True, slots=True)
class Stretch:
    """From when until when a robot had one status, version and set of flags; status SILENT where nothing was heard.

    frame_ms, exposure, sharpness: means of the rows in it, None where it did not report them.
    """

    since_ns: int
    until_ns: int
    status: str
    version: int | None
    flags: str
    frame_ms: float | None = None
    exposure: float | None = None
    sharpness: float | None = None


def stretches(rows: Sequence[TraceRow], since_ns: int, until_ns: int) -> list[Stretch]:
    """The stretches of a range, oldest first."""
    heard = sorted((row.heard_ns, row) for row in rows if since_ns <= row.heard_ns < until_ns)
    groups: list[list[tuple[int, TraceRow]]] = []
    for ns, row in heard:
        last = groups[-1] if groups else []
        if last and ns - last[-1][0] <= GAP_NS and _state(last[-1][1]) == _state(row):
            last.append((ns, row))
        else:
            groups.append([(ns, row)])
    found: list[Stretch] = []
    for number, group in enumerate(groups):
        start_ns, last_ns = group[0][0], group[-1][0]
        next_ns = groups[number + 1][0][0] if number + 1 < len(groups) else until_ns
        end_ns = next_ns if next_ns - last_ns <= GAP_NS else last_ns + GAP_NS // 4
        found.append(_stretch([row for _, row in group], start_ns, end_ns))
        if end_ns < next_ns:
            found.append(Stretch(end_ns, next_ns, SILENT, None, ""))
    return found


def _state(row: TraceRow) -> tuple[object, ...]:
    return row.status, row.version, row.flags


def _stretch(rows: list[TraceRow], since_ns: int, until_ns: int) -> Stretch:
    def mean(name: str) -> float | None:
        known = [value for row in rows if (value := getattr(row, name)) is not None]
        return fmean(known) if known else None

    first = rows[0]
    means = (mean("frame_ms"), mean("exposure"), mean("sharpness"))
    return Stretch(since_ns, until_ns, first.status, first.version, first.flags or "", *means)
