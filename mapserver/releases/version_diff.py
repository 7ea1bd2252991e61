"""Differences between two versions: tiles, landmarks, bytes, quality. Pure."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleetmap.mapformat.manifest import Manifest, TileEntry
from fleetmap.mapformat.tile import Tile

TileReader = Callable[[str], Tile]


@dataclass(frozen=True, slots=True)
class SideBySide:
    """A figure of the builds' reports; None if absent in a report."""

    before: Any
    after: Any


@dataclass(frozen=True, slots=True)
class Difference:
    """From version `before` to version `after` of a site.

    Tiles are counted by their cell, landmarks by their id. landmarks_moved: with other coordinates; moved_median_m and
    moved_max_m: their displacement, None without any. fetch_bytes: manifest, tiles and vocabulary downloaded by a robot with all
    of `before`; full_bytes: by a robot without any map. quality: by key of the builds' reports.
    """

    site: str
    before: int
    after: int
    tiles_added: int
    tiles_changed: int
    tiles_removed: int
    tiles_kept: int
    landmarks_added: int
    landmarks_removed: int
    landmarks_moved: int
    landmarks_kept: int
    moved_median_m: float | None
    moved_max_m: float | None
    fetch_bytes: int
    full_bytes: int
    vocabulary_changed: bool
    quality: dict[str, SideBySide]


def manifest_difference(
    before: Manifest, after: Manifest, after_manifest_bytes: int, read_tile: TileReader
) -> Difference:
    """Return the difference of two manifests; `read_tile` is called only for tiles that are not in both."""
    old, new = ({(tile.x, tile.y): tile for tile in manifest.tiles} for manifest in (before, after))
    known = {tile.sha256 for tile in before.tiles}
    changed = {cell for cell in old.keys() & new.keys() if old[cell].sha256 != new[cell].sha256}
    gone, come = old.keys() - new.keys(), new.keys() - old.keys()
    old_ids, old_points = _landmarks((old[cell] for cell in changed | gone), read_tile)
    new_ids, new_points = _landmarks((new[cell] for cell in changed | come), read_tile)
    shared, at_old, at_new = np.intersect1d(old_ids, new_ids, assume_unique=True, return_indices=True)
    way_m = np.linalg.norm(new_points[at_new] - old_points[at_old], axis=1)
    moved_m = way_m[way_m > 0]
    vocabulary_changed = before.vocabulary.sha256 != after.vocabulary.sha256
    same = old.keys() & new.keys() - changed
    return Difference(
        site=after.site,
        before=before.version,
        after=after.version,
        tiles_added=len(come),
        tiles_changed=len(changed),
        tiles_removed=len(gone),
        tiles_kept=len(same),
        landmarks_added=len(new_ids) - len(shared),
        landmarks_removed=len(old_ids) - len(shared),
        landmarks_moved=len(moved_m),
        landmarks_kept=sum(new[cell].landmarks for cell in same) + len(shared) - len(moved_m),
        moved_median_m=float(np.median(moved_m)) if len(moved_m) else None,
        moved_max_m=float(moved_m.max()) if len(moved_m) else None,
        fetch_bytes=after_manifest_bytes
        + sum(size for sha256, size in {t.sha256: t.bytes for t in after.tiles}.items() if sha256 not in known)
        + (after.vocabulary.bytes if vocabulary_changed else 0),
        full_bytes=after_manifest_bytes + after.tile_bytes + after.vocabulary.bytes,
        vocabulary_changed=vocabulary_changed,
        quality={
            key: SideBySide(before.report.get(key), after.report.get(key))
            for key in sorted(before.report.keys() | after.report.keys())
        },
    )


def _landmarks(entries: Iterable[TileEntry], read_tile: TileReader) -> tuple[np.ndarray, np.ndarray]:
    tiles = [read_tile(entry.sha256) for entry in sorted(entries, key=lambda entry: (entry.x, entry.y))]
    ids = np.concatenate([np.zeros(0, np.uint32), *(tile.landmark_ids for tile in tiles)])
    points_map = np.concatenate([np.zeros((0, 3)), *(tile.points_map for tile in tiles)])
    ids, first = np.unique(ids, return_index=True)
    return ids, points_map[first]
