"""The floors of a building, kept as a file of each of its sites, which robots get with the site's signed list."""

import shlex
from collections.abc import Sequence

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, UsageError
from fleetmap.mapformat.building import AREAS, FLOORS, Building, Floor, FloorEntry, read_building, read_lifts
from mapserver.store import Actor, MapStore


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

    def floor(entry: FloorEntry) -> Floor | None:
        alignment = store.alignment(entry.site)
        if alignment is None:
            return None
        return Floor(entry, alignment.frame, read_lifts(store.site_file(entry.site, AREAS), alignment.frame))

    return [found for entry in building.floors if (found := floor(entry)) is not None]


def single_lifts(floors: Sequence[Floor]) -> list[str]:
    """Return the lifts that only one floor has: robots in them cannot come out elsewhere."""
    names = [name for floor in floors for name in floor.lifts]
    return sorted(name for name in set(names) if names.count(name) == 1)
