"""How well another system's poses agree with the motion that a recording shows.

Poses that are right move as the recording does. Those of another convention turn about other axes or backwards, go another way, or are
unrelated; their errors are then as large as the motion itself. Truth plays no part.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3, se3_inverse
from fleetmap.sensors.samples import Stamps, Trajectory

FRAMES = ("camera", "body")
GAP_NS = 200_000_000  # between poses that are interpolated
NEAR_NS = 2_000_000  # a pose so close to a frame is that frame's
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
    """A convention of poses: whose they are, and what of the file is to be turned round to read it so."""

    frame: str
    is_inverted: bool = False
    is_w_first: bool = False

    def __str__(self) -> str:
        inverted = ", inverted (pose_from_map)" if self.is_inverted else ""
        return f"poses of the {self.frame}{inverted}{', quaternions w x y z' if self.is_w_first else ''}"

    def instead(self, said: str) -> str:
        """What makes the file readable where this convention fits and `said` is the frame that was named."""
        steps = [f"say --trajectory-frame {self.frame}"] if self.frame != said else []
        steps += ["write map_from_pose, the inverse of each pose"] if self.is_inverted else []
        steps += ["write quaternions as x y z w"] if self.is_w_first else []
        return " and ".join(steps)


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
    def figures(self) -> str:
        """The errors in words."""
        told = ((self.turn_error, "the turn"), (self.way_error, "the way"))
        return " and ".join(f"{100 * error:.0f} % of {what}" for error, what in told if error is not None) or "nothing"

    @property
    def in_metres(self) -> float:
        """The scale, 1 where it cannot be told from that: the file is then in metres, which are better than what the comparison gives."""
        return 1.0 if abs(np.log(self.scale)) <= self.scale_within else self.scale

    @property
    def is_told(self) -> bool:
        """Whether the recording moves enough to tell."""
        return self.turn_error is not None or self.way_error is not None


def readings(is_camera_body: bool) -> list[PoseReading]:
    """All conventions; a camera that is the body has one frame."""
    return [PoseReading(*each) for each in product(FRAMES[is_camera_body:], (False, True), (False, True))]


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


def read_as(trajectory: Trajectory, reading: PoseReading) -> Trajectory:
    """Poses that were read as map_from_pose with quaternions x y z w, by another convention."""
    matrices = trajectory.frame_from_body
    if reading.is_w_first:
        xyzw = [quat_wxyz_from_rotation(each[:3, :3])[[1, 2, 3, 0]] for each in matrices]
        matrices = np.array(
            [se3(rotation_from_quat_wxyz(q), each[:3, 3]) for q, each in zip(xyzw, matrices, strict=True)]
        )
    return Trajectory(trajectory.stamps_ns, se3_inverse(matrices) if reading.is_inverted else matrices)


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
