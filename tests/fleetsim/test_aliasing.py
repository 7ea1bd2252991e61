"""Identical aisles are as alike to the features as one aisle is to itself on another day: aliasing is real."""

import numpy as np

from benchmarks.back_end.bench_aliasing import measure
from fleetsim.scene.layout import Layout


def test_corresponding_places_match_as_well_across_aisles_as_across_days() -> None:
    layout = Layout(aisles=4, bays=4, has_landmarks=False, are_aisles_identical=True)
    found = measure(layout, (1, 2), (7.0, 9.0))
    across_days, across_aisles = found["same aisle, next day"], found["other aisle, same day"]
    assert across_aisles.matched_share > 0.95 * across_days.matched_share
    assert across_aisles.distance_bits <= across_days.distance_bits + 3
    assert found["other aisle, next day"].matched_share > 0.8 * across_days.matched_share
    assert found["same aisle, other noise"].matched_share > 0.6


def test_aisles_that_differ_do_not_match() -> None:
    layout = Layout(aisles=2, bays=4)
    found = measure(layout, (0, 1), (9.0,))
    assert found["other aisle, same day"].matched_share < 0.25 * found["same aisle, next day"].matched_share
    assert np.isfinite(found["other aisle, same day"].distance_bits)
