"""Operators' knowledge of a site's building: its named areas, and the pose of the map in its floor plan. Both are kept with the site."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import degrees

import msgspec
import numpy as np

from fleetmap.encoding import to_json
from fleetmap.errors import StateError, UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.building import ALIGNMENT, AREAS, FLOORS
from mapserver.fleet.survey_requests import ask_for_survey
from mapserver.floor_plan.alignment import PLAN, Alignment, encode_alignment, map_corners_m
from mapserver.floor_plan.areas import MAX_REASON, Area, Areas, Correction, CorrectionKind, read_areas
from mapserver.floor_plan.masks import check_masks_on_map
from mapserver.floor_plan.pins import Fit, Pin, fit_pins
from mapserver.floor_plan.plan_file import PlanFile, upwards
from mapserver.store import Actor, MapStore
from mapserver.store.map_store import AREAS_BEFORE


def keep_areas(
    store: MapStore, site: str, data: bytes | None, detail: str, actor: Actor, *, tag: str | None = None
) -> Areas:
    """Replace the areas of a site by those of a GeoJSON file, or remove them (None); return them. detail: for the log. A survey
    of new areas to forget is requested.

    tag: `areas_tag` of the areas that were looked at, None for any. UsageError for an unknown site, for invalid areas, for a mask
    outside of the map and a correction without a reason, ChangedError if somebody changed them since.
    """
    current, before = store.current(site), store.areas(site)
    if data is not None:
        areas = _read(store, site, data)
        if current is not None:
            check_masks_on_map(areas, store.manifest(site, current.version))
        data = _dated(data, areas, before, actor, store.now_ns())
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
    data = to_json(Areas.of(changed).geojson(site))
    return replace_areas(store, site, data, actor, tag=store.areas_tag(site))


def undo_areas(store: MapStore, site: str, actor: Actor) -> Areas:
    """Bring back the areas as they were before their last change, with the moments of their corrections, and return them; undone once more
    they are as now. Errors as of `keep_areas`.
    """
    store.current(site)  # raises for an unknown site
    if store.site_file(site, AREAS_BEFORE) is None and store.site_file(site, AREAS) is None:
        raise StateError(f"the areas of site {site} were never changed; there is nothing to undo")
    store.keep_site_files(site, {AREAS: store.site_file(site, AREAS_BEFORE)}, "last change undone", actor=actor)
    return store.areas(site)


def _read(store: MapStore, site: str, data: bytes) -> Areas:
    alignment = store.alignment(site)
    return read_areas(data, None if alignment is None else alignment.frame)


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
            raise UsageError(f"area {area.name!r}: a correction of the map needs a reason; add it, or --reason")
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


def replace_areas(store: MapStore, site: str, data: bytes, actor: Actor, *, tag: str | None) -> Areas:
    """As `keep_areas`, with the names in the log. Areas that were drawn in the building stay in its frame: they move with the alignment."""
    alignment, before, after = store.alignment(site), store.areas(site), _read(store, site, data)
    if alignment is not None and before.frame == "building" and after.frame == "map":
        data = to_json(after.geojson(site, alignment.frame))
    added, removed = (sorted({*these.names} - {*others.names}) for these, others in ((after, before), (before, after)))
    words = [f"{done} {', '.join(names)}" for done, names in (("added", added), ("removed", removed)) if names]
    return keep_areas(store, site, data, "; ".join(words)[:2000] or "changed", actor, tag=tag)


def estimate_alignment(
    store: MapStore, site: str, pins: Sequence[Pin], plan: PlanFile | None, metres_per_pixel: float | None
) -> tuple[Alignment, Fit]:
    """Return the pose of a site's map in the drawing of its building (None: of pins alone), from pins.

    metres_per_pixel: of the drawing, None to estimate it. StateError without a current version, UsageError for pins that give no pose.
    """
    drawn = upwards(list(pins)) if plan is None else plan.drawn(list(pins))
    fit = fit_pins(drawn, metres_per_pixel, current_corners_m(store, site))
    found = Alignment(
        frame=fit.frame,
        metres_per_unit=fit.metres_per_unit,
        method="pins",
        plan=None if plan is None else plan.name,
        off_m=fit.off_m,
    )
    return found, fit


def align(
    store: MapStore, site: str, pins: Sequence[Pin], plan: PlanFile | None, metres_per_pixel: float | None, actor: Actor
) -> tuple[Alignment, Fit]:
    """As `estimate_alignment`, and keep it with the drawing."""
    found, fit = estimate_alignment(store, site, pins, plan, metres_per_pixel)
    files = {ALIGNMENT: encode_alignment(found), PLAN: None if plan is None else plan.data}
    store.keep_site_files(site, files, alignment_words(found), actor=actor)
    return found, fit


def forget_alignment(store: MapStore, site: str, actor: Actor) -> None:
    """Remove the alignment and the drawing of a site; robots use the alignment of their version. UsageError while areas or a building
    need it."""
    if store.site_file_sha256(site, FLOORS) is not None:
        raise UsageError(
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
