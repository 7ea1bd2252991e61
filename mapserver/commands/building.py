"""`mapserver align`, `areas` and `building`: a site in its building, its named areas, and sites that are floors."""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option, echo

from fleetmap.cli_options import Group
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands import options

if TYPE_CHECKING:
    from fleetmap.geometry import Array
    from fleetmap.mapformat.building import Building, FloorEntry
    from mapserver.floor_plan.alignment import Alignment
    from mapserver.floor_plan.rmf import RmfLevel
    from mapserver.store import MapStore

_Name = Annotated[str, Argument(metavar="NAME", help="Name of the building.")]
_FORM, _RMF_FORM = "SITE=LEVEL@HEIGHT", "SITE=LEVEL"


def align(
    *,
    where: options.SiteOptions,
    plan: Annotated[Path | None, Option(metavar="FILE", help="Drawing of the building from above, a picture.")] = None,
    pin: Annotated[
        list[str] | None,
        Option(metavar="NAME=PX,PY:X,Y", help="Point of the plan (pixels) and of the map (metres); repeat it."),
    ] = None,
    metres_per_pixel: Annotated[
        float | None, Option(min=1e-6, max=1e3, help="Scale of the plan; default: estimated from the pins.")
    ] = None,
    show: Annotated[bool, Option("--show", help="Print the stored alignment; change nothing.")] = False,
    level: Annotated[
        str | None, Option(metavar="NAME", help="Name of the level for Open-RMF; default: the building's, else L1.")
    ] = None,
    json: options.Json = False,
    by: options.ActorOptions,
    forget: Annotated[bool, Option("--forget", help="Forget the alignment and the plan.")] = False,
) -> None:
    """Estimate the pose of the map in the building's drawing, and store it; robots get it with the signed list."""
    from mapserver.fleet import building
    from mapserver.floor_plan.pins import parse_pin
    from mapserver.floor_plan.plan_file import read_plan

    named = plan is not None or bool(pin)
    if show + forget + named != 1:
        raise UsageError("name --pin (and --plan) to align, --show to print the stored alignment, or --forget")
    with options.open_store(where.store, read_only=show) as maps:
        corners = building.current_corners_m(maps, where.site)
        if forget:
            building.forget_alignment(maps, where.site, by.named())
            echo(f"site {where.site}: the alignment is forgotten; robots use the alignment of their version")
            return
        if named:
            pins, drawing = [parse_pin(text) for text in pin or []], None if plan is None else read_plan(plan)
            fit = building.align(maps, where.site, pins, drawing, metres_per_pixel, by.named())
            if not fit.is_checked:
                words = "the pins lie on one line and cannot reveal a mirrored plan; add a pin beside the line"
                echo(f"note: {words}", err=True)
            off_m = 2 * fit.far_sigma_m
            echo(f"at the far end of the map positions in the building are known to {off_m:.2f} m (95 %)")
        alignment, tower = maps.alignment(where.site), maps.building(where.site)
    if level is None:
        levels = {} if tower is None else {floor.site: floor.level for floor in tower.floors}
        level = levels.get(where.site, "L1")
    if alignment is None:
        raise UsageError(f"site {where.site} is not aligned; `mapserver align --plan FILE --pin ...` does it")
    options.print_result(alignment, _alignment_words(alignment, corners, level), json=json)


def _alignment_words(found: "Alignment", corners: "Array", level: str) -> Iterator[str]:
    from mapserver.fleet.building import alignment_words
    from mapserver.floor_plan.alignment import reference_coordinates

    frame = found.frame
    numbers = f"--x {frame.x_m:.4f} --y {frame.y_m:.4f} --yaw {frame.yaw_rad:.6f}"
    yield alignment_words(found)
    yield from (f"pin {name}: {off_m:.3f} m left" for name, off_m in found.off_m.items())
    yield f"\n# Open-RMF, fleet adapter\n{reference_coordinates(frame, level, corners)}"
    yield "\n# ROS 2: building -> map, if no robot publishes it"
    yield f"ros2 run tf2_ros static_transform_publisher {numbers} --frame-id building --child-frame-id map"


def import_(
    file: Annotated[Path, Argument(metavar="FILE", help="GeoJSON of polygons, in metres.")],
    where: options.SiteOptions,
    by: options.ActorOptions,
) -> None:
    """Replace the areas of the site by those of FILE; reports, pages and metrics then use them."""
    from mapserver.fleet.building import keep_areas
    from mapserver.floor_plan.areas import MAX_AREAS_BYTES

    with disk_errors(f"{file} cannot be read", "check the path and its rights", UsageError), file.open("rb") as opened:
        data = opened.read(MAX_AREAS_BYTES + 1)
    if len(data) > MAX_AREAS_BYTES:
        raise UsageError(f"{file} has more than {MAX_AREAS_BYTES} bytes; draw the areas with fewer corners")
    with options.open_store(where.store) as maps:
        names = keep_areas(maps, where.site, data, f"areas of {file.name}", by.named()).names
    echo(f"site {where.site}: {len(names)} areas ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})")


def remove_areas(where: options.SiteOptions, by: options.ActorOptions) -> None:
    """Delete the areas of a site; their past counts stay."""
    from mapserver.fleet.building import keep_areas

    with options.open_store(where.store) as maps:
        keep_areas(maps, where.site, None, "no areas", by.named())
    echo(f"site {where.site} has no areas")


def list_areas(where: options.SiteOptions, json: options.Json = False) -> None:
    """List the areas of a site; as JSON it is GeoJSON, in the frame `map`."""
    with options.open_store(where.store, read_only=True) as maps:
        maps.current(where.site)  # raises for an unknown site
        areas = maps.areas(where.site)
    ordered = sorted(areas.areas, key=lambda area: area.name)
    lines = [f"{area.name}: {area.size_m2:.1f} m2{area.effects}" for area in ordered]
    options.print_result(areas.geojson(where.site), [*lines, f"{len(lines)} areas"], json=json)


def export(
    where: options.SiteOptions,
    keep_out: Annotated[
        Path | None, Option(metavar="OUT.yaml", help="Write the mask of nav2's KeepoutFilter, and its image.")
    ] = None,
    speed: Annotated[
        Path | None, Option(metavar="OUT.yaml", help="Write the mask of nav2's SpeedFilter, and its image.")
    ] = None,
) -> None:
    """Write the areas with a mask for nav2's costmap filters, in the frame of the map."""
    from fleetmap.version_grid import write_grid
    from mapserver.floor_plan.areas import MaskKind
    from mapserver.floor_plan.masks import mask_grid

    asked = {MaskKind.KEEP_OUT: keep_out, MaskKind.SPEED: speed}
    if not any(asked.values()):
        raise UsageError("name a file by --keep-out or --speed")
    for kind, file in asked.items():
        options.check_output(f"--{kind.value}", file, ".yaml")
    with options.open_store(where.store, read_only=True) as maps:
        maps.current(where.site)
        areas = maps.areas(where.site)
    grids = {file: mask_grid(areas, kind) for kind, file in asked.items() if file is not None}
    for file, grid in grids.items():
        write_grid(file, grid)
        echo(str(file))


AREAS = Group(
    "Named areas of a site.", {"import": import_, "list": list_areas, "remove": remove_areas, "export": export}
)


def set_(
    name: Annotated[str, Argument(metavar="NAME", help="Name of the building; default: the file's.")] = "",
    *,
    floor: Annotated[list[str], Option(metavar=_FORM, help="A floor: site, its level's name, height in metres.")],
    file: Annotated[
        Path | None, Option("--from", metavar="FILE", help="Take heights and lifts from a *.building.yaml of Open-RMF.")
    ] = None,
    store: options.StoreFolder,
    by: options.ActorOptions,
) -> None:
    """Make aligned sites the floors of a building; robots of each of them then know all of its floors."""
    from fleetmap.mapformat.building import Building
    from mapserver.fleet.building import floors_of, keep_building, keep_rmf_building, single_lifts
    from mapserver.floor_plan.rmf import read_rmf

    drawn_name, levels = ("", {}) if file is None else read_rmf(file)
    building = Building(name=name or drawn_name, floors=tuple(_entry(text, levels) for text in floor))
    with options.open_store(store) as maps:
        keep = partial(keep_rmf_building, levels=levels) if levels else keep_building
        kept = keep(maps, building, actor=by.named())
        lifts = single_lifts(floors_of(maps, kept))
        options.print_result(kept, _building_words(maps, kept))
    if lifts:
        words = "areas with the same `lift` on the other floors are missing"
        echo(f"note: {', '.join(lifts)}: {words}", err=True)


def remove_building(name: _Name, *, store: options.StoreFolder, by: options.ActorOptions) -> None:
    """Let the floors of a building be sites of their own again; their maps stay."""
    from mapserver.fleet import building

    with options.open_store(store) as maps:
        removed = building.remove_building(maps, name, by.named())
    echo(f"{name}: {', '.join(floor.site for floor in removed.floors)} are no floors of one building any more")


def list_buildings(
    *,
    store: options.StoreFolder,
    json: options.Json = False,
    form: Annotated[
        Literal["rmf"] | None, Option("--as", metavar="rmf", help="Print a *.building.yaml of Open-RMF.")
    ] = None,
) -> None:
    """List the buildings with their floors and lifts."""
    from mapserver.fleet.building import buildings, floors_of
    from mapserver.floor_plan.rmf import rmf_text

    with options.open_store(store, read_only=True) as maps:
        found = buildings(maps)
        if form == "rmf" and not json:
            echo("---\n".join(rmf_text(building, floors_of(maps, building)) for building in found), nl=False)
            return
        lines = [line for building in found for line in _building_words(maps, building)]
    options.print_result(found, [*lines, f"buildings: {len(found)}"], json=json)


def _entry(text: str, levels: "Mapping[str, RmfLevel]") -> "FloorEntry":
    from fleetmap.mapformat.building import FloorEntry
    from fleetmap.mapformat.names import check_name

    site, _, rest = text.partition("=")
    if levels:
        if rest not in levels:
            named = ", ".join(levels)[:200]
            raise UsageError(
                f"--floor {text[:80]!r}: write {_RMF_FORM}, such as hall-1=L1; the file's levels are {named}"
            )
        return FloorEntry(site=check_name(site, "site"), level=rest, height_m=levels[rest].height_m)
    level, _, height = rest.rpartition("@")
    try:
        height_m = float(height)
    except ValueError:
        height_m = float("nan")
    if not (level and len(level) <= 64 and abs(height_m) <= 10_000):
        raise UsageError(f"--floor {text[:80]!r}: write {_FORM}, such as hall-1=L1@0 and hall-2=L2@4.5")
    return FloorEntry(site=check_name(site, "site"), level=level, height_m=height_m)


def _building_words(maps: "MapStore", building: "Building") -> Iterator[str]:
    from mapserver.fleet.building import floors_of

    lifts = {floor.entry.site: ", ".join(sorted(floor.lifts)) for floor in floors_of(maps, building)}
    yield f"{building.name}:"
    for floor in reversed(building.floors):
        known = lifts.get(floor.site)
        words = "not aligned" if known is None else f"lifts: {known or 'none'}"
        yield f"  {floor.level}  {floor.site}  {floor.height_m:g} m  {words}"


BUILDING = Group(
    "Sites that are the floors of one building.", {"set": set_, "list": list_buildings, "remove": remove_building}
)
