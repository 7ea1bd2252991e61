"""Files of every released format are read by the code of today; newer ones are refused by naming what reads them."""

import importlib
import json
import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.errors import NewerFormatError
from fleetmap.mapformat.container import pack
from fleetmap.mapformat.manifest import MANIFEST_FORMAT, decode_manifest, encode_manifest
from fleetmap.mapformat.tile import TILE_FORMAT, decode_tile
from fleetmap.mapformat.version_file import EXPORT_FORMAT
from fleetmap.messages import decode_message, encode_message
from fleetmap.version_grid import known_grid
from mapserver import releases
from mapserver.store import Actor, MapStore
from mapserver.store.archive import ARCHIVE_FORMAT, decode_archive

GOLDEN = Path(__file__).parents[2] / "golden"


def test_every_format_has_its_file() -> None:
    files = f"tile-{TILE_FORMAT}.fmtl", f"manifest-{MANIFEST_FORMAT}.json", f"archive-{ARCHIVE_FORMAT}.fmar"
    for name in (*files, f"version-{EXPORT_FORMAT}.fmex"):
        assert (GOLDEN / name).is_file(), f"{name}: python -m golden.add adds the newest"


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("tile-*.fmtl")), ids=lambda file: file.stem)
def test_tiles(file: Path) -> None:
    tile = decode_tile(file.read_bytes())
    wanted = json.loads(file.with_suffix(".json").read_text())
    assert [tile.tile_x, tile.tile_y] == wanted["cell"]
    assert tile.size_m == wanted["size_m"]
    assert tile.landmark_ids.tolist() == wanted["landmark_ids"]
    assert tile.points_map.tolist() == wanted["points_map"]
    assert [bytes(row).hex() for row in tile.descriptors] == wanted["descriptors"]
    assert tile.place_ids.tolist() == wanted["place_ids"]
    np.testing.assert_allclose(tile.map_from_cam, wanted["map_from_cam"], atol=1e-12)


@pytest.mark.parametrize(("name", "data"), json.loads((GOLDEN / "messages-1.json").read_text()).items())
def test_messages_of_older_robots_and_servers_are_read_and_what_is_written_has_all_their_fields(
    name: str, data: str
) -> None:
    module, _, kind = name.rpartition(".")
    message_type = getattr(importlib.import_module(module), kind)
    older = bytes.fromhex(data)
    written = encode_message(decode_message(older, message_type))
    assert_holds(msgspec.msgpack.decode(written), msgspec.msgpack.decode(older))


def assert_holds(written: object, older: object) -> None:
    """Every field of the older one is there with its value; others are beside them, which older programs pass over."""
    if isinstance(older, dict) and isinstance(written, dict):
        for key, value in older.items():
            assert_holds(written[key], value)
    else:
        assert written == older


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("manifest-*.json")), ids=lambda file: file.stem)
def test_manifests(file: Path) -> None:
    data = file.read_bytes()
    manifest = decode_manifest(data)
    assert (manifest.site, len(manifest.tiles), manifest.landmarks) == ("lab", 2, 16)
    assert manifest.report == {"path_m": 12.5}
    if manifest.format_version == MANIFEST_FORMAT:
        assert encode_manifest(manifest) == data


@pytest.mark.parametrize("file", sorted(GOLDEN.glob("archive-*.fmar")), ids=lambda file: file.stem)
def test_archives(file: Path) -> None:
    survey = decode_archive(file.read_bytes())
    assert len(survey.landmark_ids) == 8
    assert survey.map_from_body.shape == (3, 4, 4)


def test_exports(store: MapStore) -> None:
    info = store.import_version(GOLDEN / f"version-{EXPORT_FORMAT}.fmex", actor=Actor("ada"))
    assert list(known_grid(store.manifest("lab", 1), store.blob)) == [(0, 0)]
    assert (info.site, info.version, info.state, info.tiles) == ("lab", 1, "draft", 2)
    assert store.archive("lab", 1) == b"archive 1"
    assert releases.publish(store, "lab") == 1
    assert store.verify().faults == []


def test_newer_formats_are_refused_by_number(store: MapStore, tmp_path: Path) -> None:
    with pytest.raises(NewerFormatError, match=f"format {TILE_FORMAT + 1}.*up to {TILE_FORMAT}"):
        decode_tile(pack(b"FMTL", TILE_FORMAT + 1, b""))
    with pytest.raises(NewerFormatError, match=f"format {ARCHIVE_FORMAT + 1}.*up to {ARCHIVE_FORMAT}"):
        decode_archive(pack(b"FMAR", ARCHIVE_FORMAT + 1, b""))
    with pytest.raises(NewerFormatError, match=f"format {MANIFEST_FORMAT + 1}.*up to {MANIFEST_FORMAT}"):
        decode_manifest(b'{"format_version": %d}' % (MANIFEST_FORMAT + 1))
    export = bytearray((GOLDEN / f"version-{EXPORT_FORMAT}.fmex").read_bytes())
    struct.pack_into("<H", export, 4, EXPORT_FORMAT + 1)
    (tmp_path / "newer.fmex").write_bytes(export)
    with pytest.raises(NewerFormatError, match=f"format {EXPORT_FORMAT + 1}.*up to {EXPORT_FORMAT}"):
        store.import_version(tmp_path / "newer.fmex")
    assert store.sites() == []
