"""`mapserver build` from the command line, on a small recording that holds its own truth."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.bow.vocabulary import DEFAULT_VOCABULARY_SHA256, decode_vocabulary
from fleetmap.errors import FleetmapError, RecordingError, StoreError, UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.tile import decode_tile
from mapserver.cli import app
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive
from support.plugins import needs_plugin
from support.recordings.recording_samples import make_sample, write_euroc, write_mcap
from support.room_site import invoke, run

FRAMES = 24
SAMPLE = make_sample(FRAMES)
KEYS = [
    *("recordings", "duration_s", "seconds", "realtime_factor", "path_m", "keyframes", "landmarks", "map_bytes"),
    *("loops", "ate_rmse_m", "ate_sim3_rmse_m", "evaluated_share", "scale", "scale_error"),
    *("peak_rss_mb", "findings", "corrections", "culled", "sessions", "joins", "directions"),
    *("starts", "views", "lookalike_recall", "alias_step_m", "grid", "surfels", "pictures", "surveyed_requests"),
    *("removed_landmarks", "map_errors"),
]
NOT_FOR_ROBOTS = {"map_bytes", "culled", "sessions", "directions", "starts", "views"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "walk", SAMPLE)


def built(*arguments: object) -> str:
    return run(app, "build", *arguments)


def refused(*arguments: object) -> FleetmapError:
    result = invoke(app, "build", *arguments)
    assert isinstance(result.exception, FleetmapError), result.output
    return result.exception


def read_tum(path: Path) -> Array:
    """(F, 8) t x y z qx qy qz qw."""
    return np.loadtxt(path, comments="#", ndmin=2)


@pytest.fixture(scope="module")
def done(drive: Path, tmp_path_factory) -> Path:
    """A folder with everything that one build in the truth's frame leaves."""
    out = tmp_path_factory.mktemp("out")
    files = ["--report", out / "r.json", "--trajectory-out", out / "t.tum", "--picture", out / "p.png"]
    said = built(drive, "--site", "lab", "--store", out / "store", "--frame-from-ground-truth", *files)
    assert "draft 1" in said
    assert "mapserver publish --site lab" in said
    return out


@needs_plugin("dense_maps", "mapserver.stages")
def test_the_report_has_the_stable_keys_with_their_meanings(done: Path) -> None:
    """Against the files that the same build left, counted independently."""
    report = json.loads((done / "r.json").read_text())
    assert [key for key in KEYS if key in report] == KEYS
    positions = read_tum(done / "t.tum")[:, 1:4]
    assert len(positions) == report["frames"] == FRAMES
    assert report["recordings"] == ["walk"]
    assert report["duration_s"] == pytest.approx((FRAMES - 1) * 0.05)
    assert report["path_m"] == pytest.approx(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum(), abs=1e-4)
    assert report["realtime_factor"] == pytest.approx(report["duration_s"] / report["seconds"], rel=0.01)
    assert set(report["loops"]) == {"candidates", "gated_out", "rejected", "accepted"}
    assert report["evaluated_share"] == 1.0
    assert 50 < report["peak_rss_mb"] < 20_000
    assert report["seconds"] == pytest.approx(sum(report["stage_s"].values()), rel=0.5)
    with MapStore.open(done / "store") as maps:
        manifest = maps.manifest("lab", 1)
        sizes = [len(maps.blob(tile.sha256)) for tile in manifest.tiles]
        landmarks = sum(len(decode_tile(maps.blob(tile.sha256)).landmark_ids) for tile in manifest.tiles)
        manifest_bytes = len(maps.blob(maps.version("lab", 1).manifest_sha256))
        assert report["map_bytes"] == sum(sizes) + manifest_bytes
        assert report["landmarks"] == landmarks > 100
        assert decode_vocabulary(maps.blob(manifest.vocabulary.sha256)).word_count == 10_000
        archive = maps.archive("lab", 1)
    assert len(decode_archive(archive).map_from_body) == report["keyframes"]


def test_the_store_notes_the_build_as_a_job_with_its_loops_on_the_map(done: Path) -> None:
    report = json.loads((done / "r.json").read_text())
    with MapStore.open(done / "store") as store:
        (job,) = store.jobs("lab")
    assert (job.kind, job.state, job.report["version"]) == ("build", "done", 1)
    assert job.message.startswith("site lab: draft 1")
    assert job.report["findings"] == report["findings"]
    shown = job.report["loop_places"]
    for verdict in ("accepted", "rejected", "ambiguous", "gated_out"):
        told = [record for record in report["loop_records"] if record["verdict"] == verdict]
        assert sum(place["verdict"] == verdict for place in shown) == min(len(told), 300)
    path_m = read_tum(done / "t.tum")[:, 1:3]
    for place in shown:
        for end in (place["from_map_m"], place["to_map_m"]):
            assert np.linalg.norm(path_m - end, axis=1).min() < 1e-3


@needs_plugin("dense_maps", "mapserver.stages")
def test_the_manifest_tells_what_the_map_depends_on(done: Path) -> None:
    with MapStore.open(done / "store") as maps:
        manifest = maps.manifest("lab", 1)
    report = json.loads((done / "r.json").read_text())
    assert manifest.report.pop("evidence")["calibrations"], "what the gate of another store judges by"
    assert manifest.report == {key: report[key] for key in KEYS if key not in NOT_FOR_ROBOTS}
    assert manifest.configuration["survey"]["keyframes"]["policy"] == "overlap"
    assert set(manifest.libraries) == {"numpy", "opencv-python-headless", "gtsam", "scipy", "fleetmap"}
    assert [(r.name, r.frames) for r in manifest.recordings] == [("walk", FRAMES)]
    assert str(done) not in str(manifest)


def test_the_map_lies_in_the_frame_of_the_truth(done: Path) -> None:
    """Without any alignment, errors are hardly larger than the aligned ones: rotations decide the turn about a straight walk."""
    truth = np.array(SAMPLE.world_from_body)[:, :3, 3]
    errors_m = np.linalg.norm(read_tum(done / "t.tum")[:, 1:4] - truth, axis=1)
    ate_m = json.loads((done / "r.json").read_text())["ate_rmse_m"]
    assert ate_m <= np.sqrt(np.mean(errors_m**2)) < 1.5 * ate_m
    assert ate_m < 0.02
    with MapStore.open(done / "store") as maps:
        tiles = [decode_tile(maps.blob(tile.sha256)) for tile in maps.manifest("lab", 1).tiles]
    points = np.concatenate([tile.points_map for tile in tiles])
    assert np.median(points[:, 2]) == pytest.approx(5.0, abs=0.1)  # the wall, in the axes of the first camera


def test_the_picture_shows_the_map_on_the_left_and_its_errors_on_the_right(done: Path) -> None:
    picture = cv2.imread(str(done / "p.png"))
    half = picture.shape[1] // 2

    def count(hexadecimal: str, part: NDArray[np.uint8]) -> int:
        return int((part == np.array(list(bytes.fromhex(hexadecimal)))[::-1]).all(axis=2).sum())

    left, right = picture[:, :half], picture[:, half:]
    assert count("14924b", left) > 100  # the start
    assert count("d1342f", left) > 100  # the end
    assert count("2563eb", right) > 500  # the errors
    assert count("14924b", right) + count("d1342f", right) == 0


def test_building_again_gives_the_same_tiles(drive: Path, done: Path, tmp_path: Path) -> None:
    common = [drive, "--site", "lab", "--frame-from-ground-truth", "--store"]
    built(*common, tmp_path, "--threads", 2)
    assert "draft 2" in built(*common, tmp_path, "--threads", 1)  # without a process beside it
    with MapStore.open(tmp_path) as maps, MapStore.open(done / "store") as before:
        first, second, other = maps.manifest("lab", 1), maps.manifest("lab", 2), before.manifest("lab", 1)
        assert maps.archive("lab", 1) == maps.archive("lab", 2)
        assert maps.evidence("lab", 1) == maps.evidence("lab", 2)
    assert first.tiles == second.tiles == other.tiles
    assert first.vocabulary.sha256 == second.vocabulary.sha256 == DEFAULT_VOCABULARY_SHA256


def test_without_truth_nothing_is_claimed(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "walk", SAMPLE)
    shutil.rmtree(folder / "mav0/state_groundtruth_estimate0")
    built(folder, "--site", "lab", "--store", tmp_path / "store", "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["ate_rmse_m"] is report["ate_sim3_rmse_m"] is report["evaluated_share"] is None
    error = refused(folder, "--site", "lab", "--store", tmp_path / "store", "--frame-from-ground-truth")
    assert isinstance(error, RecordingError)
    assert "no ground truth" in str(error)


def test_wrong_orders_are_refused_before_the_work(drive: Path, tmp_path: Path, monkeypatch) -> None:
    to_store = ["--site", "lab", "--store", tmp_path / "store"]
    for arguments, kind, said in (
        ([drive, "--site", "La b", "--store", tmp_path / "store"], UsageError, "La b"),
        ([drive, *to_store, "--report", tmp_path / "no/r.json"], UsageError, "--report"),
        ([drive, *to_store, "--trajectory-out", tmp_path], UsageError, "--trajectory-out"),
        ([drive, *to_store, "--picture", tmp_path / "p.jpg"], UsageError, ".png"),
        ([drive, *to_store, "--frames", "1:2:x"], UsageError, "1:2:x"),
        ([drive, *to_store, "--frames", "900:"], UsageError, "900"),
        ([drive, *to_store, "--frames", ":2", "--frame-from-ground-truth"], RecordingError, "2 of 2"),
        ([tmp_path / "nothing", *to_store], RecordingError, "nothing"),
    ):
        error = refused(*arguments)
        assert isinstance(error, kind)
        assert said in str(error)
    monkeypatch.setattr("mapserver.library.find_spec", lambda _: None)
    assert "gtsam" in str(invoke(app, "build", tmp_path / "nothing", *to_store).exception), "before a recording is read"
    assert not (tmp_path / "store").exists()


def test_a_place_that_is_no_store_is_refused(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert isinstance(refused(drive, "--site", "lab", "--store", tmp_path / "file"), StoreError)
