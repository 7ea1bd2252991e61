"""Occupancy grids of planners: a map_server YAML file and its image. Source: nav2_map_server's documented file format."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError, RecordingError, disk_errors
from fleetmap.geometry import Array, se3, so3_exp

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
_MAX_BYTES, _MAX_CELLS = 1 << 16, 1 << 25
_MODES = ("trinary", "scale", "raw")


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
    file = path.parent / str(name)
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if name and file.is_file() else None
    if image is None or image.dtype != np.uint8 or image.shape[0] * image.shape[1] > _MAX_CELLS:
        raise GridImageError(f"{path}: its image {name!r} is no picture of 8 bits and at most {_MAX_CELLS} pixels")
    return np.asarray(image, np.uint8)


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
