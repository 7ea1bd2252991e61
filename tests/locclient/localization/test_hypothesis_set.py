"""Which places compete with the one that most speaks for."""

import numpy as np
import pytest

from locclient.localization.hypothesis_set import HypothesisSet
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import TrackSettings

SETTINGS = TrackSettings()


def hypothesis(inliers: list[int], recall: list[float]) -> PoseHypothesis:
    """A place with a fix of so many inliers in each query; 0: a query without one."""
    made = PoseHypothesis(0, 0, *2 * [Place(np.eye(4), np.eye(6))])
    for count, share in zip(inliers, recall, strict=True):
        made.decay(SETTINGS.evidence_kept_share)
        if count:
            made.add_fix(count, share)
    return made


def competitors(hypotheses: list[PoseHypothesis]) -> list[PoseHypothesis]:
    found = HypothesisSet(SETTINGS)
    found.hypotheses = hypotheses
    return found.ranking()[1]


BEST = ([161, 217, 253], [0.29, 0.35, 0.42])


@pytest.mark.parametrize(
    ("inliers", "recall", "competes"),
    [
        ([150, 200, 240], [0.3, 0.3, 0.4], True),
        # Seen: of a robot that turns into its aisle, the map of the next one shows more at first. It was the wrong one.
        ([86, 86, 175], [0.08, 0.06, 0.38], True),
        ([86, 86, 86], [0.08, 0.06, 0.08], False),
        ([40, 50, 70], [0.3, 0.36, 0.41], True),
        ([150, 200, 0], [0.3, 0.3, 0.0], False),
        ([0, 0, 0], [0.0, 0.0, 0.0], False),
    ],
)
def test_another_place_competes_in_the_mean_or_in_the_present_query(
    inliers: list[int], recall: list[float], competes: bool
) -> None:
    best, other = hypothesis(*BEST), hypothesis(inliers, recall)
    assert competitors([other, best]) == ([other] if competes else [])


def test_a_place_that_is_seen_competes_with_the_best_that_is_not() -> None:
    best, other = hypothesis([161, 217, 0], [0.29, 0.35, 0.0]), hypothesis([0, 0, 60], [0.0, 0.0, 0.1])
    assert competitors([other, best]) == [other]
