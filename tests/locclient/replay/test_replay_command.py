"""`locclient replay`: wrong orders end with 2, bad input with 3, each with what to do next, and before any work."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from locclient.localization.priors.given import parse_prior
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import LocalMapSource
from mapserver.store import MapStore
from support.command_line import status
from support.recordings.recording_samples import calibration, make_sample, write_euroc, write_mcap
from support.storage.map_samples import publish_samples, save_sample_draft
from support.worlds import robot_world
from support.worlds.building import strange

Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "walk", make_sample(3))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("store") / "store"
    with MapStore.open(folder, create=True) as maps:
        publish_samples(maps, 1)
        save_sample_draft(maps, seed=2)
        save_sample_draft(maps, site="draft-only")
    return folder


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--store", "STORE"], "--site"),
        (["--site", "lab"], "--server"),
        (["--site", "lab", "--store", "STORE", "--server", "tcp/127.0.0.1:1"], "either"),
        (["--site", "La b", "--store", "STORE"], "La b"),
        (["--site", "lab", "--store", "STORE", "--frames", "1:2:x"], "1:2:x"),
        (["--site", "lab", "--store", "STORE", "--frames", "70:"], "70"),
        (["--site", "lab", "--store", "STORE", "--prior", "1,2,3"], "X,Y,YAW,SIGMA_M"),
        (["--site", "lab", "--store", "STORE", "--prior", "1,2,3,x"], "1,2,3,x"),
        (["--site", "lab", "--store", "STORE", "--prior", "1,2,3,0"], "positive"),
        (["--site", "lab", "--server", "nonsense"], "nonsense"),
        (["--site", "lab", "--store", "STORE", "--colour"], "--colour"),
        (["--site", "lab", "--store", "STORE", "--version", "7"], "it has: 1, 2"),
        (["--site", "lab", "--server", "tcp/127.0.0.1:1", "--version", "1"], "--store"),
    ],
)
def test_wrong_orders_end_with_2(walk: Path, store: Path, capsys: Said, arguments: list[str], said: str) -> None:
    given = [str(store) if argument == "STORE" else argument for argument in arguments]
    assert status("locclient", "replay", walk, *given) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert "Traceback" not in told.err + told.out


def test_any_version_of_a_store_can_be_replayed_in(store: Path) -> None:
    for site, version, sha256 in (("lab", None, 1), ("lab", 1, 1), ("lab", 2, 2), ("draft-only", 1, 1)):
        wanted = LocalMapSource(store, site, version).ready().wanted
        with MapStore.open(store, read_only=True) as maps:
            assert wanted.manifest_sha256 == maps.version(site, sha256).manifest_sha256


def test_bad_input_ends_with_3(
    walk: Path, store: Path, tmp_path: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(MapClient.__init__.__kwdefaults__, "timeout_s", 0.3)
    (tmp_path / "empty").mkdir()
    (tmp_path / "zero.mcap").write_bytes(b"")
    (tmp_path / "calibration.yaml").write_text("cam0: 7\n")
    for arguments, said in (
        ([tmp_path / "missing", "--site", "lab", "--store", store], "does not exist"),
        ([tmp_path / "empty", "--site", "lab", "--store", store], "empty"),
        ([tmp_path / "zero.mcap", "--site", "lab", "--store", store], "zero.mcap"),
        ([walk, "--site", "lab", "--store", tmp_path / "nostore"], "nostore"),
        ([walk, "--site", "draft-only", "--store", store], "draft-only"),
        ([walk, "--site", "elsewhere", "--store", store], "elsewhere"),
        ([walk, "--site", "lab", "--store", store, "--calibration", tmp_path / "calibration.yaml"], "calibration.yaml"),
        ([walk, "--site", "lab", "--server", "tcp/127.0.0.1:1", "--cache", tmp_path], "is the server running"),
    ):
        assert status("locclient", "replay", *arguments) == 3, arguments
        told = capsys.readouterr()
        assert said in told.err, told.err
        assert "Traceback" not in told.err + told.out


def test_the_file_gives_defaults_and_knows_its_keys(walk: Path, store: Path, tmp_path: Path, capsys: Said) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(f'[replay]\nsite = "elsewhere"\nstore = "{store}"\n')
    assert status("locclient", "replay", walk, "--config", file) == 3
    assert "elsewhere" in capsys.readouterr().err
    assert status("locclient", "replay", walk, "--config", file, "--site", "other") == 3
    assert "other" in capsys.readouterr().err
    file.write_text('[replay]\nsight = "lab"\n')
    assert status("locclient", "replay", walk, "--config", file) == 2
    assert "sight" in capsys.readouterr().err


def test_a_prior_is_a_place_of_the_base_with_a_doubt() -> None:
    prior = parse_prior("1.5,-2,1.5707963267948966,0.4")
    np.testing.assert_allclose(prior.map_from_base[:3, 3], [1.5, -2.0, 0.0])
    np.testing.assert_allclose(prior.map_from_base[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(prior.cov_rot_trans[3:5, 3:5], 0.16 * np.eye(2))
    assert np.isinf(np.diag(prior.cov_rot_trans)[[0, 1, 2, 5]]).all()
    assert parse_prior(None) is None


@pytest.mark.parametrize("text", ["nan,0,0,1", "0,inf,0,1", "0,0,nan,1", "0,0,0,nan", "0,0,0,inf", "0,0,0,-1", ""])
def test_numbers_that_are_no_place_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_prior(text)


@pytest.mark.parametrize("option", ["--report", "--trajectory", "--picture"])
def test_files_that_cannot_be_written_are_told_before_the_work(
    walk: Path, store: Path, tmp_path: Path, capsys: Said, option: str
) -> None:
    to_store = ("--site", "lab", "--store", store)
    assert status("locclient", "replay", walk, *to_store, option, tmp_path / "missing/file.png") == 2
    assert option in capsys.readouterr().err
    if option == "--picture":
        assert status("locclient", "replay", walk, *to_store, option, tmp_path / "picture.txt") == 2
        assert option in capsys.readouterr().err


def test_a_robot_of_another_building_says_so_and_ends_with_6(tmp_path: Path, capsys: Said) -> None:
    ride, report = robot_world.write(tmp_path / "ride", robot_world.bundles(120)), tmp_path / "report.json"
    store = robot_world.stored(tmp_path / "store", of=strange(robot_world.tiles()))
    assert status("locclient", "replay", ride, "--store", store, "--site", "room", "--report", report) == 6
    words = "nothing in the map agrees with the pictures"
    assert words in capsys.readouterr().err
    found = json.loads(report.read_text())
    assert found["localised_share_of_all"] == 0.0
    assert found["not_localised_m"] > 5.0
    assert [note for note in found["notes"] if words in note]


def test_frames_that_cannot_be_decoded_are_left_out(tmp_path: Path, capsys: Said) -> None:
    """The Huffman tables of JPEG files are destroyed, which no reader notices before decoding."""
    store, report = robot_world.stored(tmp_path / "store"), tmp_path / "report.json"
    walk = write_euroc(tmp_path / "walk", make_sample(3), image_type="jpg")
    files = sorted((walk / "mav0/cam0/data").iterdir())
    for number, count in ((1, 1), (0, 2)):
        data = bytearray(files[number].read_bytes())
        at = data.index(b"\xff\xc4") + 5
        data[at : at + 16] = b"\xff" * 16
        files[number].write_bytes(data)
        ended = status("locclient", "replay", walk, "--site", "room", "--store", store, "--report", report)
        told = capsys.readouterr()
        assert ended == (0 if count == 1 else 3), told.err
        if count == 1:
            (note,) = (note for note in json.loads(report.read_text())["notes"] if "left out" in note)
            assert note.startswith(f"{count} of 3 frames are left out; the first: {files[number]}")
    assert re.search("2 of 3 frames cannot be read; the first: .*image0.jpg: ", told.err)


def test_a_rig_whose_covered_front_is_faster_than_its_rear_is_replayed(tmp_path: Path) -> None:
    """Frames in which the followed view has no image are left out."""
    known, report = calibration(), tmp_path / "report.json"
    rig = replace(known, cameras=robot_world.turned(known.cameras) + known.cameras)
    with McapRecordingWriter(tmp_path / "rig.mcap", rig) as writer:
        for number, bundle in enumerate(robot_world.bundles(50)):
            dark = np.zeros_like(bundle.frame.left)
            seen = replace(bundle.frame, left=dark, right=dark, others=(None if number % 2 else bundle.frame,))
            writer.write_imu(bundle.imu)
            writer.write_frame(seen)
    arguments = "--site", "room", "--store", robot_world.stored(tmp_path / "store"), "--report", report
    assert status("locclient", "replay", tmp_path / "rig.mcap", *arguments) == 0
    found = json.loads(report.read_text())
    assert 20 <= found["frames"] <= 30
    assert found["localised_share_of_all"] > 0.5
