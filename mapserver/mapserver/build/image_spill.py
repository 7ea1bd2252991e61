"""Pictures of keyframes in one temporary file, the last ones used in memory: how a long survey stays small."""

import tempfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from fleetmap.errors import StoreError, disk_errors
from fleetmap.features.patch_align import half_pyramid
from fleetmap.geometry import AnyArray
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.survey.keyframes.keyframes import Pictures

_HELD = 48  # more than the keyframes that one is compared with


@dataclass(frozen=True, slots=True)
class _Place:
    stamp_ns: int
    arrays: tuple[tuple[int, np.dtype[Any], tuple[int, ...]] | None, ...]  # left, right, disparity: offset, type, shape


class ImageSpill:
    """An ImageStore over an unnamed file in `folder`, which the system removes with the process."""

    def __init__(self, folder: Path) -> None:
        with disk_errors(f"{folder} takes no temporary file", "check its rights and space"):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed with the store
        self._places: list[_Place] = []
        self._held: OrderedDict[int, Pictures] = OrderedDict()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._file.close()

    def put(self, pictures: Pictures) -> int:
        """See ImageStore."""
        frame, number = pictures.frame, len(self._places)
        parts = (frame.left, frame.right, frame.disparity_px)
        with disk_errors(f"picture {number} of the survey cannot be set aside", "make space beside the store"):
            self._places.append(_Place(frame.stamp_ns, tuple(self._write(part) for part in parts)))
        self._hold(number, pictures)
        return number

    def get(self, number: int) -> Pictures:
        """See ImageStore."""
        if number not in self._held:
            place = self._places[number]
            left, right, disparity = (None if part is None else self._read(*part) for part in place.arrays)
            assert left is not None
            self._hold(number, Pictures(RectifiedFrame(place.stamp_ns, left, right, disparity), half_pyramid(left)))
        self._held.move_to_end(number)
        return self._held[number]

    def _hold(self, number: int, pictures: Pictures) -> None:
        self._held[number] = pictures
        while len(self._held) > _HELD:
            self._held.popitem(last=False)

    def _write(self, array: AnyArray | None) -> tuple[int, np.dtype[Any], tuple[int, ...]] | None:
        if array is None:
            return None
        offset = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(array).data)
        return offset, array.dtype, array.shape

    def _read(self, offset: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Any:
        self._file.seek(offset)
        size = int(np.prod(shape)) * dtype.itemsize
        data = self._file.read(size)
        if len(data) != size:
            raise StoreError("the survey's temporary pictures were cut short; is the disk full?")
        return np.frombuffer(data, dtype).reshape(shape).copy()  # writable: numba compiles no second version for it
