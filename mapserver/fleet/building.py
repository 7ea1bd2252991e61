"""Operators' knowledge of a site's building: named areas, requested surveys, the pose of the map in its plan, and the floors.

All are kept with the site. A survey of a polygon is requested until a version covers it or the request is closed. The floors are a file of
each of their sites, which robots get with the site's signed list.
"""

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import degrees

import msgspec
import numpy as np

from fleetmap.encoding import to_json
from fleetmap.errors import InvalidValueError, MapFormatError, StateError, UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.building import ALIGNMENT, AREAS, FLOORS, Building, Floor, read_building, read_lifts
from mapserver.floor_plan.alignment import PLAN, Alignment, encode_alignment, map_corners_m
from mapserver.floor_plan.areas import MAX_REASON, Area, Areas, Correction, CorrectionKind, read_areas
from mapserver.floor_plan.masks import check_masks_on_map
from mapserver.floor_plan.pins import Fit, Pin, fit_pins
from mapserver.floor_plan.plan_file import PlanFile
from mapserver.floor_plan.rmf import RmfLevel
from mapserver.floor_plan.survey_requests import ASKED, KIND, TILES, SurveyRequest
from mapserver.store import Actor, MapStore
from mapserver.store.map_store import AREAS_BEFORE

MOST_REQUESTS, MOST_CORNERS = 100, 200
MOST_SIDE_M = 500.0
Corners = Sequence[tuple[float, float]]


def keep_areas(
    store: MapStore, site: str, data: bytes | None, detail: str | None, actor: Actor, *, tag: str | None = None
) -> Areas:
    """Replace the areas of a site by those of a GeoJSON file, or remove them (None); return them. detail: for the log, None for the names
    that come and go. Areas that were drawn in the building stay in its frame: they move with the alignment. A survey of new areas to
    forget is requested.

    tag: `areas_tag` of the areas that were looked at, None for any. UsageError for an unknown site, for invalid areas, for a mask
    outside of the map and a correction without a reason, ChangedError if somebody changed them since.
    """
    current, before, areas = store.current(site), store.areas(site), Areas()
    if data is not None:
        alignment = store.alignment(site)
        areas = read_areas(data, None if alignment is None else alignment.frame)
        if current is not None:
            check_masks_on_map(areas, store.manifest(site, current.version))
        if alignment is not None and before.frame == "building" and areas.frame == "map":
            data = to_json(areas.geojson(site, alignment.frame))
        data = _dated(data, areas, before, actor, store.now_ns())
    if detail is None:
        added, removed = (sorted({*one.names} - {*other.names}) for one, other in ((areas, before), (before, areas)))
        words = [f"{done} {', '.join(names)}" for done, names in (("added", added), ("removed", removed)) if names]
        detail = "; ".join(words)[:2000] or "changed"
    store.keep_site_files(site, {AREAS: data}, detail, actor=actor, areas_tag=tag)
    after, known = store.areas(site), {area.correction for area in before.corrections}
    for area in after.corrections if current is not None else ():
        if area.correction not in known and area.correction and area.correction.kind is CorrectionKind.FORGET:
            with suppress(UsageError, StateError):  # too large or too many for requests: somebody surveys it
                for ring in area.outlines:
                    ask_for_survey(store, site, [(x, y) for x, y in ring.tolist()], actor)
    return after


def correct_area(store: MapStore, site: str, name: str, kind: CorrectionKind | None, actor: Actor) -> Areas:
    """Let an area of a site correct the map, or no longer (None), and return all areas. UsageError for an unknown one; as `keep_areas`."""
    areas = store.areas(site)
    if name not in areas.names:
        raise UsageError(
            f"site {site} has no area {name[:80]!r}; see `mapserver areas list`, or draw it on the Maps page"
        )
    correction = None if kind is None else Correction(kind, _one_line(actor.reason))
    changed = [replace(area, correction=correction) if area.name == name else area for area in areas.areas]
    return keep_areas(store, site, to_json(Areas.of(changed).geojson(site)), None, actor, tag=store.areas_tag(site))


def undo_areas(store: MapStore, site: str, actor: Actor) -> Areas:
    """Bring back the areas as they were before their last change, with the moments of their corrections, and return them; undone once more
    they are as now. Errors as of `keep_areas`.
    """
    store.current(site)  # raises for an unknown site
    if store.site_file(site, AREAS_BEFORE) is None and store.site_file(site, AREAS) is None:
        raise StateError(f"the areas of site {site} were never changed; there is nothing to undo")
    store.keep_site_files(site, {AREAS: store.site_file(site, AREAS_BEFORE)}, "last change undone", actor=actor)
    return store.areas(site)


def _dated(data: bytes, areas: Areas, before: Areas, actor: Actor, now_ns: int) -> bytes:
    """Give every correction its reason and the moment since when it holds: that of the same one before, else now.

    A new one without a reason gets the actor's; UsageError if there is none.
    """
    if not areas.corrections:
        return data
    collection, new = msgspec.json.decode(data), {area.name: area for area in areas.corrections}
    for number, feature in enumerate(collection["features"]):
        area = new.get(feature["properties"]["name"].strip())
        if area is None or area.correction is None:
            continue
        known = next((old.correction for old in before.corrections if _is_same(old, area)), None)
        reason = area.correction.reason.strip() or (known.reason if known else _one_line(actor.reason))
        if not reason:
            raise InvalidValueError(f"area {area.name!r}: a correction of the map needs a reason; add it, or --reason")
        since_ns = known.since_ns if known else now_ns + number  # each has another one, by which versions know it
        feature["properties"]["correction"] = {"kind": area.correction.kind, "reason": reason, "since_ns": since_ns}
    return to_json(collection)


def _one_line(reason: str) -> str:
    return " ".join(reason.split())[:MAX_REASON]


def _is_same(before: Area, after: Area) -> bool:
    """True if two areas correct the map alike, whatever their names: to a millimetre, for areas that were sent in another frame."""
    if before.correction is None or after.correction is None or before.correction.kind is not after.correction.kind:
        return False
    corners = [[[len(ring) for ring in polygon] for polygon in area.polygons] for area in (before, after)]
    return corners[0] == corners[1] and all(
        np.allclose(a, b, rtol=0, atol=1e-3) for a, b in zip(before.rings, after.rings, strict=True)
    )


def estimate_alignment(
    store: MapStore, site: str, pins: Sequence[Pin], plan: PlanFile | None, metres_per_pixel: float | None
) -> Fit:
    """Return the pose of a site's map in the drawing of its building (None: of pins alone), from pins.

    metres_per_pixel: of the drawing, None to estimate it. StateError without a current version, UsageError for pins that give no pose.
    """
    if plan is not None:
        plan.check_pins(pins)
    return fit_pins(pins, metres_per_pixel, current_corners_m(store, site), None if plan is None else plan.name)


def align(
    store: MapStore, site: str, pins: Sequence[Pin], plan: PlanFile | None, metres_per_pixel: float | None, actor: Actor
) -> Fit:
    """As `estimate_alignment`, and keep it with the drawing."""
    fit = estimate_alignment(store, site, pins, plan, metres_per_pixel)
    files = {ALIGNMENT: encode_alignment(fit.alignment), PLAN: None if plan is None else plan.data}
    store.keep_site_files(site, files, alignment_words(fit.alignment), actor=actor)
    return fit


def forget_alignment(store: MapStore, site: str, actor: Actor) -> None:
    """Remove the alignment and the drawing of a site; robots use the alignment of their version. UsageError while areas or a building
    need it."""
    if store.site_file_sha256(site, FLOORS) is not None:
        raise StateError(
            f"site {site} is a floor of a building, which needs its pose; remove the building's floors first"
        )
    store.keep_site_files(site, {ALIGNMENT: None, PLAN: None}, "forgotten", actor=actor)


def current_corners_m(store: MapStore, site: str) -> Array:
    """Return the corners (4, 2) of the current version. Its frame is that of the pins; a first draft has its own frame."""
    current = store.current(site)
    if current is None:
        raise StateError(f"site {site} has no current version to align; publish one first")
    return map_corners_m(store.manifest(site, current.version))


def alignment_words(found: Alignment) -> str:
    """Return an alignment as a sentence."""
    frame = found.frame
    turned = f"turned by {degrees(frame.yaw_rad):.3f} degrees +- {degrees(frame.sigma_rad):.3f}"
    at = f"the map's origin at {frame.x_m:.3f}, {frame.y_m:.3f} m of the building"
    return f"by {found.method}: {at}, {turned}, {found.metres_per_unit:.6g} m per unit of the plan"


def ask_for_survey(store: MapStore, site: str, corners_map_m: Corners, actor: Actor) -> SurveyRequest:
    """Store a request, and log it in the site's history.

    UsageError for an unknown site or an invalid polygon (simple, at most MOST_SIDE_M each way), StateError without a map and for too many.
    """
    current = store.current(site)
    if current is None:
        raise StateError(f"site {site} has no published map to resurvey; publish one first")
    if len(store.survey_requests(site)) >= MOST_REQUESTS:
        raise StateError(f"site {site} has {MOST_REQUESTS} open requests; close some first")
    if not 3 <= len(corners_map_m) <= MOST_CORNERS:
        raise InvalidValueError(f"{len(corners_map_m)} corners; draw the polygon with 3 to {MOST_CORNERS}")
    ring = [[round(float(x), 2), round(float(y), 2)] for x, y in corners_map_m]
    asked_ns = store.now_ns()
    who = {"name": "survey", "asked_ns": asked_ns, "actor": actor.name, "reason": actor.reason}
    geometry = {"type": "Polygon", "coordinates": [[*ring, *ring[:1]]]}
    feature = {"type": "Feature", "geometry": geometry, "properties": who}
    data = to_json({"type": "FeatureCollection", "frame": "map", "features": [feature]})
    (area,) = read_areas(data, None).areas  # refuses polygons that are not simple
    sides_m = np.ptp(np.array(ring), axis=0)
    if sides_m.max() > MOST_SIDE_M:
        raise InvalidValueError(
            f"{sides_m[0]:.0f} x {sides_m[1]:.0f} m; draw several of at most {MOST_SIDE_M:g} m each way"
        )
    made = SurveyRequest(hashlib.sha256(data).hexdigest()[:8], asked_ns, actor.name, actor.reason, ring)
    middle = np.array(ring).mean(axis=0)
    named = store.areas(site).at(*middle.tolist())
    tiles = " ".join(f"{x},{y}" for x, y in made.tiles(store.manifest(site, current.version).tile_size_m))
    place = f"{area.size_m2:.0f} m2 around {middle[0]:.1f}, {middle[1]:.1f} m"
    words = f"{ASKED}{f'{named}, ' if named else ''}{place}{TILES}{tiles}"
    store.keep_site_files(site, {KIND + made.id: data}, words, actor=actor)
    return made


def end_request(store: MapStore, site: str, request: str, actor: Actor) -> None:
    """Remove a request from the list because it was surveyed or is no longer wanted. UsageError for an unknown one."""
    store.current(site)  # raises for an unknown site
    if request not in {known.id for known in store.survey_requests(site)}:
        raise UsageError(f"site {site} has no open request {request[:40]!r} for a survey; it may be closed already")
    store.keep_site_files(site, {KIND + request: None}, "done", actor=actor)


def keep_building(store: MapStore, building: Building, actor: Actor) -> Building:
    """Make the sites the floors of a building, and return it, from below; sites that it had before leave it.

    Raises UsageError for an unknown site, one without a version or pose, one of another building, for repeated levels or heights, for names
    that cannot be printed in a line, and for a single floor.
    """
    for text in (building.name, *(floor.level for floor in building.floors)):
        if not (0 < len(text) <= 64 and text.isprintable() and text == text.strip()):
            raise UsageError(f"name {text[:80]!r} of a building or level: use 1 to 64 characters of one line")
    if len(building.floors) < 2:
        raise UsageError(f"building {building.name!r}: two floors or more make a building; name each with --floor")
    try:
        building = read_building(to_json(building))
    except MapFormatError as error:
        raise UsageError(str(error)) from error
    sites = [floor.site for floor in building.floors]
    for site in sites:
        if store.current(site) is None:  # it raises for an unknown site
            how = f"publish one with `mapserver publish --site {site}`"
            raise UsageError(f"site {site} has no published version, and robots need the maps of all floors; {how}")
        known = store.building(site)
        if known is not None and known.name != building.name:
            how = f"`mapserver building remove {shlex.quote(known.name)}` first, or set that one"
            raise UsageError(f"site {site} is a floor of {known.name!r}; {how}")
        if store.alignment(site) is None:
            raise UsageError(f"site {site} has no pose in the building; run `mapserver align --site {site} --pin ...`")
    for known in buildings(store):
        if known.name == building.name:
            _forget(store, [floor.site for floor in known.floors if floor.site not in sites], known, actor)
    data = to_json(building)
    for floor in building.floors:
        words = f"{building.name}: level {floor.level}, {floor.height_m:g} m"
        store.keep_site_files(floor.site, {FLOORS: data}, words, actor=actor)
    return building


def keep_rmf_building(store: MapStore, building: Building, levels: Mapping[str, RmfLevel], actor: Actor) -> Building:
    """As `keep_building`, with the lifts of Open-RMF's levels, by name, in place of the sites' own. Errors of `RmfLevel.check_aligned` and
    `keep_areas` too.
    """
    for floor in building.floors:
        if (alignment := store.alignment(floor.site)) is not None:
            levels[floor.level].check_aligned(floor.site, alignment)
    kept = keep_building(store, building, actor)
    for floor in kept.floors:
        alignment, before = store.alignment(floor.site), store.areas(floor.site)
        assert alignment is not None  # `keep_building` refuses it
        areas = before.with_lifts(levels[floor.level].lifts, alignment.frame)
        data = to_json(areas.geojson(floor.site, alignment.frame if areas.frame == "building" else None))
        if before or areas:
            keep_areas(store, floor.site, data if areas else None, f"lifts of {kept.name}", actor)
    return kept


def remove_building(store: MapStore, name: str, actor: Actor) -> Building:
    """Let each floor of a building be a site of its own again, and return the building; UsageError for an unknown one."""
    for known in buildings(store):
        if known.name == name:
            _forget(store, [floor.site for floor in known.floors], known, actor)
            return known
    raise UsageError(f"there is no building {name[:80]!r}; `mapserver building list` shows all")


def _forget(store: MapStore, sites: Sequence[str], building: Building, actor: Actor) -> None:
    for site in sites:
        store.keep_site_files(site, {FLOORS: None}, f"no floor of {building.name}", actor=actor)


def buildings(store: MapStore) -> list[Building]:
    """Return all buildings, by name."""
    found = {known.name: known for info in store.sites() if (known := store.building(info.site)) is not None}
    return [found[name] for name in sorted(found)]


def floors_of(store: MapStore, building: Building) -> list[Floor]:
    """Return the floors with their poses and lifts; one whose alignment was removed is left out."""
    return [
        Floor(entry, alignment.frame, read_lifts(store.site_file(entry.site, AREAS), alignment.frame))
        for entry in building.floors
        if (alignment := store.alignment(entry.site)) is not None
    ]


def single_lifts(floors: Sequence[Floor]) -> list[str]:
    """Return the lifts that only one floor has: robots in them cannot come out elsewhere."""
    names = [name for floor in floors for name in floor.lifts]
    return sorted(name for name in set(names) if names.count(name) == 1)
