"""What a robot was at which time, by its traces in the order in which they were heard: stretches of one state, its way, curves. Pure."""

from collections import defaultdict
from collections.abc import Sequence
from math import dist
from statistics import fmean
from typing import NamedTuple

from mapserver.dashboard.live import ORDER, SILENT, words_of
from mapserver.dashboard.map_layers import Line
from mapserver.store import TraceRow

GAP_NS = 45_000_000_000
"""A row is kept at least each ten seconds: after so long without one the robot was silent."""

_COLUMNS = 300  # of a curve
_STEP_M = 0.5
Range = tuple[int, int]
"""From when until before when, nanoseconds since 1970."""


class Stretch(NamedTuple):
    """From when until when a robot had one status, version and set of flags; status "" where nothing was heard.

    is_mixed: others were between, too short to be seen.
    """

    since_ns: int
    until_ns: int
    status: str
    version: int | None = None
    flags: str = ""
    is_mixed: bool = False

    @property
    def length_ns(self) -> int:
        return self.until_ns - self.since_ns

    @property
    def state(self) -> tuple[str, str]:
        """The status in words, and its tone."""
        return words_of(self.status) if self.status else SILENT


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


def band(parts: Sequence[Stretch], least_ns: int) -> list[Stretch]:
    """Stretches that can be told apart: neighbours shorter than `least_ns` are one, as the worst of them."""
    found: list[Stretch] = []
    for part in parts:
        if found and max(found[-1].length_ns, part.length_ns) < least_ns:
            worst = min(found[-1], part, key=lambda each: ORDER[each.state[1]])
            found[-1] = worst._replace(since_ns=found[-1].since_ns, until_ns=part.until_ns, is_mixed=True)
        else:
            found.append(part)
    return found


def way(rows: Sequence[TraceRow], parts: Sequence[Stretch], every_s: float = 10.0) -> list[Line]:
    """Where it drove, in the tones of the stretches, the worst on top; who stands adds nothing.

    every_s: longest time between two rows of a robot that is heard. Nothing joins rows farther apart than that and some lost reports, nor
    where it thought to be while it was lost and where it found itself.
    """
    found: list[Line] = []
    remaining, before_ns, was_lost = iter(parts), None, False
    part = next(remaining, None)
    for row in rows:
        if row.x_map_m is None or row.y_map_m is None:
            before_ns = None
            continue
        while part is not None and part.until_ns <= row.heard_ns:
            part = next(remaining, None)
        here, tone = (round(row.x_map_m, 2), round(row.y_map_m, 2)), "quiet" if part is None else part.state[1]
        is_lost = words_of(row.status)[1] == "bad"
        if before_ns is None or row.heard_ns - before_ns > 1.5e9 * every_s or (was_lost and not is_lost):
            found.append(Line([here], tone))
        elif tone != found[-1].tone:
            found.append(Line([found[-1].points[-1], here], tone))
        elif dist(found[-1].points[-1], here) >= _STEP_M:
            found[-1].points.append(here)
        before_ns, was_lost = row.heard_ns, is_lost
    return sorted((line for line in found if len(line.points) > 1), key=lambda line: -ORDER[line.tone])


def curve(rows: Sequence[TraceRow], name: str, shown: Range) -> tuple[float, float, str] | None:
    """How a figure of the traces went, in means of equal parts of a range: lowest, highest, and the path of an SVG 1000 wide and 100 high.

    It begins at 0 and is broken where nothing was heard; None where the figure was never reported.
    """
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
    return min(means.values()), high, path
