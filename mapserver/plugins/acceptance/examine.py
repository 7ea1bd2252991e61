"""Examination of a site: a version and drives through it become the figures of a report."""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np

from fleetmap.geometry import Array
from fleetmap.mapformat.tile import decode_tile
from fleetmap.relocalization.map_view import MapView
from mapserver.config import MapserverConfig
from mapserver.dashboard.plan import make_plan
from mapserver.drafting.draft_evidence import PROBES
from mapserver.drafting.survey_recordings import RecordingOptions
from mapserver.drafting.worker import single_threaded_libraries
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.kpis import Counters, format_rate, rate
from mapserver.floor_plan.areas import Areas
from mapserver.plugins.acceptance.document import SitePlan
from mapserver.plugins.acceptance.drives import Drive, MapUnderTest, examined, replayed
from mapserver.plugins.acceptance.figures import UNKNOWN_PLACE, AreaFigures, Count, Report, Similar, StartCounts
from mapserver.plugins.acceptance.ladders import darkest_grey
from mapserver.plugins.acceptance.verdict import judged
from mapserver.quality.directions import headings_of, opposite, tile_directions
from mapserver.quality.figures import merged
from mapserver.quality.probes import Probe, aliases, spread
from mapserver.store import MapStore

_STARTS, _PICTURES = 40, 80  # of all drives: with 40 starts and none lost, fewer than 8 % of starts are lost
_STRIDE_M = 4.0  # from one arrow of the plan to the next
Where = Callable[[Array], str]
"""Names the area of a place (2,) in `map`."""


def examine(
    maps: MapStore,
    site: str,
    version: int,
    *,
    recordings: Sequence[Path],
    reading: RecordingOptions,
    promises: Sequence[str],
    config: MapserverConfig,
) -> tuple[Report, SitePlan]:
    """Return the report of a version, and its plan. promises: the operator's statements about the robots."""
    under_test = MapUnderTest.of(maps, site, version)
    areas = maps.areas(site)
    starts, pictures = (-(-number // len(recordings)) for number in (_STARTS, _PICTURES))
    where = partial(area_name, areas, under_test.manifest.tile_size_m)
    with single_threaded_libraries(), ThreadPoolExecutor(os.cpu_count()) as pool:
        drives = [(path, pool.submit(replayed, path, reading, starts, under_test)) for path in recordings]
        found = [examined(path, reading, pictures, under_test, replay) for path, replay in drives]
        looked = [picture for drive in found for picture in drive.pictures]
        probes = [looked[n].probe for n in spread(np.arange(len(looked)), PROBES)]
        alike = similar(under_test.view, where, probes)
    known = [] if under_test.built is None else under_test.built.calibrations
    evidence = maps.evidence(site, version)
    built = [] if evidence is None else evidence.calibrations or []
    rungs = [rung for picture in looked for rung in picture.rungs["darkness"].values()]
    levels = [*((picture.grey, picture.is_fixed) for picture in looked), *rungs]
    counts = maps.fleet.counters(site, "version", key=str(version)).get((site, str(version)), Counters())
    reported = rate(counts.position_failures, counts.robot_days)
    report = Report(
        site=site,
        version=version,
        manifest_sha256=maps.version(site, version).manifest_sha256,
        created=under_test.manifest.created,
        program=metadata.version("fleetmap"),
        promises=list(promises),
        areas=areas_of(under_test.view, where, found),
        drives=[drive.figures for drive in found],
        similar=alike,
        similar_of=len(probes),
        darkest_grey=darkest_grey(*map(np.array, zip(*levels, strict=True))) if levels else None,
        calibrations=merged([*known, *built, *(drive.figures.calibration for drive in found)]),
        fleet=None if reported.low is None else format_rate(reported),
    )
    tried = [start for drive in found for start in drive.starts]
    places = {
        name: np.array([start.place_m for start in tried if start.outcome == name])
        for name in StartCounts.__struct_fields__
    }
    seen = make_plan(under_test.manifest, lambda tile: decode_tile(maps.blob(tile.sha256)))
    plan = SitePlan(seen, areas, places, drives_to_add(under_test.view, where, report.areas))
    again = resurvey_list(maps, site, config.resurvey, maps.now_ns()).tiles
    fleet = [f"{tile.name}: {'; '.join(tile.reasons)}" for tile in again]
    return judged(report, config.gate, evidence, fleet), plan


def area_name(named: Areas, size_m: float, place_m: Array) -> str:
    """Return the area of a place (2,) in `map`, NaN if unknown; its tile outside of all areas."""
    if not np.isfinite(place_m).all():
        return UNKNOWN_PLACE
    x, y = (int(n) for n in np.floor(place_m / size_m))
    return named.at(float(place_m[0]), float(place_m[1])) or f"tile {x},{y}"


def similar(view: MapView, where: Where, probes: Sequence[Probe]) -> list[Similar]:
    """Return the areas of which frames fit other places, too, the most alike first."""
    pairs: Counter[tuple[str, str]] = Counter()
    for probe in probes:
        others = {where(fix.map_from_cam[:2, 3]) for fix in aliases(view, probe)}
        pairs.update((where(probe.map_from_cam[:2, 3]), other) for other in others)
    return [Similar(*pair, frames) for pair, frames in sorted(pairs.items(), key=lambda found: (-found[1], found[0]))]


def areas_of(view: MapView, where: Where, drives: Sequence[Drive]) -> list[AreaFigures]:
    """Return the figures of each area with places of the map or of a drive, by name."""
    places: defaultdict[str, list[Array]] = defaultdict(list)
    for place in view.map_from_cam:
        places[where(place[:2, 3])].append(place)
    figures = {name: AreaFigures(name, len(of_area)) for name, of_area in places.items()}
    for ways in tile_directions({(n, 0): np.array(of_area) for n, of_area in enumerate(places.values())}):
        figures[list(places)[ways.tile[0]]].seen = ways.seen
        figures[list(places)[ways.tile[0]]].missing = ways.missing

    def area(place_m: Array) -> AreaFigures:
        return figures.setdefault(where(place_m), AreaFigures(where(place_m)))

    greys: defaultdict[str, list[float]] = defaultdict(list)
    for drive in drives:
        for place_m in drive.places_m:
            area(place_m)
        for start in drive.starts:
            starts = area(start.place_m).starts
            setattr(starts, start.outcome, getattr(starts, start.outcome) + 1)
        for picture in drive.pictures:
            found = area(picture.probe.map_from_cam[:2, 3])
            found.frames += Count(int(picture.is_fixed), 1)
            found.wrong += picture.is_wrong
            greys[found.name].append(picture.grey)
            if picture.error_m is not None and not picture.is_wrong:
                found.errors_mm.append(round(1e3 * picture.error_m, 2))
            for kind, ladder in (("darkness", found.darkness), ("blur", found.blur)):
                for level, (_, is_fixed) in picture.rungs[kind].items():
                    ladder[str(level)] = ladder.get(str(level), Count()) + Count(int(is_fixed), 1)
    for name, levels in greys.items():
        figures[name].grey = float(np.median(levels))
    return [figures[name] for name in sorted(figures)]


def drives_to_add(view: MapView, where: Where, areas: Sequence[AreaFigures]) -> list[tuple[Array, str]]:
    """Return places (2,) of the map, a few metres apart, with the heading in which nobody drove there."""
    missing = {area.name: area.missing for area in areas}
    found: dict[tuple[object, ...], tuple[Array, str]] = {}
    for map_from_cam, sector, _, is_alone in zip(view.map_from_cam, *headings_of(view.map_from_cam), strict=True):
        place_m, heading = map_from_cam[:2, 3], opposite(int(sector))
        if is_alone and heading in missing[where(place_m)]:
            found.setdefault((heading, *np.floor(place_m / _STRIDE_M)), (place_m, heading))
    return list(found.values())
