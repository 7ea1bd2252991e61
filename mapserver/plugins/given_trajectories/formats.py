"""Poses in files of other SLAM systems: TUM and KITTI text, and DROID-SLAM's arrays.

Files are untrusted: their size is checked before they are read, and nothing is unpickled.
"""

from pathlib import Path
from tokenize import TokenError
from typing import NamedTuple

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array, rotation_from_quat_wxyz, se3, se3_inverse
from fleetmap.recordings.files import read_text
from fleetmap.recordings.tum import parse_tum
from fleetmap.sensors.samples import Stamps

_MOST_BYTES, _MOST_ROWS = 64 << 20, 500_000
_MOST = 1e12  # of a position, in any unit
_MOST_S = 9e9
_UNIT_WITHIN = 0.01
_EXPECTED = "TUM or KITTI text, or DROID's poses.npy, is expected"


class WrittenPoses(NamedTuple):
    """N poses of a file; kind: TUM, KITTI or DROID.

    stamps_ns (N,): 10^9 times the written number, seconds or frame numbers; None if each frame has one row.
    map_from_it (N, 4, 4): poses of the camera or body, in the file's unit of length.
    """

    kind: str
    stamps_ns: Stamps | None
    map_from_it: Array


def read_poses(path: Path) -> WrittenPoses:
    """Read the poses of a file, detecting its format from the content; RecordingError for unknown formats."""
    if path.is_dir() or path.suffix == ".npy":
        written = _droid(path / "poses.npy" if path.is_dir() else path)
    else:
        text = read_text(sized(path), _EXPECTED)
        rows = [fields for line in text.splitlines() if (fields := line.split()) and not fields[0].startswith("#")]
        if rows and len(rows[0]) == 12:
            written = WrittenPoses("KITTI", None, _matrices(path, rows))
        else:
            rows_in_time = parse_tum(text, str(path))
            written = WrittenPoses("TUM", rows_in_time.stamps_ns, rows_in_time.frame_from_body)
    count, positions = len(written.map_from_it), written.map_from_it[:, :3, 3]
    if not 2 <= count <= _MOST_ROWS:
        raise RecordingError(f"{path} holds {count} poses, 2 to {_MOST_ROWS} are expected")
    if not (good := np.all(np.abs(positions) < _MOST, axis=1)).all():
        row = int(np.argmin(good))
        raise RecordingError(f"{path}: pose {row + 1} is at {positions[row].tolist()}; leave it out")
    return written


def _matrices(path: Path, rows: list[list[str]]) -> Array:
    """Return (N, 4, 4) from rows of twelve numbers, the upper rows of matrices."""
    try:
        upper = np.array([[float(field) for field in fields] for fields in rows]).reshape(-1, 3, 4)
    except ValueError as error:
        raise RecordingError(f"{path} is an invalid KITTI trajectory: each line must have twelve numbers") from error
    turns = np.where(np.isfinite(upper), upper, 0.0)[:, :, :3]
    off = np.abs(turns @ np.swapaxes(turns, 1, 2) - np.eye(3)).max(axis=(1, 2))
    good = (off < 2 * _UNIT_WITHIN) & (np.linalg.det(turns) > 0)
    if not good.all():
        row = int(np.argmin(good))
        raise RecordingError(f"{path}: pose {row + 1} has an invalid rotation: {upper[row].tolist()}; leave it out")
    u, _, vt = np.linalg.svd(turns)
    map_from_it = np.tile(np.eye(4), (len(upper), 1, 1))
    map_from_it[:, :3, :3], map_from_it[:, :3, 3] = u @ vt, upper[:, :, 3]
    return map_from_it


def _droid(path: Path) -> WrittenPoses:
    """Read `poses.npy` (N, 7), cam_from_map as position and quaternion x y z w, and `tstamps.npy` beside it if present."""
    mapped, file, stamps_ns = array_in(path), path.with_name("tstamps.npy"), None
    if mapped.shape[1:] != (7,) or len(mapped) > _MOST_ROWS:
        raise RecordingError(f"{path} is of shape {mapped.shape}; (N, 7), position and quaternion x y z w, is expected")
    rows = np.array(mapped, np.float64)
    good = np.isfinite(rows).all(axis=1) & (np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) < _UNIT_WITHIN)
    if not good.all():
        row = int(np.argmin(good))
        raise RecordingError(f"{path}: pose {row + 1} is {rows[row].tolist()}; a unit quaternion is expected")
    if file.exists():
        stamps = np.array(array_in(file), np.float64).ravel()
        if len(stamps) != len(rows):
            raise RecordingError(f"{file} has {len(stamps)} stamps for {len(rows)} poses; pass those of one run")
        if not (np.abs(stamps) < _MOST_S).all():
            raise RecordingError(f"{file} holds stamps that are neither seconds nor numbers of frames")
        stamps_ns = np.round(stamps * 1e9).astype(np.int64)
    cam_from_map = np.array([se3(rotation_from_quat_wxyz(row[[6, 3, 4, 5]]), row[:3]) for row in rows]).reshape(
        -1, 4, 4
    )
    return WrittenPoses("DROID", stamps_ns, se3_inverse(cam_from_map))


def array_in(path: Path) -> AnyArray:
    """Return the numbers in a .npy file, memory-mapped; RecordingError for anything else; pickles are never loaded."""
    try:
        found = np.load(sized(path, 4 << 30), mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, OverflowError, SyntaxError, TokenError, TypeError, MemoryError) as error:
        raise RecordingError(f"{path} is not a .npy file of numbers; save it again with numpy.save") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu" or found.ndim == 0:
        raise RecordingError(f"{path} is not a .npy file of numbers")
    if found.ndim < 3 and found.size > 16 * _MOST_ROWS:
        raise RecordingError(f"{path} holds {found.size} numbers, too many for a trajectory")
    return found


def sized(path: Path, most_bytes: int = _MOST_BYTES) -> Path:
    """Return the path of a file of at most `most_bytes`; RecordingError for anything else."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the path") from error
    if not path.is_file() or size > most_bytes:
        raise RecordingError(f"{path} has {size} bytes; a file of at most {most_bytes} is expected")
    return path
