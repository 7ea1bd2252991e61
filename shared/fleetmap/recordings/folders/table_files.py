"""Rows of numbers and stamps as sensors' files hold them: reading, ordering, pairing.

What is left out is counted, never hidden.
"""

import bisect
import io
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array, rotation_from_quat_wxyz, se3
from fleetmap.sensors.samples import DataIssue, ImuSamples, Stamps, Trajectory

_ABSURD = 1e5  # no inertial sensor measures this in any unit; flipped bits do
PAIR_TOLERANCE_NS = 5_000_000  # two cameras of one rig: more than this apart is not one moment


def read_stamped_rows(path: Path, columns: int, losses: list[DataIssue]) -> tuple[Stamps, Array]:
    """Stamps (N,) in ns and values (N, columns) of a text table.

    A line holds an integer and then numbers, parted by commas or blanks; # begins a comment.

    Lines that are no such row (a file cut off in the middle of one) are counted in `losses`; RecordingError where no
    line is.
    """
    text = _read_text(path).replace(",", " ")
    dtype = np.dtype([("stamp_ns", np.int64), ("values", np.float64, (columns,))])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of empty tables, which are an error below
            table: AnyArray = np.loadtxt(io.StringIO(text), dtype, comments="#", usecols=range(columns + 1), ndmin=1)
    except ValueError:
        table = _read_rows_singly(path, text, columns, dtype, losses)
    if len(table) == 0:
        raise RecordingError(f"{path} holds no row of a stamp in ns and {columns} numbers; the recording is incomplete")
    return table["stamp_ns"], table["values"]


def read_name_table(path: Path) -> tuple[Stamps, list[str]]:
    """Stamps (N,) and file names of a EuRoC camera's data.csv; RecordingError for a line that is neither."""
    stamps, names = [], []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, _, name = line.partition(",")
        if not stamp.strip().isdigit() or not name.strip():
            raise RecordingError(f"{path}, line {number}: {line[:60]!r} is no stamp in ns, a comma and a file name")
        stamps.append(int(stamp))
        names.append(name.strip())
    return np.array(stamps, np.int64), names


def forward_only(stamps_ns: Stamps, what: str, losses: list[DataIssue]) -> NDArray[np.bool_]:
    """(N,) which stamps to keep so that they increase strictly and as few as possible are left out.

    Those are counted in `losses`.

    RecordingError where more than half would be left out: such a clock says nothing. Stamps are never sorted, because
    values that arrive out of order carry stamps that cannot be trusted. One stamp far in the future costs itself, not
    all that follow.
    """
    kept = np.ones(len(stamps_ns), np.bool_)
    backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(backwards) == 0:
        return kept
    kept = _longest_increasing(stamps_ns)
    dropped, first = int((~kept).sum()), int(backwards[0])
    losses.append(
        DataIssue(
            f"{what}: stamps not increasing",
            f"{dropped} of {len(kept)} left out; the first is {stamps_ns[first + 1]} after {stamps_ns[first]}",
        )
    )
    if dropped > len(kept) // 2:
        raise RecordingError(
            f"{what}: stamps go backwards, {dropped} of {len(kept)} do not fit; the sensor's clock is broken, record "
            f"again"
        )
    return kept


def _longest_increasing(stamps_ns: Stamps) -> NDArray[np.bool_]:
    """(N,) a longest strictly increasing subsequence. Source: patience sorting."""
    ends: list[int] = []  # ends[k]: smallest stamp that ends an increasing run of k + 1
    end_index: list[int] = []
    before = np.full(len(stamps_ns), -1)
    for index, stamp in enumerate(stamps_ns.tolist()):
        place = bisect.bisect_left(ends, stamp)
        before[index] = end_index[place - 1] if place else -1
        ends[place : place + 1] = [stamp]
        end_index[place : place + 1] = [index]
    kept = np.zeros(len(stamps_ns), np.bool_)
    index = end_index[-1]
    while index >= 0:
        kept[index] = True
        index = int(before[index])
    return kept


def clean_imu(stamps_ns: Stamps, gyro_radps: Array, accel_mps2: Array, losses: list[DataIssue]) -> ImuSamples:
    """The samples whose values are possible and move forward in time; what was left out is counted in `losses`."""
    possible = np.asarray((np.abs(np.hstack([gyro_radps, accel_mps2])) < _ABSURD).all(axis=1))
    if not possible.all():
        losses.append(
            DataIssue("imu: impossible values", f"{int((~possible).sum())} of {len(possible)} samples left out")
        )
    stamps_ns, gyro_radps, accel_mps2 = stamps_ns[possible], gyro_radps[possible], accel_mps2[possible]
    kept = forward_only(stamps_ns, "imu", losses)
    return ImuSamples(
        np.ascontiguousarray(stamps_ns[kept]),
        np.ascontiguousarray(gyro_radps[kept]),
        np.ascontiguousarray(accel_mps2[kept]),
    )


def trajectory_of_rows(
    stamps_ns: Stamps, position_quat_wxyz: Array, losses: list[DataIssue], what: str
) -> Trajectory | None:
    """Trajectory of rows x y z qw qx qy qz (N, 7); rows without a unit quaternion are left out and counted.

    None if none is left.
    """
    norms = np.linalg.norm(position_quat_wxyz[:, 3:7], axis=1)
    good = np.isfinite(position_quat_wxyz).all(axis=1) & (np.abs(norms - 1) < 0.01)
    if not good.all():
        losses.append(
            DataIssue(
                f"{what}: no rotation", f"{int((~good).sum())} of {len(good)} rows without a unit quaternion left out"
            )
        )
    stamps_ns, rows = stamps_ns[good], position_quat_wxyz[good]
    kept = forward_only(stamps_ns, what, losses)
    if not kept.any():
        return None
    frame_from_body = np.stack([se3(rotation_from_quat_wxyz(row[3:7]), row[:3]) for row in rows[kept]])
    return Trajectory(np.ascontiguousarray(stamps_ns[kept]), frame_from_body)


def pair_stamps(
    left_ns: Stamps, right_ns: Stamps, tolerance_ns: int = PAIR_TOLERANCE_NS
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (P,), (P,) of left and right stamps that belong together.

    Stamps increase. Two belong together where each is the other's nearest and they are within the tolerance.
    """
    if len(left_ns) == 0 or len(right_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    right_of_left = _nearest(right_ns, left_ns)
    left_of_right = _nearest(left_ns, right_ns)
    lefts = np.arange(len(left_ns))
    mutual = left_of_right[right_of_left] == lefts
    close = np.abs(right_ns[right_of_left] - left_ns) <= tolerance_ns
    chosen = lefts[mutual & close]
    return chosen, right_of_left[chosen]


def natural_key(name: str) -> tuple[object, ...]:
    """Sorts file names by the numbers in them."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name))


def _nearest(sorted_ns: Stamps, wanted_ns: Stamps) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(sorted_ns, wanted_ns), 0, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = wanted_ns - sorted_ns[before] < sorted_ns[after] - wanted_ns
    return np.where(is_before & (after > 0), before, after).astype(np.int64)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); the recording is incomplete") from error


def _read_rows_singly(
    path: Path, text: str, columns: int, dtype: "np.dtype[np.void]", losses: list[DataIssue]
) -> AnyArray:
    rows, bad = [], 0
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            stamp, values = int(words[0]), [float(word) for word in words[1 : columns + 1]]
        except ValueError:
            values = []
        if len(values) == columns:
            rows.append((stamp, values))
        else:
            bad += 1
    losses.append(
        DataIssue(
            f"{path.name}: unreadable lines", f"{bad} of {bad + len(rows)} lines are no stamp and {columns} numbers"
        )
    )
    return np.array(rows, dtype) if rows else np.zeros(0, dtype)
