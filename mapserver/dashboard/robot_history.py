"""What a robot was at which time, by its traces in the order in which they were heard: stretches of one state, its way, curves. Pure."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean
from typing import NamedTuple

from mapserver.dashboard.live import SILENT, words_of
from mapserver.dashboard.map_layers import Line
from mapserver.store import TraceRow

GAP_NS = 45_000_000_000
"""Robots report every second, of which one in ten seconds is kept: after so long without one it was silent."""

_COLUMNS = 300  # of a curve
Range = tuple[int, int]
"""From when until before when, nanoseconds since 1970."""


class Stretch(NamedTuple):
    """From when until when a robot had one status, version and set of flags; status "" where nothing was heard."""

    since_ns: int
    until_ns: int
    status: str
    version: int | None = None
    flags: str = ""

    @property
    def state(self) -> tuple[str, str]:
        """The status in words, and its tone."""
        return words_of(self.status) if self.status else SILENT


class Curve(NamedTuple):
    """How a figure went: from low to high, and an SVG path 1000 wide and 100 high, from 0 at its foot, broken where nothing was heard."""

    low: float
    high: float
    path: str


def stretches(rows: Sequence[TraceRow], until_ns: int) -> list[Stretch]:
    """The stretches, oldest first; what is not known until the end was silent."""
    found: list[Stretch] = []
    for row, next_ns in zip(rows, [*(row.heard_ns for row in rows[1:]), until_ns], strict=False):
        end_ns = next_ns if next_ns - row.heard_ns <= GAP_NS else row.heard_ns + GAP_NS // 4
        here = Stretch(row.heard_ns, end_ns, row.status, row.version, row.flags or "")
        if found and found[-1][2:] == here[2:]:
            found[-1] = found[-1]._replace(until_ns=end_ns)
        else:
            found.append(here)
        if end_ns < next_ns:
            found.append(Stretch(end_ns, next_ns, ""))
    return found


def way(rows: Sequence[TraceRow]) -> list[Line]:
    """Where it drove, by tone; nothing joins what lies apart in time."""
    found: list[Line] = []
    for before, row in pairwise(rows):
        start, end = _place(before), _place(row)
        if start is None or end is None or row.heard_ns - before.heard_ns > GAP_NS:
            continue
        tone = words_of(row.status)[1]
        if found and found[-1].tone == tone and found[-1].points[-1] == start:
            found[-1].points.append(end)
        else:
            found.append(Line([start, end], tone))
    return found


def _place(row: TraceRow) -> tuple[float, float] | None:
    return None if row.x_map_m is None or row.y_map_m is None else (round(row.x_map_m, 2), round(row.y_map_m, 2))


def curve(rows: Sequence[TraceRow], name: str, shown: Range) -> Curve | None:
    """How a figure of the traces went, as means of equal parts of a range; None where it was never reported."""
    part_ns = max((shown[1] - shown[0]) // _COLUMNS, GAP_NS)
    parts: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        if (value := getattr(row, name)) is not None:
            parts[(row.heard_ns - shown[0]) // part_ns].append(value)
    if not parts:
        return None
    means, width = {n: fmean(values) for n, values in parts.items()}, 1000 * part_ns / (shown[1] - shown[0])
    high = max(means.values())
    path = "".join(
        f"{'L' if n - 1 in means else 'M'}{n * width:.1f} {100 - 90 * mean / (high or 1):.0f}h{width:.1f}"
        for n, mean in means.items()
    )
    return Curve(min(means.values()), high, path)
