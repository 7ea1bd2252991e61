"""Starts without a prior: what a map's own look-alikes say of robots that start where nothing is mapped. Pure."""

from collections.abc import Sequence

from fleetmap.geometry import Array
from fleetmap.relocalization.map_view import MapView
from mapserver.quality.figures import LookAlike, Starts
from mapserver.quality.probes import ELSEWHERE_M, Probe, most_similar_beyond, taken_elsewhere

_NAMED = 3


def starts_without_prior(view: MapView, probes: Sequence[Probe]) -> Starts | None:
    """Each probe as a start without a prior at a place that the map lacks; None where all of the map lies around each.

    A robot in an unmapped place is one more such probe: it exceeds the largest recall of n with a probability of 1 / (n + 1).
    Source: Vovk et al. 2005, Algorithmic Learning in a Random World, chapter 2 (conformal prediction).
    """
    offered = [probe for probe in probes if most_similar_beyond(view, probe, ELSEWHERE_M) is not None]
    if not offered:
        return None
    found = [(probe, taken_elsewhere(view, probe, ELSEWHERE_M)) for probe in offered]
    taken = [(probe, fix) for probe, fix in found if fix is not None]
    return Starts(
        frames=len(found),
        taken_share=round(len(taken) / len(found), 4),
        lookalike_recall=round(max((fix.landmark_recall for _, fix in taken), default=0.0), 4),
        max_wrong_share=round(1 / (len(found) + 1), 4),
        lookalikes=[
            LookAlike(_xy(probe.map_from_cam), _xy(fix.map_from_cam), round(fix.landmark_recall, 4))
            for probe, fix in taken
        ],
    )


def lookalike_words(starts: Starts | None) -> str:
    """Where robots without a prior are not believed, in words; empty where they are believed everywhere."""
    if starts is None or starts.lookalike_recall == 0.0:
        return ""
    worst = sorted(starts.lookalikes, key=lambda alike: -alike.recall)
    named = "; ".join(
        f"({a.place[0]:g}, {a.place[1]:g}) looks like ({a.taken_for[0]:g}, {a.taken_for[1]:g})" for a in worst[:_NAMED]
    )
    more = f"; and {len(worst) - _NAMED} more" if len(worst) > _NAMED else ""
    return (
        f"{len(worst)} of {starts.frames} frames look like another place of the map ({named}{more}): a robot without a coarse position "
        f"stays AMBIGUOUS unless it sees more than {100 * starts.lookalike_recall:.0f} % of what it should see"
    )


def _xy(map_from_cam: Array) -> tuple[float, float]:
    return round(float(map_from_cam[0, 3]), 1), round(float(map_from_cam[1, 3]), 1)
