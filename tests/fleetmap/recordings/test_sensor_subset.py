"""A recording used with fewer sensors than it has, the presets of the sensor sets, and what becomes of a map without metres."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import GateRefusedError, RecordingError, SurveyError, UsageError
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.recordings.sensor_subset import REDUCTIONS, named_sensor_set, reduced, sensor_set_of
from fleetmap.sensors.samples import SensorSet
from mapserver import releases
from mapserver.cli import app
from mapserver.config import survey_settings
from mapserver.store import DraftContent, MapStore
from mapserver.survey.settings import SurveySettings
from support.recordings.recording_samples import make_sample, write_mcap
from support.room_site import run
from support.storage.map_samples import draft_details, random_tile


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "turn", make_sample(8))


def test_each_reduction_has_what_its_name_says(drive: Path) -> None:
    with open_recording(drive) as whole:
        assert whole.sensor_set is sensor_set_of(drive) is SensorSet.STEREO_INERTIAL
        assert reduced(whole, None) is whole
        for use in REDUCTIONS[whole.sensor_set]:
            less = reduced(whole, use)
            single, inertial = use.value.startswith("mono"), use.value.endswith("inertial")
            assert less.sensor_set is use
            assert len(less.calibration.cameras) == (1 if single else 2)
            assert (less.calibration.imu is not None, len(less.imu) > 0) == (inertial, inertial)
            frame = less.read_frame(3)
            assert (frame.right is None) is single
            assert np.array_equal(frame.left, whole.read_frame(3).left)
            assert less.content_hash() == whole.content_hash()


def test_what_a_recording_lacks_cannot_be_used(drive: Path) -> None:
    with open_recording(drive) as whole, pytest.raises(RecordingError, match=r"it cannot be used as rgbd; use it as"):
        reduced(whole, SensorSet.RGBD)
    with pytest.raises(UsageError, match=r"unknown sensor set of --use .lidar.; known are"):
        named_sensor_set("lidar")


def test_every_sensor_set_has_a_preset_and_the_file_goes_over_it(tmp_path: Path) -> None:
    file = tmp_path / "site.toml"
    file.write_text("[survey]\nseed = 3\n[survey.keyframes]\nmin_overlap = 0.5\n")
    for sensor_set in SensorSet:
        preset, mine = survey_settings(None, sensor_set), survey_settings(file, sensor_set)
        assert (mine.seed, mine.keyframes.min_overlap) == (3, 0.5)
        assert mine.keyframes.max_parallax == preset.keyframes.max_parallax
    assert survey_settings(None, SensorSet.STEREO_INERTIAL) == SurveySettings()
    assert survey_settings(None, SensorSet.MONO) != SurveySettings()


def test_one_camera_that_only_turns_makes_no_map(drive: Path, tmp_path: Path) -> None:
    """The sample's camera turns on the spot: with two cameras that is a map, with one it is refused, never guessed."""
    with pytest.raises(SurveyError, match="connected keyframe"):
        run(app, "build", drive, "--site", "lab", "--store", tmp_path / "store", "--use", "mono")


def test_the_gate_refuses_a_map_without_metres(tmp_path: Path) -> None:
    tiles = [random_tile(np.random.default_rng(1))]
    with MapStore.open(tmp_path / "store", create=True) as maps:
        for scale in ("unknown", "metric"):
            maps.save("lab", DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(scale=scale)))
        with pytest.raises(GateRefusedError, match="has a scale of its own"):
            releases.publish(maps, "lab", 1)
        assert releases.publish(maps, "lab", 2) == 2


# --frames A:B:C means what Python's slices mean.

SAMPLE = make_sample(5)


@pytest.mark.parametrize("text", [":", "::", "0:3", "1:", ":4", "::2", "1::2", "-3:", ":-1", "0:100:3"])
def test_pythons_slices(text: str, tmp_path: Path) -> None:
    recording = open_recording(write_mcap(tmp_path / "r", SAMPLE))
    wanted = list(range(5))[slice(*(int(p) if p else None for p in text.split(":")))]
    assert FrameSelection.parse(text).apply(recording).tolist() == wanted
    with pytest.raises(UsageError, match="selects none of the 5 frames"):
        FrameSelection.parse("7:").apply(recording)


@pytest.mark.parametrize("text", ["", "3", "a:b", "1:2:3:4", "::0", "::-1", "1.5:", "0,3"])
def test_nonsense_is_a_usage_error_that_names_it(text: str) -> None:
    with pytest.raises(UsageError, match="--frames"):
        FrameSelection.parse(text)
