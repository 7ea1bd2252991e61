"""Operators' knowledge of a site's building: its named areas, and the pose of the map in its floor plan. Both are kept with the site."""

from collections.abc import Sequence
from math import degrees

from fleetmap.encoding import to_json
from fleetmap.errors import StateError
from fleetmap.geometry import Array
from fleetmap.mapformat.building import ALIGNMENT, AREAS
from mapserver.floor_plan.alignment import PLAN, Alignment, encode_alignment, map_corners_m
from mapserver.floor_plan.areas import Areas, read_areas
from mapserver.floor_plan.pins import Fit, Pin, fit_pins
from mapserver.floor_plan.plan_file import PlanFile, upwards
from mapserver.grid.masks import check_masks_on_map
from mapserver.store import Actor, MapStore


def keep_areas(
    store: MapStore, site: str, data: bytes | None, detail: str, actor: Actor, *, tag: str | None = None
) -> Areas:
    """Replace the areas of a site by those of a GeoJSON file, or remove them (None); return them. detail: for the log.

    tag: `areas_tag` of the areas that were looked at, None for any. UsageError for an unknown site, for invalid areas and for a mask
    outside of the map, ChangedError if somebody changed them since.
    """
    current, alignment = store.current(site), store.alignment(site)
    if data is not None and current is not None:
        areas = read_areas(data, None if alignment is None else alignment.frame)
        check_masks_on_map(areas, store.manifest(site, current.version))
    store.keep_site_files(site, {AREAS: data}, detail, actor=actor, areas_tag=tag)
    return store.areas(site)


def replace_areas(store: MapStore, site: str, data: bytes, actor: Actor, *, tag: str | None) -> Areas:
    """As `keep_areas`, with the names in the log. Areas that were drawn in the building stay in its frame: they move with the alignment."""
    alignment, before = store.alignment(site), store.areas(site)
    frame = None if alignment is None else alignment.frame
    after = read_areas(data, frame)
    if before.frame == "building" and after.frame == "map":
        data = to_json(after.geojson(site, frame))
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
    """Remove the alignment and the drawing of a site; robots use the alignment of their version. UsageError while areas need it."""
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
