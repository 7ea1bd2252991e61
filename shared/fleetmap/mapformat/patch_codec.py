"""Patches: bytes that make a newer tile or manifest out of the one that a robot has. Magic FMPT, in `container`'s envelope.

docs/map_format.md describes every byte. A tile's patch says what is gone and holds what is new as a small tile; that of
anything else is the new bytes, compressed with the old ones before them, and of a grid tile both payloads. The old payload
stands before a tile's patch too: a landmark that moved keeps its descriptor.

The result is encoded anew and must have its address, so a robot whose zstd writes other bytes than the server's cannot use
patches of tiles: it is told so by the error and fetches the tile whole.
"""

import struct
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.mapformat.columns import Columns, differences, planes
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.grid_tile import GRID_MAGIC, grid_tile_payload, pack_grid_tile
from fleetmap.mapformat.names import sha256_hex, verified
from fleetmap.mapformat.tile import Ids, Tile, check_tile
from fleetmap.mapformat.tile_codec import (
    MAX_TILE_PAYLOAD_BYTES,
    TILE_FORMAT,
    TILE_MAGIC,
    decode_tile,
    encode_tile,
    tile_columns,
    tile_from_payload,
    tile_payload,
)

PATCH_MAGIC = b"FMPT"
PATCH_FORMAT = 1
MAX_PATCH_PAYLOAD_BYTES = MAX_TILE_PAYLOAD_BYTES
_BYTES, _TILE, _GRID_TILE = 0, 1, 2
_SMALL_BYTES = 16_384
_HEAD = struct.Struct("<32s32sBBHIIII")
_NO_IDS: Ids = np.zeros(0, np.uint32)
_LANDMARKS = (
    *("landmark_ids", "points_map", "descriptors"),
    *("view_directions_map", "view_half_angle_rad", "max_distance_m", "sigma_m"),
)


def make_patch(base: bytes, result: bytes) -> bytes:
    """What turns `base` into `result`: two tiles, or two pieces of any other bytes.

    Raises MapFormatError where the pair cannot be patched: damaged tiles, a result of an older format, too large bytes.
    """
    addresses = bytes.fromhex(sha256_hex(base)), bytes.fromhex(sha256_hex(result))
    if len(base) + len(result) > MAX_PATCH_PAYLOAD_BYTES:
        raise MapFormatError(f"{len(base)} and {len(result)} bytes are too many for a patch; send them whole")
    if base[:4] == GRID_MAGIC and result[:4] == GRID_MAGIC:
        head = _HEAD.pack(*addresses, _GRID_TILE, 0, 0, 0, 0, 0, 0)
        return pack(PATCH_MAGIC, PATCH_FORMAT, [head, grid_tile_payload(result)], prefix=_prefix(base))
    if base[:4] != TILE_MAGIC or result[:4] != TILE_MAGIC:
        head = _HEAD.pack(*addresses, _BYTES, 0, 0, 0, 0, 0, 0)
        return pack(PATCH_MAGIC, PATCH_FORMAT, [head, result], prefix=_prefix(base))
    old, new = decode_tile(base), decode_tile(result)
    # Its compression is not repeated here, which would be most of the work: a robot that cannot repeat it takes the whole.
    is_canonical = tile_payload(result) == (b"".join(tile_columns(new)), TILE_FORMAT)
    if (old.tile_x, old.tile_y, old.size_m) != (new.tile_x, new.tile_y, new.size_m) or not is_canonical:
        raise MapFormatError(
            f"{new.name} lies elsewhere than its base, or is not as this fleetmap writes it; send it whole"
        )
    gone_landmarks = np.setdiff1d(old.landmark_ids, new.landmark_ids)
    gone_places = np.setdiff1d(old.place_ids, new.place_ids)
    news, lists = _news(old, new)
    changes = np.concatenate([_NO_IDS, *lists.values()])
    counts = (len(gone_landmarks), len(gone_places), len(lists), len(changes))
    head = _HEAD.pack(*addresses, _TILE, TILE_FORMAT, 0, *counts)
    columns = [
        planes(differences(gone_landmarks), 4),
        planes(differences(gone_places), 4),
        planes(differences(np.array(list(lists), np.uint32)), 4),
        planes(np.array([len(ids) for ids in lists.values()], np.uint32), 4),
        planes(np.concatenate([_NO_IDS, *(differences(ids) for ids in lists.values())]), 4),
    ]
    parts, prefix = [head, *columns, *tile_columns(news)], _prefix(base)
    patch = pack(PATCH_MAGIC, PATCH_FORMAT, parts, prefix=prefix)
    if sum(map(len, parts)) > _SMALL_BYTES:
        return patch
    # A quiet night's patch is mostly the heads of its blocks: then one block for all is smaller.
    return min(patch, pack(PATCH_MAGIC, PATCH_FORMAT, b"".join(parts), prefix=prefix), key=len)


def apply_patch(base: bytes, patch: bytes) -> bytes:
    """The bytes that the patch was made for, verified against the address that it names.

    Raises NewerFormatError for a newer format, MapFormatError for a damaged patch, another base, or a result that differs.
    """
    what = "patch"
    _, payload = unpack(PATCH_MAGIC, PATCH_FORMAT, patch, what, MAX_PATCH_PAYLOAD_BYTES, _prefix(base))
    if len(payload) < _HEAD.size:
        raise MapFormatError(f"{what}: {len(payload)} bytes are too few for its header; the bytes are damaged")
    base_sha, result_sha, kind, number, _, landmarks, places, lists, changes = _HEAD.unpack_from(payload)
    verified(base, base_sha.hex())
    if kind == _BYTES:
        return verified(payload[_HEAD.size :], result_sha.hex())
    if kind == _GRID_TILE:
        return verified(pack_grid_tile(payload[_HEAD.size :]), result_sha.hex())
    start = _HEAD.size + 4 * (landmarks + places + 2 * lists + changes)
    if kind != _TILE or number != TILE_FORMAT or start > len(payload):
        raise MapFormatError(f"{what} of kind {kind} for tiles of format {number} cannot be applied; fetch the whole")
    columns = Columns(payload, _HEAD.size, what)
    gone_landmarks, gone_places = columns.increasing(landmarks), columns.increasing(places)
    listed, counts = columns.increasing(lists), columns.planes(lists, 4).astype(np.int64)
    if counts.sum() != changes:
        raise MapFormatError(
            f"{what}: {counts.sum()} changes of lists, the header says {changes}; the bytes are damaged"
        )
    toggled = dict(zip(listed.tolist(), columns.increasing_lists(counts), strict=True))
    news, old = check_tile(tile_from_payload(payload[start:])), decode_tile(base)
    if not np.isin(listed, old.place_ids).all():
        raise MapFormatError(f"{what}: changes the list of a place that its base does not have; the bytes are damaged")
    return verified(encode_tile(_merged(old, news, toggled, gone_landmarks, gone_places)), result_sha.hex())


def _prefix(base: bytes) -> bytes:
    """A tile's payload, because nothing repeats in its compressed bytes; anything else as it is."""
    if base[:4] == GRID_MAGIC:
        return grid_tile_payload(base)
    return tile_payload(base)[0] if base[:4] == TILE_MAGIC else base


def _news(old: Tile, new: Tile) -> tuple[Tile, dict[int, Ids]]:
    """Landmarks and places of `new` that `old` does not have alike, as a tile; and by place what changes in other lists.

    A change of a list, that tile's too, is the landmarks that are in one of the two lists and not in the other, those apart
    that the patch removes anyway.
    """
    rows = _changed(old.landmark_ids, new.landmark_ids, [(getattr(old, f), getattr(new, f)) for f in _LANDMARKS[1:]])
    kept = _without(old, np.setdiff1d(old.landmark_ids, new.landmark_ids))
    changes = {
        int(place): np.setxor1d(kept.get(int(place), _NO_IDS), ids).astype(np.uint32)
        for place, ids in zip(new.place_ids, new.place_landmark_ids, strict=True)
    }
    places = _changed(old.place_ids, new.place_ids, [(old.map_from_cam, new.map_from_cam)])
    moved = new.place_ids[places].tolist()
    news = replace(
        new,
        **{field: getattr(new, field)[rows] for field in _LANDMARKS},
        place_ids=new.place_ids[places],
        map_from_cam=new.map_from_cam[places],
        place_landmark_ids=tuple(changes.pop(place) for place in moved),
    )
    return news, {place: ids for place, ids in changes.items() if len(ids)}


def _changed(
    old_ids: Ids, new_ids: Ids, columns: list[tuple[NDArray[np.generic], NDArray[np.generic]]]
) -> NDArray[np.bool_]:
    """(N,) which of the new rows are not among the old ones with the same id and values."""
    at = np.minimum(np.searchsorted(old_ids, new_ids), max(len(old_ids) - 1, 0))
    if not len(old_ids) or not len(new_ids):
        return np.ones(len(new_ids), bool)
    changed = old_ids[at] != new_ids
    for old, new in columns:
        changed |= (old[at] != new).reshape(len(new), -1).any(axis=1)
    return np.asarray(changed)


def _without(tile: Tile, gone: Ids) -> dict[int, Ids]:
    """The landmarks of each place, less those that are gone."""
    return {
        int(place): ids[~np.isin(ids, gone)] if len(gone) else ids
        for place, ids in zip(tile.place_ids, tile.place_landmark_ids, strict=True)
    }


def _merged(old: Tile, news: Tile, toggled: dict[int, Ids], gone_landmarks: Ids, gone_places: Ids) -> Tile:
    """The inverse of `_news`: the new tile of the old one."""
    kept_rows = ~np.isin(old.landmark_ids, gone_landmarks) & ~np.isin(old.landmark_ids, news.landmark_ids)
    kept_places = ~np.isin(old.place_ids, gone_places) & ~np.isin(old.place_ids, news.place_ids)
    ids = np.concatenate([old.landmark_ids[kept_rows], news.landmark_ids])
    place_ids = np.concatenate([old.place_ids[kept_places], news.place_ids])
    order, place_order = np.argsort(ids, kind="stable"), np.argsort(place_ids, kind="stable")
    lists = _without(old, gone_landmarks)
    changes = toggled | dict(zip(news.place_ids.tolist(), news.place_landmark_ids, strict=True))
    for place, ids_changed in changes.items():
        lists[place] = np.setxor1d(lists.get(place, _NO_IDS), ids_changed).astype(np.uint32)
    columns: dict[str, Any] = {
        field: np.concatenate([getattr(old, field)[kept_rows], getattr(news, field)])[order] for field in _LANDMARKS
    }
    centres = np.concatenate([old.map_from_cam[kept_places], news.map_from_cam])[place_order]
    return replace(
        news,
        **columns,
        place_ids=place_ids[place_order],
        map_from_cam=centres,
        place_landmark_ids=tuple(lists[int(place)] for place in place_ids[place_order]),
    )
