"""Hostile manifests, tiles, archives and exports are read or refused; `make bench` tries many more."""

from pathlib import Path

import pytest

from support.storage.fuzzed_formats import FORMATS, fuzz


@pytest.mark.parametrize("name", FORMATS)
def test_nothing_from_outside_breaks_the_reader(name: str, tmp_path: Path) -> None:
    found = fuzz(name, 150, tmp_path)
    assert found["inputs"] >= 120
    assert found["refused"] > found["inputs"] / 4
