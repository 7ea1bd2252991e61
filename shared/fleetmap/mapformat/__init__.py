"""The map as bytes: tiles, manifests, and the names that address them. Pure; docs/map_format.md describes them byte by byte."""

from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.manifest import (
    MANIFEST_FORMAT,
    MAX_MANIFEST_BYTES,
    BlobEntry,
    CameraEntry,
    Manifest,
    RecordingEntry,
    TileEntry,
    decode_manifest,
    encode_manifest,
)
from fleetmap.mapformat.names import blob_path, check_name, check_sha256, current_path, sha256_hex, verified
from fleetmap.mapformat.tile import Tile
from fleetmap.mapformat.tile_codec import LANDMARK_BYTES, MAX_TILE_PLACES, TILE_FORMAT, decode_tile, encode_tile

__all__ = [
    "LANDMARK_BYTES",
    "MANIFEST_FORMAT",
    "MAX_MANIFEST_BYTES",
    "MAX_TILE_PLACES",
    "TILE_FORMAT",
    "BlobEntry",
    "CameraEntry",
    "Manifest",
    "RecordingEntry",
    "Tile",
    "TileEntry",
    "blob_path",
    "check_name",
    "check_sha256",
    "current_path",
    "decode_manifest",
    "decode_tile",
    "encode_manifest",
    "encode_tile",
    "pack",
    "sha256_hex",
    "unpack",
    "verified",
]
