"""Occupancy grids of planners: a map_server YAML file and its image. Source: nav2_map_server's documented file format."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError, RecordingError, StoreError, disk_errors
from fleetmap.geometry import Array, se3, so3_exp, so3_log
from fleetmap.recordings.images import image_size

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
_MAX_BYTES, _MAX_CELLS = 1 << 16, 1 << 25
_MAX_IMAGE_BYTES = 16 * _MAX_CELLS  # four channels of four bytes, more than any picture of so many cells takes
_MODES = ("trinary", "scale", "raw")
# Those of map_saver, but for free_thresh: with its 0.25 the grey of unknown cells is read as free.
_SHADES = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196
_GAP = rb"(?:\s|#[^\n]*\n)+"
_PGM = re.compile(rb"P5" + _GAP + rb"\d{1,10}" + _GAP + rb"\d{1,10}" + _GAP + rb"(\d{1,5})\s")


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """cells (H, W) int8: 0 free to 100 occupied, -1 unknown; row 0 has the lowest y. map_from_grid (4, 4): of its corner there."""

    cells: NDArray[np.int8]
    resolution_m: float
    map_from_grid: Array


class MissingGridError(RecordingError):
    """The YAML file of a grid is not there."""


class GridImageError(MapFormatError):
    """The image of a grid is not there, or is none."""


def read_grid(path: Path) -> OccupancyGrid:
    """The grid of a map_server YAML file. MissingGridError, MapFormatError for its entries, GridImageError for its image."""
    if not path.is_file():
        raise MissingGridError(f"{path} is no file; give the YAML file that map_saver wrote")
    with disk_errors(f"{path} cannot be read", "check its rights", RecordingError):
        text = path.read_bytes()[: _MAX_BYTES + 1]
    entries = _entries(path, text)
    resolution_m, occupied, free = (
        _number(path, entries, key) for key in ("resolution", "occupied_thresh", "free_thresh")
    )
    if not resolution_m > 0 or not 0 <= free <= occupied <= 1:
        raise MapFormatError(
            f"{path}: resolution must be positive metres, and 0 <= free_thresh <= occupied_thresh <= 1"
        )
    origin, mode = entries.get("origin"), entries.get("mode", "trinary")
    if not isinstance(origin, list) or len(origin) != 3 or not np.isfinite(np.array(origin, float)).all():
        raise MapFormatError(f"{path}: origin is {origin!r}; it must be [x, y, yaw] in metres and radians")
    if mode not in _MODES:
        raise MapFormatError(f"{path}: mode is {mode!r}; known are {', '.join(_MODES)}")
    image = _image(path, entries.get("image"))
    cells = _cells(image, mode, is_negated=bool(entries.get("negate", 0)), thresholds=(free, occupied))
    corner = se3(so3_exp(np.array([0.0, 0.0, origin[2]])), np.array([origin[0], origin[1], 0.0]))
    return OccupancyGrid(np.ascontiguousarray(cells[::-1]), resolution_m, corner)


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Writes NAME.yaml and NAME.pgm beside it, as of `map_server_files`. Raises StoreError where the disk refuses."""
    text, image = map_server_files(grid, path.with_suffix(".pgm").name)
    with disk_errors(f"{path} cannot be written", "check the folder, its space and rights", StoreError):
        path.with_suffix(".pgm").write_bytes(image)
        path.write_bytes(text)


def map_server_files(grid: OccupancyGrid, image_name: str) -> tuple[bytes, bytes]:
    """A map_server YAML file and its PGM image, which `read_grid` reads as the same cells.

    Mode trinary where cells are free, occupied or unknown, else raw.
    """
    values, trinary = grid.cells[::-1], bool(np.isin(grid.cells, list(_SHADES)).all())
    shades = np.where(values < 0, 255, values).astype(np.uint8)
    if trinary:
        shades = np.select([values == value for value in _SHADES], list(_SHADES.values())).astype(np.uint8)
    height, width = shades.shape
    x, y, _ = (float(v) for v in grid.map_from_grid[:3, 3])
    entries = {
        "image": image_name,
        "mode": "trinary" if trinary else "raw",
        "resolution": grid.resolution_m,
        "origin": [x, y, float(so3_log(grid.map_from_grid[:3, :3])[2])],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESH,
        "free_thresh": _FREE_THRESH,
    }
    return yaml.safe_dump(entries, sort_keys=False).encode(), b"P5\n%d %d\n255\n" % (width, height) + shades.tobytes()


def _entries(path: Path, text: bytes) -> dict[str, Any]:
    try:
        entries = yaml.safe_load(text) if len(text) <= _MAX_BYTES else None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MapFormatError(f"{path} is no YAML file ({error}); give the one that map_saver wrote") from error
    if not isinstance(entries, dict):
        raise MapFormatError(f"{path} holds no entries of a map_server map; give the YAML file that map_saver wrote")
    return entries


def _number(path: Path, entries: dict[str, Any], key: str) -> float:
    try:
        value = float(entries[key])
    except (KeyError, TypeError, ValueError) as error:
        raise MapFormatError(f"{path}: {key} is {entries.get(key)!r}; it must be a number") from error
    if not np.isfinite(value):
        raise MapFormatError(f"{path}: {key} is {value}; it must be finite")
    return value


def _image(path: Path, name: object) -> NDArray[np.uint8]:
    """Nothing is decoded before its header has said how large it is."""
    file = path.parent / str(name)
    wanted = f"a whole picture of 8 bits and at most {_MAX_CELLS} pixels"
    if not name or not file.is_file() or file.stat().st_size > _MAX_IMAGE_BYTES:
        raise GridImageError(f"{path}: its image {name!r} is no file of {wanted}")
    with disk_errors(f"{file} cannot be read", "check its rights", RecordingError):
        data = file.read_bytes()
    size = image_size(data)
    if size is None or not 0 < size[0] * size[1] <= _MAX_CELLS or _is_cut(data, size[0] * size[1]):
        raise GridImageError(f"{path}: its image {name!r} is not {wanted}; it says {size} and has {len(data)} bytes")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8:
        kind = "cannot be decoded" if image is None else f"has pixels of {image.dtype}"
        raise GridImageError(f"{path}: its image {name!r} {kind}; it must be {wanted}")
    return np.asarray(image, np.uint8)


def _is_cut(data: bytes, pixels: int) -> bool:
    """Whether the end is missing, which OpenCV fills with grey and says nothing."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    header = _PGM.match(data[:4096])
    return header is not None and len(data) - header.end() < pixels * (1 + (int(header[1]) > 255))


def _cells(
    image: NDArray[np.uint8], mode: str, *, is_negated: bool, thresholds: tuple[float, float]
) -> NDArray[np.int8]:
    """Channels are averaged; a pixel that is not opaque is unknown in the mode `scale`."""
    channels = image.reshape(*image.shape[:2], -1)
    has_alpha = channels.shape[2] in (2, 4)
    shade = channels[..., : channels.shape[2] - has_alpha].mean(axis=2)
    if mode == "raw":
        return np.where(shade <= OCCUPIED, np.rint(shade), UNKNOWN).astype(np.int8)
    free, occupied = thresholds
    share = shade / 255.0 if is_negated else 1.0 - shade / 255.0
    between = np.full(share.shape, float(UNKNOWN))
    if mode == "scale":
        between = np.rint((share - free) / max(occupied - free, 1e-9) * (OCCUPIED - 1))
        if has_alpha:
            between = np.where(channels[..., -1] < 255, UNKNOWN, between)
    return np.where(share >= occupied, OCCUPIED, np.where(share <= free, FREE, between)).astype(np.int8)
