"""`mapserver versions`, `inspect` and `diff`: the versions of a site, the content of one, the differences between two."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapserver.commands.options import Json, SiteName, StoreFolder, print_json

if TYPE_CHECKING:
    from fleetmap.mapformat import Manifest
    from mapserver.releases import Difference
    from mapserver.store import Event, MapStore, VerdictRow, VersionInfo


def versions(site: SiteName, store: StoreFolder, json: Json = False) -> None:
    """List the versions of a site with their states, oldest first."""
    from rich.console import Console
    from rich.table import Table

    from mapserver.store import MapStore

    with MapStore.open(store, read_only=True) as maps:
        infos = maps.versions(site)
        trusted = {info.version: maps.trusted(info) for info in infos}
    if json:
        print_json([asdict(info) | {"trusted_calibrations": trusted[info.version]} for info in infos])
        return
    table = Table("version", "state", "parent", "created", "tiles", "landmarks", "bytes")
    for info in infos:
        parent = "" if info.parent is None else str(info.parent)
        sizes = (str(info.tiles), str(info.landmarks), str(info.map_bytes))
        table.add_row(str(info.version), info.state, parent, info.created, *sizes)
    console = Console(markup=False, emoji=False, highlight=False)
    console.print(table)
    for version, choices in trusted.items():
        for choice in choices:
            console.print(f"version {version}: {choice.sentence}")


def inspect(
    site: SiteName,
    store: StoreFolder,
    version: Annotated[
        int | None, typer.Option(min=1, help="Version; default: the current one, else the newest.")
    ] = None,
    json: Json = False,
) -> None:
    """Show a version's manifest: tiles, sizes, recordings and the build's report."""
    from mapserver.store import MapStore

    with MapStore.open(store, read_only=True) as maps:
        info = _chosen(maps, site, version)
        manifest = maps.manifest(site, info.version)
        verdicts = maps.verdicts(site, info.version)
        history = [event for event in maps.events(site) if event.version == info.version]
    if json:
        _print_json(info, manifest, verdicts, history)
    else:
        _print_tables(info, manifest, verdicts, history)


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


def _print_json(
    info: "VersionInfo", manifest: "Manifest", verdicts: "list[VerdictRow]", history: "list[Event]"
) -> None:
    from fleetmap.encoding import to_plain

    built: dict[str, Any] = to_plain(manifest)
    shown = {
        "state": info.state,
        "manifest_sha256": info.manifest_sha256,
        "map_bytes": info.map_bytes,
        "bytes_per_m": bytes_per_m(info, manifest),
        "verdicts": verdicts,
        "history": history,
        "manifest": built,
    }
    print_json(shown)


def _print_tables(
    info: "VersionInfo", manifest: "Manifest", verdicts: "list[VerdictRow]", history: "list[Event]"
) -> None:
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
    for verdict in verdicts:
        word = "accepted" if verdict.accepted else "forced" if verdict.forced else "refused"
        console.print(f"gate: {word}" + "".join(f"; {reason}" for reason in verdict.reasons))
    for event in history:
        who = f" by {event.actor}" if event.actor else ""
        why = f" ({event.reason})" if event.reason else ""
        console.print(f"{_moment(event.stamp_ns)} {event.kind}{who}{why}: {event.detail}")


def _moment(stamp_ns: int) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="seconds")


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
        _print_difference(found)


def _print_difference(found: "Difference") -> None:
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
