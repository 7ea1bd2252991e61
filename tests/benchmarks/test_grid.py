"""The grid of planners in halls that development has not looked at, and after a night in which stock moved."""

import pytest

from benchmarks.survey.bench_grid import judge, judge_night, views_from_truth
from fleetmap.version_grid import occupancy
from fleetsim.recorder import Order, prepare
from mapserver.grid.site_grid import updated

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
HEIGHT_M = 1.1


@pytest.mark.parametrize("hall", ["small-loop", "five-aisles"])
def test_a_halls_grid_is_near_the_truth_and_follows_its_stock(hall: str) -> None:
    sessions = [prepare(Order(hall, seed=303, day=day)) for day in (0, 8)]
    first = updated(views_from_truth(sessions[0], 6, {}))
    views = views_from_truth(sessions[1], 6, first)
    second = updated(views)
    judged = [
        judge(occupancy(tiles, HEIGHT_M), s, HEIGHT_M) for tiles, s in zip((first, second), sessions, strict=True)
    ]
    for found in judged:
        assert found.figures.free_wrong <= 0.005
        assert found.figures.occupied_near >= 0.98
        assert found.path > 100
        assert found.crossed == 0
    moved, left = judge_night(views, second, (judged[0].truth, judged[1].truth), HEIGHT_M)
    assert moved > 0
    assert left == 0
