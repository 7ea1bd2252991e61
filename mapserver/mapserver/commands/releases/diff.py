"""`mapserver diff`: the differences between two versions."""

from typing import TYPE_CHECKING, Annotated

import typer

from mapserver.commands.options import Json, SiteName, StoreFolder, print_json

if TYPE_CHECKING:
    from mapserver.releases import Difference


def diff(
    before: Annotated[int, typer.Argument(min=1, metavar="A", help="The older version.")],
    after: Annotated[int, typer.Argument(min=1, metavar="B", help="The newer version.")],
    site: SiteName,
    store: StoreFolder,
    json: Json = False,
) -> None:
    """Show the differences from version A to version B: tiles, landmarks, bytes to fetch, quality side by side."""
    from mapserver import releases
    from mapserver.store import MapStore

    with MapStore.open(store, read_only=True) as maps:
        found = releases.difference(maps, site, before, after)
    if json:
        print_json(found)
    else:
        _print_tables(found)


def _print_tables(found: "Difference") -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table("", "added", "changed", "removed", "kept", title=f"{found.site}: {found.before} to {found.after}")
    for name, *counts in (
        ("tiles", found.tiles_added, found.tiles_changed, found.tiles_removed, found.tiles_kept),
        ("landmarks", found.landmarks_added, found.landmarks_moved, found.landmarks_removed, found.landmarks_kept),
    ):
        table.add_row(name, *(str(count) for count in counts))
    console.print(table)
    if found.moved_max_m is not None and found.moved_median_m is not None:
        console.print(
            f"landmarks moved by {found.moved_median_m:.4f} m in the median, {found.moved_max_m:.4f} m at most"
        )
    share = found.fetch_bytes / max(1, found.full_bytes)
    console.print(f"a robot with version {found.before} fetches {found.fetch_bytes} bytes ({share:.1%} of everything)")
    quality = Table("quality", str(found.before), str(found.after))
    for key, both in found.quality.items():
        quality.add_row(key, *("" if figure is None else str(figure) for figure in (both.before, both.after)))
    console.print(quality)
