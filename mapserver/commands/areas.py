"""`mapserver areas`: the named areas of a site."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import ActorOptions, Json, SiteOptions, check_output, open_store, print_json


@expand_options
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON of polygons, in metres.")],
    where: SiteOptions,
    by: ActorOptions,
) -> None:
    """Replace the areas of the site by those of FILE; reports, pages and metrics then use them."""
    from mapserver.fleet.building import keep_areas
    from mapserver.floor_plan.areas import MAX_AREAS_BYTES

    with disk_errors(f"{file} cannot be read", "check the path and its rights", UsageError), file.open("rb") as opened:
        data = opened.read(MAX_AREAS_BYTES + 1)
    if len(data) > MAX_AREAS_BYTES:
        raise UsageError(f"{file} has more than {MAX_AREAS_BYTES} bytes; draw the areas with fewer corners")
    with open_store(where.store) as maps:
        names = keep_areas(maps, where.site, data, f"areas of {file.name}", by.named()).names
    typer.echo(f"site {where.site}: {len(names)} areas ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})")


@expand_options
def remove(where: SiteOptions, by: ActorOptions) -> None:
    """Delete the areas of a site; their past counts stay."""
    from mapserver.fleet.building import keep_areas

    with open_store(where.store) as maps:
        keep_areas(maps, where.site, None, "no areas", by.named())
    typer.echo(f"site {where.site} has no areas")


@expand_options
def correct(
    name: Annotated[str, typer.Argument(metavar="NAME", help="An area of the site.")],
    kind: Annotated[str, typer.Argument(metavar="forget|never-use|freeze|nothing", help="What maps do there.")],
    where: SiteOptions,
    by: ActorOptions,
) -> None:
    """Let an area correct the map, from the next build on, with --reason; `nothing` ends that."""
    from mapserver.fleet.building import correct_area
    from mapserver.floor_plan.areas import CorrectionKind

    kinds = {kind.value: kind for kind in CorrectionKind}
    if kind not in (*kinds, "nothing"):
        raise UsageError(f"{kind!r} is none of {', '.join(kinds)} and nothing")
    with open_store(where.store) as maps:
        areas = correct_area(maps, where.site, name, kinds.get(kind), by.named())
    (changed,) = (area for area in areas.areas if area.name == name)
    typer.echo(f"{name}: {changed.size_m2:.1f} m2{changed.effects}")


@expand_options
def undo(where: SiteOptions, by: ActorOptions) -> None:
    """Bring back the areas and corrections as before their last change; once more, and they are as now."""
    from mapserver.fleet.building import undo_areas

    with open_store(where.store) as maps:
        names = undo_areas(maps, where.site, by.named()).names
    typer.echo(f"site {where.site}: {len(names)} areas, as before the last change")


@expand_options
def list_(where: SiteOptions, json: Json = False) -> None:
    """List the areas of a site; as JSON it is GeoJSON, in the frame `map`."""
    with open_store(where.store, read_only=True) as maps:
        maps.current(where.site)  # raises for an unknown site
        areas = maps.areas(where.site)
    if json:
        print_json(areas.geojson(where.site))
        return
    for area in sorted(areas.areas, key=lambda area: area.name):
        typer.echo(f"{area.name}: {area.size_m2:.1f} m2{area.effects}")
    typer.echo(f"{len(areas.areas)} areas")


@expand_options
def export(
    where: SiteOptions,
    keep_out: Annotated[
        Path | None, typer.Option(metavar="OUT.yaml", help="Write the mask of nav2's KeepoutFilter, and its image.")
    ] = None,
    speed: Annotated[
        Path | None, typer.Option(metavar="OUT.yaml", help="Write the mask of nav2's SpeedFilter, and its image.")
    ] = None,
) -> None:
    """Write the areas with a mask for nav2's costmap filters, in the frame of the map."""
    from fleetmap.occupancy_grid import write_grid
    from mapserver.floor_plan.areas import MaskKind
    from mapserver.floor_plan.masks import mask_grid

    asked = {MaskKind.KEEP_OUT: keep_out, MaskKind.SPEED: speed}
    if not any(asked.values()):
        raise UsageError("name a file by --keep-out or --speed")
    for kind, file in asked.items():
        check_output(f"--{kind.value}", file, ".yaml")
    with open_store(where.store, read_only=True) as maps:
        maps.current(where.site)
        areas = maps.areas(where.site)
    grids = {file: mask_grid(areas, kind) for kind, file in asked.items() if file is not None}
    for file, grid in grids.items():
        write_grid(file, grid)
        typer.echo(str(file))


AREAS_GROUP = Group(
    "Named areas of a site.",
    {"import": import_, "list": list_, "remove": remove, "export": export, "correct": correct, "undo": undo},
)
