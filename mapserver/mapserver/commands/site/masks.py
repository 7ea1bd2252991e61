"""`mapserver masks`: keep-out and speed masks that people draw over a site's map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import ActorOptions, SiteOptions, check_output

if TYPE_CHECKING:
    from mapserver.grid.masks import Mask
    from mapserver.store import MapStore


def _masks(maps: "MapStore", site: str) -> "list[Mask]":
    from fleetmap.mapformat.building import MASKS
    from mapserver.grid.masks import read_masks

    data, alignment = maps.site_file(site, MASKS), maps.alignment(site)
    return [] if data is None else read_masks(data, None if alignment is None else alignment.frame)


@expand_options
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON of polygons, in metres.")],
    where: SiteOptions,
    by: ActorOptions,
) -> None:
    """Take the masks of FILE in the place of those that the site has; they stay with it across versions."""
    from fleetmap.mapformat.building import MASKS
    from mapserver.floor_plan.areas import MAX_AREAS_BYTES
    from mapserver.grid.masks import check_on_map, read_masks
    from mapserver.store import MapStore

    with disk_errors(f"{file} cannot be read", "check the path and its rights", UsageError), file.open("rb") as opened:
        data = opened.read(MAX_AREAS_BYTES + 1)
    with MapStore.open(where.store) as maps:
        alignment, current = maps.alignment(where.site), maps.current(where.site)
        masks = read_masks(data, None if alignment is None else alignment.frame)
        if current is not None:
            check_on_map(masks, maps.manifest(where.site, current.version))
        maps.keep_site_files(where.site, {MASKS: data}, f"masks of {file.name}", actor=by.named())
    typer.echo(f"site {where.site}: {len(masks)} masks")


@expand_options
def remove(where: SiteOptions, by: ActorOptions) -> None:
    """Forget the masks of a site."""
    from fleetmap.mapformat.building import MASKS
    from mapserver.store import MapStore

    with MapStore.open(where.store) as maps:
        maps.keep_site_files(where.site, {MASKS: None}, "no masks", actor=by.named())
    typer.echo(f"site {where.site} has no masks")


@expand_options
def list_(where: SiteOptions) -> None:
    """List the masks of a site."""
    from mapserver.store import MapStore

    with MapStore.open(where.store, read_only=True) as maps:
        maps.current(where.site)  # an unknown site is not an empty one
        masks = _masks(maps, where.site)
    for mask in masks:
        speed = "" if mask.percent is None else f" {mask.percent} %"
        typer.echo(f"{mask.area.name}: {mask.kind.value}{speed}, {mask.area.size_m2:.1f} m2")
    typer.echo(f"{len(masks)} masks")


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
    """Write a site's masks as nav2's costmap filters read them, in the frame of the map."""
    from fleetmap.occupancy_grid import write_grid
    from mapserver.grid.masks import MaskKind, mask_grid
    from mapserver.store import MapStore

    asked = {MaskKind.KEEP_OUT: keep_out, MaskKind.SPEED: speed}
    if not any(asked.values()):
        raise UsageError("name a file by --keep-out or --speed")
    for kind, file in asked.items():
        check_output(f"--{kind.value}", file)
        if file is not None and file.suffix != ".yaml":
            raise UsageError(f"--{kind.value} {file} must end in .yaml")
    with MapStore.open(where.store, read_only=True) as maps:
        maps.current(where.site)
        masks = _masks(maps, where.site)
    grids = {file: mask_grid(masks, kind) for kind, file in asked.items() if file is not None}
    for file, grid in grids.items():
        write_grid(file, grid)
        typer.echo(str(file))


MASKS_GROUP = Group(
    "Keep-out and speed masks over a site's map, for planners.",
    {"import": import_, "list": list_, "remove": remove, "export": export},
)
