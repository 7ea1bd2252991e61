"""Trajectories as TUM text: one line `t x y z qx qy qz qw` each, seconds and metres, quaternion with w last.

Stamps are written with nine decimals and read as decimals, never through a float, so that nanoseconds survive.
"""

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from fleetmap.errors import RecordingError, disk_errors
from fleetmap.geometry import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3
from fleetmap.recordings.files import read_text
from fleetmap.recordings.ordering import ReadLog, forward_only
from fleetmap.sensors.samples import Trajectory

_NS = 1_000_000_000
_MOST_S = 9_223_372_036  # limit of 64 bits of nanoseconds


def format_tum(trajectory: Trajectory) -> str:
    """The lines of a trajectory, after a comment line that names the columns."""
    lines = ["# timestamp_s tx ty tz qx qy qz qw"]
    for stamp, frame_from_body in zip(trajectory.stamps_ns.tolist(), trajectory.frame_from_body, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(frame_from_body[:3, :3])
        numbers = [*frame_from_body[:3, 3], x, y, z, w]
        lines.append(format_stamp(stamp) + " " + " ".join(f"{number:.9f}" for number in numbers))
    return "\n".join(lines) + "\n"


def parse_tum(text: str, what: str = "trajectory", first_line: int = 1) -> Trajectory:
    """Parse the trajectory in `text`; empty lines and those that begin with # are skipped.

    Raises RecordingError, naming `what` and the line, for anything but eight finite numbers, a quaternion that is not
    of unit length within 1 %, or stamps that do not rise.
    """
    stamps, frame_from_body = [], []
    for where, line, stamp_ns, values in stamped_lines(text, what, first_line):
        if len(values) != 7 or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > 0.01:
            fault = "is not 't x y z qx qy qz qw' with a unit quaternion"
            if len(values) == 11:
                fault = "has KITTI's twelve numbers of a matrix and no stamp: write 't x y z qx qy qz qw'"
            elif not np.isfinite(values).all():
                fault = "holds NaN or infinity: leave out lines without a pose"
            raise RecordingError(f"{where}: {line!r} {fault}")
        stamps.append(stamp_ns)
        frame_from_body.append(se3(rotation_from_quat_wxyz(values[[6, 3, 4, 5]]), values[:3]))
    return Trajectory(np.array(stamps, np.int64), np.array(frame_from_body).reshape(-1, 4, 4))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write `trajectory` as TUM text; RecordingError if the file cannot be written."""
    with disk_errors(f"{path} cannot be written", "check folder and space", RecordingError):
        path.write_text(format_tum(trajectory), encoding="ascii")


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory in the file at `path`; RecordingError as `parse_tum`, and if it cannot be read."""
    return parse_tum(read_text(path, "a TUM trajectory is expected"), str(path))


def read_truth(path: Path, log: ReadLog) -> Trajectory:
    """Read the ground truth in the file at `path`: each line without a pose, or with a stamp that does not rise, is left out and noted.

    RecordingError if the file cannot be read, or most of it cannot be used.
    """
    read, faults = list[Trajectory](), list[str]()
    for number, line in enumerate(read_text(path, "a TUM trajectory is expected").splitlines(), start=1):
        try:
            read.append(parse_tum(line, str(path), number))
        except RecordingError as error:
            faults.append(str(error))
    if len(faults) >= sum(map(len, read)):
        raise RecordingError(faults[0] if faults else f"{path} holds no pose; leave the file out")
    if faults:
        log.note("ground truth: unreadable lines", f"{len(faults)} left out; {faults[0]}")
    stamps_ns = np.concatenate([one.stamps_ns for one in read])
    kept = forward_only(stamps_ns, "ground truth", log)
    return Trajectory(stamps_ns[kept], np.concatenate([one.frame_from_body for one in read])[kept])


def stamped_lines(text: str, what: str, first_line: int = 1) -> Iterator[tuple[str, str, int, Array]]:
    """The lines of a table with rising stamps: each one's place, its first 80 characters, its stamp in ns and the values after it.

    Comments and empty lines are skipped; RecordingError for other lines.
    """
    last_ns: int | None = None
    is_first = True
    for number, line in enumerate(text.splitlines(), start=first_line):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        where = f"{what}, line {number}"
        words = [field for field in fields if not _is_number(field)]
        is_header, is_first = is_first and len(words) == len(fields), False
        if is_header:
            continue
        if words:
            raise RecordingError(f"{where}: {line[:80]!r} is not all numbers, {words[0][:40]!r} is not a number")
        try:
            stamp_ns = parse_stamp_ns(fields[0])
        except ValueError as error:
            raise RecordingError(f"{where}: {error}; write seconds") from error
        yield where, line[:80], stamp_ns, np.array(fields[1:], np.float64)
        if last_ns is not None and stamp_ns <= last_ns:
            advice = "sort the lines by time"
            if stamp_ns == last_ns:
                advice = "it is that of the line before; write stamps with nine decimals, or leave out doubled lines"
            raise RecordingError(f"{where}: stamp {fields[0]} does not rise, {advice}")
        last_ns = stamp_ns


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def format_stamp(stamp_ns: int) -> str:
    """Seconds with nine decimals."""
    sign, (whole, rest) = "-" if stamp_ns < 0 else "", divmod(abs(stamp_ns), _NS)
    return f"{sign}{whole}.{rest:09d}"


def parse_stamp_ns(field: str) -> int:
    """Convert decimal seconds to nanoseconds, truncating finer digits. ValueError for anything else."""
    try:
        seconds = Decimal(field)
    except InvalidOperation as error:
        raise ValueError(f"stamp {field!r}") from error
    if not seconds.is_finite():
        raise ValueError(f"stamp {field!r} is not a number of seconds")
    if abs(seconds) > _MOST_S:
        unit = next((name for name, most in (("ms", 10**13), ("us", 10**16)) if abs(seconds) < most), "ns")
        raise ValueError(f"stamp {field!r} is not within {_MOST_S} seconds, it looks like {unit}")
    return int(seconds * _NS)
