"""`mapserver versions`, `inspect` and `diff`: versions of a site."""

from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from fleetmap.errors import UsageError
from mapserver.commands.options import Json, SiteName, StoreFolder, open_store, print_result, table

if TYPE_CHECKING:
    from rich.table import Table

    from fleetmap.mapformat.manifest import Manifest
    from mapserver.releases.version_diff import Difference
    from mapserver.store import Event, MapStore, VerdictRow, VersionInfo


def versions(site: SiteName, store: StoreFolder, json: Json = False) -> None:
    """List the versions of a site with their states, oldest first."""
    with open_store(store, read_only=True) as maps:
        infos = maps.versions(site)
        trusted = {info.version: maps.trusted(info) for info in infos}
    shown = [asdict(info) | {"trusted_calibrations": trusted[info.version]} for info in infos]
    columns = ("version", "state", "parent", "created", "tiles", "landmarks")
    rows = ((*(getattr(info, name) for name in columns), info.map_bytes) for info in infos)
    words = [f"version {version}: {choice.sentence}" for version, choices in trusted.items() for choice in choices]
    print_result(shown, [table((*columns, "bytes"), rows), *words], json=json)


def inspect(
    site: SiteName,
    store: StoreFolder,
    version: Annotated[int | None, Option(min=1, help="Version; default: the current one, else the newest.")] = None,
    json: Json = False,
) -> None:
    """Show a version: sizes, recordings and their findings, gate results, history. --json has the whole manifest."""
    with open_store(store, read_only=True) as maps:
        info = _chosen(maps, site, version)
        manifest = maps.manifest(site, info.version)
        verdicts = maps.verdicts(site, info.version)
        history = [event for event in maps.events(site) if event.version == info.version]
    path_m = manifest.report.get("path_m")
    per_m = info.map_bytes / path_m if isinstance(path_m, int | float) and path_m > 0 else None
    shown = {name: getattr(info, name) for name in ("state", "manifest_sha256", "map_bytes")}
    shown |= {"bytes_per_m": per_m, "verdicts": verdicts, "history": history, "manifest": manifest}
    print_result(shown, _words(info, manifest, per_m, verdicts, history), json=json)


def _chosen(maps: "MapStore", site: str, version: int | None) -> "VersionInfo":
    if version is not None:
        return maps.version(site, version)
    infos = maps.versions(site)
    if not infos:
        raise UsageError(f"site {site} has no version; make one with `mapserver build RECORDING --site {site}`")
    return maps.current(site) or infos[-1]


_FIGURES = {
    "path_m": "path {:.1f} m",
    "duration_s": "{:.0f} s of driving",
    "keyframes": "{} keyframes",
    "ate_rmse_m": "{:.4f} m from the ground truth after alignment",
}
"""Text for keys of a build's report; --json has all keys."""


def _words(
    info: "VersionInfo", manifest: "Manifest", per_m: float | None, verdicts: "list[VerdictRow]", history: "list[Event]"
) -> Iterator[str]:
    from mapserver.quality.figures import trusted_calibrations

    report, findings = manifest.report, manifest.report.get("findings")
    built_on = "the first" if info.parent is None else f"built on version {info.parent}"
    yield f"site {info.site} version {info.version}: {info.state}, {built_on}, created {info.created}"
    sizes = f"{info.tiles} tiles of {manifest.tile_size_m:g} m, {info.landmarks} landmarks, {info.map_bytes} bytes for a robot"
    yield sizes + ("" if per_m is None else f", {per_m:.0f} bytes per metre")
    figures = [words.format(report[key]) for key, words in _FIGURES.items() if isinstance(report.get(key), int | float)]
    if isinstance(loops := report.get("loops"), dict):
        figures.append(f"{loops.get('accepted', 0)} of {loops.get('candidates', 0)} possible loops accepted")
    if figures:
        yield ", ".join(figures)
    yield f"manifest {info.manifest_sha256}, vocabulary {manifest.vocabulary.sha256}"
    for recording in manifest.recordings:
        yield f"recording {recording.name}: {recording.frames} frames, SHA-256 {recording.sha256[:16]}"
        yield from (f"  {found}" for found in (findings.get(recording.name, ()) if isinstance(findings, dict) else ()))
    yield from (choice.sentence for choice in trusted_calibrations(manifest))
    for verdict in verdicts:
        word = "accepted" if verdict.accepted else "published by force" if verdict.forced else "refused"
        yield f"gate: {word}, {_moment(verdict.stamp_ns)}"
        yield from (f"  {reason}" for reason in verdict.reasons)
    for event in history:
        if event.kind not in ("refused", "forced"):  # shown above with the gate
            who = f" by {event.actor}" if event.actor else ""
            why = f" ({event.reason})" if event.reason else ""
            yield f"{_moment(event.stamp_ns)} {event.kind}{who}{why}: {event.detail}"


def _moment(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="seconds")


def diff(
    before: Annotated[int, Argument(min=1, metavar="A", help="The older version.")],
    after: Annotated[int, Argument(min=1, metavar="B", help="The newer version.")],
    site: SiteName,
    store: StoreFolder,
    json: Json = False,
) -> None:
    """Show the differences from version A to version B: tiles, landmarks, bytes to fetch, quality side by side."""
    from mapserver import releases

    with open_store(store, read_only=True) as maps:
        found = releases.difference(maps, site, before, after)
    print_result(found, _difference_words(found), json=json)


def _difference_words(found: "Difference") -> "Iterator[str | Table]":
    counts = [
        ("tiles", found.tiles_added, found.tiles_changed, found.tiles_removed, found.tiles_kept),
        ("landmarks", found.landmarks_added, found.landmarks_moved, found.landmarks_removed, found.landmarks_kept),
    ]
    title = f"{found.site}: {found.before} to {found.after}"
    yield table(("", "added", "changed", "removed", "kept"), counts, title)
    if found.moved_max_m is not None and found.moved_median_m is not None:
        yield f"landmarks moved by {found.moved_median_m:.4f} m in the median, {found.moved_max_m:.4f} m at most"
    share = found.fetch_bytes / max(1, found.full_bytes)
    yield f"a robot with version {found.before} fetches {found.fetch_bytes} bytes ({share:.1%} of everything)"
    quality = ((key, both.before, both.after) for key, both in found.quality.items())
    yield table(("quality", str(found.before), str(found.after)), quality)
