"""Stock that moves by day, aisles that are identical on request, chunks that do not depend on the way there."""

import numpy as np
import pytest

from fleetsim.scene.layout import Layout, Slot, last_restock_day, slot_generator
from fleetsim.scene.world import World


def _slots(layout: Layout) -> list[Slot]:
    return [Slot(*place) for place in np.ndindex(layout.rows, layout.bays, layout.levels)]


@pytest.mark.parametrize("rate", [0.0, 0.125, 0.5])
def test_share_of_restocked_slots(rate: float) -> None:
    layout = Layout(aisles=10, bays=20, restock_per_day=rate)
    slots = _slots(layout)
    after_one = np.mean([last_restock_day(layout, 5, 1, slot) == 1 for slot in slots])
    after_three = np.mean([last_restock_day(layout, 5, 3, slot) > 0 for slot in slots])
    assert abs(after_one - rate) < 0.03
    assert abs(after_three - (1 - (1 - rate) ** 3)) < 0.04


def test_a_slot_keeps_its_content_until_it_is_restocked() -> None:
    layout = Layout(aisles=2, bays=4)
    changed = 0
    for slot in _slots(layout):
        first, next_day = (slot_generator(layout, 5, day, slot).random(4) for day in (0, 1))
        is_same = np.array_equal(first, next_day)
        assert is_same == (last_restock_day(layout, 5, 1, slot) == 0)
        changed += not is_same
    assert 0 < changed < len(_slots(layout)) / 2


def test_stock_changes_faces_only_where_restocked() -> None:
    today, tomorrow = (World(Layout(aisles=1, bays=4), seed=5, day=day).detailed_faces(0, 0).quads for day in (0, 3))
    common = {row.tobytes() for row in today} & {row.tobytes() for row in tomorrow}
    assert 0.5 * len(today) < len(common) < len(today)


def _inside_rows(world: World, row: int) -> set[bytes]:
    """Faces of a chunk that carry texture, relative to their aisle, rounded to a micrometre."""
    faces = world.detailed_faces(0, row)
    moved = faces.quads.copy()
    moved[:, 1] -= world.layout.aisle_y_m(row)
    columns = np.concatenate([np.round(moved, 6), np.round(faces.values, 6), faces.numbers[:, :2]], axis=1) + 0.0
    return {line.tobytes() for line in columns}


def test_identical_aisles_are_identical_and_others_are_not() -> None:
    plain = {"aisles": 5, "bays": 4, "has_landmarks": False}
    identical = World(Layout(**plain, are_aisles_identical=True), seed=5)
    inner = [_inside_rows(identical, row) for row in (1, 2, 3)]
    assert inner[0] == inner[1] == inner[2]
    distinct = World(Layout(**plain), seed=5)
    inner = [_inside_rows(distinct, row) for row in (1, 2)]
    assert len(inner[0] & inner[1]) < 0.1 * len(inner[0])


def test_a_chunk_looks_the_same_whatever_was_visited_before() -> None:
    layout = Layout(aisles=6, bays=8)
    direct, roundabout = World(layout, seed=1), World(layout, seed=1)
    for x_m, y_m in ((3.0, 27.0), (5.0, 3.0)):
        roundabout.scene_around(x_m, y_m)
    one, other = direct.scene_around(28.0, 20.0), roundabout.scene_around(28.0, 20.0)
    assert one is not other
    for name in ("quads", "values", "numbers", "light"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_cross_aisle_is_free_and_its_sides_are_guarded() -> None:
    layout = Layout(aisles=1, bays=5, cross_bays=(2,), dock_m=10.0)
    assert layout.rack_runs == [(0, 2), (3, 5)]
    world = World(layout, seed=5)
    boxes = np.concatenate([world.detailed_faces(column, 0).boxes for column in range(layout.chunk_counts[0])])
    x, half = boxes[:, 0], boxes[:, 3]
    start, end = layout.bay_x_m(2) + 0.3, layout.bay_x_m(3) - 0.3
    inside = (x + half > start) & (x - half < end)
    assert not (inside & (boxes[:, 2] < 3.0)).any()
    guards = np.abs(boxes[:, 2] - 0.25) < 1e-6
    for place in (layout.bay_x_m(bay) + side_m for bay, side_m in ((0, -0.12), (2, 0.12), (3, -0.12), (5, 0.12))):
        assert (guards & (np.abs(x - place) < 1e-6)).sum() == 2, place
    assert len(layout.packing_stations_m()) == 2
    assert (x < layout.dock_m).any()


def test_a_moved_rack_row_takes_its_faces_along_and_no_others() -> None:
    before, after = (World(Layout(aisles=1, bays=4, moved_rows=moved), seed=5) for moved in ((), ((1, -0.4),)))
    old, new = (world.detailed_faces(0, 0).quads[:, 1] for world in (before, after))
    shift = np.round(new - old, 9)
    assert set(np.unique(shift).tolist()) == {-0.4, 0.0}
    row_y = before.layout.row_y_m(1)
    assert np.abs(old[shift != 0] - row_y).max() < 1.0
    assert (shift != 0).sum() > 100
