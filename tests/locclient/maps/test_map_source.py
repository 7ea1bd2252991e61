"""A store's folder as the source of maps: no store, nothing published, damaged files."""

from pathlib import Path

import pytest

from fleetmap.errors import StoreError
from locclient.maps.map_source import LocalMapSource


def test_a_folder_without_sites_is_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="not a map store"):
        LocalMapSource(tmp_path, "lab")


def test_a_damaged_current_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "sites" / "lab").mkdir(parents=True)
    source = LocalMapSource(tmp_path, "lab")
    assert source.wanted().manifest_sha256 is None
    (tmp_path / "sites" / "lab" / "current").write_bytes(b"\xff\xfe nonsense")
    with pytest.raises(StoreError, match="repair"):
        source.wanted()
    with pytest.raises(StoreError, match="incomplete"):
        source.blob("0" * 64)
