"""Clouds of points in PLY files, and what a camera sees of them: depths where other systems keep no images of them.

MASt3R-SLAM writes one beside its poses: x, y, z and red, green, blue of every pixel of its keyframes that it is sure of, in the frame and
unit of the poses. Files are hostile: what the header promises is compared with the file before anything is read.
"""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array
from mapserver.build.trajectory.formats import sized

EDGE_RATIO = 1.25  # between neighbouring depths: what lies between them is neither surface
_MOST_HEADER, _MOST_POINTS, _MOST_BYTES = 16 << 10, 50_000_000, 4 << 30
_MOST = 1e12  # of a coordinate, in any unit
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
_TYPES |= {f"{kind}{8 * int(size)}": f"{kind[0]}{size}" for kind in ("int", "uint") for size in "124"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_CHUNK = 1 << 20  # points


@dataclass(frozen=True)
class Cloud:
    """points (N, 3) in the file's unit; grey (N,), None where the file has no colours."""

    points: NDArray[np.float32]
    grey: NDArray[np.float32] | None

    def thinned(self, most: int) -> "Cloud":
        """At most so many of the points, evenly from the whole file."""
        step = -(-len(self.points) // most)
        return Cloud(self.points[::step], None if self.grey is None else self.grey[::step])


class _Header(NamedTuple):
    """Order of bytes, "" for text; the vertices' type and how many; where they start; whether nothing else follows them."""

    order: str
    dtype: "np.dtype[np.void]"
    points: int
    start: int
    is_last: bool


class SeenCloud(NamedTuple):
    """What a camera sees of a cloud in cells (h, w): inverse depth, 0 for nothing; grey, NaN for nothing; and the sum of squared
    deviations of inverse depths from their cell's mean, with how many more of them there are than cells."""

    inverse: NDArray[np.float32]
    grey: Array
    squares: float
    freedom: int


def read_ply(path: Path) -> Cloud:
    """The vertices of a PLY file, ascii or binary; RecordingError for anything else."""
    size = sized(path, _MOST_BYTES).stat().st_size
    try:
        with path.open("rb") as file:
            header = _header(file.read(_MOST_HEADER))
        table = _rows(path, header) if header.order == "" else _mapped(path, header, size)
        points = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float32)
        good = np.all(np.abs(points) < _MOST, axis=1)
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(f"point {row + 1} is at {points[row].tolist()}; coordinates must be finite")
    except (ValueError, OSError, OverflowError) as error:
        raise RecordingError(f"{path} is no cloud of points: {error}") from error
    colours = [header.dtype.fields.get(name) for name in ("red", "green", "blue")] if header.dtype.fields else [None]
    if any(colour is None or colour[0] != np.uint8 for colour in colours):
        return Cloud(points, None)
    return Cloud(points, np.column_stack([table[name] for name in ("red", "green", "blue")]).astype(np.float32) @ _LUMA)


def _header(head: bytes) -> _Header:
    """ValueError, in words, unless the vertices come first and are numbers alone."""
    end = head.find(b"\nend_header")
    start = head.find(b"\n", end + 1) + 1
    if not head.startswith(b"ply") or end < 0 or start == 0:
        raise ValueError(f"no PLY header within {_MOST_HEADER} bytes")
    lines = [line.split() for line in head[:end].decode("ascii").splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    if not lines or lines[0][0] != "format" or len(lines[0]) < 2 or lines[0][1] not in _FORMATS:
        raise ValueError(f"its header does not begin with a format of {', '.join(_FORMATS)}")
    elements = [number for number, line in enumerate(lines) if line[0] == "element"]
    if not elements or elements[0] != 1 or lines[1][1:2] != ["vertex"] or len(lines[1]) != 3:
        raise ValueError("its first element is not vertex")
    order, count = _FORMATS[lines[0][1]], int(lines[1][2])
    if not 1 <= count <= _MOST_POINTS:
        raise ValueError(f"it holds {count} points, 1 to {_MOST_POINTS} are expected")
    kinds = []
    for line in lines[2 : elements[1] if len(elements) > 1 else None]:
        if len(line) != 3 or line[0] != "property" or line[1] not in _TYPES:
            raise ValueError(f"{' '.join(line)[:80]!r} of its header is no property that is a number")
        kinds.append((line[2], f"{order}{_TYPES[line[1]]}"))
    if not {"x", "y", "z"} <= {name for name, _ in kinds}:
        raise ValueError(f"its points have {', '.join(name for name, _ in kinds)[:80]}; x, y and z are expected")
    return _Header(order, np.dtype(kinds), count, start, len(elements) == 1)


def _mapped(path: Path, header: _Header, size: int) -> AnyArray:
    expected = header.start + header.points * header.dtype.itemsize
    if size < expected or (header.is_last and size > expected):
        raise ValueError(f"its {header.points} points end after {expected} bytes, it has {size}")
    return np.memmap(path, header.dtype, "r", header.start, (header.points,))


def _rows(path: Path, header: _Header) -> AnyArray:
    """The same of text; a line more than there are points is looked for where nothing should follow."""
    with path.open("rb") as file:
        file.seek(header.start)
        lines = list(islice(file, header.points + header.is_last))
    if len(lines) != header.points:
        raise ValueError(
            f"it has {'more than ' * (len(lines) > header.points)}{len(lines)} lines for {header.points} points"
        )
    return np.loadtxt(lines, header.dtype, comments=None, ndmin=1)


def sighting(cloud: Cloud, cam_from_cloud: Array, pinhole: Array, shape: tuple[int, int]) -> SeenCloud:
    """What a camera at cam_from_cloud (4, 4), with pinhole fx, fy, cx, cy of cells, sees; the units are those of the cloud.

    Of each cell the points near the nearest one in it and beside it are averaged: what is further off lies behind that surface and shows
    through between its points.
    """
    (height, width), (fx, fy, cx, cy) = shape, pinhole.astype(np.float32)
    turn, move = cam_from_cloud[:3, :3].astype(np.float32), cam_from_cloud[:3, 3].astype(np.float32)
    cells, depths, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)], [np.zeros(0, np.int64)]
    for first in range(0, len(cloud.points), _CHUNK):
        x, y, z = turn @ cloud.points[first : first + _CHUNK].T + move[:, None]
        with np.errstate(all="ignore"):
            u, v = np.rint(x / z * fx + cx), np.rint(y / z * fy + cy)
            inside = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
        cells.append(v[inside].astype(np.int64) * width + u[inside].astype(np.int64))
        depths.append(z[inside])
        numbers.append(first + inside)
    cell, depth, number = np.concatenate(cells), np.concatenate(depths), np.concatenate(numbers)
    nearest = np.full(height * width, np.inf, np.float32)
    np.minimum.at(nearest, cell, depth)
    around = cv2.erode(nearest.reshape(shape), np.ones((3, 3), np.uint8)).ravel()
    kept = depth <= EDGE_RATIO * around[cell]
    cell, inverse, number = cell[kept], 1.0 / depth[kept].astype(np.float64), number[kept]
    count = np.bincount(cell, minlength=height * width)
    means = np.bincount(cell, inverse, height * width) / np.maximum(count, 1)
    grey = np.full(height * width, np.nan)
    if cloud.grey is not None:
        grey[count > 0] = (np.bincount(cell, cloud.grey[number], height * width) / np.maximum(count, 1))[count > 0]
    squares = float(np.square(inverse - means[cell]).sum())
    return SeenCloud(
        means.astype(np.float32).reshape(shape), grey.reshape(shape), squares, len(cell) - int((count > 0).sum())
    )
