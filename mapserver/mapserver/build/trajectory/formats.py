"""Files of other SLAM systems' poses: what they say, with everything left open that they do not.

Files are hostile: their size is looked at before they are read, and nothing that is pickled is unpacked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array
from fleetmap.recordings.tum import read_text

BILLION = 10**9
_MOST_BYTES, _MOST_ROWS = 64 << 20, 500_000
_MOST = 1e12  # of a position, in any unit
_MOST_STAMP = Decimal(10) ** 19
_UNIT_WITHIN = 0.01


@dataclass(frozen=True, slots=True)
class PoseRows:
    """N poses as written.

    stamps (N,) in billionths of the file's unit of time, None where rows carry none; positions (N, 3) in its unit of length; turns:
    (N, 4) quaternions in the order of the file, or (N, 3, 3) rotations.
    """

    stamps: list[int] | None
    positions: Array
    turns: Array

    def __post_init__(self) -> None:
        """ValueError, in words, for what cannot be poses."""
        count = len(self.positions)
        if not 2 <= count <= _MOST_ROWS:
            raise ValueError(f"it holds {count} poses, 2 to {_MOST_ROWS} are expected")
        good: NDArray[np.bool_] = np.all(np.abs(self.positions) < _MOST, axis=1)
        if self.turns.ndim == 2:
            good &= np.abs(np.linalg.norm(self.turns, axis=1) - 1.0) < _UNIT_WITHIN
        else:
            good &= (np.abs(self.turns) < 2.0).all(axis=(1, 2))
            turns = np.where(good[:, None, None], self.turns, 0.0)
            square = turns @ np.swapaxes(turns, 1, 2)
            good &= (np.abs(square - np.eye(3)) < 2 * _UNIT_WITHIN).all(axis=(1, 2)) & (np.linalg.det(turns) > 0)
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(
                f"pose {row + 1} is none: position {self.positions[row].tolist()}, rotation {self.turns[row].tolist()}; positions must "
                "be finite and rotations of unit length"
            )


PoseReader = Callable[[Path], PoseRows]
"""Raises ValueError, in words, for content that is not of the format, and RecordingError for files that cannot be read."""


def text_rows(*columns: int) -> PoseReader:
    """A reader of lines of numbers, as many as `columns` allows: 12 are the upper rows of a matrix, others begin with stamp, position
    and quaternion. Comments (#), empty lines and a first line of names are skipped.
    """

    def read(path: Path) -> PoseRows:
        rows: list[list[float]] = []
        stamps: list[int] = []
        for number, line in enumerate(read_text(sized(path), "poses as lines of numbers are expected").splitlines(), 1):
            fields = line.replace(",", " ").replace(";", " ").split()
            if not fields or fields[0].startswith("#"):
                continue
            try:
                values = [float(field) for field in fields]
            except ValueError as error:
                if not rows:
                    continue  # names of columns
                raise ValueError(f"line {number}: {line[:80]!r} is not all numbers") from error
            if len(values) not in columns or (rows and len(values) != len(rows[0])):
                expected = " or ".join(str(count) for count in columns)
                raise ValueError(f"line {number} has {len(values)} numbers, {expected} are expected: {line[:80]!r}")
            rows.append(values)
            if len(values) != 12:
                stamps.append(billionths(fields[0]))
            if len(rows) > _MOST_ROWS:
                break
        if not rows:
            raise ValueError("it holds no poses")
        table = np.array(rows)
        if stamps:
            return PoseRows(stamps, table[:, 1:4], table[:, 4:8])
        matrices = table.reshape(-1, 3, 4)
        return PoseRows(None, matrices[:, :, 3], matrices[:, :, :3])

    return read


def droid_rows(path: Path) -> PoseRows:
    """DROID-SLAM's `poses.npy` (N, 7) position and quaternion, or (N, 4, 4), with `tstamps.npy` beside it; or text."""
    if path.is_dir():
        path = path / "poses.npy"
    if path.suffix != ".npy":
        return text_rows(8)(path)
    mapped, file, stamps = array_in(path), path.with_name("tstamps.npy"), None
    if mapped.shape[1:] not in ((7,), (4, 4), (3, 4)) or len(mapped) > _MOST_ROWS:
        raise ValueError(f"its shape is {mapped.shape}; (N, 7) or (N, 4, 4) is expected")
    written = np.array(mapped, np.float64)
    if file.exists():
        values = np.array(array_in(file)).ravel()
        if len(values) != len(written):
            raise ValueError(f"{file.name} has {len(values)} stamps for {len(written)} poses")
        stamps = [billionths(repr(value)) for value in values.tolist()]
    if written.shape[1:] == (7,):
        return PoseRows(stamps, written[:, :3], written[:, 3:])
    return PoseRows(stamps, written[:, :3, 3], written[:, :3, :3])


TRAJECTORY_FORMATS: dict[str, PoseReader] = {
    "tum": text_rows(8),
    "kitti": text_rows(12),
    "euroc": text_rows(8, 17),
    "okvis2": text_rows(8, 17),
    "orb-slam3": text_rows(8, 12),
    "stella": text_rows(8, 12),
    "droid": droid_rows,
    "mast3r": text_rows(8),
}


def array_in(path: Path) -> AnyArray:
    """The numbers in a .npy file, mapped; RecordingError for anything else, of which nothing is unpacked."""
    try:
        found = np.load(sized(path, 4 << 30), mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, OverflowError, SyntaxError, TokenError, TypeError, MemoryError) as error:
        raise RecordingError(f"{path} is no .npy file of numbers; save it again with numpy.save") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu" or found.ndim == 0:
        raise RecordingError(f"{path} is no .npy file of numbers")
    if found.ndim < 3 and found.size > 16 * _MOST_ROWS:
        raise RecordingError(f"{path} holds {found.size} numbers, too many for a trajectory")
    return found


def billionths(field: str) -> int:
    """A decimal number times 10^9, exact to its ninth decimal; ValueError for anything else."""
    try:
        value = Decimal(field)
    except InvalidOperation as error:
        raise ValueError(f"stamp {field!r} is no number") from error
    if not value.is_finite() or abs(value) > _MOST_STAMP:
        raise ValueError(f"stamp {field!r} is no time")
    return int(value * BILLION)


def sized(path: Path, most_bytes: int = _MOST_BYTES) -> Path:
    """The path of a file of at most so many bytes; RecordingError for anything else."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the path") from error
    if not path.is_file() or size > most_bytes:
        raise RecordingError(f"{path} has {size} bytes; a file of at most {most_bytes} is expected")
    return path
