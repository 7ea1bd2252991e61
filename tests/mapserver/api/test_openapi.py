"""The OpenAPI document holds: whatever is asked as it allows (or not), the answers are as it says and never 500."""

from pathlib import Path

from support.fleet.asked_api import answers
from support.storage.map_samples import save_grid_draft


def test_no_question_breaks_the_server(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("mapserver.api.app.plugins", lambda _: {})  # a plug-in's tests ask its own
    asked = answers(tmp_path, monkeypatch, lambda store: save_grid_draft(store, site="hall"))
    assert sum(len(statuses) for statuses in asked.values()) >= 100
    for label, statuses in asked.items():
        is_known = "v1" in label and "{sha256}" not in label and not label.endswith(("/build", "/correct"))
        assert not is_known or {200, 201} & set(statuses), f"{label}: {statuses}"
