"""State of a localizer as values: what its later estimates depend on beside maps and perception. Pure.

Arrays are shared with the localizer, which never changes one in place.
"""

from copy import copy
from dataclasses import dataclass

from fleetmap.geometry import Array
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.pose_hypothesis import PoseHypothesis


@dataclass(frozen=True, slots=True)
class CandidatesState:
    """State of a HypothesisSet. disambiguated: place among the hypotheses, None for none of them."""

    hypotheses: tuple[PoseHypothesis, ...]
    disambiguated: int | None
    abandoned: PoseHypothesis | None
    view_odom_from_body: Array | None
    lookalikes: LookAlikes | None


@dataclass(frozen=True, slots=True)
class PriorState:
    """State of an InitialPosePrior."""

    prior: PositionPrior
    travelled_m: float
    since: PoseHypothesis | None
    hypothesis: PoseHypothesis | None
    contradictions: tuple[PoseHypothesis, ...]


@dataclass(frozen=True, slots=True)
class LocalizerState:
    """State of a Localizer between two frames and two map queries. stamps_ns: of the last frame and of the last query's frame."""

    confirmed: PoseHypothesis | None
    candidates: CandidatesState
    prior: PriorState | None
    odom_from_body: Array | None
    stamps_ns: tuple[int | None, int | None]
    failed_queries: int
    failed_places: tuple[Array, ...]
    search_odom_from_body: Array | None
    was_tracking: bool


def copied(hypothesis: PoseHypothesis | None) -> PoseHypothesis | None:
    """A copy that later frames do not change."""
    return None if hypothesis is None else _copied(hypothesis)


def all_copied(hypotheses: "tuple[PoseHypothesis, ...] | list[PoseHypothesis]") -> tuple[PoseHypothesis, ...]:
    """Copies that later frames do not change."""
    return tuple(_copied(hypothesis) for hypothesis in hypotheses)


def _copied(hypothesis: PoseHypothesis) -> PoseHypothesis:
    made = copy(hypothesis)
    made.history = copy(hypothesis.history)
    made.kidnap_hypotheses = list(all_copied(hypothesis.kidnap_hypotheses))
    return made
