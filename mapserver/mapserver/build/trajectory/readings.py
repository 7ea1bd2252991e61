"""Readings of a file of poses: a choice of each item that the file leaves open, judged by the motion that the recording shows.

A right reading moves as the recording does. A wrong one turns about other axes or backwards, goes another way, or is unrelated;
its errors are then as large as the motion itself. Truth plays no part.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3_inverse
from fleetmap.sensors.samples import Stamps, Trajectory
from mapserver.build.trajectory.formats import BILLION, PoseRows

FRAMES = ("camera", "body")
DIRECTIONS = ("map-from-pose", "pose-from-map")
QUATERNIONS = ("xyzw", "wxyz")
UNITS = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": BILLION}  # billionths of the unit in a nanosecond
STAMPS = (*UNITS, "elapsed-s", "frames")
GAP_NS = 200_000_000  # between poses that are interpolated
NEAR_NS = 2_000_000  # a pose so close to a frame is that frame's
_FAR = 2**62
_MARGIN_NS = 1_000_000_000
_STRETCH_RAD, _STRETCH_M, _STRETCH_NS = 0.15, 0.3, 1_000_000_000
_LEAST_RAD, _LEAST_M = 0.05, 0.1  # of a motion, below which errors count as if it were so large
LEAST_STRETCHES = 6
_STANDARD_ERRORS = 4.0
_OWN_SCALE_WITHIN = (
    0.01  # what stereo and depth show of scale: a tenth of a pixel in ten of disparity, which no averaging takes away
)
_OUTLIER_MEDIANS = 4.0  # of the distances between translations: 3 standard deviations and more
FITS_WITHIN = 0.5  # of the motion: a guess that is further off is worse than none for the larger half
SCALE_WITHIN = 0.05 * _STANDARD_ERRORS  # by what the survey assumes of a given trajectory's drift


@dataclass(frozen=True, slots=True)
class PoseReading:
    """A choice: frame of the poses, direction of the transform, order of quaternions (None without), unit of stamps (None without)."""

    frame: str
    direction: str
    quaternion: str | None
    stamps: str | None

    def __str__(self) -> str:
        order = "" if self.quaternion is None else f", quaternions {self.quaternion}"
        unit = "" if self.stamps is None else f", stamps in {self.stamps}"
        return f"poses of the {self.frame}, {self.direction}{order}{unit}"


@dataclass(frozen=True)
class Followed:
    """Motion that the recording shows: stamps_ns (F,), frame_from_body (F, 4, 4), and the number of the piece (F,) in which a frame is
    tied to others, -1 for none.
    """

    stamps_ns: Stamps
    frame_from_body: Array
    piece: NDArray[np.int64]


@dataclass(frozen=True)
class Shown:
    """What readings are compared with: the motion, its stretches (P, 2), and where the camera is mounted."""

    followed: Followed
    pairs: NDArray[np.int64]
    body_from_cam: Array

    def body_from(self, reading: PoseReading) -> Array:
        """(4, 4) body_from_pose."""
        return self.body_from_cam if reading.frame == "camera" else np.eye(4)


@dataclass(frozen=True)
class Judged:
    """A reading against the recording: metres in the file's unit of length and how far their logarithm may be off, errors (P,) of stretches
    as shares of the motion, medians of those of rotations and ways (None where fewer than LEAST_STRETCHES tell).
    """

    reading: PoseReading
    scale: float
    scale_within: float
    errors: Array
    turn_error: float | None
    way_error: float | None

    @property
    def fits(self) -> bool:
        """Whether the recording shows nothing else."""
        return all(error is None or error <= FITS_WITHIN for error in (self.turn_error, self.way_error))

    @property
    def in_metres(self) -> float:
        """The scale, 1 where it cannot be told from that: the file is then in metres, which are better than what the comparison gives."""
        return 1.0 if abs(np.log(self.scale)) <= self.scale_within else self.scale

    @property
    def is_told(self) -> bool:
        """Whether the recording moves enough to tell."""
        return self.turn_error is not None or self.way_error is not None


def readings(
    rows: PoseRows, units: list[str | None], given: dict[str, str | None], is_camera_body: bool
) -> Iterator[PoseReading]:
    """All that the file and the options leave open; a camera that is the body has one frame."""
    frames = FRAMES[1:] if is_camera_body else FRAMES
    orders = QUATERNIONS if rows.turns.ndim == 2 else (None,)
    items = (
        ("frame", frames),
        ("direction", DIRECTIONS),
        ("quaternion", orders),
        ("stamps", units if rows.stamps else [None]),
    )
    chosen = [
        options if (said := given.get(name)) is None or options == (None,) else (said,) for name, options in items
    ]
    return (PoseReading(*choice) for choice in product(*chosen))  # type: ignore[arg-type]


def possible_units(rows: PoseRows, frame_stamps_ns: Stamps) -> list[str]:
    """Units of the stamps by which at least half of the poses lie within the time of the frames."""
    assert rows.stamps is not None
    middle = sorted(rows.stamps)[len(rows.stamps) // 2]
    first, last = int(frame_stamps_ns[0]), int(frame_stamps_ns[-1])
    found = [name for name, parts in UNITS.items() if first - _MARGIN_NS <= middle // parts <= last + _MARGIN_NS]
    if 0 <= middle <= last - first + _MARGIN_NS:
        found.append("elapsed-s")
    count = len(frame_stamps_ns)
    if all(stamp % BILLION == 0 and 0 <= stamp < count * BILLION for stamp in rows.stamps):
        found.append("frames")
    return found


def stamps_of(rows: PoseRows, unit: str | None, frame_stamps_ns: Stamps) -> Stamps:
    """(N,) nanoseconds on the recording's clock; rows without stamps belong to one frame each."""
    if rows.stamps is None:
        return frame_stamps_ns[: len(rows.positions)]
    if unit == "frames":
        return np.asarray(frame_stamps_ns[[stamp // BILLION for stamp in rows.stamps]], np.int64)
    start, parts = (int(frame_stamps_ns[0]), 1) if unit == "elapsed-s" else (0, UNITS[unit or "ns"])
    return np.array([max(-_FAR, min(_FAR, start + stamp // parts)) for stamp in rows.stamps], np.int64)


def covered(stamps: Stamps, at_ns: Stamps) -> NDArray[np.bool_]:
    """Which of the moments (F,) have a pose there, or one on either side that is not far: those at which `pose_at` finds one."""
    ordered = np.sort(stamps)
    after = np.searchsorted(ordered, at_ns)
    before_ns, after_ns = ordered[np.maximum(after - 1, 0)], ordered[np.minimum(after, len(ordered) - 1)]
    between = (before_ns <= at_ns) & (at_ns <= after_ns) & (after_ns - before_ns <= GAP_NS)
    return np.asarray(between | (np.minimum(np.abs(at_ns - before_ns), np.abs(at_ns - after_ns)) <= NEAR_NS))


def pose_at(as_read: Trajectory, stamp_ns: int) -> Array:
    """(4, 4) interpolated, or that of the nearest stamp: stamps may be rounded."""
    found = as_read.at(stamp_ns, GAP_NS)
    return np.asarray(
        as_read.frame_from_body[np.argmin(np.abs(as_read.stamps_ns - stamp_ns))] if found is None else found
    )


def read_as(rows: PoseRows, reading: PoseReading, frame_stamps_ns: Stamps) -> Trajectory:
    """map_from_pose of the poses in order of time, translations in the file's unit."""
    stamps = stamps_of(rows, reading.stamps, frame_stamps_ns)
    order = np.argsort(stamps, kind="stable")
    turns = rows.turns
    if reading.quaternion is not None:
        wxyz = [3, 0, 1, 2] if reading.quaternion == "xyzw" else [0, 1, 2, 3]
        turns = np.array([rotation_from_quat_wxyz(quat) for quat in rows.turns[:, wxyz]])
    else:
        u, _, vt = np.linalg.svd(turns)
        turns = u @ vt
    written = np.tile(np.eye(4), (len(turns), 1, 1))
    written[:, :3, :3], written[:, :3, 3] = turns, rows.positions
    if reading.direction != DIRECTIONS[0]:
        written = se3_inverse(written)
    return Trajectory(stamps[order], written[order])


def stretches(followed: Followed, known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(P, 2) numbers of frames with poses, one after the other: each pair turned, moved or waited long enough to tell something."""
    found: list[tuple[int, int]] = []
    for piece in np.unique(followed.piece[followed.piece >= 0]):
        numbers = np.flatnonzero(known & (followed.piece == piece))
        for number in numbers[1:]:
            begin = found[-1][1] if found and followed.piece[found[-1][1]] == piece else numbers[0]
            moved = se3_inverse(followed.frame_from_body[begin]) @ followed.frame_from_body[number]
            if (
                _angles(moved[:3, :3]) >= _STRETCH_RAD
                or np.linalg.norm(moved[:3, 3]) >= _STRETCH_M
                or followed.stamps_ns[number] - followed.stamps_ns[begin] >= _STRETCH_NS
            ):
                found.append((begin, number))
    return np.array(found, np.int64).reshape(-1, 2)


def judge(as_read: Trajectory, reading: PoseReading, shown: Shown, scale: float | None) -> Judged:
    """The reading, by which the file says `as_read`, over stretches; scale: metres in the unit of length where they are known."""
    followed, pairs = shown.followed, shown.pairs
    ends = np.array([pose_at(as_read, int(followed.stamps_ns[k])) for k in pairs.ravel()]).reshape(-1, 2, 4, 4)
    moved = se3_inverse(ends[:, 0]) @ ends[:, 1]
    seen_ends = followed.frame_from_body[pairs] @ shown.body_from(reading)
    seen = se3_inverse(seen_ends[:, 0]) @ seen_ends[:, 1]
    turns, seen_turns = _angles(moved[:, :3, :3]), _angles(seen[:, :3, :3])
    ways, seen_ways = (np.linalg.norm(motion[:, :3, 3], axis=1) for motion in (moved, seen))
    scale, within = (scale, 0.0) if scale is not None else fitted_scale(moved[:, :3, 3], seen[:, :3, 3])
    apart = _angles(np.swapaxes(seen[:, :3, :3], 1, 2) @ moved[:, :3, :3])
    turn_size, way_size = np.maximum(turns, seen_turns), np.maximum(scale * ways, seen_ways)
    turn_errors = np.minimum(apart / np.maximum(turn_size, _LEAST_RAD), 1.0)
    off_m = np.linalg.norm(scale * moved[:, :3, 3] - seen[:, :3, 3], axis=1)
    way_errors = np.minimum(off_m / np.maximum(way_size, _LEAST_M), 1.0)
    medians = [
        float(np.median(errors[tell])) if (tell := sizes >= least).sum() >= LEAST_STRETCHES else None
        for errors, sizes, least in ((turn_errors, turn_size, _LEAST_RAD), (way_errors, way_size, _LEAST_M))
    ]
    return Judged(reading, scale, within, 0.5 * (turn_errors + way_errors), *medians)


def undecided(best: Judged, others: list[Judged]) -> list[Judged]:
    """Those that the stretches do not tell from the best one: their errors are larger by less than the noise of that difference."""
    found = []
    for other in others:
        worse = other.errors - best.errors
        noise = float(worse.std(ddof=1)) / np.sqrt(len(worse)) if len(worse) > 1 else np.inf
        if len(worse) < LEAST_STRETCHES or worse.mean() <= _STANDARD_ERRORS * noise or worse.mean() < 1e-6:
            found.append(other)
    return found


def fitted_scale(moved: Array, seen: Array) -> tuple[float, float]:
    """Metres in the unit of translations moved (P, 3), given those in metres, seen (P, 3), and how far its logarithm may be off.

    Both are noisy. A regression of either on the other is low by the share of noise in what it divides by, so that the truth lies between
    the two; taken is their geometric mean, the ratio of root mean squares. It may be off by half of what the regressions differ by, four
    standard errors and what our own metres may be; infinite where too few stretches move. Those that slipped on either side are left out.
    Source: Horn 1987, section 2.E (symmetric scale).
    """
    moving = (np.linalg.norm(seen, axis=1) >= _LEAST_M) & (np.linalg.norm(moved, axis=1) > 0)
    if moving.sum() < LEAST_STRETCHES:
        return 1.0, np.inf
    moved, seen = moved[moving], seen[moving]
    start = float(np.median(np.linalg.norm(seen, axis=1) / np.linalg.norm(moved, axis=1)))
    off_m = np.linalg.norm(start * moved - seen, axis=1)
    kept = off_m <= _OUTLIER_MEDIANS * np.median(off_m)
    moved_squared, seen_squared = (np.einsum("ni,ni->n", way, way) for way in (moved[kept], seen[kept]))
    both = float(np.einsum("ni,ni->", moved[kept], seen[kept]))
    moved_sum, seen_sum = float(moved_squared.sum()), float(seen_squared.sum())
    apart = max(np.log(np.sqrt(moved_sum * seen_sum) / both), 0.0) if both > 0 else np.inf
    error = 0.5 * float(np.linalg.norm(seen_squared / seen_sum - moved_squared / moved_sum))
    return np.sqrt(seen_sum / moved_sum), apart + _STANDARD_ERRORS * error + _OWN_SCALE_WITHIN


def _angles(rotations: Array) -> Array:
    """Angles of rotations (..., 3, 3)."""
    chord = np.linalg.norm(rotations - np.eye(3), axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))
