"""Levels and lifts of a building in a file of Open-RMF's traffic editor, `*.building.yaml`. Pure but for the reading.

Points of the plane are complex numbers here, as in `pins`. The building's frame is Open-RMF's: metres, x right, y up; of drawings with its
origin in the upper left corner of the reference level's. Source: the documented format of rmf_traffic_editor.
"""

from collections.abc import Sequence
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import cv2
import msgspec
import numpy as np
import yaml

from fleetmap.errors import UsageError
from fleetmap.failure_definition import ERROR_LIMIT_M
from fleetmap.geometry import Array
from fleetmap.mapformat.building import Building, Coordinate, Floor
from fleetmap.recordings.calibration_files import check_yaml
from fleetmap.recordings.files import read_text
from mapserver.floor_plan.alignment import Alignment
from mapserver.floor_plan.areas import moved
from mapserver.floor_plan.pins import similarity

_MAX_BYTES, _MAX_VALUES = 8 << 20, 1 << 20
_Index = Annotated[int, msgspec.Meta(ge=0)]
_Metres = Annotated[float, msgspec.Meta(gt=0, le=1e4)]


class _Vertex(msgspec.Struct, array_like=True):
    x: Coordinate
    y: Coordinate


class _Fiducial(_Vertex, array_like=True):
    name: str


class _Distance(msgspec.Struct):
    distance: tuple[int, _Metres]  # the number of its type, and the value


class _Measurement(msgspec.Struct, array_like=True):
    start: _Index
    end: _Index
    properties: _Distance


class _Drawing(msgspec.Struct, frozen=True):
    filename: str = ""


class _Level(msgspec.Struct):
    elevation: Coordinate = 0.0
    drawing: _Drawing = _Drawing()
    vertices: list[_Vertex] | None = None
    fiducials: list[_Fiducial] | None = None
    measurements: list[_Measurement] | None = None


class _Lift(msgspec.Struct):
    """x and y: as a vertex of its reference level; yaw: in the building. level_doors: the doors that open on a level."""

    x: Coordinate
    y: Coordinate
    yaw: Coordinate
    width: _Metres
    depth: _Metres
    level_doors: dict[str, Any] | None = None
    reference_floor_name: str | None = None


class _File(msgspec.Struct):
    name: str
    levels: Annotated[dict[str, _Level], msgspec.Meta(min_length=1)]
    lifts: dict[str, _Lift] | None = None
    reference_level_name: str | None = None
    coordinate_system: Literal["reference_image", "cartesian_meters"] = "reference_image"

    @property
    def reference(self) -> str:
        return self.reference_level_name or next(iter(self.levels))

    def point(self, drawn: _Vertex | _Lift) -> complex:
        """Return a point of a level's drawing with y up."""
        return complex(drawn.x, -drawn.y if self.coordinate_system == "reference_image" else drawn.y)

    def placed(self, name: str) -> tuple[complex, complex]:
        """Return scale and rotation, and shift, from the drawing of a level to the building. UsageError if the file does not tell them."""
        if self.coordinate_system == "cartesian_meters":
            return 1, 0
        reference, level = self._level(self.reference), self._level(name)
        vertices = [self.point(vertex) for vertex in reference.vertices or []]
        try:
            lengths = [
                (m.properties.distance[1], vertices[m.end] - vertices[m.start]) for m in reference.measurements or []
            ]
            scale = sum(length_m / abs(length_px) for length_m, length_px in lengths) / len(lengths)
        except (IndexError, ZeroDivisionError):
            raise UsageError(f"level {self.reference}: no measurement between two vertices gives its scale") from None
        if level is reference:
            return scale, 0
        known = {fiducial.name: scale * self.point(fiducial) for fiducial in reference.fiducials or []}
        shared = {fiducial.name: self.point(fiducial) for fiducial in level.fiducials or [] if fiducial.name in known}
        if len({*shared.values()}) < 2:
            raise UsageError(f"level {name}: two fiducials of level {self.reference} must say where its drawing lies")
        points, drawn = np.array([*shared.values()]), np.array([known[fiducial] for fiducial in shared])
        scale_rotation, shift = similarity(drawn, points, None)
        off_m = np.abs(drawn - scale_rotation * points - shift).max()
        if off_m > ERROR_LIMIT_M:
            raise UsageError(
                f"level {name}: its fiducials are {off_m:.2f} m off those of level {self.reference}; correct them"
            )
        return scale_rotation, shift

    def _level(self, name: str) -> _Level:
        if name not in self.levels:
            raise UsageError(f"it has no level {name[:80]!r}, but {', '.join(self.levels)[:200]}")
        return self.levels[name]


class RmfLevel(NamedTuple):
    """lifts: outlines (4, 2) of the cabins that open here, in the building. drawing: name of its picture, and `placed` what `_File.placed`
    returns for it. reference: the reference level's picture, with its scale."""

    height_m: float
    lifts: dict[str, Array]
    drawing: str
    placed: tuple[complex, complex]
    reference: str

    def check_aligned(self, site: str, alignment: Alignment) -> None:
        """Raise UsageError if a site was aligned by this level's drawing alone, and its lifts are elsewhere by that."""
        scale_rotation, shift = self.placed
        corners = np.concatenate([np.zeros((0, 2)), *self.lifts.values()]) @ [1, 1j]
        by_drawing = alignment.metres_per_unit * (corners - shift) / scale_rotation
        off_m = np.abs(by_drawing - corners).max(initial=0.0)
        if alignment.plan == self.drawing and off_m > ERROR_LIMIT_M:
            raise UsageError(
                f"site {site} was aligned by {self.drawing}, which puts lifts {off_m:.2f} m elsewhere; align it without --plan, by "
                f"pins in pixels of {self.reference}"
            )


def read_rmf(path: Path) -> tuple[str, dict[str, RmfLevel]]:
    """Read the building's name and its levels. UsageError for anything else, for lifts whose place the file does not tell, and for
    coordinates on the globe."""
    text = read_text(path, "a *.building.yaml is expected", most_bytes=_MAX_BYTES, error_type=UsageError)
    try:
        check_yaml(text, str(path), _MAX_VALUES, UsageError)
        file = msgspec.yaml.decode(text, type=_File)
    except (yaml.YAMLError, msgspec.MsgspecError, ValueError) as error:
        wanted = "it must be a building of Open-RMF's traffic editor, drawn on pictures or in metres"
        raise UsageError(f"{path} cannot be read ({str(error)[:200]}); {wanted}") from error
    try:
        return file.name, _levels(file)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error


def _levels(file: _File) -> dict[str, RmfLevel]:
    lifts = {name: (lift.level_doors or {}, _outline(file, lift)) for name, lift in (file.lifts or {}).items()}
    reference = ""
    if lifts:
        drawing, scale = file.levels[file.reference].drawing, abs(file.placed(file.reference)[0])
        reference = f"{drawing.filename or file.reference}, with --metres-per-pixel {scale:.6g}"
    levels = {}
    for name, level in file.levels.items():
        outlines = {lift: outline for lift, (doors, outline) in lifts.items() if name in doors}
        placed = file.placed(name) if outlines else (1, 0)
        levels[name] = RmfLevel(level.elevation, outlines, level.drawing.filename, placed, reference)
    return levels


def _outline(file: _File, lift: _Lift) -> Array:
    scale_rotation, shift = file.placed(lift.reference_floor_name or file.reference)
    middle = scale_rotation * file.point(lift) + shift
    across, along = lift.width / 2, lift.depth / 2
    offsets = np.array([-across - 1j * along, across - 1j * along, across + 1j * along, -across + 1j * along])
    corners = middle + np.exp(1j * lift.yaw) * offsets
    return np.stack([corners.real, corners.imag], axis=1)


def rmf_text(building: Building, floors: Sequence[Floor]) -> str:
    """Return a building as a file of the traffic editor, in metres of the building. floors: those with a pose, from below.

    A lift's cabin is the smallest rectangle around its lowest area; its doors, which nobody has drawn here, are left to add.
    """
    lifts: dict[str, dict[str, Any]] = {}
    for floor in floors:
        level = floor.entry.level
        for name, polygons in floor.lifts.items():
            if name not in lifts:
                corners = np.concatenate([ring for rings in polygons for ring in rings])
                known = dict.fromkeys(("reference_floor_name", "initial_floor_name", "lowest_floor"), level)
                lifts[name] = _cabin(moved(corners, floor.building_from_map)) | known | {"doors": {}, "level_doors": {}}
            lifts[name]["highest_floor"] = level
            lifts[name]["level_doors"][level] = []
    levels = {floor.level: {"elevation": floor.height_m} for floor in building.floors}
    in_order = dict(sorted(lifts.items()))
    content = {"name": building.name, "coordinate_system": "cartesian_meters", "levels": levels, "lifts": in_order}
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _cabin(corners: Array) -> dict[str, float]:
    """Return the smallest rectangle around corners (N, 2), turned by at most 45 degrees; to the digits that the editor writes."""
    origin = corners.mean(axis=0)  # OpenCV computes with 24 bits
    (x, y), (width, depth), degrees = cv2.minAreaRect((corners - origin).astype(np.float32))
    quarters = round(degrees / 90)
    if quarters % 2:
        width, depth = depth, width
    yaw = round(radians(degrees - 90 * quarters), 4) + 0.0  # never -0.0
    sizes = {"x": origin[0] + x, "y": origin[1] + y, "width": width, "depth": depth}
    return {name: round(float(value), 3) for name, value in sizes.items()} | {"yaw": yaw}
