"""A publisher of signed lists and a robot that reads them, over both buses."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.bus import Bus
from support.fleet.list_publisher import ListPublisher, ListReader, bus_pair, reading


@pytest.fixture(scope="module", params=["memory", "zenoh"])
def buses(request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
    with bus_pair(request.param) as pair:
        yield pair


@pytest.fixture
def publisher() -> ListPublisher:
    return ListPublisher()


@pytest.fixture
def robot(publisher: ListPublisher, buses: tuple[Bus, Bus], tmp_path: Path) -> Iterator[ListReader]:
    with reading(publisher, buses, tmp_path / "lists") as reader:
        yield reader
