"""Manifests as canonical JSON."""

import json
from typing import Annotated

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleetmap.errors import MapFormatError, UsageError
from fleetmap.mapformat.manifest import (
    BlobEntry,
    CameraEntry,
    Manifest,
    Name,
    RecordingEntry,
    TileEntry,
    decode_manifest,
    encode_manifest,
    map_errors_of,
)
from fleetmap.mapformat.names import (
    NAME_PATTERN,
    blob_path,
    check_name,
    check_sha256,
    current_path,
    sha256_hex,
    verified,
)
from fleetmap.mapformat.version_file import ExportHead
from support.fleet.contracts_documents import REPOSITORY

GOLDEN = REPOSITORY / "tests" / "golden"
MANIFEST = Manifest(
    site="hall-3",
    version=2,
    parent=1,
    created="2026-01-02T03:04:05Z",
    tile_size_m=16.0,
    tiles=(
        TileEntry(x=0, y=-1, sha256="0" * 64, bytes=100, landmarks=3),
        TileEntry(x=0, y=0, sha256="1" * 64, bytes=50, landmarks=4),
    ),
    vocabulary=BlobEntry(sha256="a" * 64, bytes=10),
    camera=CameraEntry(focal_px=450.0, width_px=752, height_px=480, baseline_m=0.11),
    recordings=(RecordingEntry(name="walk", sha256="b" * 64, frames=9),),
    configuration={"b": {"y": 1, "x": 2.5}, "a": [1, 2]},
    libraries={"numpy": "2.4"},
    report={"path_m": 12.5},
)


def test_round_trip_and_sums() -> None:
    data = encode_manifest(MANIFEST)
    assert decode_manifest(data) == MANIFEST
    assert encode_manifest(decode_manifest(data)) == data
    assert (MANIFEST.landmarks, MANIFEST.tile_bytes) == (7, 150)


def test_it_says_how_wrong_each_tile_may_be() -> None:
    told = msgspec.structs.replace(MANIFEST, report={"map_errors": {"0,-1": [0.001, 0.004, 0.002]}})
    errors = map_errors_of(decode_manifest(encode_manifest(told)))
    assert errors.sigmas(np.array([3.0, -0.1, 9.0])).tolist() == [0.001] * 3 + [0.004] * 2 + [0.002]
    assert errors.sigmas(np.array([3.0, 0.1, 0.0])).tolist() == [0.006] * 3 + [0.02] * 3
    for place, wrong in (("0,0", [0.0, 0.1, 0.1]), ("0,0", [0.1] * 2), ("0;0", [0.1] * 3), ("\u0663,0", [0.1] * 3)):
        with pytest.raises(MapFormatError, match="map_errors"):
            decode_manifest(encode_manifest(msgspec.structs.replace(MANIFEST, report={"map_errors": {place: wrong}})))


def test_bytes_do_not_depend_on_the_order_of_keys() -> None:
    data = encode_manifest(MANIFEST)
    turned = decode_manifest(json.dumps(dict(reversed(json.loads(data).items()))).encode())
    turned.configuration["b"] = {"x": 2.5, "y": 1}
    assert encode_manifest(turned) == data
    assert b'"configuration":{"a":[1,2],"b":{"x":2.5,"y":1}}' in data


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("site", "../etc"),
        ("version", 0),
        ("tile_size_m", 0),
        ("vocabulary", {"sha256": "../../x", "bytes": 1}),
        ("tiles", [{"x": 0, "y": 0, "sha256": "0" * 64, "bytes": -1, "landmarks": 1}]),
        ("unknown", 1),
        ("created", None),
        ("configuration", {"building": {"x_m": "1", "y_m": 0, "yaw_rad": 0}}),
        ("configuration", {"building": {"x_m": 1, "y_m": 0, "yaw_rad": 7}}),
    ],
)
def test_damaged_manifests_are_refused(key: str, value: object) -> None:
    damaged = json.loads(encode_manifest(MANIFEST)) | {key: value}
    with pytest.raises(MapFormatError, match=key):
        decode_manifest(json.dumps(damaged).encode())


def test_names_and_addresses() -> None:
    assert current_path("lab_1") == "sites/lab_1/current"
    assert blob_path("ab" * 32) == "blobs/ab/" + "ab" * 32
    for name in ("", "Lab", "a/b", "..", "-a", "a" * 65, "a b", "lab\n"):
        with pytest.raises(UsageError, match="site name"):
            check_name(name, "site")
    for sha256 in ("", "g" * 64, "A" * 64, "0" * 63, "0" * 64 + "\n"):
        with pytest.raises(MapFormatError, match="SHA-256"):
            blob_path(sha256)
    assert verified(b"x", sha256_hex(b"x")) == b"x"
    with pytest.raises(MapFormatError, match="damaged"):
        verified(b"y", sha256_hex(b"x"))


STRANGE = ["hall\n", "hall\r\n", "../hall", "hall/..", ".", "-hall", "hall\0", "HALL", "a" * 65, "hall ", "hàll"]
WORDS = st.text(alphabet=st.characters(codec="utf-8"), max_size=70) | st.sampled_from(STRANGE)


@given(site=WORDS | st.from_regex(r"[a-z0-9][a-z0-9_-]{0,63}\n?", fullmatch=True), end=st.sampled_from(["", "\n", " "]))
def test_whatever_decodes_has_names_that_fit_paths(site: str, end: str) -> None:
    """Row 17 of docs/security.md."""
    content = msgspec.json.decode((GOLDEN / "manifest-1.json").read_bytes())
    content["site"] = site
    content["vocabulary"]["sha256"] += end
    try:
        manifest = decode_manifest(msgspec.json.encode(content))
    except MapFormatError:
        return
    assert check_name(manifest.site, "site") == site
    assert check_sha256(manifest.vocabulary.sha256)
    assert all(check_sha256(tile.sha256) for tile in manifest.tiles)


def test_a_pattern_that_ends_in_a_dollar_lets_a_line_break_through() -> None:
    """The control: why the patterns of the formats end otherwise."""
    loose = Annotated[str, msgspec.Meta(pattern=NAME_PATTERN)]
    assert msgspec.json.decode(b'"hall\\n"', type=loose) == "hall\n"
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'"hall\\n"', type=Name)
    head = {"site": "hall\n", "version": 1, "blobs": []}
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(msgspec.json.encode(head), type=ExportHead)
