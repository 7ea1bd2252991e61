"""`mapserver live` for every kind of rig, by one configuration file, and what it refuses. A robot rides through a painted room."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from fleetmap.errors import FleetmapError, LinkError, RecordingError, UsageError
from fleetmap.geometry import transform_points
from fleetmap.recordings import OpenOptions, Topics, open_recording
from fleetmap.sensors.samples import CameraFrame, SensorSet
from fleetmap.sources.intake import Intake
from mapserver.cli import app
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildRequest
from mapserver.plugins.live_surveys import command as live_command
from mapserver.plugins.live_surveys import drives
from mapserver.plugins.live_surveys.drives import SensorDrive
from mapserver.plugins.live_surveys.live_survey import run_live
from mapserver.plugins.live_surveys.message import LiveSurveyState
from mapserver.store import MapStore
from support.recordings.live_drives import Call, MappingHere, laid_on_truth, order_builds, write_rgbd
from support.recordings.recording_samples import calibration, kalibr_text, write_mcap
from support.room_site import invoke
from support.worlds import robot_world
from support.worlds.box_room import ROOM_M

METRIC = [SensorSet.STEREO_INERTIAL, SensorSet.STEREO, SensorSet.RGBD, SensorSet.MONO_INERTIAL]
KINDS = [*METRIC, SensorSet.MONO]
QUIET = Console(quiet=True)


class Site:
    """Recordings of one ride, by kind of rig, and the store of the room's map."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "maps"
        self.pairs = write_mcap(folder / "ride", robot_world.cycle())
        self.depths = write_rgbd(folder / "depths.mcap", robot_world.cycle())
        with MapStore.open(self.store, create=True) as store:
            self.version = robot_world.save(store, site="lab")

    def recording(self, kind: SensorSet) -> Path:
        return self.depths if kind is SensorSet.RGBD else self.pairs


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture(autouse=True)
def builds(monkeypatch) -> list[Call]:
    monkeypatch.setattr(live_command, "_stopping", threading.Event)
    return order_builds(monkeypatch)


def configured(tmp_path: Path, site: Site, kind: SensorSet, more: str = "") -> Path:
    """The configuration file for a kind of rig."""
    file, use = tmp_path / "rig.toml", f'use = "{kind}"'
    survey = "[survey.keyframes]\nmax_interval_s = 0.9"
    file.write_text(
        f'site = "lab"\nstore = "{site.store}"\n{survey}\n[live]\nspeed = 0.0\n{use}\n[build]\n{use}\n{more}'
    )
    return file


@pytest.mark.parametrize("kind", KINDS)
def test_live_and_build_take_one_configuration_file(
    site: Site, tmp_path: Path, builds: list[Call], kind: SensorSet
) -> None:
    file, recording = configured(tmp_path, site, kind), site.recording(kind)
    done = invoke(app, "live", recording, "--config", file)
    assert done.exit_code == 0, done.exception
    made = MappingHere.made
    if kind in METRIC:
        laid = laid_on_truth(made.map_from_body, robot_world.cycle(), list(made.after))
        assert np.quantile(laid.error_m, 0.9) < 0.2
        points = transform_points(laid.truth_from_map, made.map.points_map())
        assert np.median(np.abs(points[:, None] - ROOM_M).min(axis=(1, 2))) < 0.2, "landmarks lie on the walls"
    found = made.sketch
    assert found.keyframes > 8
    assert [part.is_map for part in found.parts] == [True]
    assert found.estimate.status == "TRACKING"
    assert ("scale: unknown" in done.stderr) is (kind is SensorSet.MONO)
    assert invoke(app, "build", recording, "--config", file).exit_code == 0
    (_, *live_at, by_live), (_, *build_at, by_build) = builds
    assert live_at == build_at
    assert by_live.settings == survey_settings(file, kind)
    assert by_live.settings.keyframes.max_interval_s == 0.9
    assert replace(by_live, settings=None) == by_build
    assert by_live.use is kind


def drive(site: Site, record: Path, sensors: "Scripted", names: Topics) -> list[LiveSurveyState]:
    told: list[LiveSurveyState] = []
    try:
        sensor_drive = SensorDrive(BuildRequest((record,), "lab", site.store), sensors, names)
        run_live(sensor_drive, [told.append], lambda: False, QUIET)
    except FleetmapError:
        assert told[-1].phase == "failed"
        raise
    return told


def test_what_a_build_would_refuse_is_refused_before_the_drive(site: Site, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(MappingHere, "start", lambda *_: pytest.fail("the drive began"))
    config = configured(tmp_path, site, SensorSet.STEREO)
    other = tmp_path / "other.yaml"
    rig = yaml.safe_load(kalibr_text())  # of which the right camera looks down by a degree
    rig["cam1"]["T_cn_cnm1"][1:3] = [[0.0, 0.99985, -0.01745, 0.0], [0.0, 0.01745, 0.99985, 0.0]]
    other.write_text(yaml.safe_dump(rig))
    blind = write_rgbd(tmp_path / "blind.mcap", replace(robot_world.cycle(), stamps_ns=robot_world.cycle().stamps_ns[:9],
        left=robot_world.cycle().left[:9], world_from_body=robot_world.cycle().world_from_body[:9]), has_depth=False)  # fmt: skip
    cases: list[tuple[tuple[object, ...], type[Exception], str]] = [
        ((site.pairs, "--calibration", other), RecordingError, "epipolar error"),
        ((site.depths, "--use", "stereo"), RecordingError, "use it as rgbd, mono"),
        ((site.pairs, "--use", "rgbd"), RecordingError, "is stereo-inertial, it cannot be used as rgbd"),
        ((blind, "--use", "rgbd"), RecordingError, "depth: 100.0% of the pixels have no depth"),
    ]
    for words, kind, message in cases:
        done = invoke(app, "live", *words, "--config", config)
        assert isinstance(done.exception, kind), words
        assert message in str(done.exception)


class Scripted:
    """Sensors that send these frames and no IMU, whatever the calibration says; with an error they die then."""

    has_depth = False

    def __init__(self, frames: list[CameraFrame], error: Exception | None = None) -> None:
        self.calibration, self._frames, self._error = calibration(), frames, error

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        for frame in self._frames:
            intake.put_frame(frame)
        if self._error is not None:
            raise self._error
        while not wait(0.05):
            pass

    def close(self) -> None:
        """Nothing is open."""


def test_sensors_that_say_nothing_are_not_waited_for(site: Site, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(drives, "_SILENCE_S", 0.2)
    record, sample = tmp_path / "drive.mcap", robot_world.cycle()
    names = Topics(left="/front/left", right="/front/right")
    with pytest.raises(RecordingError, match="expected on /front/left and /front/right"):
        drive(site, record, Scripted([]), names)
    assert not record.exists(), "nothing was recorded"
    frames = [CameraFrame(int(sample.stamps_ns[n]), sample.left[n], sample.right[n]) for n in range(3)]
    with pytest.raises(RecordingError, match="no sample of the calibration's IMU"):
        drive(site, record, Scripted(frames), names)
    with open_recording(record, OpenOptions(topics=names)) as kept:
        assert 1 <= len(kept) <= len(frames)
        np.testing.assert_array_equal(kept.read_frame(0).right, frames[0].right)
    assert "sensors" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize(
    ("count", "error", "says"),
    [
        (3, ZeroDivisionError("no rate"), "ZeroDivisionError: no rate; .*drive.mcap holds the drive.*mapserver build"),
        (0, LinkError("no router at tcp/1.2.3.4:7447"), "no router at .*; nothing was recorded before"),
    ],
)
def test_sensors_that_die_end_the_drive_with_their_reason(
    site: Site, tmp_path: Path, count: int, error: Exception, says: str
) -> None:
    record, sample = tmp_path / "drive.mcap", robot_world.cycle()
    frames = [CameraFrame(int(sample.stamps_ns[n]), sample.left[n], sample.right[n]) for n in range(count)]
    with pytest.raises(RecordingError, match=f"the sensors ended the drive: {says}"):
        drive(site, record, Scripted(frames, error), Topics())
    assert record.exists() == bool(count)


def test_sensors_by_the_same_file_are_built_with_their_topics(site: Site, tmp_path: Path, builds: list[Call]) -> None:
    record = tmp_path / "drive.mcap"
    more = f'[source]\nkind = "recording"\nrecording = "{site.depths}"\nspeed = 0.0\n'
    file = configured(tmp_path, site, SensorSet.RGBD, more)
    file.write_text(file.read_text().replace('[live]\nspeed = 0.0\nuse = "rgbd"\n', f'[live]\nrecord = "{record}"\n'))
    done = invoke(app, "live", "--config", file)
    assert done.exit_code == 0, done.exception
    ((path, _, name, options),) = builds
    assert (path, name, options.frames) == (record, "lab", "::")
    assert options.settings == survey_settings(file, SensorSet.RGBD)
    kept, indices = options.opened(record)
    with kept:
        assert (kept.sensor_set, len(indices)) == (SensorSet.RGBD, len(robot_world.cycle().stamps_ns))
    for option, value in (("--use", "stereo"), ("--calibration", file), ("--topic", "imu=/a")):
        refused = invoke(app, "live", "--config", file, option, value)
        assert isinstance(refused.exception, UsageError)
        assert "[source]" in str(refused.exception)
