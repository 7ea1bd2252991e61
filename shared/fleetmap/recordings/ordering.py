"""Ordering and pairing of stamps, checks of samples; all omissions are noted as issues."""

import bisect
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fleetmap.encoding import MOST
from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, Indices, Mask, rotation_from_quat_wxyz, se3
from fleetmap.sensors.samples import PAUSE_NS, DataIssue, ImuSamples, Stamps, Trajectory

PAIR_TOLERANCE_NS = 5_000_000  # images of one rig that are further apart were not taken simultaneously
DEPTH_TOLERANCE_NS = 20_000_000  # depth and colour of consumer sensors are not triggered together
LAST_NS = 2**63 - 1
# For recordings whose stamps were not taken at the exposure of the images
UNCERTAIN_STAMPS = DataIssue("stamps uncertain", "they are a video's: not set by the exposure, not shared with sensors")
UNITS = {1_000: "microseconds", 1_000_000: "milliseconds", 1_000_000_000: "seconds"}  # by the nanoseconds in each
_FINER = {1_000: "milliseconds", 1_000_000: "microseconds", 1_000_000_000: "nanoseconds"}  # by how many are in a second
_MAX_IMU_VALUE = 1e5  # no inertial sensor measures this in any unit; flipped bits may give it
# Between values in the median: no inertial sensor has more than 10 kHz; no camera or odometry more than 2 kHz or less than 0.05 Hz
_SHORTEST_IMU_NS, _SHORTEST_NS, _LONGEST_NS = 100_000, 500_000, 20_000_000_000
_EPOCH_NS = (9e17, 5e18)  # 1998 to 2128
_FEWEST = 10  # values needed to recognise a unit by their steps
# Of a part of a stream with a pause on either side: a part shorter than the second that an odometry needs to start is useless, so
# an interrupted recording loses nothing by it. Sparse streams, of keyframes or of single photographs, have longer steps.
_SHORTEST_PART_NS, _PAUSE_STEPS, _STRAY_SHARE = 1_000_000_000, 10, 0.05


@dataclass(slots=True)
class ReadLog:
    """Log of reading a recording: missing and damaged data, and the files read beside the images.

    damaged_ns: stamps of images left out because they cannot be decoded.
    """

    issues: list[DataIssue] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    damaged_ns: list[int] = field(default_factory=list)

    def note(self, what: str, detail: str) -> None:
        """Add an issue."""
        self.issues.append(DataIssue(what, detail))

    def told(self) -> str:
        """All issues as words of an error."""
        return "; ".join(f"{issue.what}: {issue.detail}" for issue in self.issues)


def as_logged(stamps: ArrayLike, log_times: ArrayLike, what: str, log: ReadLog) -> tuple[Stamps, Indices]:
    """Stamps (N,), and indices (N,) of the order in which they were logged: files hold chunks, parts and channels one after the other.

    The order of the file is kept where more stamps increase in it: the recorder's clock may have been set. Unset stamps (0) are replaced by
    log times (N,) minus the logging delay of the others; noted in `log`.
    """
    stamps_ns, log_times_ns = np.array(stamps, np.int64), np.array(log_times, np.int64)
    unset = (stamps_ns == 0) & (log_times_ns != 0)
    if unset.any():
        delay_ns = 0 if unset.all() else int(np.median((log_times_ns - stamps_ns)[~unset]))
        stamps_ns = np.where(unset, log_times_ns - delay_ns, stamps_ns)
        share = f"{int(unset.sum())} of {len(unset)}"
        log.note(f"{what}: stamps of zero", f"{share}; the times of logging stand in for them")
    orders = np.argsort(log_times_ns, kind="stable"), np.arange(len(stamps_ns))
    return stamps_ns, max(orders, key=lambda order: int(_longest_increasing(stamps_ns[order]).sum()))


def usual_size(sizes_px: Sequence[tuple[int, int] | None], what: str, log: ReadLog) -> Mask:
    """(N,) mask of the images with the most frequent size (width, height) or an unknown one; the others are noted in `log`."""
    counts = Counter(size for size in sizes_px if size).most_common()
    if len(counts) < 2:
        return np.ones(len(sizes_px), np.bool_)
    (usual, most), *rest = counts
    others = ", ".join(f"{count} of {width}x{height}" for (width, height), count in rest[:4])
    log.note(f"{what}: images of another size", f"{others} left out, {most} have {usual[0]}x{usual[1]} px")
    return np.array([size in (None, usual) for size in sizes_px], np.bool_)


def forward_only(stamps_ns: Stamps, what: str, log: ReadLog) -> Mask:
    """(N,) mask of a longest strictly increasing subsequence without isolated stamps far from all others; omissions are noted in `log`.

    Stamps are never sorted: stamps of values that arrive out of order cannot be trusted. One stamp far in the
    future is dropped alone, not all that follow. RecordingError if more than half would be left out, and for stamps in
    another unit.
    """
    _check_steps(stamps_ns, what)
    kept = _longest_increasing(stamps_ns)
    if dropped := int((~kept).sum()):
        steps, share = np.diff(stamps_ns), f"{dropped} of {len(kept)}"
        if (steps >= 0).all():
            first_ns = stamps_ns[np.flatnonzero(steps == 0)[0]]
            what_is_wrong = "stamps repeated"
            detail = f"are that of the one before and left out; the first is {first_ns}"
            fault = (
                f"{share} stamps repeat the one before, the first is {first_ns}; the driver stamps several alike, or rounds: "
                "let it stamp each one when it is measured"
            )
        else:
            back = int(np.flatnonzero(steps < 0)[0])
            from_to = f"{steps[back] * 1e-9:.3f} s, from {stamps_ns[back]} to {stamps_ns[back + 1]}"
            what_is_wrong, detail = "stamps not increasing", f"left out; the first step back is {from_to}"
            fault = f"stamps go backwards, {share} do not fit; the sensor's clock is broken, record again"
        log.note(f"{what}: {what_is_wrong}", f"{share} {detail}")
        if dropped > len(kept) // 2:
            raise RecordingError(f"{what}: {fault}")
    if what not in ("position priors", "ground truth"):  # which arrive irregularly
        rows = np.flatnonzero(kept)
        kept[rows[_strays(stamps_ns[rows], what, log)]] = False
    return kept


def _strays(stamps_ns: Stamps, what: str, log: ReadLog) -> Mask:
    """(N,) mask of the few isolated increasing stamps, a pause away from all others; noted in `log`."""
    strays, steps = np.zeros(len(stamps_ns), np.bool_), np.diff(stamps_ns)
    if len(steps) == 0:
        return strays
    pause_ns = max(PAUSE_NS, _PAUSE_STEPS * int(np.median(steps)))
    parts = np.split(np.arange(len(stamps_ns)), np.flatnonzero(steps > pause_ns) + 1)
    largest = max(parts, key=len)
    for part in parts:
        strays[part] = part is not largest and stamps_ns[part[-1]] - stamps_ns[part[0]] < _SHORTEST_PART_NS
    count = int(strays.sum())
    if not 0 < count <= max(1, _STRAY_SHARE * len(stamps_ns)):
        return np.zeros_like(strays)
    first_ns, others = stamps_ns[strays][:3], stamps_ns[~strays]
    away_s = (first_ns - others[nearest(others, first_ns)]) * 1e-9
    named = ", ".join(f"{stamp} ({seconds:+.1f} s)" for stamp, seconds in zip(first_ns, away_s, strict=True))
    where = f"{named}{', ...' if count > 3 else ''} from the nearest other; was the clock set?"
    log.note(f"{what}: stamps far apart", f"{count} of {len(stamps_ns)} left out: {where}")
    return strays


def _longest_increasing(stamps_ns: Stamps) -> Mask:
    """(N,) a longest strictly increasing subsequence. Source: patience sorting."""
    if (np.diff(stamps_ns) > 0).all():
        return np.ones(len(stamps_ns), np.bool_)
    ends: list[int] = []  # ends[k]: smallest stamp that ends an increasing run of k + 1
    end_index: list[int] = []
    before = np.full(len(stamps_ns), -1)
    for index, stamp in enumerate(stamps_ns.tolist()):
        position = bisect.bisect_left(ends, stamp)
        before[index] = end_index[position - 1] if position else -1
        ends[position : position + 1] = [stamp]
        end_index[position : position + 1] = [index]
    kept = np.zeros(len(stamps_ns), np.bool_)
    index = end_index[-1]
    while index >= 0:
        kept[index] = True
        index = int(before[index])
    return kept


def _check_steps(stamps_ns: Stamps, what: str) -> None:
    """RecordingError for stamps with an implausible median step for the sensor, naming their likely unit."""
    if len(stamps_ns) < _FEWEST:
        return
    steps, shortest = np.diff(stamps_ns), _SHORTEST_IMU_NS if what == "imu" else _SHORTEST_NS
    step = int(np.median(steps[steps > 0])) if (steps > 0).any() else 0
    middle = float(np.median(stamps_ns))
    if step < shortest:
        by_date = [ns for ns in UNITS if _EPOCH_NS[0] < middle * ns < _EPOCH_NS[1]]
        for ns in by_date or [ns for ns in UNITS if step * ns >= shortest]:
            why = f"as nanoseconds they are {step * 1e-9:.9f} s apart"
            raise wrong_unit(what, UNITS[ns], why, f"multiply them by {ns}")
    if step > _LONGEST_NS and what != "position priors":
        finer = next((ns for ns in UNITS if step / ns < _LONGEST_NS), 1_000_000_000)
        why = f"they are {step * 1e-9:.0f} s apart"
        raise wrong_unit(what, f"{_FINER[finer]} that were read as seconds", why, f"divide them by {finer}")


def check_seconds(value: float, where: str) -> None:
    """RecordingError for a value too large for seconds since 1970, naming its likely unit."""
    if abs(value) > 9_223_372_036:  # limit of 64 bits of nanoseconds
        factor = next((factor for factor in _FINER if abs(value) < 1e11 * factor), 1_000_000_000)
        why = f"{value:.0f} is not a time in seconds"
        raise wrong_unit(f"{where}:", _FINER[factor], why, f"divide them by {factor}")


def check_together(stamps_ns: Stamps, what: str, frame_stamps_ns: Stamps) -> None:
    """RecordingError if the stamps cover other times than the frames, but the same times in another unit."""
    if not len(stamps_ns) or not len(frame_stamps_ns) or _overlap(stamps_ns, 1, frame_stamps_ns):
        return
    for ns, unit in UNITS.items():
        for name, some, other, others in (
            (what, stamps_ns, "the images'", frame_stamps_ns),
            ("images", frame_stamps_ns, f"those of {what}", stamps_ns),
        ):
            if _overlap(some, ns, others):
                raise wrong_unit(name, unit, f"from {some[0]}, {other} from {others[0]}", f"multiply them by {ns}")


def wrong_unit(what: str, unit: str, why: str, remedy: str) -> RecordingError:
    """Error for stamps in a wrong unit."""
    name = what.replace("imu", "IMU")
    return RecordingError(
        f"{name} stamps look like {unit}: {why}; {remedy} where they are written, or leave this sensor out"
    )


def _overlap(stamps_ns: Stamps, factor: int, others_ns: Stamps) -> bool:
    """True if at least half of the shorter interval overlaps the other, the stamps multiplied by `factor`."""
    first, last = int(stamps_ns[0]) * factor, int(stamps_ns[-1]) * factor
    begin, end = int(others_ns[0]), int(others_ns[-1])
    return 2 * (min(last, end) - max(first, begin)) >= min(last - first, end - begin)


def clean_imu(stamps_ns: Stamps, gyro_radps: Array, accel_mps2: Array, log: ReadLog) -> ImuSamples:
    """Samples with plausible values and increasing stamps; the others are noted in `log`."""
    possible = np.asarray((np.abs(np.hstack([gyro_radps, accel_mps2])) < _MAX_IMU_VALUE).all(axis=1))
    if not possible.all():
        log.note("imu: impossible values", f"{int((~possible).sum())} of {len(possible)} samples left out")
    rows = np.flatnonzero(possible)
    rows = rows[forward_only(stamps_ns[rows], "imu", log)]
    return ImuSamples(stamps_ns[rows], gyro_radps[rows], accel_mps2[rows])


def trajectory_of_rows(stamps_ns: Stamps, position_quat_wxyz: Array, log: ReadLog) -> Trajectory | None:
    """Ground truth from rows x y z qw qx qy qz (N, 7), None if no row is usable; rows without a unit quaternion are noted."""
    norms = np.linalg.norm(position_quat_wxyz[:, 3:7], axis=1)
    good = (np.abs(position_quat_wxyz) <= MOST).all(axis=1) & (np.abs(norms - 1) < 0.01)
    if not good.all():
        detail = f"{int((~good).sum())} of {len(good)} rows without a unit quaternion or a near position left out"
        log.note("ground truth: no rotation", detail)
    rows = np.flatnonzero(good)
    try:
        rows = rows[forward_only(stamps_ns[rows], "ground truth", log)]
    except RecordingError as error:
        log.note("ground truth not used", str(error))
        return None
    if not len(rows):
        return None
    frame_from_body = [se3(rotation_from_quat_wxyz(row[3:7]), row[:3]) for row in position_quat_wxyz[rows]]
    return Trajectory(stamps_ns[rows], np.stack(frame_from_body))


def pair_stamps(left_ns: Stamps, right_ns: Stamps, tolerance_ns: int) -> tuple[Indices, Indices]:
    """Indices (P,), (P,) of increasing left and right stamps that are each other's nearest, and within the tolerance."""
    if len(left_ns) == 0 or len(right_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    right_of_left, left_of_right = nearest(right_ns, left_ns), nearest(left_ns, right_ns)
    is_mutual = left_of_right[right_of_left] == np.arange(len(left_ns))
    chosen = np.flatnonzero(is_mutual & (np.abs(right_ns[right_of_left] - left_ns) <= tolerance_ns))
    return chosen, right_of_left[chosen]


def nearest(sorted_ns: Stamps, wanted_ns: Stamps) -> Indices:
    """(N,) index of the stamp in sorted_ns (M,), M > 0, that is nearest to each of wanted_ns (N,)."""
    after = np.clip(np.searchsorted(sorted_ns, wanted_ns), 0, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = wanted_ns - sorted_ns[before] < sorted_ns[after] - wanted_ns
    return np.where(is_before & (after > 0), before, after).astype(np.int64)
