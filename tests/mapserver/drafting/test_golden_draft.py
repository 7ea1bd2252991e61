"""A draft of a fixed survey is the same to the byte as ever: one golden tile and manifest.

`SNAPSHOTS=write python -m pytest tests/mapserver/drafting/test_golden_draft.py` writes them anew, where a change of the map is wanted.
"""

import os
from pathlib import Path

import numpy as np

from mapserver.store import DraftContent, MapStore
from mapserver.survey.settings import BudgetSettings
from mapserver.tiles.tiling import choose_landmarks, tiles_from_survey
from support.storage.map_samples import draft_details, random_survey

GOLDEN = Path(__file__).parents[2] / "golden"


def test_the_draft_of_a_fixed_survey_is_the_golden_one(store: MapStore) -> None:
    survey = random_survey(np.random.default_rng(11), keyframes=6, landmarks=80)
    budget = BudgetSettings(min_landmarks=60, landmarks_per_m=0.1, view_landmarks=20, view_distinctive_landmarks=10)
    chosen = choose_landmarks(survey, budget)
    tiles = tiles_from_survey(survey, chosen=chosen)
    store.save("lab", DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(path_m=12.5)))
    manifest = store.blob(store.version("lab", 1).manifest_sha256)
    largest = max(store.manifest("lab", 1).tiles, key=lambda entry: entry.landmarks)
    tile = store.blob(largest.sha256)
    assert chosen.sum() == 60
    for name, data in (("draft-tile.fmtl", tile), ("draft-manifest.json", manifest)):
        if os.environ.get("SNAPSHOTS") == "write":
            (GOLDEN / name).write_bytes(data)
        assert data == (GOLDEN / name).read_bytes(), name
