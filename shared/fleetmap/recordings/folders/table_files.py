"""Text tables of stamps with numbers or file names, as data sets in folders hold them."""

import io
import re
import warnings
from pathlib import Path

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray, Array
from fleetmap.recordings.ordering import ReadLog, clean_imu, trajectory_of_rows, wrong_unit
from fleetmap.recordings.strange_files import what_file_instead
from fleetmap.recordings.tum import check_table
from fleetmap.sensors.samples import ImuSamples, Stamps, Trajectory

_LAST_NS = 2**63 - 1
_IMU_NAMES = {
    "gyro": ("w_", "wx", "wy", "wz", "gyr", "gx", "gy", "gz", "omega", "ang"),
    "accel": ("a_", "ax", "ay", "az", "acc", "lin"),
}


def read_stamped_rows(path: Path, columns: int, log: ReadLog) -> tuple[Stamps, Array]:
    """Stamps (N,) in ns and values (N, columns) of a text table.

    A line holds an integer and then numbers, separated by commas or blanks; # begins a comment. Lines that are no such
    row (a file cut off in the middle of one) are noted in `log`; RecordingError where no line is, and for stamps with
    decimals.
    """
    text = _without_names(read_table_text(path)).replace(",", " ").replace(";", " ")
    dtype = np.dtype([("stamp_ns", np.int64), ("values", np.float64, (columns,))])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of empty tables, which are an error below
            table: AnyArray = np.loadtxt(io.StringIO(text), dtype, comments="#", usecols=range(columns + 1), ndmin=1)
    except ValueError:
        table = _read_rows_singly(path, text, dtype, log)
    if len(table) == 0:
        first = next((line for line in text.splitlines() if line.partition("#")[0].strip()), "")
        _check_whole(first.split()[0] if first else "", str(path))
        there = f"its first is {first[:80]!r}" if first else "it is empty"
        raise RecordingError(
            f"{path} holds no row of a stamp in ns and {columns} numbers, {there}; the recording is incomplete, copy it again"
        )
    log.files.append(path)
    return table["stamp_ns"], table["values"]


def read_imu(path: Path, log: ReadLog) -> ImuSamples:
    """The samples in a table of stamps, gyro rad/s and accelerometer m/s^2; none where there is no such file."""
    if not path.is_file():
        return ImuSamples.empty()
    stamps_ns, rows = read_stamped_rows(path, 6, log)
    order = _imu_columns(read_table_text(path).lstrip().partition("\n")[0])
    return clean_imu(stamps_ns, rows[:, order[:3]], rows[:, order[3:]], log)


def _imu_columns(header: str) -> list[int]:
    """Of six columns behind the stamp those of gyro and accelerometer x y z: by their names, EuRoC's order where these say nothing."""
    found: dict[str, int] = {}
    for number, name in enumerate(re.split(r"[,;\t]", header.lower())[1:7]):
        word = re.sub(r"[\[(].*", "", name).strip()
        kind = next((kind for kind, starts in _IMU_NAMES.items() if word.startswith(starts)), "")
        if kind and word[-1:] in "xyz":
            found[kind + word[-1]] = number
    order = [found.get(kind + axis, -1) for kind in _IMU_NAMES for axis in "xyz"]
    return order if -1 not in order else list(range(6))


def read_ground_truth(path: Path, log: ReadLog) -> Trajectory | None:
    """The trajectory in a table of stamps and x y z qw qx qy qz; None where there is no such file or no usable row."""
    return trajectory_of_rows(*read_stamped_rows(path, 7, log), log) if path.is_file() else None


def read_name_table(path: Path) -> tuple[Stamps, list[str]]:
    """Stamps (N,) and file names of a EuRoC camera's data.csv, whose further columns are not read.

    RecordingError for a line that has none, but for names of columns in the first.
    """
    stamps, names = [], []
    for number, line in enumerate(read_table_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        columns = re.split(r"[,;\t]" if re.search(r"[,;\t]", line) else r"\s+", line)
        stamp, name, *_ = [*(column.strip(' \t"') for column in columns), ""]
        _check_whole(stamp, f"{path}, line {number}")
        if not stamp.isdecimal() or not name or int(stamp) > _LAST_NS:
            if number == 1 and name and not stamp[:1].isdecimal():
                continue  # names of columns
            raise RecordingError(f"{path}, line {number}: {line[:60]!r} is no stamp in ns, a comma and a file name")
        stamps.append(int(stamp))
        names.append(check_inside(name, f"{path}, line {number}"))
    return np.array(stamps, np.int64), names


def _check_whole(word: str, where: str) -> None:
    """RecordingError for a number with a decimal point or exponent where a whole number of ns is expected."""
    try:
        value = float(word)
    except ValueError:
        return
    if word.lstrip("+-").isdecimal() or not np.isfinite(value):
        return
    names = {1e17: "nanoseconds that a program rounded", 1e14: "microseconds", 1e11: "milliseconds", 0.0: "seconds"}
    unit = next(name for least, name in names.items() if abs(value) >= least)
    raise wrong_unit(f"{where}:", unit, f"{word[:40]} is no whole number", "write all digits of the nanoseconds")


def check_inside(name: str, where: str) -> str:
    """The name of a file that a list gives, if it stays below the list's folder; RecordingError else."""
    if ".." in Path(name).parts or Path(name).is_absolute():
        raise RecordingError(f"{where}: {name[:80]!r} is not inside the folder; name images below it")
    return name


def natural_key(name: str) -> tuple[object, ...]:
    """Sorts file names by the numbers in them."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name))


def _without_names(text: str) -> str:
    """The text without a first line that names its columns, as tables of other programs have one without #."""
    first, _, rest = text.lstrip().partition("\n")
    return rest if first[:1].isalpha() and re.search(r"[,;\s]", first.strip()) and re.match(r"\s*\d", rest) else text


def read_table_text(path: Path) -> str:
    """The text of a table, without a byte order mark; RecordingError for what cannot be read or stands in for the file."""
    if fault := what_file_instead(path):
        raise RecordingError(f"{path} is {fault}")
    try:
        check_table(path)
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); the recording is incomplete") from error


def _read_rows_singly(path: Path, text: str, dtype: "np.dtype[np.void]", log: ReadLog) -> AnyArray:
    columns = dtype["values"].shape[0]
    rows, bad = [], 0
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            stamp, values = int(words[0]), [float(word) for word in words[1 : columns + 1]]
        except ValueError:
            stamp, values = 0, []
        if len(values) == columns and abs(stamp) <= _LAST_NS:
            rows.append((stamp, values))
        else:
            bad += 1
    detail = f"{bad} of {bad + len(rows)} lines are no stamp and {columns} numbers"
    log.note(f"{path.name}: unreadable lines", detail)
    return np.array(rows, dtype) if rows else np.zeros(0, dtype)
