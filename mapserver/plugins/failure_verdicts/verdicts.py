"""Verdicts on stored failures, revised by what else failed within a week, how often each was given, and an export with them."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from mapserver.fleet.exports import write_json_lines
from mapserver.fleet_statistics.kpis import HOUR_NS
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.plugins.failure_verdicts.model import Verdict, verdict
from mapserver.store import FailureDetail, FailureFilter, MapStore

_WEEK_NS, _COUNTED, _AROUND = 168 * HOUR_NS, 200, 2000


def judged(store: MapStore, found: Sequence[FailureDetail]) -> list[Verdict]:
    """Return verdicts on failures of one site, given its others a week before and after them, as far as they are the last 2000."""
    times_ns, site = [each.failure.happened_ns for each in found] or [0], found[0].failure.site if found else ""
    around = FailureFilter(site, since_ns=min(times_ns) - _WEEK_NS, until_ns=max(times_ns) + _WEEK_NS)
    rows, said = store.fleet.failures(around, limit=_AROUND), []
    for row, report in ((each.failure, each.report) for each in found):
        near = [o for o in rows if abs(o.happened_ns - row.happened_ns) <= _WEEK_NS]
        others = {o.robot for o in near if row.tile and o.tile == row.tile} - {row.robot}
        tiles = {o.tile for o in near if o.robot == row.robot} - {row.tile, None}
        said.append(verdict(report, len(others), len(tiles)))
    return said


def counted(store: MapStore, site: str, hours: tuple[int, int], by: str) -> dict[str, Counter[str]]:
    """Return by `tile` or `area` how often each verdict was given, on the last 200 failures of hours since 1970, the end excluded."""
    wanted = FailureFilter(site, since_ns=hours[0] * HOUR_NS, until_ns=hours[1] * HOUR_NS)
    found = [store.fleet.failure(row.number) for row in store.fleet.failures(wanted, limit=_COUNTED)]
    counts = defaultdict[str, Counter[str]](Counter)
    for each, said in zip(found, judged(store, found), strict=True):
        counts[getattr(each.failure, by) or OUTSIDE][said.says] += 1
    return dict(sorted(counts.items()))


def write_with_verdicts(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Write the failures and return their number; as `write_json_lines`, each with its verdict."""
    return write_json_lines(store, wanted, path, lambda found: {"verdict": asdict(judged(store, [found])[0])})
