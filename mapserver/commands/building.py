"""`mapserver building`: sites that are the floors of one building."""

from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, Json, StoreFolder, open_store, print_json

if TYPE_CHECKING:
    from fleetmap.mapformat.building import Building, FloorEntry
    from mapserver.store import MapStore

_Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the building.")]
_FORM = "SITE=LEVEL@HEIGHT"


@expand_options
def set_(
    name: _Name,
    *,
    floor: Annotated[list[str], typer.Option(metavar=_FORM, help="A floor: site, its level's name, height in metres.")],
    store: StoreFolder,
    by: ActorOptions,
) -> None:
    """Make aligned sites the floors of a building; robots of each of them then know all of its floors."""
    from fleetmap.mapformat.building import Building
    from mapserver.fleet.floors import floors_of, keep_building, single_lifts

    building = Building(name=name, floors=tuple(map(_entry, floor)))
    with open_store(store) as maps:
        kept = keep_building(maps, building, by.named())
        lifts = single_lifts(floors_of(maps, kept))
        _print(maps, kept)
    if lifts:
        words = "areas with the same `lift` on the other floors are missing"
        typer.echo(f"note: {', '.join(lifts)}: {words}", err=True)


@expand_options
def remove(name: _Name, *, store: StoreFolder, by: ActorOptions) -> None:
    """Let the floors of a building be sites of their own again; their maps stay."""
    from mapserver.fleet.floors import remove_building

    with open_store(store) as maps:
        removed = remove_building(maps, name, by.named())
    typer.echo(f"{name}: {', '.join(floor.site for floor in removed.floors)} are no floors of one building any more")


@expand_options
def list_(*, store: StoreFolder, json: Json = False) -> None:
    """List the buildings with their floors and lifts."""
    from mapserver.fleet.floors import buildings

    with open_store(store, read_only=True) as maps:
        found = buildings(maps)
        if json:
            print_json(found)
            return
        for building in found:
            _print(maps, building)
    typer.echo(f"buildings: {len(found)}")


def _entry(text: str) -> "FloorEntry":
    from fleetmap.mapformat import check_name
    from fleetmap.mapformat.building import FloorEntry

    site, _, rest = text.partition("=")
    level, _, height = rest.rpartition("@")
    try:
        height_m = float(height)
    except ValueError:
        height_m = float("nan")
    if not (level and len(level) <= 64 and abs(height_m) <= 10_000):
        raise UsageError(f"--floor {text[:80]!r}: write {_FORM}, such as hall-1=L1@0 and hall-2=L2@4.5")
    return FloorEntry(site=check_name(site, "site"), level=level, height_m=height_m)


def _print(maps: "MapStore", building: "Building") -> None:
    from mapserver.fleet.floors import floors_of

    lifts = {floor.entry.site: ", ".join(sorted(floor.lifts)) for floor in floors_of(maps, building)}
    typer.echo(f"{building.name}:")
    for floor in reversed(building.floors):
        known = lifts.get(floor.site)
        words = "not aligned" if known is None else f"lifts: {known or 'none'}"
        typer.echo(f"  {floor.level}  {floor.site}  {floor.height_m:g} m  {words}")


BUILDING = Group("Sites that are the floors of one building.", {"set": set_, "list": list_, "remove": remove})
