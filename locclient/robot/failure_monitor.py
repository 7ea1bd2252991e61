"""Detection of position failures and their causes, from successive estimates. Pure; `fleetmap.failure_definition` has the limits."""

from collections import Counter, deque
from typing import NamedTuple

from fleetmap import failure_definition as definition
from fleetmap.messages import Cause, FailureKind, FixNote, Status
from locclient.localization.estimate import Estimate

_FIX_NOTES = 20
_MAX_REFUSED_CHARS = 500
CONTRADICTING_LOOKS = 3  # one refused fix is chance, several in a row are a doubt


class Failure(NamedTuple):
    """A failure, reported once.

    stamp_ns: of its first frame. estimate: of the frame of its detection, or the last one before frames were missing.
    """

    kind: FailureKind
    cause: Cause
    stamp_ns: int
    duration_s: float
    estimate: Estimate
    fixes: tuple[FixNote, ...]


class FailureMonitor:
    """Reports every failure once, when it has lasted long enough; the next may begin after GOOD_S of good tracking.

    `blind`: after the first fix, no reliable position for BLIND_S. `not_found`: no pose for too long, from the start on or later.
    `suspected`: the robot is tracking, but the last fixes contradict it for SILENT_S, or it is found elsewhere than claimed, beyond
    its covariance. The first two are certain; the third is an indication of an error that only ground truth could prove.
    """

    def __init__(self) -> None:
        self._fixes: deque[FixNote] = deque(maxlen=_FIX_NOTES)
        self._causes: Counter[Cause] = Counter()  # of frames while blind
        self._search = definition.SearchClock()
        self._search_causes: Counter[Cause] = Counter()
        self._had_fix = False
        self._blind_ns: int | None = None
        self._doubted_ns: int | None = None
        self._contradicted_ns: int | None = None  # since when no fix was accepted and some contradicted the estimate
        self._contradicting_looks = 0
        self._good_ns: int | None = None
        self.is_running = False  # a reported failure has not ended yet
        self._last: Estimate | None = None

    @property
    def begun_ns(self) -> dict[FailureKind, int]:
        """Return first stamps of ongoing failures and of conditions that may become one, by kind."""
        begun_ns = {FailureKind.BLIND: self._blind_ns, FailureKind.NOT_FOUND: self._search.began_ns}
        begun_ns[FailureKind.SUSPECTED] = self._contradicted_ns
        return {kind: stamp_ns for kind, stamp_ns in begun_ns.items() if stamp_ns is not None}

    def handle(
        self, estimate: Estimate, speed_mps: float | None = None, *, may_be_mapped: bool = True
    ) -> Failure | None:
        """Return the failure detected with this frame, if any.

        speed_mps: by wheels or odometry, None if unknown. may_be_mapped: False if the map does not cover the place.
        """
        # Of other frames it decides nothing.
        has_say = estimate.status is Status.DEGRADED or estimate.fix is not None
        radius_m = definition.radius_95_m(estimate.cov_rot_trans) if has_say else float("inf")
        is_lost = self._is_lost(estimate, radius_m, definition.is_driving(speed_mps), may_be_mapped=may_be_mapped)
        self._last, now_ns = estimate, estimate.stamp_ns
        contradicted_ns = self._contradicted_ns or now_ns
        self._note_fix(estimate)
        self._had_fix |= estimate.fix is not None
        blind = self._had_fix and definition.is_blind(estimate.status, radius_m) and estimate.cause is not Cause.RIDING
        doubted = self._contradicting_looks >= CONTRADICTING_LOOKS
        is_good = estimate.status is Status.TRACKING and not (blind or doubted)
        self._blind_ns = _since(self._blind_ns, now_ns, holds=blind)
        self._doubted_ns = _since(self._doubted_ns, now_ns, holds=doubted)
        self._good_ns = _since(self._good_ns, now_ns, holds=is_good)
        if self._good_ns is not None and (now_ns - self._good_ns) * 1e-9 >= definition.GOOD_S:
            self.is_running = False
        if blind:
            self._causes[failure_cause(estimate)] += 1
        else:
            self._causes.clear()
        if self.is_running:
            return None
        if self._blind_ns is not None and (now_ns - self._blind_ns) * 1e-9 > definition.BLIND_S:
            return self._detected(FailureKind.BLIND, self._causes.most_common(1)[0][0], self._blind_ns, now_ns)
        if is_lost and self._search.began_ns is not None:
            cause = self._search_causes.most_common(1)[0][0]
            return self._detected(FailureKind.NOT_FOUND, cause, self._search.began_ns, now_ns)
        if self._doubted_ns is not None and (now_ns - self._doubted_ns) * 1e-9 > definition.SILENT_S:
            return self._detected(FailureKind.SUSPECTED, Cause.FIX_REFUSED, contradicted_ns, now_ns)
        if estimate.moved_m is not None and definition.is_wrong(estimate.moved_m):
            return self._detected(FailureKind.SUSPECTED, Cause.MOVED, contradicted_ns, now_ns)
        return None

    def handle_silence(self, for_s: float) -> Failure | None:
        """Return the failure of a source without frames for so many seconds; None before the first frame."""
        is_too_long = for_s > definition.BLIND_S if self._had_fix else for_s >= definition.FIND_DRIVING_S
        if self.is_running or self._last is None or not is_too_long:
            return None
        began_ns = self._last.stamp_ns
        self._good_ns = None
        kind = FailureKind.BLIND if self._had_fix else FailureKind.NOT_FOUND
        return self._detected(kind, Cause.NO_FRAMES, began_ns, began_ns + int(for_s * 1e9))

    def _is_lost(self, estimate: Estimate, radius_m: float, is_driving: bool, *, may_be_mapped: bool) -> bool:
        """Return True if the robot has had no pose for too long."""
        before_ns = estimate.stamp_ns if self._last is None else self._last.stamp_ns
        has_fix = estimate.fix is not None
        localised = definition.is_localised(estimate.status, has_fix, radius_m, (estimate.stamp_ns - before_ns) * 1e-9)
        found = definition.is_found(localised, has_fix, estimate.status, radius_m)
        if found:
            self._search_causes.clear()
        else:
            self._search_causes[failure_cause(estimate)] += 1
        how = {"is_found": found, "is_driving": is_driving, "may_be_mapped": may_be_mapped}
        return self._search.handle(estimate.stamp_ns, **how)

    def _note_fix(self, estimate: Estimate) -> None:
        if estimate.fix is None and not estimate.refused:
            return  # this frame was not compared with the map
        fix = estimate.fix
        x, y, z = (0.0, 0.0, 0.0) if fix is None else (float(v) for v in fix.map_from_cam[:3, 3])
        note = FixNote(
            stamp_ns=estimate.stamp_ns,
            status=estimate.status,
            position_map_m=None if fix is None else (x, y, z),
            inliers=None if fix is None else fix.inliers,
            innovation=None if estimate.innovation is None else float(estimate.innovation),
            refused=estimate.refused[:_MAX_REFUSED_CHARS],
        )
        self._fixes.append(note)
        if fix is not None:
            self._contradicted_ns = None
        elif estimate.innovation is not None and self._contradicted_ns is None:
            self._contradicted_ns = estimate.stamp_ns
        contradicts = fix is None and estimate.innovation is not None and estimate.status is Status.TRACKING
        self._contradicting_looks = self._contradicting_looks + 1 if contradicts else 0

    def _detected(self, kind: FailureKind, cause: Cause, began_ns: int, now_ns: int) -> Failure:
        assert self._last is not None
        self.is_running = True
        return Failure(kind, cause, began_ns, (now_ns - began_ns) * 1e-9, self._last, tuple(self._fixes))


def _since(before_ns: int | None, now_ns: int, *, holds: bool) -> int | None:
    """Return the stamp since when a condition holds, None if it does not. before_ns: the same at the frame before."""
    return None if not holds else now_ns if before_ns is None else before_ns


def failure_cause(estimate: Estimate) -> Cause:
    """Return the cause of a frame without a reliable position: the estimate's own, or a more specific one about the map."""
    if estimate.cause not in {Cause.NONE, Cause.UNMATCHED}:
        return estimate.cause
    if estimate.map_version is None:
        return Cause.NO_MAP
    if estimate.status is Status.AMBIGUOUS:
        return Cause.AMBIGUOUS
    return Cause.NO_MATCH if estimate.innovation is None else Cause.FIX_REFUSED
