"""`mapserver versions`: the versions of a site."""

from mapserver.commands.options import Json, SiteName, StoreFolder, print_json


def versions(site: SiteName, store: StoreFolder, json: Json = False) -> None:
    """List the versions of a site with their states, oldest first."""
    from rich.console import Console
    from rich.table import Table

    from mapserver.store import MapStore

    with MapStore.open(store, read_only=True) as maps:
        infos = maps.versions(site)
    if json:
        print_json(infos)
        return
    table = Table("version", "state", "parent", "created", "tiles", "landmarks", "bytes")
    for info in infos:
        parent = "" if info.parent is None else str(info.parent)
        sizes = (str(info.tiles), str(info.landmarks), str(info.map_bytes))
        table.add_row(str(info.version), info.state, parent, info.created, *sizes)
    Console().print(table)
