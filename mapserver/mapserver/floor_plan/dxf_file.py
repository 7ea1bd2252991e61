"""DXF drawings: their straight lines, in the drawing's own coordinates. Needs the extra `plan` (ezdxf)."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import Array
from mapserver.floor_plan.pins import Pin

MAX_DXF_BYTES = 32 << 20  # as objects it is some twenty times that
_MAX_STEPS = 200_000  # entities that are looked at: blocks within blocks grow without end
_MAX_DEPTH = 8
_SHORT_SHARE = 0.003  # of the drawing's extent: symbols, hatching
_MOST_LINES = 4000
# $INSUNITS, in metres. Source: DXF reference, HEADER section.
_UNITS_M = {1: 0.0254, 2: 0.3048, 4: 0.001, 5: 0.01, 6: 1.0, 7: 1000.0, 10: 0.9144, 14: 0.1}


class DxfFile:
    """A drawing. Pins are in its own units, and the building's frame is that of the drawing, in metres."""

    def __init__(self, path: Path, data: bytes) -> None:
        """UsageError for what is no DXF file, damaged, or too large."""
        self.name, self.data = path.name, data
        document = _document(path)
        unit = int(document.header.get("$INSUNITS", 0))
        self.metres_per_unit = _UNITS_M.get(unit)
        self._lines = np.array(list(_segments(document, path.name)), float).reshape(-1, 4)

    def drawn(self, pins: list[Pin]) -> list[Pin]:
        """As they are: x to the right, y up."""
        return pins

    def lines(self) -> Array:
        """(S, 4) x0 y0 x1 y1 of the longest lines that are visible in the model space."""
        lengths = np.hypot(self._lines[:, 2] - self._lines[:, 0], self._lines[:, 3] - self._lines[:, 1])
        longest = np.argsort(-lengths, kind="stable")[:_MOST_LINES]
        extent = np.ptp(self._lines.reshape(-1, 2), axis=0).max() if len(self._lines) else 0.0
        return np.asarray(self._lines[longest[lengths[longest] > _SHORT_SHARE * extent]], np.float64)


def _document(path: Path) -> Any:
    try:
        from ezdxf.filemanagement import readfile
    except ImportError as error:
        raise UsageError(f"--plan {path}: DXF needs the extra `plan`: pip install '.[server,plan]'") from error
    try:
        return readfile(path)
    except Exception as error:  # a parser of another project on bytes of anybody
        raise UsageError(f"--plan {path} cannot be read as DXF ({str(error)[:200]}); save it again as DXF") from error


def _segments(document: Any, name: str) -> Iterator[tuple[float, float, float, float]]:
    hidden = {layer.dxf.name for layer in document.layers if layer.is_off() or layer.is_frozen()}
    steps = 0

    def look(entities: Iterable[Any], depth: int) -> Iterator[tuple[float, float, float, float]]:
        nonlocal steps
        for entity in entities:
            steps += 1
            if steps > _MAX_STEPS or depth > _MAX_DEPTH:
                raise UsageError(
                    f"--plan {name} has more than {_MAX_STEPS} entities, or blocks {_MAX_DEPTH} deep; simplify it"
                )
            if entity.dxf.layer in hidden:
                continue
            kind = entity.dxftype()
            if kind == "LINE":
                yield (*entity.dxf.start.vec2, *entity.dxf.end.vec2)
            elif kind in {"LWPOLYLINE", "POLYLINE"} and (kind == "LWPOLYLINE" or entity.is_2d_polyline):
                yield from look((part for part in entity.virtual_entities() if part.dxftype() == "LINE"), depth)
            elif kind == "INSERT" and entity.mcount <= 1:
                yield from look(entity.virtual_entities(), depth + 1)

    try:
        for segment in look(document.modelspace(), 0):
            if np.isfinite(segment).all() and np.abs(segment).max() < 1e9:
                yield segment
    except UsageError:
        raise
    except Exception as error:  # as above
        raise UsageError(
            f"--plan {name}: its lines cannot be read ({str(error)[:200]}); save it again as DXF"
        ) from error
