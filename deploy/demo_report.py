"""Output of the demo: ground truth of a recording (yes or no), robots of the server, when they drive, table of results."""

import json
import sys
import time
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from rich.console import Console
from rich.table import Table
from rich.text import Text

Report = dict[str, Any]
_WAIT_S = 60

# Title, path of the key in the report, factor, format of the value with its unit.
BUILD_ROWS = (
    ("position error of the survey (ATE, RMSE)", "ate_rmse_m", 1, "{:.3f} m"),
    ("the same after removing scale", "ate_sim3_rmse_m", 1, "{:.3f} m"),
    ("frames with an estimate", "evaluated_share", 100, "{:.1f} %"),
    ("path", "path_m", 1, "{:.1f} m"),
    ("keyframes", "keyframes", 1, "{:d}"),
    ("landmarks", "landmarks", 1, "{:d}"),
    ("map that a robot downloads", "map_bytes", 1e-3, "{:.0f} kB"),
    ("loop candidates", "loops.candidates", 1, "{:d}"),
    ("loops refused by position", "loops.gated_out", 1, "{:d}"),
    ("loops refused by geometry", "loops.rejected", 1, "{:d}"),
    ("loops accepted", "loops.accepted", 1, "{:d}"),
    ("time", "seconds", 1, "{:.1f} s"),
    ("peak memory", "peak_rss_mb", 1, "{:.0f} MB"),
)
REPLAY_ROWS = (
    ("map version", "map_version", 1, "{:d}"),
    ("frames", "frames", 1, "{:d}"),
    ("first fix after", "first_fix_s", 1, "{:.2f} s"),
    ("localized, of all", "localised_share_of_all", 100, "{:.1f} %"),
    ("position error, median", "error_m.median", 1, "{:.3f} m"),
    ("position error, 95 %", "error_m.p95", 1, "{:.3f} m"),
    ("position error, 99 %", "error_m.p99", 1, "{:.3f} m"),
    ("position error, worst", "error_m.max", 1, "{:.3f} m"),
    ("direction error, median", "error_deg.median", 1, "{:.2f} deg"),
    ("position failures", "position_failures", 1, "{:d}"),
    ("silent failures", "silent_failures", 1, "{:d}"),
    ("CPU time for a frame, median", "frame_ms.p50", 1, "{:.1f} ms"),
    ("CPU time for a frame, 99 %", "frame_ms.p99", 1, "{:.1f} ms"),
    ("peak memory", "peak_rss_mb", 1, "{:.0f} MB"),
)


def value_at(report: Report, path: str) -> Any:
    """Return the value at a dotted path; None if it or one of its parents is null."""
    return reduce(lambda value, key: None if value is None else value[key], path.split("."), report)


def table_of(titles: Sequence[str], reports: Sequence[Report], rows: Sequence[tuple[str, str, float, str]]) -> Table:
    """A row per value, a column per report."""
    table = Table("", *titles)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, path, factor, shown in rows:
        values = [value_at(report, path) for report in reports]
        table.add_row(name, *("not known" if v is None else shown.format(v * factor) for v in values))
    return table


def robots_at(url: str) -> list[Report]:
    """Return what the server tells of its robots."""
    with urlopen(url, timeout=10) as answer:  # an address that the server itself has printed
        return json.load(answer)["items"]


def wait_for_drive(url: str) -> None:
    """Wait until a robot knows its place; SystemExit if none does."""
    for _ in range(_WAIT_S):
        if any((robot["last_health"] or {}).get("status") == "TRACKING" for robot in robots_at(url)):
            return
        time.sleep(1.0)
    raise SystemExit(f"demo: no robot at {url} knew its place within {_WAIT_S} s; see the logs of the robots")


def show_robots(console: Console, url: str) -> None:
    """Print one line for each robot; SystemExit without any, because one has just reported."""
    robots = robots_at(url)
    if not robots:
        raise SystemExit(f"demo: {url} shows no robot, though one has just run; see the server's log")
    for robot in robots:
        health = robot["last_health"] or {}
        console.print(
            Text(
                f"robot {robot['robot']} on site {robot['site']}: runs version {robot['version']}, "
                f"should run {robot['wanted_version']}, last status {health.get('status')}, "
                f"flags {', '.join(health.get('flags') or ()) or 'none'}, last report {robot['seconds_since']:.1f} s ago"
            )
        )


def main(arguments: list[str]) -> None:
    """Run one of: has-truth RECORDING, driving URL, robots URL, table BUILD.json REPLAY.json...."""
    console = Console(width=78)
    match arguments:
        case ["has-truth", recording]:
            from fleetmap.errors import FleetmapError
            from fleetmap.recordings import open_recording

            try:
                with open_recording(Path(recording)) as source:
                    print("no" if source.ground_truth is None else "yes")
            except FleetmapError as error:
                print(f"demo: {error}", file=sys.stderr)
                sys.exit(error.exit_status)
        case ["driving", url]:
            wait_for_drive(url)
        case ["robots", url]:
            show_robots(console, url)
        case ["table", build, *replays]:
            console.print(table_of(["survey"], [json.loads(Path(build).read_text("utf-8"))], BUILD_ROWS))
            robots = [json.loads(Path(replay).read_text("utf-8")) for replay in replays]
            console.print(table_of([Path(replay).stem for replay in replays], robots, REPLAY_ROWS))
        case _:
            sys.exit(
                "usage: demo_report.py has-truth RECORDING | driving URL | robots URL | table BUILD.json REPLAY.json..."
            )


if __name__ == "__main__":
    main(sys.argv[1:])
