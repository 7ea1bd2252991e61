"""The API of site `lab` for a client in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from support.fleet.served_api import Server, served_api


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served_api(tmp_path) as made:
        yield made
