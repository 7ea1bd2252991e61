"""The file of a plan: a picture (PNG, JPEG, TIFF, BMP, PGM), looked at before it is decoded, or DXF."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError, disk_errors
from fleetmap.geometry import Array
from fleetmap.recordings.images import image_size
from mapserver.floor_plan.dxf_file import MAX_DXF_BYTES, DxfFile
from mapserver.floor_plan.pins import Pin

MAX_PLAN_BYTES = 64 << 20
MAX_PLAN_PIXELS = 100_000_000
_STROKE_PX = 7.0  # a line that is drawn thinner has no sides
_MOST_LINES = 4000
_SHORT_SHARE = 0.01  # of the picture's longer side: letters, hatching, symbols


@dataclass(frozen=True, slots=True)
class PlanFile:
    """data: as it came. grey (H, W)."""

    name: str
    data: bytes
    grey: NDArray[np.uint8]

    metres_per_unit = None

    def drawn(self, pins: list[Pin]) -> list[Pin]:
        """Right and up. UsageError for a pin beside the picture."""
        height, width = self.grey.shape
        for pin in pins:
            if not (0 <= pin.drawing[0] <= width and 0 <= pin.drawing[1] <= height):
                x, y = pin.drawing
                raise UsageError(
                    f"--pin {pin.name}: {x:g},{y:g} is not in {self.name}, which has {width}x{height} pixels"
                )
        return upwards(pins)

    def lines(self) -> Array:
        """(S, 4) x0 y0 x1 y1 of straight lines in the picture, in pixels right and up (so negative); of a thick wall both edges."""
        detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
        found = detector.detect(self.grey)[0]
        if found is None:
            return np.zeros((0, 4))
        # The centre of the upper left pixel is 0, 0 to OpenCV; pins count from the pixel's corner.
        lines = found.reshape(-1, 4).astype(float) + 0.5
        lengths = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        long = np.argsort(-lengths, kind="stable")[:_MOST_LINES]
        long = long[lengths[long] > _SHORT_SHARE * max(self.grey.shape)]
        return _strokes_as_lines(lines[long]) * (1, -1, 1, -1)


def _strokes_as_lines(lines: Array) -> Array:
    """Both edges of a thin stroke become its middle: what is that thin is a line of the drawing, and no wall with two sides.

    Edges run with the dark side to one hand, so that those of a stroke run against each other.
    """
    starts, ends = lines[:, 0] + 1j * lines[:, 1], lines[:, 2] + 1j * lines[:, 3]
    along = ends - starts
    lengths = np.maximum(np.abs(along), 1e-9)
    unit, middles = along / lengths, (starts + ends) / 2
    moved = lines.copy()
    for n in range(len(lines)):
        to = (middles - middles[n]) * np.conj(unit[n])
        against = (unit * np.conj(unit[n])).real < -0.995
        overlap = (lengths + lengths[n]) / 2 - np.abs(to.real)
        near = against & (np.abs(to.imag) < _STROKE_PX) & (overlap > 0.5 * np.minimum(lengths, lengths[n]))
        if near.any():
            off = to.imag[near][np.abs(to.imag[near]).argmin()] / 2 * 1j * unit[n]
            moved[n] += (off.real, off.imag, off.real, off.imag)
    return moved


def upwards(pins: list[Pin]) -> list[Pin]:
    """Pins that were said in a picture, where down is positive."""
    return [Pin(pin.name, (pin.drawing[0], -pin.drawing[1]), pin.map_m) for pin in pins]


def read_plan(path: Path) -> PlanFile | DxfFile:
    """The plan of a file. UsageError for what is none, is too large, or is damaged."""
    with (
        disk_errors(f"--plan {path} cannot be read", "check the path and its rights", UsageError),
        path.open("rb") as file,
    ):
        data = file.read(MAX_PLAN_BYTES + 1)
    if len(data) > MAX_PLAN_BYTES:
        raise UsageError(f"--plan {path} has more than {MAX_PLAN_BYTES} bytes; save it smaller")
    if path.suffix.lower() == ".dxf":
        if len(data) > MAX_DXF_BYTES:
            raise UsageError(f"--plan {path} has more than {MAX_DXF_BYTES} bytes; leave out what is no wall")
        return DxfFile(path, data)
    size = image_size(data)
    if size is None:
        raise UsageError(f"--plan {path} is no PNG, JPEG, TIFF, BMP or PGM picture; save it as one of these")
    if not 0 < size[0] * size[1] <= MAX_PLAN_PIXELS:
        raise UsageError(
            f"--plan {path} has {size[0]}x{size[1]} pixels, the limit is {MAX_PLAN_PIXELS}; save it smaller"
        )
    try:
        grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        grey = None
    if grey is None or grey.shape != (size[1], size[0]):
        raise UsageError(f"--plan {path} cannot be decoded; it is damaged, save it again")
    return PlanFile(path.name, data, np.asarray(grey, np.uint8))
