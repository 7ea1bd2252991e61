"""`mapserver inspect`: what is in a version."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from fleetmap.mapformat import Manifest
    from mapserver.store import MapStore, VersionInfo


def inspect(
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    version: Annotated[
        int | None, typer.Option(min=1, help="Version; the current one if left out, else the newest.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Show a version's manifest: tiles, sizes, recordings and the build's report."""
    from mapserver.store import MapStore

    with MapStore.open(store) as maps:
        info = _chosen(maps, site, version)
        manifest = maps.manifest(site, info.version)
    if json:
        _print_json(info, manifest)
    else:
        _print_tables(info, manifest)


def _chosen(maps: "MapStore", site: str, version: int | None) -> "VersionInfo":
    from fleetmap.errors import UsageError

    if version is not None:
        return maps.version(site, version)
    infos = maps.versions(site)
    if not infos:
        raise UsageError(f"site {site} has no version; make one with `mapserver build --site {site}`")
    return maps.current(site) or infos[-1]


def bytes_per_m(info: "VersionInfo", manifest: "Manifest") -> float | None:
    """Size of the map per metre of surveyed path, None where the report does not know the path."""
    path_m = manifest.report.get("path_m")
    return info.map_bytes / path_m if isinstance(path_m, int | float) and path_m > 0 else None


def _print_json(info: "VersionInfo", manifest: "Manifest") -> None:
    import msgspec

    built: dict[str, Any] = msgspec.to_builtins(manifest)
    shown = {
        "state": info.state,
        "manifest_sha256": info.manifest_sha256,
        "map_bytes": info.map_bytes,
        "bytes_per_m": bytes_per_m(info, manifest),
        "manifest": built,
    }
    typer.echo(msgspec.json.format(msgspec.json.encode(shown), indent=2).decode())


def _print_tables(info: "VersionInfo", manifest: "Manifest") -> None:
    from rich.console import Console
    from rich.table import Table

    per_m = bytes_per_m(info, manifest)
    console = Console()
    console.print(
        f"site {info.site} version {info.version}: {info.state}, parent {info.parent}, created {info.created}"
    )
    console.print(f"manifest {info.manifest_sha256}")
    console.print(
        f"{info.map_bytes} bytes for a robot" + ("" if per_m is None else f", {per_m:.0f} bytes per metre") + ", "
        f"vocabulary {manifest.vocabulary.bytes} bytes {manifest.vocabulary.sha256}"
    )
    tiles = Table("x", "y", "landmarks", "bytes", "sha256", title=f"{info.tiles} tiles of {manifest.tile_size_m:g} m")
    for tile in manifest.tiles:
        tiles.add_row(str(tile.x), str(tile.y), str(tile.landmarks), str(tile.bytes), tile.sha256[:16])
    console.print(tiles)
    recordings = Table("recording", "frames", "sha256")
    for recording in manifest.recordings:
        recordings.add_row(recording.name, str(recording.frames), recording.sha256[:16])
    console.print(recordings)
    report = Table("report", "value")
    for key, value in manifest.report.items():
        report.add_row(key, str(value))
    console.print(report)
