"""Starts anywhere in aisles that look the same, estimator level: what the localizer says before and after motion decides."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks import estimator_loop
from fleetmap.bow import Vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat import Tile
from fleetmap.samples import PositionPrior
from fleetsim.estimator import EstimatorSession, Found, Ids, Sighting
from locclient.localizer import Estimate, Status

RIGHT_M, WRONG_M = 0.5, 0.3


class LateSession(EstimatorSession):
    """A session from one of its frames on."""

    def __init__(self, whole: EstimatorSession, start: int) -> None:
        self.session, self.camera, self.body_from_cam = whole.session, whole.camera, whole.body_from_cam
        self.stamps_ns, self.map_from_body = whole.stamps_ns[start:], whole.map_from_body[start:]
        self._whole, self._start = whole, start

    def sighting(self, frame: int) -> Sighting:
        return self._whole.sighting(frame + self._start)

    def follow(self, frame: int, ids: Ids, begun_px: Array) -> tuple[Array, NDArray[np.bool_]]:
        return self._whole.follow(frame + self._start, ids, begun_px)

    def corners(self, frame: int, taken: Array, count: int, min_distance_px: float) -> tuple[Ids, Array]:
        return self._whole.corners(frame + self._start, taken, count, min_distance_px)

    def features(self, frame: int) -> Found:
        return self._whole.features(frame + self._start)


@dataclass(frozen=True, slots=True)
class Start:
    """How one start went.

    wrong_frames: TRACKING and more than WRONG_M off. ambiguous_frames, and of those with the right place among the hypotheses.
    tracking_s: until the first TRACKING at the right place, None without. is_right_then: TRACKING and right at `until_s`.
    """

    frame: int
    wrong_frames: int
    ambiguous_frames: int
    ambiguous_right_frames: int
    tracking_s: float | None


def prior_at(session: EstimatorSession, sigma_m: float, rng: np.random.Generator) -> PositionPrior:
    """The place at the session's first frame, known so well."""
    map_from_base = session.map_from_body[0] @ se3_inverse(session.session.nominal.base_from_body)
    map_from_base[:2, 3] += rng.normal(0.0, sigma_m, 2)
    return PositionPrior(
        session.stamps_ns[0], map_from_base, np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    )


def judged(frame: int, session: EstimatorSession, estimates: list[Estimate]) -> Start:
    """The start's outcome."""
    wrong = ambiguous = with_right = 0
    first: float | None = None
    for estimate, truth in zip(estimates, session.map_from_body, strict=False):
        if estimate.status is Status.TRACKING:
            assert estimate.map_from_body is not None
            is_right = np.linalg.norm(estimate.map_from_body[:3, 3] - truth[:3, 3]) <= WRONG_M
            wrong += not is_right
            if is_right and first is None:
                first = (estimate.stamp_ns - session.stamps_ns[0]) * 1e-9
        elif estimate.status is Status.AMBIGUOUS:
            ambiguous += 1
            off = [np.linalg.norm(h.map_from_body[:3, 3] - truth[:3, 3]) for h in estimate.hypotheses]
            with_right += min(off) < RIGHT_M
    return Start(frame, wrong, ambiguous, with_right, first)


def starts(
    whole: EstimatorSession, tiles: list[Tile], vocabulary: Vocabulary, numbers: Iterable[int], duration_s: float,
    sigma_m: float | None, rng: np.random.Generator,
) -> list[Start]:  # fmt: skip
    """One outcome for each number of a frame to start at."""
    found = []
    for number in numbers:
        session = LateSession(whole, number)
        prior = None if sigma_m is None else prior_at(session, sigma_m, rng)
        count = int(np.searchsorted(session.stamps_ns, session.stamps_ns[0] + int(duration_s * 1e9)))
        found.append(judged(number, session, estimator_loop.run_localizer(session, tiles, vocabulary, prior, count)))
    return found


def summary(found: list[Start], within_s: float) -> dict[str, float]:
    """Shares over the starts."""
    ambiguous = sum(s.ambiguous_frames for s in found)
    soon = [s.tracking_s is not None and s.tracking_s <= within_s for s in found]
    return {
        "starts": len(found),
        "wrong_starts": sum(s.wrong_frames > 0 for s in found),
        "right_in_time_share": float(np.mean(soon)),
        "tracking_share": float(np.mean([s.tracking_s is not None for s in found])),
        "ambiguous_starts_share": float(np.mean([s.ambiguous_frames > 0 for s in found])),
        "right_among_hypotheses_share": sum(s.ambiguous_right_frames for s in found) / ambiguous if ambiguous else 1.0,
    }
