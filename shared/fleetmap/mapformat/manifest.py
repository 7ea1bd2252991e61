"""The manifest: the content of a version as canonical JSON. Its SHA-256 is the version's identity."""

from typing import Annotated, Any, Literal, TypeVar

import msgspec

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import MapFormatError, NewerFormatError
from fleetmap.mapformat.building import BUILDING_KEY, BuildingFrame
from fleetmap.mapformat.map_errors import ErrorSigmas, MapErrors
from fleetmap.mapformat.names import NAME_PATTERN, SHA256_PATTERN

T = TypeVar("T")
MANIFEST_FORMAT = 1
MAX_MANIFEST_BYTES = 64 << 20

# As `check_name` and `check_sha256`: Python's $ stands before a last line break too.
Sha256 = Annotated[str, msgspec.Meta(pattern=SHA256_PATTERN.replace("$", r"\Z"))]
Name = Annotated[str, msgspec.Meta(pattern=NAME_PATTERN.replace("$", r"\Z"))]
Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 62))]
TileName = Annotated[str, msgspec.Meta(pattern=r"^-?[0-9]{1,10},-?[0-9]{1,10}\Z")]
Positive = Annotated[int, msgspec.Meta(ge=1, le=(1 << 62))]


class TileEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One tile: its place in the grid, address, size and content counts."""

    x: Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
    y: Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
    sha256: Sha256
    bytes: Positive
    landmarks: Count


class BlobEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address and size of a blob."""

    sha256: Sha256
    bytes: Positive


class CameraEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rectified camera of the survey; robots compare their own with it."""

    focal_px: float
    width_px: Positive
    height_px: Positive
    baseline_m: float


class RecordingEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A recording used by the survey."""

    name: str
    sha256: Sha256
    frames: Count


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a version. `created` is ISO 8601 in UTC; `parent` is the version that was current then."""

    format_version: Positive = MANIFEST_FORMAT
    site: Name
    version: Positive
    parent: Positive | None = None
    created: str
    tile_size_m: Annotated[float, msgspec.Meta(gt=0)]
    tiles: tuple[TileEntry, ...]
    vocabulary: BlobEntry
    camera: CameraEntry
    recordings: tuple[RecordingEntry, ...] = ()
    configuration: dict[str, Any] = {}
    libraries: dict[str, str] = {}
    report: dict[str, Any] = {}

    @property
    def landmarks(self) -> int:
        """Number of landmarks in all tiles."""
        return sum(tile.landmarks for tile in self.tiles)

    @property
    def tile_bytes(self) -> int:
        """Size of all tiles in bytes, compressed."""
        return sum(tile.bytes for tile in self.tiles)


class _FormatOnly(msgspec.Struct):
    format_version: int


def encode_manifest(manifest: Manifest) -> bytes:
    """Encode as canonical JSON: sorted keys, no spaces, so that equal manifests have equal hashes.

    Raises MapFormatError for values that JSON can't hold.
    """
    try:
        return to_json(manifest, order="deterministic")
    except (TypeError, ValueError) as error:
        raise MapFormatError(
            f"manifest of {manifest.site} version {manifest.version}: {error}; use plain values"
        ) from error


def decode_manifest(data: bytes) -> Manifest:
    """Decode the manifest in `data`.

    Raises NewerFormatError for a newer format, MapFormatError for anything that isn't a manifest.
    """
    if len(data) > MAX_MANIFEST_BYTES:
        raise MapFormatError(
            f"manifest of {len(data)} bytes, the limit is {MAX_MANIFEST_BYTES}; it is damaged or not ours"
        )
    refusal = "manifest: {}; it is damaged or not a manifest"
    number = decode_json(data, _FormatOnly, refusal).format_version
    if number > MANIFEST_FORMAT:
        raise NewerFormatError(
            f"manifest has format {number}, this fleetmap reads up to {MANIFEST_FORMAT}; update fleetmap to read it"
        )
    manifest = decode_json(data, Manifest, refusal)
    building_frame(manifest)
    map_errors_of(manifest)
    return manifest


def building_frame(manifest: Manifest) -> BuildingFrame | None:
    """The building's frame at the time when the version was made; None if absent. MapFormatError for an invalid one."""
    return manifest_entry(manifest, "configuration", BUILDING_KEY, BuildingFrame)


def map_errors_of(manifest: Manifest) -> MapErrors:
    """The errors of the map that its build measured, none of older builds. MapFormatError for invalid ones."""
    found = manifest_entry(manifest, "report", "map_errors", dict[TileName, ErrorSigmas]) or {}
    by_tile = {(int(x), int(y)): sigmas for name, sigmas in found.items() for x, y in [name.split(",")]}
    return MapErrors(manifest.tile_size_m, by_tile)


def manifest_entry(manifest: Manifest, part: Literal["configuration", "report"], key: str, kind: type[T]) -> T | None:
    """An entry of a manifest's configuration or of the build's report, None if absent. MapFormatError for invalid content."""
    found = getattr(manifest, part).get(key)
    try:
        return None if found is None else msgspec.convert(found, kind)
    except msgspec.ValidationError as error:
        raise MapFormatError(
            f"manifest of {manifest.site} version {manifest.version}: {part}.{key}: {error}; it is damaged"
        ) from error
