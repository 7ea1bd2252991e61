"""Onset of a failure: the robot's pose belief at its beginning, and earlier pictures. Pure."""

from collections import deque
from collections.abc import Mapping
from math import dist
from typing import NamedTuple

import cv2
import numpy as np

from fleetmap.failure_definition import ERROR_LIMIT_M, radius_95_m
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Cause, FailureKind
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import Image
from locclient.localization.estimate import Estimate

PICTURE_WIDTH_PX = 240
_BEFORE_NS = (2_000_000_000, 500_000_000)
_EVERY_NS, _KEPT = 250_000_000, 10  # pictures of the last 2.5 s, four a second
_BREAK_NS = 3_000_000_000  # from lost tracks to a failure caused by them; fixes and status need up to 2 s
AGREEING_FIXES = 3  # that make another place significant, as for a kidnapped robot
_USUAL_FIXES = 50  # over which their recall is averaged
_RECENT_FIX_NS = 2_000_000_000
_DROPPED_STEPS = 1.5  # shortest steps between frames; frames are missing in a longer one


class Belief(NamedTuple):
    """The last claimed pose of a robot: map_from_body (4, 4), cov_rot_trans (6, 6).

    odom_from_body (4, 4) of the same frame, in an odometry frame that is never redefined. fix_ns: stamp of the last fix until then;
    recall: share of the expected landmarks found by it.
    """

    map_from_body: Array
    cov_rot_trans: Array
    odom_from_body: Array
    fix_ns: int
    recall: float
    floor: str = ""  # as of `Estimate`

    def carried_on(self, odom_from_body: Array) -> "Belief":
        """Return the belief with its pose propagated by odometry, and its covariance as it was."""
        map_from_body = self.map_from_body @ se3_inverse(self.odom_from_body) @ odom_from_body
        return self._replace(map_from_body=map_from_body, odom_from_body=odom_from_body)

    def off_m(self, map_from_body: Array, odom_from_body: Array) -> float:
        """Return the distance of a pose from the belief, carried on."""
        return dist(map_from_body[:3, 3], self.carried_on(odom_from_body).map_from_body[:3, 3])


class Onset(NamedTuple):
    """The first frame of a failure. left: its left image, of the view compared with the map; pictures: stamps, small images, oldest first.

    belief: carried on to this frame; None if the robot had claimed no pose. track_pixels (N, 3): of the odometry, None if it had none.
    """

    stamp_ns: int
    left: Image
    pictures: tuple[tuple[int, Image], ...]
    belief: Belief | None
    view: int = 0
    track_pixels: Array | None = None


class Evidence(NamedTuple):
    """Evidence for a cause when a failure is detected.

    wrong_by_m: distance from the belief to the place of agreeing fixes, None without such fixes. broke: the odometry lost all tracks
    between two good images. had_fix: a fix had agreed with the belief shortly before. places: number of other places with several
    fixes each. usual_recall: share of the expected landmarks found by the last fixes, on average.
    """

    wrong_by_m: float | None = None
    broke: bool = False
    had_fix: bool = False
    places: int = 0
    usual_recall: float = 0.0


def refined_cause(cause: Cause, evidence: Evidence) -> Cause:
    """Return the cause of a failure by the evidence; faults of the image, of the calibration and of the source are not changed."""
    if cause not in {Cause.AMBIGUOUS, Cause.NO_MATCH, Cause.FIX_REFUSED, Cause.MOVED, Cause.ODOMETRY}:
        return cause
    if evidence.wrong_by_m is not None and evidence.broke:
        return Cause.CARRIED
    if evidence.wrong_by_m is not None and evidence.had_fix and cause is not Cause.ODOMETRY:
        return Cause.ALIASED
    return Cause.ALIASED if cause is Cause.AMBIGUOUS and evidence.places >= 2 else cause


class OnsetRecorder:
    """Keeps small pictures of the last seconds, and in `open` the onset of every ongoing condition that may become a failure."""

    def __init__(self) -> None:
        self._pictures: deque[tuple[int, Image]] = deque(maxlen=_KEPT)
        self.open: dict[FailureKind, Onset] = {}
        self._belief: Belief | None = None
        self._fix: tuple[int, float] = (-(1 << 62), 0.0)
        self._usual_recall, self._fixes = 0.0, 0
        self._break: Onset | None = None
        self._least_step_ns = 1 << 62  # between two frames
        self._last: tuple[Estimate, Array] | None = None

    def handle(
        self, estimate: Estimate, frame: RectifiedFrame, odom_from_body: Array, begun_ns: Mapping[FailureKind, int]
    ) -> None:
        """Add a frame. begun_ns: start of conditions that may become a failure, by kind; odom_from_body as of `Belief`."""
        stamp_ns, last, self._last = estimate.stamp_ns, self._last, (estimate, odom_from_body)
        if estimate.fix is not None:
            self._fix = (stamp_ns, estimate.fix.landmark_recall)
            self._fixes = min(self._fixes + 1, _USUAL_FIXES)
            self._usual_recall += (estimate.fix.landmark_recall - self._usual_recall) / self._fixes
        # A claimed pose is one without competitors that is not an unconfirmed candidate.
        if estimate.map_from_body is not None and estimate.cov_rot_trans is not None and not estimate.hypotheses:
            claimed = (estimate.map_from_body, estimate.cov_rot_trans, odom_from_body)
            self._belief = Belief(*claimed, *self._fix, estimate.floor)
        if last is not None and self._breaks(last[0], estimate):
            self._break = self._onset(stamp_ns, frame, odom_from_body, estimate.view)
        for kind, began_ns in begun_ns.items():
            if kind not in self.open or self.open[kind].stamp_ns != began_ns:
                self.open[kind] = self._onset(began_ns, frame, odom_from_body, estimate.view)
        for kind in [kind for kind in self.open if kind not in begun_ns]:
            del self.open[kind]
        if not self._pictures or stamp_ns - self._pictures[-1][0] >= _EVERY_NS:
            self._pictures.append((stamp_ns, reduced(_left(frame, estimate.view))))

    def onset(self, kind: FailureKind, began_ns: int, frame: RectifiedFrame, *, was_carried: bool = False) -> Onset:
        """Return the onset of a detected failure; for a carried robot, that of the lost tracks."""
        assert self._last is not None
        if was_carried and self._break is not None and self._is_break_of(began_ns):
            return self._break
        found = self.open.get(kind)
        return found if found is not None else self._onset(began_ns, frame, self._last[1], self._last[0].view)

    def evidence(self, estimate: Estimate, kind: FailureKind, began_ns: int, odom_from_body: Array) -> Evidence:
        """Return evidence for the cause of a failure detected with this estimate."""
        found = self.open.get(kind)
        belief = self._belief if found is None else found.belief
        elsewhere = estimate.hypotheses
        wrong_by_m = estimate.moved_m
        had_fix = False
        if belief is not None:
            had_fix = began_ns - belief.fix_ns <= _RECENT_FIX_NS
            limit_m = max(ERROR_LIMIT_M, radius_95_m(belief.cov_rot_trans))
            elsewhere = tuple(h for h in elsewhere if belief.off_m(h.map_from_body, odom_from_body) > limit_m)
            best = max(elsewhere, key=lambda hypothesis: hypothesis.support, default=None)
            if wrong_by_m is None and best is not None and best.support >= AGREEING_FIXES:
                wrong_by_m = belief.off_m(best.map_from_body, odom_from_body)
        places = sum(hypothesis.support >= 2 for hypothesis in elsewhere)
        return Evidence(wrong_by_m, self._is_break_of(began_ns), had_fix, places, self._usual_recall)

    def _is_break_of(self, began_ns: int) -> bool:
        return self._break is not None and self._break.stamp_ns >= began_ns - _BREAK_NS

    def _breaks(self, last: Estimate, estimate: Estimate) -> bool:
        """Return True if the odometry lost its tracks in this frame although the image is good and no frame before it is missing."""
        step_ns = estimate.stamp_ns - last.stamp_ns
        self._least_step_ns = min(self._least_step_ns, step_ns)
        was_lost, is_lost = (each.odometry.status is OdometryStatus.DEGRADED for each in (last, estimate))
        begins = is_lost and not was_lost
        is_next = step_ns <= _DROPPED_STEPS * self._least_step_ns
        return begins and is_next and estimate.image.cause is Cause.NONE

    def _onset(self, stamp_ns: int, frame: RectifiedFrame, odom_from_body: Array, view: int) -> Onset:
        before = [self._nearest(stamp_ns - age_ns, stamp_ns) for age_ns in _BEFORE_NS]
        chosen = {picture[0]: picture[1] for picture in before if picture is not None}
        belief = self._belief and self._belief.carried_on(odom_from_body)
        left = _left(frame, view)
        tracked = None if self._last is None else self._last[0].odometry.track_pixels
        return Onset(stamp_ns, left, (*chosen.items(), (stamp_ns, reduced(left))), belief, view, tracked)

    def _nearest(self, wanted_ns: int, before_ns: int) -> tuple[int, Image] | None:
        """Return the picture nearest to a stamp, at most 0.5 s off and before `before_ns`."""
        known = [picture for picture in self._pictures if picture[0] < before_ns]
        nearest = min(known, key=lambda picture: abs(picture[0] - wanted_ns), default=None)
        return nearest if nearest is not None and abs(nearest[0] - wanted_ns) <= 2 * _EVERY_NS else None


def _left(frame: RectifiedFrame, view: int) -> Image:
    """Return the left image of a view, of the first one where that has none."""
    return (frame.view(view) or frame).left


def block_px(width_px: int, about_px: int) -> int:
    """Return the side of the blocks whose means are an image of at least so many pixels, and less than twice as many."""
    return max(1, width_px // about_px)


def reduced(image: Image, about_px: int = PICTURE_WIDTH_PX) -> Image:
    """Return means of whole blocks of pixels by `block_px`, at a tenth of the cost of a free scale."""
    height, width = image.shape
    step = block_px(width, about_px)
    whole = image[: height // step * step, : width // step * step]
    return np.asarray(cv2.resize(whole, (width // step, height // step), interpolation=cv2.INTER_AREA), np.uint8)
