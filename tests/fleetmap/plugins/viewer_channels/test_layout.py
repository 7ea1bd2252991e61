"""The layout in `deploy/` shows channels that there are, and every panel stands in it."""

import json
from collections.abc import Iterator
from typing import Any

from fleetmap.plugins.viewer_channels.channels import CHANNELS
from support.fleet.contracts_documents import REPOSITORY

LAYOUT = json.loads((REPOSITORY / "deploy" / "foxglove-layout.json").read_text("utf-8"))


def words(value: Any) -> Iterator[str]:
    """All keys and strings."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from words(item)
    elif isinstance(value, list):
        for item in value:
            yield from words(item)
    elif isinstance(value, str):
        yield value


def test_it_shows_every_channel_that_there_is() -> None:
    assert {word for word in words(LAYOUT) if word.startswith("/")} == set(CHANNELS) - {"/tf"}, (
        "frames are always drawn"
    )


def test_every_panel_stands_in_it_once() -> None:
    tabs = [panel["tabs"] for name, panel in LAYOUT["configById"].items() if name.startswith("Tab!")]
    placed = [word for word in words([LAYOUT["layout"], tabs]) if "!" in word]
    assert sorted(placed) == sorted(LAYOUT["configById"])
