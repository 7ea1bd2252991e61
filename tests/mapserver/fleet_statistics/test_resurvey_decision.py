"""Tiles to survey again: found where robots fail more or see less than before, and nowhere else."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from mapserver import releases
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics import resurvey_decision
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters
from mapserver.store import FleetBatch, MapStore
from support.storage.map_samples import save_sample_draft

SETTINGS = resurvey_decision.ResurveySettings()


def counts(failures: int = 0, hours: float = 10.0, expected: int = 0, seen: int = 0) -> Counters:
    landmarks = {"landmarks_expected": expected, "landmarks_seen": seen}
    return Counters(failures=failures, driving_ms=round(hours * 3.6e6), **landmarks)


@pytest.mark.parametrize(
    ("now", "then", "words"),
    [
        (counts(12), counts(2, 70.0), "12 failures in 10.0 h of driving, 2 in 70.0 h before"),
        (counts(2), counts(0, 70.0), ""),  # too few to say
        (counts(4), counts(20, 70.0), ""),  # as before
        (counts(9), Counters(), "elsewhere on the site"),  # no before
        (counts(0, expected=9000, seen=4000), counts(0, 70.0, 90_000, 63_000), "44% of the landmarks are found, 70%"),
        (counts(0, expected=9000, seen=5700), counts(0, 70.0, 90_000, 63_000), ""),
        (counts(0, expected=90, seen=0), counts(0, 70.0, 90_000, 63_000), ""),
    ],
)
def test_a_tile_is_listed_for_a_reason(now: Counters, then: Counters, words: str) -> None:
    recent = {"0,0": now} | {f"{n},5": counts(1, 40.0) for n in range(10)}
    before = {"0,0": then} | {f"{n},5": counts(5, 280.0) for n in range(10)}
    found = resurvey_decision.concerns(recent, before, SETTINGS)
    assert [concern.tile for concern in found] == (["0,0"] if words else [])
    assert not words or words in found[0].reasons[0]


def test_chance_alone_lists_almost_nothing() -> None:
    rng = np.random.default_rng(3)
    listed = 0
    for _ in range(100):
        recent = {f"{n},0": counts(int(rng.poisson(1.0)), 16.0) for n in range(60)}
        before = {f"{n},0": counts(int(rng.poisson(7.0)), 112.0) for n in range(60)}
        listed += len(resurvey_decision.concerns(recent, before, SETTINGS))
    assert listed <= 3  # of 6000 tiles; alpha is for all tiles of a list together


def test_positions_outside_of_all_tiles_are_no_tile() -> None:
    assert resurvey_decision.concerns({"outside": counts(50)}, {}, SETTINGS) == []


def test_the_route_goes_to_the_nearest_that_is_left() -> None:
    (one,) = resurvey_decision.concerns({"0,0": counts(50), "9,9": counts(0, 400.0)}, {}, SETTINGS)
    found = [one] + [
        resurvey_decision.TileConcern(tile, ['=x"\ny'], one.failures, one.failures, None, None)
        for tile in ("9,0", "1,0", "5,0")
    ]
    places = {concern.tile: (10.0 * int(concern.tile[0]), 0.0) for concern in found}
    way = resurvey_decision.route(found, places)
    assert [point.tile for point in way] == ["0,0", "1,0", "5,0", "9,0"]
    rows = [*csv.reader(resurvey_decision.route_csv(way).splitlines())]
    assert len(rows) == 5 and rows[2] == ["2", "10.000", "0.000", "1,0", "'=x\" y"], "no formula of a spreadsheet"
    document = json.loads(json.dumps(resurvey_decision.route_geojson("lab", 3, way)))
    assert document["type"] == "FeatureCollection"
    assert document["features"][-1]["geometry"]["coordinates"] == [[0.0, 0.0], [10.0, 0.0], [50.0, 0.0], [90.0, 0.0]]
    assert len(resurvey_decision.route_geojson("lab", 3, way[:1])["features"]) == 1


def test_a_store_leads_to_where_the_survey_stood(tmp_path: Path) -> None:
    now_ns = 490_000 * HOUR_NS
    with MapStore.open(tmp_path, create=True, clock_ns=lambda: now_ns) as store:
        save_sample_draft(store)
        batch = FleetBatch()
        batch.add("lab", "tile", "1,0", 489_990, counts(20))
        batch.add("lab", "tile", "1,0", 489_990 - 24 * 7, counts(2, 100.0))
        batch.add("lab", "tile", "0,0", 489_990, counts(0, 30.0))
        store.fleet.add(batch)
        assert resurvey_list(store, "lab", SETTINGS, now_ns).route == []  # nothing is published yet
        releases.publish(store, "lab")
        found = resurvey_list(store, "lab", SETTINGS, now_ns)
        assert [concern.tile for concern in found.tiles] == ["1,0"]
        assert found.tiles[0].failures_before.events == 2
        (point,) = found.route
        assert math.isfinite(point.x_map_m) and math.isfinite(point.y_map_m)
        assert resurvey_list(store, "lab", SETTINGS, now_ns + 400 * 24 * HOUR_NS).tiles == []
