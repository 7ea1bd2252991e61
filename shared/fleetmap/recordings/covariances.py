"""Covariances beside a TUM trajectory, as comma-separated text: one line `t, c00, c01, ... c05, c11, ... c55` for each stamp.

The 21 numbers are the upper triangle, row by row, of the (6, 6) covariance of rotation (radians) and position (metres), in
that order and in the axes of the trajectory's frame. Stamps are those of the trajectory, to the nanosecond.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.tum import format_stamp, parse_stamp_ns
from fleetmap.sensors.samples import Stamps

_ROWS, _COLUMNS = np.triu_indices(6)


@dataclass(frozen=True, slots=True)
class StampedCovariances:
    """stamps_ns (N,) rising, covs_rot_trans (N, 6, 6)."""

    stamps_ns: Stamps
    covs_rot_trans: Array


def format_covariances(given: StampedCovariances) -> str:
    """The lines, with a comment line that names the columns first."""
    names = ", ".join(f"c{row}{column}" for row, column in zip(_ROWS, _COLUMNS, strict=True))
    lines = [f"# timestamp_s, {names}"]
    for stamp_ns, covariance in zip(given.stamps_ns.tolist(), given.covs_rot_trans, strict=True):
        lines.append(", ".join([format_stamp(stamp_ns), *(f"{value:.9g}" for value in covariance[_ROWS, _COLUMNS])]))
    return "\n".join(lines) + "\n"


def parse_covariances(text: str, what: str = "covariances") -> StampedCovariances:
    """What `format_covariances` wrote.

    Raises RecordingError, naming `what` and the line, for anything but 22 finite numbers of a positive definite matrix, or
    stamps that do not rise.
    """
    stamps: list[int] = []
    found: list[Array] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            stamp_ns, values = parse_stamp_ns(fields[0]), np.array([float(field) for field in fields[1:]])
        except ValueError as error:
            raise RecordingError(f"{what}, line {number}: {line[:80]!r} is not all numbers ({error})") from error
        if len(values) != len(_ROWS) or not np.isfinite(values).all():
            raise RecordingError(
                f"{what}, line {number}: {len(values)} numbers after the stamp, 21 finite ones are needed"
            )
        covariance = np.zeros((6, 6))
        covariance[_ROWS, _COLUMNS] = covariance[_COLUMNS, _ROWS] = values
        if np.linalg.eigvalsh(covariance)[0] <= 0:
            raise RecordingError(
                f"{what}, line {number}: the covariance is not positive definite; is its order rotation first?"
            )
        if stamps and stamp_ns <= stamps[-1]:
            raise RecordingError(f"{what}, line {number}: stamp {fields[0]} does not rise; sort the lines by time")
        stamps.append(stamp_ns)
        found.append(covariance)
    return StampedCovariances(np.array(stamps, np.int64), np.array(found).reshape(-1, 6, 6))


def read_covariances(path: Path) -> StampedCovariances:
    """The covariances in the file at `path`; RecordingError as `parse_covariances`, and where it cannot be read."""
    try:
        return parse_covariances(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is not a text file ({error.reason}); covariances as CSV are expected") from error


def write_covariances(path: Path, given: StampedCovariances) -> None:
    """Writes them; RecordingError where the file cannot be written."""
    try:
        path.write_text(format_covariances(given), encoding="ascii")
    except OSError as error:
        raise RecordingError(f"{path} cannot be written ({error.strerror}); check folder and space") from error
