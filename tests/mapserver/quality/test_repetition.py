"""The smallest distance at which a map looks like itself: racks whose bays are alike, and an aisle that repeats nothing."""

import numpy as np
import pytest

from fleetmap.relocalization.map_view import ALIAS_STEP_M
from fleetmap.relocalization.relocalizer import SAME_PLACE_M
from mapserver.quality.figures import Repetition
from mapserver.quality.probes import Probe, alias_step_m, fixes_of, repetition
from support.worlds.aisle_world import BODY_FROM_CAM, CAMERA, Aisle, aisle, drive, frame, relocalizer


def racks(bay_m: float, bays: int = 10) -> Aisle:
    """Bays of equal stock with descriptors off by 5 % of their bits, and a wall of its own at either end."""
    rng = np.random.default_rng(5)
    bay, ends = aisle(1, length_m=bay_m - 4.0, count=300), aisle(2, length_m=bay_m * bays, count=3000)
    at_end = (ends.points_map[:, 0] < 1.0) | (ends.points_map[:, 0] > bay_m * bays)
    steps_m = np.repeat(bay_m * np.arange(bays), len(bay.points_map))[:, None] * [1.0, 0.0, 0.0]
    flips = np.packbits(rng.random((len(steps_m), 256)) < 0.05, axis=1)
    return Aisle(
        np.concatenate([np.tile(bay.points_map, (bays, 1)) + steps_m, ends.points_map[at_end]]),
        np.concatenate([np.tile(bay.descriptors, (bays, 1)) ^ flips, ends.descriptors[at_end]]),
        np.concatenate([np.tile(bay.reaches_m, bays), ends.reaches_m[at_end]]),
    )


def measured(seen: Aisle) -> Repetition | None:
    """By twenty frames between the survey's keyframes."""
    rng, places = np.random.default_rng(3), drive(50)
    view = relocalizer(seen, places)[0].view
    between = places[5:45:2].copy()
    between[:, 0, 3] += 0.2
    probes = [Probe(CAMERA, frame(seen, place, rng), place @ BODY_FROM_CAM) for place in between]
    return repetition([fixes_of(view, probe) for probe in probes])


@pytest.mark.parametrize("bay_m", [1.8, 2.7, 3.6])
def test_racks_repeat_at_their_bays(bay_m: float) -> None:
    assert measured(racks(bay_m)).step_m == pytest.approx(bay_m, rel=0.1)


def test_a_fix_that_is_off_by_less_than_an_alias_is_no_alias() -> None:
    rng, places, seen = np.random.default_rng(3), drive(50), aisle(1)
    view = relocalizer(seen, places)[0].view
    aside = places[20] @ BODY_FROM_CAM
    aside[0, 3] += 0.6
    assert repetition([fixes_of(view, Probe(CAMERA, frame(seen, places[20], rng), aside))]) == Repetition(1, None)


def test_an_aisle_whose_places_differ_repeats_nothing() -> None:
    assert measured(aisle(1)) == Repetition(20, None)


@pytest.mark.parametrize(
    ("found", "known_m", "step_m"),
    [
        (Repetition(40, 1.8), None, 1.8),
        (Repetition(40, 5.0), None, ALIAS_STEP_M),  # others may be nearer, where no frame looks
        (Repetition(40, 5.0), 1.8, 1.8),  # of the version before, by drives through other aisles
        (Repetition(40, None), 1.8, 1.8),
        (Repetition(40, None), None, None),
        (Repetition(40, None), 0.55, SAME_PLACE_M),  # no alias, but an error of a fix
        (None, None, None),
    ],
)
def test_the_step_for_robots_is_the_smallest_known_one(
    found: Repetition | None, known_m: float | None, step_m: float | None
) -> None:
    assert alias_step_m(found, known_m) == step_m
