"""Calibration monitor beside the localizer: order of the stereo pair, drift of parameters, effect on estimates. Pure."""

from dataclasses import replace
from enum import StrEnum

import numpy as np

from fleetmap.features.extraction import extract
from fleetmap.features.matching import match_mutual
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, transport_cov, turn_both
from fleetmap.messages import Cause, Status
from fleetmap.relocalization.relocalizer import is_reliable
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame
from fleetmap.time_sliced import TimeSliced
from locclient.localization.calibration.parameters import CalibrationState
from locclient.localization.calibration.watch import CalibrationWatch
from locclient.localization.estimate import Estimate
from locclient.localization.map_query import FinishedQuery

# Seconds between tests of the pair's order: before the first decision, after a reversed one, and while the robot is not localized.
_UNDECIDED_S, _REVERSED_S, _NOT_LOCALIZED_S = 0.5, 5.0, 20.0
_WITHOUT_DEPTH_S = 1.0  # between two searches without depth, while frames match nothing in the map
_HELD_S = 1.0  # maximum age of the fix for which a pose of wrongly calibrated cameras is published
_ORDER_CORNERS = 500


class CalibrationMonitor:
    """Runs the calibration watch for the localizer. Its work is spread over the frames after a query, except for the first confirmed
    pose: that is judged at once, before it is published."""

    def __init__(self, rig: MountedRig, settings: RelocalizerSettings) -> None:
        self._settings = settings
        self.watch = CalibrationWatch(rig, settings.stereo)
        self._job: TimeSliced[None] | None = None
        self._searched_ns: int | None = None
        self._order, self._order_ns = PairOrder.UNKNOWN, -(2**62)
        self.contradiction = ""  # reason why the images cannot be used, by all other sensors

    def is_reversed(self, frame: RectifiedFrame, *, is_localized: bool) -> bool:
        """Return True if images are known to be exchanged or mirrored; test the order of this frame's pair if due."""
        age_s = (frame.stamp_ns - self._order_ns) * 1e-9
        undecided = {PairOrder.UNKNOWN: _UNDECIDED_S, **dict.fromkeys(FAULTS, _REVERSED_S)}
        if age_s >= undecided.get(self._order, np.inf if is_localized else _NOT_LOCALIZED_S):
            order = pair_order(frame, OrbSettings(count=_ORDER_CORNERS))
            self._order_ns = frame.stamp_ns
            self._order = self._order if order is PairOrder.UNKNOWN else order
        return self._order in FAULTS

    def add(self, query: FinishedQuery) -> None:
        """Add a finished map query; from time to time, search for an unmatched frame without its depth."""
        if query.fix is not None:
            self._job = self._view(query)
            if query.is_confirmed and not self.watch.has_confirmed:
                self.work()
        elif self._job is None and query.frame.right is not None:
            stamp_ns = query.odometry.stamp_ns
            if self._searched_ns is None or (stamp_ns - self._searched_ns) * 1e-9 >= _WITHOUT_DEPTH_S:
                self._searched_ns = stamp_ns
                self._job = self._search(query)

    def work(self) -> None:
        """Do one slice of the pending work."""
        if self._job is not None and next(self._job, self) is self:
            self._job = None

    def give_up(self) -> None:
        """Drop pending work: the map has changed."""
        self._job = None

    @property
    def state(self) -> CalibrationState:
        text = self.contradiction or FAULTS.get(self._order, "")
        return CalibrationState(text=text) if text else self.watch.state

    def _view(self, query: FinishedQuery) -> TimeSliced[None]:
        self.watch.handle(query)
        yield

    def _search(self, query: FinishedQuery) -> TimeSliced[None]:
        """Search by the left camera alone: a wrong stereo calibration spoils depth first, which a fix needs."""
        fixes = yield from query.relocalizer.anywhere(query.features.without_depth())
        if fixes and is_reliable(fixes[0], self._settings.fix):
            yield
            self.watch.handle_unmatched(replace(query, fix=fixes[0], is_confirmed=False))


def with_calibration(estimate: Estimate, rig: MountedRig, last_fix_ns: int | None, *, was_localized: bool) -> Estimate:
    """Return the estimate by the state of its calibration: if wrong, not TRACKING and with a larger covariance; the covariance
    also grows if an error beyond the limit is not excluded.

    last_fix_ns: of a confirmed pose, None for a reversed pair. With a wrong calibration, a pose without a recent fix is dropped,
    since the odometry is as wrong as the cameras.
    """
    if not estimate.calibration.is_wrong:
        return _widened(estimate, rig)
    status = Status.DEGRADED if estimate.status is Status.TRACKING else estimate.status
    is_result = estimate.cause in {Cause.NONE, Cause.UNMATCHED, Cause.ODOMETRY}
    cause = Cause.CALIBRATION if is_result else estimate.cause
    estimate = replace(estimate, status=status, cause=cause)
    if last_fix_ns is not None and (estimate.odometry.stamp_ns - last_fix_ns) * 1e-9 <= _HELD_S:
        return _widened(estimate, rig)
    status = Status.LOST if was_localized else Status.INITIALISING
    return replace(estimate, status=status, map_from_body=None, cov_rot_trans=None)


def _widened(estimate: Estimate, rig: MountedRig) -> Estimate:
    covariance, map_from_body = estimate.cov_rot_trans, estimate.map_from_body
    bias_cam = estimate.calibration.cov_bias_cam
    if covariance is None or map_from_body is None or bias_cam is None:
        return estimate
    map_from_cam = map_from_body @ rig.mounted[0].body_from_cam
    turn = turn_both(map_from_cam[:3, :3])
    added = transport_cov(turn @ bias_cam @ turn.T, map_from_body[:3, 3] - map_from_cam[:3, 3])
    return replace(estimate, cov_rot_trans=covariance + added)


_MIN_MATCHES = 40
# minimum size of a signed disparity; rows and columns as shares of the image
_DECIDED_PX, _ROW_SHARE, _WIDTH_SHARE = 1.0, 0.03, 0.3
_MAX_BITS, _RATIO = 48, 0.9
_ODDS = 3.0  # random matches have both signs equally often


class PairOrder(StrEnum):
    """Order of the images of a pair. CROSSED: one of them is exchanged with an image of another view."""

    UNKNOWN = "unknown"
    RIGHT = "right"
    REVERSED = "reversed"
    CROSSED = "crossed"


FAULTS = {
    PairOrder.REVERSED: "matches have negative disparity: left and right images are exchanged, or mirrored; exchange the two topics, "
    "folders or cables, or switch the mirroring off in the camera's driver",
    PairOrder.CROSSED: "an image of the first pair is exchanged with one of another view: they match each other, those of the pair do not; "
    "exchange the two topics, folders or cables",
}


def pair_order(frame: RectifiedFrame, settings: OrbSettings) -> PairOrder:
    """Return the order by one frame at half its size; UNKNOWN for a single camera, too few features or only distant ones.

    In the right order, features lie farther left in the right image; those of another view lie in neither.
    """
    if frame.right is None:
        return PairOrder.UNKNOWN
    pair = [extract(image, settings) for image in (frame.half_left, frame.half_right)]
    height, width = frame.half_left.shape
    offsets = _offsets(pair[0], pair[1], height)
    if len(offsets) >= _MIN_MATCHES:
        return _order(offsets, width)
    for view in filter(None, (frame.view(n + 1) for n in range(len(frame.others)))):
        images = [view.half_left] if view.right is None else [view.half_left, view.half_right]
        for other in (extract(image, settings) for image in images):
            if any(_order(_offsets(own, other, height), width) is not PairOrder.UNKNOWN for own in pair):
                return PairOrder.CROSSED
    return PairOrder.UNKNOWN


def _offsets(left: Features, right: Features, height: int) -> Array:
    """Return (M,) how much farther left features of two images are in the right one, of matches in about the same row."""
    pairs = match_mutual(left.descriptors, right.descriptors, _MAX_BITS, _RATIO)
    offsets = left.pixels[pairs[:, 0]] - right.pixels[pairs[:, 1]]
    return np.asarray(offsets[np.abs(offsets[:, 1]) < _ROW_SHARE * height, 0])


def _order(offsets: Array, width: int) -> PairOrder:
    decided = offsets[(np.abs(offsets) > _DECIDED_PX) & (np.abs(offsets) < _WIDTH_SHARE * width)]
    positive, negative = int((decided > 0).sum()), int((decided < 0).sum())
    if max(positive, negative) < _MIN_MATCHES:
        return PairOrder.UNKNOWN
    if negative > _ODDS * positive:
        return PairOrder.REVERSED
    return PairOrder.RIGHT if positive > _ODDS * negative else PairOrder.UNKNOWN
