"""The file of a plan: a picture (PNG, JPEG, TIFF, BMP, PGM), checked before it is decoded."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InvalidValueError, disk_errors
from fleetmap.recordings.images import image_size
from mapserver.floor_plan.pins import Pin

MAX_PLAN_BYTES = 64 << 20
MAX_PLAN_PIXELS = 100_000_000


class PlanFile(NamedTuple):
    """data: the file's bytes. grey (H, W)."""

    name: str
    data: bytes
    grey: NDArray[np.uint8]

    def check_pins(self, pins: Sequence[Pin]) -> None:
        """Raise InvalidValueError for a pin outside the picture."""
        height, width = self.grey.shape
        for pin in pins:
            if not (0 <= pin.drawing[0] <= width and 0 <= pin.drawing[1] <= height):
                x, y = pin.drawing
                raise InvalidValueError(
                    f"pin {pin.name}: {x:g},{y:g} is not in {self.name}, which has {width}x{height} pixels"
                )


def read_plan(path: Path) -> PlanFile:
    """Read the plan in a file; errors as of `decode_plan`."""
    with (
        disk_errors(f"--plan {path} cannot be read", "check the path and its rights", InvalidValueError),
        path.open("rb") as file,
    ):
        data = file.read(MAX_PLAN_BYTES + 1)
    return decode_plan(path.name, data)


def decode_plan(name: str, data: bytes) -> PlanFile:
    """Decode the plan in a file's bytes. InvalidValueError for an unknown format, a too large or a damaged file."""
    if len(data) > MAX_PLAN_BYTES:
        raise InvalidValueError(f"plan {name} has more than {MAX_PLAN_BYTES} bytes; save it smaller")
    if name.lower().endswith(".dxf"):
        raise InvalidValueError(f"plan {name}: DXF is not supported; save the drawing as PNG and align it by pins")
    size = image_size(data)
    if size is None:
        raise InvalidValueError(f"plan {name} is not a PNG, JPEG, TIFF, BMP or PGM picture; save it as one of these")
    if not 0 < size[0] * size[1] <= MAX_PLAN_PIXELS:
        raise InvalidValueError(
            f"plan {name} has {size[0]}x{size[1]} pixels, the limit is {MAX_PLAN_PIXELS}; save it smaller"
        )
    try:
        grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        is_png = data.startswith(b"\x89PNG")
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if is_png else None
        if grey is not None and picture is not None and picture.ndim == 3 and picture.shape[2] == 4:
            # Transparent pixels are paper, whatever colour is stored under them.
            opaque = cv2.convertScaleAbs(picture[:, :, 3], alpha=1.0 if picture.dtype == np.uint8 else 1 / 257)
            grey = 255 - cv2.multiply(255 - grey, opaque, scale=1 / 255)
    except cv2.error:
        grey = None
    if grey is None or grey.shape != (size[1], size[0]):
        raise InvalidValueError(f"plan {name} cannot be decoded; it is damaged, save it again")
    return PlanFile(name, data, np.asarray(grey, np.uint8))
