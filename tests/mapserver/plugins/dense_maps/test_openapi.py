"""What the OpenAPI document says of dense maps holds."""

from pathlib import Path

import numpy as np
import pytest

from mapserver.store import MapStore
from support.fleet.asked_api import answers
from support.storage.dense_samples import save_session_pictures, surfel_extras, wall
from support.storage.map_samples import save_grid_draft
from support.storage.room_sessions import session_at


def fill(store: MapStore) -> None:
    """Version 3 with grid and surfels, 4 with pictures."""
    extras, said = surfel_extras(wall())
    save_grid_draft(store, site="hall", extras=extras, surfels=said)
    save_session_pictures(store, [session_at([np.eye(4)], has_depth=True)], site="hall")


def chosen(label: str) -> dict[str, int]:
    """The versions that have it; few questions would be answered otherwise."""
    if "/changes." in label:
        return {"before": 3, "after": 3}
    return {"version": 4} if label.endswith("/pictures") else {}


def test_no_question_breaks_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answers(tmp_path, monkeypatch, fill, chosen, r"/(grid|view|changes|expected)\.|/pictures(/\{sha256\})?$")
    assert len(asked) >= 8
    for label, statuses in asked.items():
        if label.endswith("/changes.geojson"):  # it shares a rate with changes.png, which was asked before
            continue
        assert "{sha256}" in label or 200 in statuses, f"{label}: {statuses}"
