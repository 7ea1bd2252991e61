"""`mapserver areas`: the areas of a site that people have names for."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import ActorOptions, Json, SiteOptions, print_json


@expand_options
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON of polygons, in metres.")],
    where: SiteOptions,
    by: ActorOptions,
) -> None:
    """Take the areas of FILE in the place of those that the site has; reports, pages and metrics then speak of them."""
    from fleetmap.mapformat.building import AREAS
    from mapserver.floor_plan.areas import MAX_AREAS_BYTES
    from mapserver.store import MapStore

    with disk_errors(f"{file} cannot be read", "check the path and its rights", UsageError), file.open("rb") as opened:
        data = opened.read(MAX_AREAS_BYTES + 1)
    if len(data) > MAX_AREAS_BYTES:
        raise UsageError(f"{file} has more than {MAX_AREAS_BYTES} bytes; draw the areas with fewer corners")
    with MapStore.open(where.store) as maps:
        maps.keep_site_files(where.site, {AREAS: data}, f"areas of {file.name}", actor=by.named())
        names = maps.areas(where.site).names
    typer.echo(f"site {where.site}: {len(names)} areas ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})")


@expand_options
def remove(where: SiteOptions, by: ActorOptions) -> None:
    """Forget the areas of a site; what was counted for them stays."""
    from fleetmap.mapformat.building import AREAS
    from mapserver.store import MapStore

    with MapStore.open(where.store) as maps:
        maps.keep_site_files(where.site, {AREAS: None}, "no areas", actor=by.named())
    typer.echo(f"site {where.site} has no areas")


@expand_options
def list_(where: SiteOptions, json: Json = False) -> None:
    """List the areas of a site; as JSON it is GeoJSON, in the frame `map`."""
    from mapserver.store import MapStore

    with MapStore.open(where.store, read_only=True) as maps:
        maps.current(where.site)  # an unknown site is not an empty one
        areas = maps.areas(where.site)
    if json:
        print_json(areas.geojson(where.site))
        return
    for area in sorted(areas.areas, key=lambda area: area.name):
        typer.echo(f"{area.name}: {area.size_m2:.1f} m2")
    typer.echo(f"{len(areas.areas)} areas")


AREAS_GROUP = Group(
    "The areas of a site that people have names for.", {"import": import_, "list": list_, "remove": remove}
)
