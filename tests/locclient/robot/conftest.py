"""The store of a server with the map of robot_world's room."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from mapserver.store import MapStore
from support.worlds import robot_world


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(robot_world.stored(tmp_path / "store")) as maps:
        yield maps
