"""A failure's recording repeats what the robot said, within a centimetre; another map may say otherwise; what no robot wrote is refused."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import zstandard

from fleetmap.errors import RecordingError
from fleetmap.geometry import se3_inverse
from fleetmap.messages import FailureReport
from fleetmap.recordings import open_recording
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY, attachments_of
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.delivery.failure_file import failure_file, read_failure_file
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_source import LocalMapSource
from locclient.replay.failure_replay import SAME_M, Comparison, compare_failure
from locclient.replay.replay import load_map
from locclient.robot.robot import Robot
from mapserver.fleet import bounded_process
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from support.command_line import status
from support.fleet.failed_robot import failed, profile, send_replay
from support.recordings.recording_samples import calibration
from support.worlds import robot_world
from support.worlds.building import house, strange


@dataclass
class Carried:
    """A robot that was put down 2.4 m away."""

    folder: Path
    file: Path
    report: FailureReport
    said: list[str]

    def compare(self, manifest: str | None = None) -> Comparison:
        return compare_failure(read_failure_file(self.file), LocalMapSource(self.folder / "store", "room"), manifest)


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Carried:
    folder = tmp_path_factory.mktemp("carried")
    with MapStore.open(robot_world.stored(folder / "store")) as store:
        found = failed(robot_world.carried(140, 75), load_map(LocalMapSource(folder / "store", "room"))[0])
        # Version 2 lies half a metre higher: the same failure, other places.
        robot_world.save(store, of=robot_world.moved(np.array([0.0, 0.0, 0.5])))
    report, data, said = found
    (folder / "failure.mcap").write_bytes(data)
    return Carried(folder, folder / "failure.mcap", report, said)


def test_the_same_client_says_the_same(carried: Carried) -> None:
    found = carried.compare()
    assert [moment.status for moment in found.now] == carried.said
    assert len({*carried.said}) > 1, "the robot failed meanwhile"
    assert found.first_difference_ns is None
    assert found.apart_m <= SAME_M
    assert "gives the same result" in found.answer


def test_it_begins_where_the_recording_says(carried: Carried) -> None:
    summary, record = read_failure_file(carried.file)
    beside = np.array(record.start.map_from_body)
    beside[0, 3] += 0.3
    changed = msgspec.structs.replace(record, start=replace(record.start, map_from_body=beside))
    found = compare_failure((summary, changed), LocalMapSource(carried.folder / "store", "room"))
    assert found.first_difference_ns == summary.moments[0].stamp_ns
    assert found.apart_m > 0.2


def recorded(carried: Carried, folder: Path, robot: Robot, ride: list[SensorBundle], until_s: float) -> Any:
    """The recording of a robot that fails so long after the beginning of its ride."""
    for bundle in ride:
        robot.handle(bundle)
    cut = robot.ring.cut(ride[0].frame.stamp_ns + round(until_s * 1e9))
    robot.ring.finish()
    (folder / "failure.mcap").write_bytes(failure_file(cut, carried.report, profile(pictures="full")))
    return read_failure_file(folder / "failure.mcap")


def test_a_prior_at_its_beginning_is_kept(carried: Carried, tmp_path: Path) -> None:
    """A robot that has seen nothing of the map yet: its place is the prior and its way since."""
    with MapStore.open(carried.folder / "store", read_only=True) as store:
        robot = robot_world.new_robot(store, keeps_replay=True)
    first, *later = robot_world.bundles(90, dark=range(90))
    prior = PositionPrior(0, robot_world.truth(0) @ se3_inverse(robot.base_from_body), 0.04 * np.eye(6))
    failure = recorded(carried, tmp_path, robot, [replace(first, priors=[prior]), *later], 7.0)
    assert not failure[1].start.is_confirmed
    found = compare_failure(failure, LocalMapSource(carried.folder / "store", "room"))
    assert found.first_difference_ns is None


def test_it_begins_five_seconds_before_and_ends_five_after(carried: Carried) -> None:
    summary, record = read_failure_file(carried.file)
    times_s = (np.array([moment.stamp_ns for moment in summary.moments]) - carried.report.stamp_ns) * 1e-9
    assert -6.5 < times_s[0] <= -4.9
    assert 4.9 < times_s[-1] < 5.2
    assert (summary.robot, summary.id, summary.version) == ("r1", "f1", 1)
    assert len(record.frames) == len(summary.moments)


def test_another_version_is_asked_for_its_own_places(carried: Carried) -> None:
    with MapStore.open(carried.folder / "store", read_only=True) as store:
        sha256 = store.version("room", 2).manifest_sha256
    found = carried.compare(sha256)
    assert found.version == 2
    assert found.first_difference_ns is not None
    then, now = (next(m for m in moments[::-1] if m.position_map_m) for moments in (found.summary.moments, found.now))
    assert now.position_map_m[2] - then.position_map_m[2] == pytest.approx(0.5, abs=0.05)
    assert "version 2" in found.answer


def test_a_failure_on_another_floor_is_replayed_in_that_floors_map(carried: Carried, tmp_path: Path) -> None:
    """A robot of the lower floor that knows its place on the upper one when the recording begins."""
    robot = robot_world.new_robot(keeps_replay=True)
    with house(tmp_path, strange(robot_world.tiles()), robot_world.tiles(), x_m=3.0):
        floors = BuildingMaps(LocalMapSource(tmp_path, "low"), lambda site: LocalMapSource(tmp_path, site))
        floors.refresh()
        robot.use(load_map(LocalMapSource(tmp_path, "low"))[0])
        robot.use_building(*floors.changes.popleft())
    summary, record = recorded(carried, tmp_path, robot, list(robot_world.bundles(120)), 10.5)
    assert record.start.is_confirmed and record.start.floor == "high" and record.used.floor == "high"
    found = compare_failure((summary, record), LocalMapSource(tmp_path, "high"))
    assert {moment.status for moment in found.now} == {"TRACKING"}
    assert found.first_difference_ns is None


def test_it_is_a_recording_with_reduced_pictures(carried: Carried) -> None:
    with open_recording(carried.file) as recording:
        assert recording.issues == ()
        assert recording.sensor_set == "stereo-inertial"
        assert 10 <= len(recording) <= 25
        assert len(recording.imu) > 1000
        assert len(recording.stored_frame(0).left.data) < 25_000


def test_blurred_pictures_show_no_detail(carried: Carried, tmp_path: Path) -> None:
    with MapStore.open(carried.folder / "store", read_only=True) as store:
        found = failed(robot_world.carried(90, 75), robot_world.loaded(store), "blurred")
    (tmp_path / "blurred.mcap").write_bytes(found[1])
    with open_recording(carried.file) as sharp, open_recording(tmp_path / "blurred.mcap") as blurred:
        detail = [cv2.Laplacian(each.read_frame(3).left, cv2.CV_64F).var() for each in (sharp, blurred)]
    assert detail[1] < 0.1 * detail[0]
    assert read_failure_file(tmp_path / "blurred.mcap")[0].pictures == "blurred"


_MASK = ((0.0, 0.0), (319.0, 0.0), (319.0, 60.0), (0.0, 60.0))


@pytest.mark.parametrize("rig", ["rear", "mask"])
def test_a_robot_that_saw_the_map_behind_it_or_beside_a_mask_is_replayed_as_well(tmp_path: Path, rig: str) -> None:
    """With lenses covered in front, its report and recording show what the rear pair saw, by the rear pair's camera."""
    known, ride = calibration(), list(robot_world.carried(90, 75))
    whole = replace(known, cameras=tuple(replace(camera, mask=(_MASK,)) for camera in known.cameras))
    if rig == "rear":
        whole = replace(known, cameras=robot_world.turned(known.cameras) + known.cameras)
        dark = np.zeros_like(ride[0].frame.left)
        ride = [replace(b, frame=replace(b.frame, left=dark, right=dark, others=(b.frame,))) for b in ride]
    with MapStore.open(robot_world.stored(tmp_path / "store")) as store:
        report, data, said = failed(ride, robot_world.loaded(store), "full", whole)
    assert (report.cause, report.view) == ("carried", 1 if rig == "rear" else None)
    base_from_cam = report.camera.base_from_cam.target_from_source
    np.testing.assert_allclose(base_from_cam, known.cameras[0].body_from_cam, atol=0.02)
    shown = [cv2.imdecode(np.frombuffer(each.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE) for each in report.thumbnails]
    assert min(picture.std() for picture in shown) > 20, "none is black"
    (tmp_path / "failure.mcap").write_bytes(data)
    failure = read_failure_file(tmp_path / "failure.mcap")
    again = compare_failure(failure, LocalMapSource(tmp_path / "store", "room"))
    assert [moment.status for moment in again.now] == said
    assert "TRACKING" in said
    assert again.first_difference_ns is None
    with open_recording(tmp_path / "failure.mcap") as recording:
        assert len(recording.calibration.views) == (2 if rig == "rear" else 1)
        if rig == "rear":
            pictures = [each for k in range(len(recording)) for each in recording.read_frame(k).others if each]
            assert len(pictures) > 5 and pictures[0].left.std() > 20


def _changed(carried: Carried, path: Path, localizer: bytes) -> Path:
    with McapRecordingWriter(path, calibration()) as writer:
        writer.attach(SUMMARY, "", attachments_of(carried.file)[SUMMARY])
        writer.attach(LOCALIZER, "", localizer)
    return path


def _packed_array(values: Any) -> list[Any]:
    array = np.asarray(values)
    return [array.dtype.str, list(array.shape), array.tobytes()]


def _first_query(state: Any) -> Any:
    queries = (percept["query"] for _, percept in state["frames"])
    return next(query for query in queries if query and query["features"])


def _feature(name: str, make: Callable[[int], Any], *, is_depth: bool = False) -> Callable[[Any], None]:
    """Another array of the first map query, for its number of features."""

    def change(state: Any) -> None:
        found = _first_query(state)["features"]
        found = found if is_depth else found["features"]
        found[name] = _packed_array(make(found["pixels"][1][0]))

    return change


def _odometry(name: str, value: Any) -> Callable[[Any], None]:
    return lambda state: state["frames"][3][1]["odometry"].update({name: value})


NO_ROBOT_WRITES = {
    "one descriptor": _feature("descriptors", lambda n: np.zeros((1, 32), np.uint8)),
    "short descriptors": _feature("descriptors", lambda n: np.zeros((n, 1), np.uint8)),
    "no octaves": _feature("octaves", lambda n: np.zeros(0, np.int8)),
    "an octave of -128": _feature("octaves", lambda n: np.full(n, -128, np.int8)),
    "octaves of another kind": _feature("octaves", np.zeros),
    "pixels outside the picture": _feature("pixels", lambda n: np.full((n, 2), 1e9)),
    "pixels that are no numbers": _feature("pixels", lambda n: np.full((n, 2), np.nan)),
    "too many features": _feature("pixels", lambda n: np.zeros((10_001, 2))),
    "columns without end": _feature("pixels", lambda n: np.full((n, 3), 1e300), is_depth=True),
    "a picture without pixels": lambda state: state["camera"].update(width_px=0),
    "a picture of 60000 pixels": lambda state: state["camera"].update(width_px=60_000, height_px=60_000),
    "a lens that is none": lambda state: state["camera"].update(focal_px=float("nan")),
    "no rotation": _odometry("odom_from_body", _packed_array(np.zeros((4, 4)))),
    "a transform without a place": _odometry("odom_from_body", _packed_array(np.full((4, 4), np.inf))),
    "a covariance that is none": _odometry("cov_rot_trans", _packed_array(-np.eye(6))),
    "a skew covariance": _odometry("cov_rot_trans", _packed_array(np.triu(np.ones((6, 6))))),
    "stamps that fall": _odometry("stamp_ns", 1),
    "fewer depths than features": _feature("pixels", lambda n: np.zeros((n - 1, 3)), is_depth=True),
    "features with images": lambda state: _first_query(state)["features"].update(
        is_tried=_packed_array(np.ones(3, bool))
    ),
    "a motion that is none": lambda state: state["frames"][3][1].update(
        motions={0: [_packed_array(np.zeros((4, 4))), _packed_array(np.eye(6)), False]}
    ),
    "slices without end": lambda state: _first_query(state).update(slices=10**12),
    "a pose without a covariance": lambda state: state["start"].update(cov_rot_trans=None),
    "a pose that is no transform": lambda state: state["start"].update(map_from_body=_packed_array(np.ones((4, 4)))),
    "a covariance of the pose that is none": lambda state: state["start"].update(
        cov_rot_trans=_packed_array(-np.eye(6))
    ),
    "settings without end": lambda state: state["settings"]["fix"].update(top_places=10**15),
    "a view before the first": lambda state: _first_query(state).update(view=-1),
    "a view of another rig": lambda state: _first_query(state).update(view=1),
    "an older format": lambda state: state.update(format=1, state={"confirmed": None}),
    "no camera": lambda state: state.pop("camera"),
    "an array of objects": lambda state: state.update(body_from_cam=["|O8", [4, 4], b"x" * 128]),
    "an array of terabytes": lambda state: state.update(body_from_cam=["<f8", [1 << 40, 4], b"x"]),
    "no frames": lambda state: state.update(frames=[]),
}
FOREIGN = "an older format", "no camera", "an array of objects", "an array of terabytes", "no frames"
SAID = dict.fromkeys(FOREIGN, "another fleetmap") | {
    "a view before the first": "-1 of a rig of 1 cameras",
    "a view of another rig": "1 of a rig of 1 cameras",
}


@pytest.mark.parametrize("what", NO_ROBOT_WRITES)
def test_what_no_robot_wrote_is_refused_and_reaches_no_kernel(carried: Carried, tmp_path: Path, what: str) -> None:
    packed = attachments_of(carried.file)[LOCALIZER]
    state = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed), strict=False)
    del state["frames"][30:]
    NO_ROBOT_WRITES[what](state)
    spoiled = zstandard.ZstdCompressor().compress(msgspec.msgpack.encode(state))
    with pytest.raises(RecordingError, match=SAID.get(what, "no robot writes that|cannot be read")):
        read_failure_file(_changed(carried, tmp_path / "spoiled.mcap", spoiled))


def test_what_unpacks_without_end_is_refused(carried: Carried, tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(300_000_000))
    with pytest.raises(RecordingError, match="no robot writes that"):
        read_failure_file(_changed(carried, tmp_path / "bomb.mcap", bomb))
    with pytest.raises(RecordingError, match="cannot be unpacked"):
        read_failure_file(_changed(carried, tmp_path / "none.mcap", b"no zstd"))


def test_damaged_and_other_recordings_are_refused(carried: Carried, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(carried.file.read_bytes()[:-5000])
    with pytest.raises(RecordingError, match="damaged"):
        read_failure_file(tmp_path / "cut.mcap")
    with McapRecordingWriter(tmp_path / "other.mcap", calibration()):
        pass
    with pytest.raises(RecordingError, match="not a failure's recording"):
        read_failure_file(tmp_path / "other.mcap")


def test_the_command_answers(carried: Carried, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = (carried.file, "--store", carried.folder / "store")
    for version, is_same in (((), True), (("--version", 1), True), (("--version", 2), False)):
        ended = status("locclient", "replay", *given, *version, "--report", tmp_path / "report.json")
        said = capsys.readouterr()
        assert ended == 0, said.err
        assert "then:" in said.out
        assert ("this client gives the same result for every frame" in said.out) == is_same
        assert json.loads((tmp_path / "report.json").read_text())["is_same"] == is_same
    assert status("locclient", "replay", *given, "--frames", "1:20") == 2
    assert "--frames is not for a failure's recording" in capsys.readouterr().err


def test_the_server_replays_it_in_a_process_with_limits(
    carried: Carried, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    store = carried.folder / "store"
    with MapStore.open(store) as maps:
        fleet = Fleet(maps)
        assert fleet.take_failure("room", "r1", carried.report).refused == ""
        send_replay(fleet, "room", "r1", carried.report.id, carried.file.read_bytes())
    command = ("mapserver", "fleet", "replay", "1", "--store", store)
    assert status(*command) == 0
    assert "gives the same result for every frame" in capfd.readouterr().out
    assert status(*command, "--json") == 0
    said = capfd.readouterr().out
    assert json.loads(said[: said.rindex("}") + 1])["is_same"]
    monkeypatch.setattr(bounded_process, "ProcessLimits", partial(bounded_process.ProcessLimits, wall_s=0.1))
    assert status(*command) == 3
    assert "the replay of failure 1 was ended after 0 s" in capfd.readouterr().err
