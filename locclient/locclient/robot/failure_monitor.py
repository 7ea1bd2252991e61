"""When a run has failed, and why, told from estimates and pictures as they come. Pure. docs/reports.md defines failures."""

from collections import Counter, deque
from dataclasses import dataclass

import cv2
import numpy as np

from fleetmap.failure_definition import BLIND_S, GOOD_S, SILENT_S, is_blind, is_wrong, radius_95_m
from fleetmap.messages import Cause, FailureKind, FixNote, Status
from fleetmap.sensors.samples import Image
from locclient.localization.estimate import Estimate

_FIX_NOTES = 20
_DARK, _BLURRED_SHARE = 0.06, 0.25
_TYPICAL_FRAMES = 200
_MAX_REFUSED_CHARS = 500
CONTRADICTING_LOOKS = 3  # one refused fix is chance, several in a row are a doubt


@dataclass(frozen=True, slots=True)
class Picture:
    """What a left image is worth. exposure: mean brightness, 0 to 1; sharpness: 1 is typical for this robot so far."""

    exposure: float
    sharpness: float
    is_frozen: bool

    @property
    def fault(self) -> Cause:
        """DARK, FROZEN, BLURRED, or NONE."""
        if self.exposure < _DARK:
            return Cause.DARK
        if self.is_frozen:
            return Cause.FROZEN
        return Cause.BLURRED if self.sharpness < _BLURRED_SHARE else Cause.NONE


class PictureJudge:
    """Measures one left image after another, on every second row and column: a third of a millisecond."""

    def __init__(self) -> None:
        self._variances: deque[float] = deque(maxlen=_TYPICAL_FRAMES)
        self._last: Image | None = None

    def judge(self, left: Image) -> Picture:
        """The measures of `left` (H, W), compared with what came before."""
        small = np.ascontiguousarray(left[::2, ::2])
        exposure = float(small.mean()) / 255.0
        variance = float(cv2.Laplacian(small, cv2.CV_16S).var())
        # Sensor noise never repeats itself: equal to the last bit is a stuck camera. Black is dark, not stuck.
        is_frozen = self._last is not None and exposure > _DARK and np.array_equal(small, self._last)
        self._last = small
        typical = float(np.median(self._variances)) if self._variances else variance
        if exposure >= _DARK and not is_frozen:
            self._variances.append(variance)
        return Picture(exposure, variance / max(typical, 1e-9), is_frozen)


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure as it is told once. stamp_ns: of its first frame; estimate, picture: when it was told, picture None without one."""

    kind: FailureKind
    cause: Cause
    stamp_ns: int
    duration_s: float
    estimate: Estimate
    picture: Picture | None
    fixes: tuple[FixNote, ...]


class FailureMonitor:
    """Tells every failure once, when it is old enough to be one; the next may begin after GOOD_S of good tracking.

    `blind`: after the first fix, no place that may be relied upon for BLIND_S. `suspected`: the robot believes to track, but the
    last looks at the map contradict it for SILENT_S, or it is found elsewhere than it had said, beyond what its
    covariance admitted. The first can be seen by the robot; the second estimates what only a truth could show.
    """

    def __init__(self) -> None:
        self._fixes: deque[FixNote] = deque(maxlen=_FIX_NOTES)
        self._causes: Counter[Cause] = Counter()
        self._had_fix = False
        self._blind_ns: int | None = None
        self._doubted_ns: int | None = None
        self._doubts = 0
        self._good_ns: int | None = None
        self._running = False
        self._last: Estimate | None = None

    @property
    def is_running(self) -> bool:
        """Whether a failure was told whose end has not come."""
        return self._running

    def handle(self, estimate: Estimate, picture: Picture) -> Failure | None:
        """What begins to be a failure with this frame."""
        self._last = estimate
        self._note(estimate)
        self._had_fix |= estimate.fix is not None
        now_ns = estimate.stamp_ns
        blind, doubted = (
            self._had_fix and is_blind(estimate.status, radius_95_m(estimate.cov_rot_trans)),
            self._doubts >= CONTRADICTING_LOOKS,
        )
        self._follow(now_ns, blind, doubted)
        if blind:
            self._causes[cause_of(estimate, picture)] += 1
        if self._running:
            return None
        if self._blind_ns is not None and (now_ns - self._blind_ns) * 1e-9 > BLIND_S:
            return self._told(FailureKind.BLIND, self._causes.most_common(1)[0][0], self._blind_ns, now_ns, picture)
        if self._doubted_ns is not None and (now_ns - self._doubted_ns) * 1e-9 > SILENT_S:
            return self._told(FailureKind.SUSPECTED, Cause.FIX_REFUSED, self._doubted_ns, now_ns, picture)
        if estimate.moved_m is not None and is_wrong(estimate.moved_m):
            return self._told(FailureKind.SUSPECTED, Cause.MOVED, now_ns, now_ns, picture)
        return None

    def handle_silence(self, for_s: float) -> Failure | None:
        """The same where no frame has come for so long; there is nothing to tell before the first fix."""
        if self._running or not self._had_fix or self._last is None or for_s <= BLIND_S:
            return None
        began_ns = self._last.stamp_ns
        self._good_ns = None
        return self._told(FailureKind.BLIND, Cause.NO_FRAMES, began_ns, began_ns + int(for_s * 1e9), None)

    def _note(self, estimate: Estimate) -> None:
        if estimate.fix is None and not estimate.refused:
            return  # this frame was not looked at
        fix = estimate.fix
        x, y, z = (0.0, 0.0, 0.0) if fix is None else (float(v) for v in fix.map_from_cam[:3, 3])
        self._fixes.append(
            FixNote(
                stamp_ns=estimate.stamp_ns,
                status=estimate.status.value,
                position_map_m=None if fix is None else (x, y, z),
                inliers=None if fix is None else fix.inliers,
                innovation=None if estimate.innovation is None else float(estimate.innovation),
                refused=estimate.refused[:_MAX_REFUSED_CHARS],
            )
        )
        contradicts = fix is None and estimate.innovation is not None and estimate.status is Status.TRACKING
        self._doubts = self._doubts + 1 if contradicts else 0

    def _follow(self, now_ns: int, blind: bool, doubted: bool) -> None:
        if not blind:
            self._blind_ns = None
            self._causes.clear()
        elif self._blind_ns is None:
            self._blind_ns = now_ns
        if not self._doubts:
            self._doubted_ns = None
        elif doubted and self._doubted_ns is None:
            self._doubted_ns = now_ns
        if blind or doubted or self._last is None or self._last.status is not Status.TRACKING:
            self._good_ns = None
        elif self._good_ns is None:
            self._good_ns = now_ns
        elif (now_ns - self._good_ns) * 1e-9 >= GOOD_S:
            self._running = False

    def _told(self, kind: FailureKind, cause: Cause, began_ns: int, now_ns: int, picture: Picture | None) -> Failure:
        assert self._last is not None
        self._running = True
        return Failure(kind, cause, began_ns, (now_ns - began_ns) * 1e-9, self._last, picture, tuple(self._fixes))


def cause_of(estimate: Estimate, picture: Picture) -> Cause:
    """In a word, why a frame has no place: what is wrong with the picture goes first, then what the map said."""
    if picture.fault:
        return picture.fault
    if estimate.map_version is None:
        return Cause.NO_MAP
    if estimate.status is Status.AMBIGUOUS:
        return Cause.AMBIGUOUS
    return Cause.NO_MATCH if estimate.innovation is None else Cause.FIX_REFUSED
