"""Metrics of a run: localized share, times, errors, failures. Pure. To add one: a function here and a line in METRICS."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np

from fleetmap import failure_definition
from fleetmap.failure_definition import BLIND_S, GOOD_S, SILENT_S, SearchClock
from fleetmap.geometry import Array
from fleetmap.messages import Status

WARM_UP_FRAMES = 20
_USABLE_M = 0.5


class FrameRecord(NamedTuple):
    """One frame of a run.

    Errors are unaligned against the truth in the map's frame, None if either is unknown; error_map_m (3,) is estimate minus
    truth. cpu_s and wall_s: from decoded images to estimate. stage_s: seconds by stage, decoding included. speed_mps: by wheels or
    odometry, None if unknown. may_be_mapped: False if the robot knows that the map does not cover its place.
    protection_m: as of `Estimate`.
    """

    stamp_ns: int
    status: Status
    has_fix: bool
    cov_rot_trans: Array | None
    error_map_m: Array | None
    error_rad: float | None
    cpu_s: float
    wall_s: float
    stage_s: dict[str, float]
    speed_mps: float | None = None
    may_be_mapped: bool = True
    protection_m: float = inf

    @property
    def radius_95_m(self) -> float:
        return failure_definition.radius_95_m(self.cov_rot_trans)

    @property
    def error_m(self) -> float | None:
        return None if self.error_map_m is None else float(np.linalg.norm(self.error_map_m))


Frames = Sequence[FrameRecord]


def localised(frames: Frames) -> list[bool]:
    """Return for each frame True if localized, by `failure_definition.is_localised` with the longer of the gaps before and after it."""
    stamps_ns = np.array([frame.stamp_ns for frame in frames], np.int64)
    gaps_ns = np.maximum(np.diff(stamps_ns, prepend=stamps_ns[:1]), np.diff(stamps_ns, append=stamps_ns[-1:]))
    return [
        failure_definition.is_localised(frame.status, frame.has_fix, frame.radius_95_m, gap_ns * 1e-9)
        for frame, gap_ns in zip(frames, gaps_ns, strict=True)
    ]


def first_fix(frames: Frames) -> int | None:
    """Return the index of the first frame with a verified fix."""
    return next((k for k, f in enumerate(frames) if f.has_fix), None)


def localised_share(frames: Frames) -> float | None:
    """Return the share of localized frames from the first fix on."""
    start = first_fix(frames)
    return None if start is None else float(np.mean(localised(frames)[start:]))


def localised_share_of_all(frames: Frames) -> float | None:
    """Return the share of localized frames among all; None without frames."""
    return float(np.mean(localised(frames))) if frames else None


def not_localised_share(frames: Frames) -> float | None:
    """Return the share of the driving time in which the robot was not localized; None if it did not drive.

    A frame represents the time since the previous one. Frames without a known speed count as driving.
    """
    stamps_s = np.array([frame.stamp_ns for frame in frames], np.int64) * 1e-9
    lasted_s = np.diff(stamps_s, prepend=stamps_s[:1])
    driving = np.array([failure_definition.is_driving(frame.speed_mps) for frame in frames], bool)
    driven_s = float(lasted_s[driving].sum())
    lost = driving & ~np.array(localised(frames), bool)
    return float(lasted_s[lost].sum()) / driven_s if driven_s > 0 else None


def first_fix_s(frames: Frames) -> float | None:
    """Return the sensor time from the first frame to the first fix."""
    start = first_fix(frames)
    return None if start is None else (frames[start].stamp_ns - frames[0].stamp_ns) * 1e-9


def frame_ms(frames: Frames, clock: str = "cpu_s") -> dict[str, float] | None:
    """Return milliseconds per frame, after the warm-up frames: CPU of the whole process, or by the wall clock ("wall_s")."""
    return spread([1e3 * getattr(f, clock) for f in frames[WARM_UP_FRAMES:]], ("mean", "p50", "p99", "max"))


def stage_ms(frames: Frames) -> dict[str, float]:
    """Return mean CPU milliseconds per frame and stage, after the warm-up frames."""
    rows = [f.stage_s for f in frames[WARM_UP_FRAMES:]]
    names = sorted({name for row in rows for name in row})
    return {name: 1e3 * float(np.mean([row.get(name, 0.0) for row in rows])) for name in names}


def error_m(frames: Frames) -> dict[str, float] | None:
    """Return unaligned position errors of localized frames with ground truth."""
    return spread([f.error_m for f in _good(frames) if f.error_m is not None], ("median", "p95", "p99", "max"))


def error_deg(frames: Frames) -> dict[str, float] | None:
    """Return unaligned orientation errors of localized frames with ground truth."""
    errors_rad = [f.error_rad for f in _good(frames) if f.error_rad is not None]
    return spread([float(np.degrees(error_rad)) for error_rad in errors_rad], ("median", "p99"))


def _good(frames: Frames) -> list[FrameRecord]:
    return [frame for frame, is_localised in zip(frames, localised(frames), strict=True) if is_localised]


def protection(frames: Frames) -> dict[str, object] | None:
    """Return how errors and protection levels compare while TRACKING: the share with a level below 0.5 m, levels, and with ground truth the
    share of errors beyond their level, and the median of errors over levels. None if it was never TRACKING."""
    tracked = [frame for frame in frames if frame.status is Status.TRACKING]
    levels_m = [frame.protection_m for frame in tracked if frame.protection_m < inf]
    shares = [f.error_m / f.protection_m for f in tracked if f.error_m is not None and f.protection_m < inf]
    if not tracked:
        return None
    return {
        "available_share": float(np.mean([frame.protection_m < _USABLE_M for frame in tracked])),
        "level_m": spread(levels_m, ("median", "p90", "p99", "max")),
        "beyond_share": float(np.mean([share > 1.0 for share in shares])) if shares else None,
        "error_of_level": spread(shares, ("median", "max")),
    }


def status_share(frames: Frames) -> dict[str, float]:
    """Return the share of frames by status."""
    return {status.value: float(np.mean([f.status is status for f in frames])) for status in Status} if frames else {}


def silent_failures(frames: Frames) -> int | None:
    """Return the number of failures with status TRACKING and a wrong position; None without ground truth."""
    return None if all(f.error_m is None for f in frames) else len(_episodes(frames, _is_silent, SILENT_S))


def position_failures(frames: Frames) -> int:
    """Return the number of failures by `fleetmap.failure_definition`; overlapping ones count once.

    Without ground truth only the failures `blind` and `not_found` are detectable.
    """
    start = first_fix(frames)
    after = list(frames[start:]) if start is not None else []
    kinds = ((frames, _is_silent, SILENT_S), (after, _is_blind, BLIND_S), (frames, is_outside_its_bound, SILENT_S))
    spans = not_found(frames) + [span for kind in kinds for span in _episodes(*kind)]
    good = localised(frames)
    bad = [any(is_bad(f, good[k]) for _, is_bad, _ in kinds) for k, f in enumerate(frames)]
    return len(_merged(sorted(spans), [(f.stamp_ns, good[k] and not bad[k]) for k, f in enumerate(frames)]))


def not_found(frames: Frames) -> list[tuple[int, int]]:
    """Return (begin, end) stamps of periods in which the robot was not localized for too long."""
    clock, stretches = SearchClock(), []
    begin = None
    for frame, is_localised in zip(frames, localised(frames), strict=True):
        fails = clock.handle(
            frame.stamp_ns,
            is_found=failure_definition.is_found(is_localised, frame.has_fix, frame.status, frame.radius_95_m),
            is_driving=failure_definition.is_driving(frame.speed_mps),
            may_be_mapped=frame.may_be_mapped,
        )
        if begin is not None and not fails:
            stretches.append((begin, frame.stamp_ns))
        begin = clock.began_ns if fails else None
    return stretches if begin is None else [*stretches, (begin, frames[-1].stamp_ns)]


def _is_silent(frame: FrameRecord, is_localised: bool) -> bool:
    is_wrong = frame.error_m is not None and failure_definition.is_wrong(frame.error_m, frame.error_rad)
    return (frame.status is Status.TRACKING or is_localised) and is_wrong


def _is_blind(frame: FrameRecord, is_localised: bool) -> bool:
    return not is_localised and failure_definition.is_blind(frame.status, frame.radius_95_m)


def is_outside_its_bound(frame: FrameRecord, _is_localised: bool = False) -> bool:
    """Return True if the ground truth lies outside the 99.9 % bound of the frame's position."""
    if frame.error_map_m is None or frame.cov_rot_trans is None:
        return False
    return failure_definition.is_outside_bound(frame.error_map_m, frame.cov_rot_trans)


def _episodes(frames: Frames, is_bad: Callable[[FrameRecord, bool], bool], over_s: float) -> list[tuple[int, int]]:
    """Return (begin, end) stamps of bad periods longer than so many seconds.

    A period lasts until the next frame that is not bad. Periods without 5 s of good tracking between them are one failure.
    """
    good, stamps_ns = localised(frames), [frame.stamp_ns for frame in frames]
    bad = [is_bad(frame, good[k]) for k, frame in enumerate(frames)]
    long = [(begin, end) for begin, end in _runs(stamps_ns, bad) if end - begin > over_s * 1e9]
    return _merged(long, [(stamp_ns, good[k] and not bad[k]) for k, stamp_ns in enumerate(stamps_ns)])


def _runs(stamps_ns: Sequence[int], flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return (begin, end) stamps of the runs of True, each until the next False or the last stamp."""
    edges = np.flatnonzero(np.diff(np.array([0, *flags, 0], int))).reshape(-1, 2)
    return [(stamps_ns[first], stamps_ns[min(after, len(flags) - 1)]) for first, after in edges.tolist()]


def _merged(stretches: list[tuple[int, int]], fine: list[tuple[int, bool]]) -> list[tuple[int, int]]:
    """Merge periods, sorted by begin, without 5 s of good tracking between them. fine: stamp and goodness of each frame."""
    merged = stretches[:1]
    for begin, end in stretches[1:]:
        between = [each for each in fine if merged[-1][1] <= each[0] <= begin]
        runs = _runs([stamp_ns for stamp_ns, _ in between], [is_fine for _, is_fine in between])
        if max((until - since for since, until in runs), default=0) < GOOD_S * 1e9:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    return merged


def spread(values: list[float], names: tuple[str, ...]) -> dict[str, float] | None:
    """Return mean, median or percentiles of the values by name; None without values."""
    if not values:
        return None
    shares = {"p50": 50, "median": 50, "p90": 90, "p95": 95, "p99": 99, "max": 100}
    return {name: float(np.mean(values) if name == "mean" else np.percentile(values, shares[name])) for name in names}


METRICS: dict[str, Callable[[Frames], object]] = {
    "frames": len,
    "localised_share_of_all": localised_share_of_all,
    "localised_share": localised_share,
    "first_fix_s": first_fix_s,
    "not_localised_share": not_localised_share,
    "frame_ms": frame_ms,
    "frame_wall_ms": partial(frame_ms, clock="wall_s"),
    "stage_ms": stage_ms,
    "error_m": error_m,
    "error_deg": error_deg,
    "protection": protection,
    "position_failures": position_failures,
    "silent_failures": silent_failures,
    "status_share": status_share,
}
