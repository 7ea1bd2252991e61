"""Joining as a test: foreign sessions and true ones without pictures, through the decision that builds take.

A site is a building of its own seed. Foreign: every site's session in the map of every other site, without docks, with the docks of its own
building (whose coordinates mean nothing in the other), with docks put anywhere. True: sessions of the same day, the next, three days on, of
which half leads through what is not in the map, and against the survey's direction. Lengths are 10 to 80 m. Rates come with the 95 % bound
of Clopper and Pearson. There is no joint adjustment: errors are those of the pose graph of fixes.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from scipy.stats import binomtest

from benchmarks.common.joining_sites import Drive, Site, SiteMap, cut, drive, error_m, length_m, session, site_map
from benchmarks.common.recorded_runs import Options, Results, benchmark
from fleetmap.geometry import Array
from mapserver.survey.merge.membership import Membership, MembershipVerdict

_PLAIN = ("small-loop", "five-aisles", "busy")
_LENGTHS_M = (10.0, 20.0, 40.0, 80.0)
_DOCKS = ("none", "own", "wrong")
_MISPLACED_M = 0.05
PARTS = "foreign", "true"


def rate(count: int, total: int) -> dict[str, Any]:
    """A share with its bounds of 95 %."""
    low, high = binomtest(count, total).proportion_ci() if total else (0.0, 1.0)
    return {"count": count, "of": total, "share": count / max(total, 1), "low": float(low), "high": float(high)}


def decided(here: SiteMap, moved: Drive, docks: Array | None) -> dict[str, Any]:
    """What the test says of a drive in a map, and how far off it is placed."""
    test = here.test(moved, docks)
    located = test.locate()
    if isinstance(located, Membership):
        return {"verdict": located.verdict.value, "cells": 0, "share": 0.0, "error_m": None, "reason": located.reason}
    refused = test.judged(located)
    verdict = MembershipVerdict.JOINED if refused is None else refused.verdict
    off_m = error_m(located.map_from_body, moved.map_from_body, [fix.k for fix in located.placed.fixes])
    figures = {"cells": located.seen.cells, "share": round(located.seen.share, 3), "error_m": round(off_m, 4)}
    return {"verdict": verdict.value, **figures, "reason": "" if refused is None else refused.reason}


def sites(count: int, seed: int) -> list[Site]:
    """Buildings of all layouts, each with a seed of its own."""
    kinds = ("small-loop", "five-aisles", "small-loop", "busy", "marked-ends", "identical-aisles", "five-aisles")
    return [Site(kinds[n % len(kinds)], seed + n) for n in range(count)]


def foreign(places: Sequence[Site]) -> Iterator[dict[str, Any]]:
    """Every site's session in every other site's map."""
    drives: dict[int, tuple[float, Drive]] = {}
    for here in places:
        known = site_map(session(here, 0, cut(here.route(), 0.0, 80.0), "map"))
        for n, site in enumerate(places):
            if site == here:
                continue
            if n not in drives:
                way = cut(site.route(), 1.0 + n % 3, _LENGTHS_M[n % 4])
                robot = ("surveyor", "tote")[n % 2]
                drives[n] = length_m(way), drive(session(site, n % 2, way, f"foreign-{n}", robot))
            way_m, moved = drives[n]
            docks = _DOCKS[(n + here.seed) % 3]
            shift_m = 0.0 if docks == "own" else 3.0 + 7.0 * (n % 3)
            given = None if docks == "none" else moved.docks(shift_m, 0.0 if docks == "own" else 0.3)
            row = {"kind": "foreign", "map": here, "session": site, "way_m": round(way_m), "docks": docks}
            yield row | decided(known, moved, given)


def true(places: Sequence[Site]) -> Iterator[dict[str, Any]]:
    """Sessions of each site in its own map."""
    for site in places:
        route, back = site.route(), site.route(is_reversed=True)
        whole_m = min(length_m(route), 80.0)
        half = site_map(session(site, 0, cut(route, 0.0, whole_m / 2), "map"))
        full = site_map(session(site, 0, cut(route, 0.0, whole_m), "map"))
        n = site.seed % 4
        asked = [
            ("same day", full, 0, cut(route, 1.0 + n, _LENGTHS_M[n % 3]), "tote"),
            ("next day", full, 1, cut(route, 2.0 + n, _LENGTHS_M[(n + 1) % 4]), "surveyor"),
            ("next day", full, 1, cut(route, 4.0 + n, _LENGTHS_M[n % 2]), "runner"),
            ("three days on", full, 3, cut(route, 1.0 + n, _LENGTHS_M[(n + 2) % 4]), "tote"),
            ("partly new area", half, 1, cut(route, whole_m / 2 - 10.0, 24.0), "surveyor"),
            ("opposite direction", full, 1, cut(back, length_m(back) - whole_m, _LENGTHS_M[(n + 2) % 4]), "tote"),
        ]
        for m, (kind, known, day, way, robot) in enumerate(asked):
            moved = drive(session(site, day, way, f"true-{m}", robot))
            docks = _DOCKS[(m + site.seed) % 2]
            row = {"kind": kind, "map": site, "session": site, "way_m": round(length_m(way)), "docks": docks}
            yield row | decided(known, moved, None if docks == "none" else moved.docks())


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates by kind of session."""
    result: dict[str, Any] = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        verdicts = [row["verdict"] for row in own]
        result[kind] = {"joined": rate(verdicts.count("joined"), len(own)), "foreign": verdicts.count("foreign")}
    kept = [row for row in rows if row["kind"] != "foreign" and row["verdict"] == "joined"]
    off = [row for row in kept if row["error_m"] > _MISPLACED_M]
    result["misplaced"] = rate(len(off), len(kept))
    with_overlap = [row for row in rows if row["kind"] not in ("foreign", "opposite direction")]
    result["true"] = rate(sum(row["verdict"] == "joined" for row in with_overlap), len(with_overlap))
    return result


def measured(options: Options) -> Iterator[dict[str, Any]]:
    """A row for each session."""
    plain = [Site(_PLAIN[n % 3], options.seed + 100 + n) for n in range(options.true_sites)]
    parts = {"foreign": foreign(sites(options.sites, options.seed + 50)), "true": true(plain)}
    for part in options.only:
        for row in parts[part]:
            yield row | {name: f"{row[name].scenario} {row[name].seed}" for name in ("map", "session")} | {"part": part}


@benchmark(PARTS, sites=15, true_sites=34, seed=500)
def main(options: Options) -> Results:
    rows = list(measured(options))
    figures = {part: summary([row for row in rows if row["part"] == part]) for part in options.only}
    return {"rates": figures | {"all": summary(rows)}, "sessions": rows}
