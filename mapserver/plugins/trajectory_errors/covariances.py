"""Covariances of a trajectory as CSV, for the check of its consistency."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.files import read_text
from fleetmap.recordings.tum import stamped_lines
from fleetmap.sensors.samples import Stamps

_ROWS, _COLUMNS = np.triu_indices(6)


@dataclass(frozen=True, slots=True)
class StampedCovariances:
    """stamps_ns (N,) rising, covs_rot_trans (N, 6, 6)."""

    stamps_ns: Stamps
    covs_rot_trans: Array


def parse_covariances(text: str, what: str = "covariances") -> StampedCovariances:
    """Parse the covariances of a trajectory: lines of a stamp and the 21 numbers of the upper triangle, rotation first.

    Raises RecordingError, naming `what` and the line, for anything but 22 finite numbers of a positive definite matrix, or
    stamps that do not rise.
    """
    stamps, covariances = [], []
    for line in stamped_lines(text, what):
        if len(line.values) != len(_ROWS) or not np.isfinite(line.values).all():
            raise RecordingError(f"{line.where}: {len(line.values)} numbers after the stamp, 21 finite ones are needed")
        covariance = np.zeros((6, 6))
        covariance[_ROWS, _COLUMNS] = covariance[_COLUMNS, _ROWS] = line.values
        if np.linalg.eigvalsh(covariance)[0] <= 0:
            raise RecordingError(f"{line.where}: the covariance is not positive definite; is its order rotation first?")
        stamps.append(line.stamp_ns)
        covariances.append(covariance)
    return StampedCovariances(np.array(stamps, np.int64), np.array(covariances).reshape(-1, 6, 6))


def read_covariances(path: Path) -> StampedCovariances:
    """Read the covariances in the file at `path`; RecordingError as `parse_covariances`, and if it cannot be read."""
    return parse_covariances(read_text(path, "covariances as CSV are expected"), str(path))
