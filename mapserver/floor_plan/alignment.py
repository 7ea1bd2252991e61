"""The pose of a site's map in the drawing of its building, as stored. Pure."""

from typing import Annotated

import msgspec
import numpy as np

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import StoreError
from fleetmap.geometry import Array
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.mapformat.manifest import Manifest
from mapserver.floor_plan.areas import moved

PLAN = "plan"
"""Kind of a site's file in the store that is not sent to robots."""


class Alignment(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `mapserver align`. metres_per_unit: of the drawing, whose units are pixels.

    off_m: residual at each pin; plan: the file's name, for operators.
    """

    frame: BuildingFrame
    metres_per_unit: Annotated[float, msgspec.Meta(gt=0)]
    method: str
    plan: str | None = None
    off_m: dict[str, float] = {}


def encode_alignment(alignment: Alignment) -> bytes:
    """Encode as JSON."""
    return to_json(alignment, order="deterministic")


def decode_alignment(data: bytes) -> Alignment:
    """Decode the result of `encode_alignment`. StoreError for invalid data."""
    refusal = "the site's alignment cannot be read ({}); run `mapserver align` again"
    return decode_json(data, Alignment, refusal, StoreError)


def map_corners_m(manifest: Manifest) -> Array:
    """Return (4, 2) corners of the rectangle covered by a version's tiles; one tile at the origin for a version without tiles."""
    cells = np.array([(tile.x, tile.y) for tile in manifest.tiles] or [(0, 0)], float)
    (x0, y0), (x1, y1) = cells.min(axis=0) * manifest.tile_size_m, (cells.max(axis=0) + 1) * manifest.tile_size_m
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def reference_coordinates(frame: BuildingFrame, level: str, corners_m: Array) -> str:
    """Return the block of an Open-RMF fleet adapter's config.yaml: four points in both frames, from which it fits the transform."""

    def listed(points: Array) -> str:
        return ", ".join(f"[{x:.4f}, {y:.4f}]" for x, y in points)

    rows = ["reference_coordinates:", f"  {level}:", f"    rmf: [{listed(moved(corners_m, frame.building_from_map))}]"]
    return "\n".join([*rows, f"    robot: [{listed(corners_m)}]"])
