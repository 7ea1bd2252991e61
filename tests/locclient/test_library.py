"""locclient as a library: the two documented ways to a pose."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import FleetmapError
from fleetmap.messages import Status
from fleetmap.recordings import open_recording
from locclient import LocalizeOptions, LocalizerSettings, MapView, Relocalizer, fetch_map, finished, localize
from locclient.maps.map_client import MapClient
from support.recordings.recording_samples import write_mcap
from support.worlds import robot_world

FRAMES = 40


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return robot_world.stored(tmp_path_factory.mktemp("maps") / "store")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("drive"), robot_world.cycle())


def test_a_recording_is_localized_in_a_store(drive: Path, store: Path, tmp_path: Path) -> None:
    seen: list[int] = []
    options = LocalizeOptions(frames=f":{FRAMES}", progress=seen.append)
    result = localize(drive, store, robot_world.SITE, options=options)
    assert seen == list(range(FRAMES))
    assert result.map_from_body.shape == (FRAMES, 4, 4)
    assert result.cov_rot_trans.shape == (FRAMES, 6, 6)
    assert result.statuses[-1] is Status.TRACKING
    truth = np.array([robot_world.truth(number) for number in range(FRAMES)])
    tracking = [status is Status.TRACKING for status in result.statuses]
    assert np.linalg.norm((result.map_from_body - truth)[tracking, :3, 3], axis=1).max() < 0.1
    assert result.report["frames"] == len(result.stamps_ns) == FRAMES
    assert len(result.trajectory.stamps_ns) == sum(tracking)
    result.save_picture(tmp_path / "drive.png")
    assert (tmp_path / "drive.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(FleetmapError, match="missing"):
        result.save_picture(tmp_path / "missing/drive.png")
    with open_recording(drive) as recording:
        again = localize(recording, str(store), robot_world.SITE, options=LocalizeOptions(frames=f":{FRAMES}"))
    np.testing.assert_array_equal(again.map_from_body, result.map_from_body)


def test_what_cannot_be_had_is_said(drive: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MapClient.__init__.__kwdefaults__, "timeout_s", 0.3)
    for recording, maps, site, words in (
        (tmp_path / "nowhere", store, robot_world.SITE, "nowhere"),
        (drive, tmp_path / "nostore", robot_world.SITE, "nostore"),
        (drive, store, "elsewhere", "elsewhere"),
        (drive, "tcp/127.0.0.1:1", robot_world.SITE, "is the server running"),
    ):
        with pytest.raises(FleetmapError, match=words):
            localize(recording, maps, site, options=LocalizeOptions(cache=tmp_path / "cache"))


def test_one_frame_is_relocalized_without_odometry(store: Path) -> None:
    loaded = fetch_map(store, robot_world.SITE)
    view = MapView(loaded.tiles.values(), loaded.vocabulary, loaded.manifest.camera.focal_px)
    rectifier = robot_world.rectifier()
    relocalizer = Relocalizer(view, rectifier.camera, LocalizerSettings().relocalizer)
    bundle = list(robot_world.bundles(31))[30]
    query = finished(relocalizer.extract(rectifier.rectify(bundle.frame)))
    best = finished(relocalizer.anywhere(query))[0]
    map_from_body = best.map_from_cam @ np.linalg.inv(rectifier.body_from_cam)
    assert np.linalg.norm(map_from_body[:3, 3] - robot_world.truth(30)[:3, 3]) < 0.05
