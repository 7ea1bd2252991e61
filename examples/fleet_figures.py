"""Figures of the robots that report to a store: python examples/fleet_figures.py STORE SITE [HOURS]

Failures per robot-day (16 h of driving) with the 95 % confidence interval of the rate, by robot and by map version:
the numbers behind the dashboard and `mapserver fleet report`, as Python values. Robots send them to `mapserver serve`.
"""

import sys
import time

from fleetmap import FleetmapError
from mapserver import open_store
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.kpis import Counters, Kpis, hour_of, kpis
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings


def in_words(figures: Kpis) -> str:
    """Return a line of a table."""
    failures = figures.failures
    if failures.per_robot_day is None:
        return f"{figures.driving_h:7.1f} h, {failures.events} failures, too little driving for a rate"
    interval = f"{failures.low:.2f} to {failures.high:.2f}"
    share = figures.localised_share_of_all
    localised = "-" if share is None else f"{share:.1%} of the driving"
    return (
        f"{figures.driving_h:7.1f} h, {failures.per_robot_day:.2f} failures a day ({interval}), localized {localised}"
    )


def main(store: str, site: str, hours: str = "24") -> None:
    """Print the tables, the worst robots and versions first."""
    now_ns = time.time_ns()
    since = hour_of(now_ns) + 1 - int(hours)
    with open_store(store) as maps:
        current = maps.current(site)
        axes = ("site", "robot", "version", "cause")
        found = {axis: maps.fleet.counters(site, axis, since_hour=since) for axis in axes}
        again = resurvey_list(maps, site, ResurveySettings(), now_ns)
    total = kpis(found.pop("site").get((site, ""), Counters()))
    print(f"{site}, version {current and current.version}, last {hours} h: {in_words(total)}")
    for axis, counters in found.items():
        rows = [(key, kpis(counts)) for (_, key), counts in counters.items()]
        for key, figures in sorted(rows, key=lambda row: (-row[1].failures.events, row[0])):
            print(f"{axis:8} {key or '-':16} {in_words(figures)}")
    for tile in again.tiles:
        print(f"survey again: tile {tile.tile}, {'; '.join(tile.reasons)}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
