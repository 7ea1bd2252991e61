"""TUM RGB-D folders, whose images OpenCV writes."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, open_recording
from fleetmap.sensors.samples import SensorSet
from mapserver.cli import app
from support.recordings.recording_samples import HEIGHT, kalibr_text, make_sample, write_tum_rgbd
from support.room_site import invoke

SAMPLE = make_sample(4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tum_rgbd(tmp_path / "office", SAMPLE)


def options(folder: Path) -> OpenOptions:
    rig = folder.with_name("rig.yaml")
    rig.write_text(kalibr_text())
    return OpenOptions(rig)


def test_depth_is_in_metres_and_comes_with_its_colour(folder: Path) -> None:
    with open_recording(folder, options(folder)) as recording:
        assert (recording.format, recording.sensor_set, recording.issues) == ("tum-rgbd", SensorSet.RGBD, ())
        frame = recording.read_frame(1)
        assert frame.depth_m[HEIGHT // 2, 0] == np.float32(2.0)
        assert frame.depth_m[HEIGHT // 2, -1] == np.float32(5.0)
        assert frame.depth_m[0, 0] == 0
        np.testing.assert_array_equal(frame.left, SAMPLE.left[1])


def test_without_a_calibration_only_the_data_sets_own_folders_are_read(folder: Path) -> None:
    with pytest.raises(CalibrationError, match=r"holds no calibration.*freiburg1.*--calibration FILE"):
        open_recording(folder)
    named = folder.with_name("rgbd_dataset_freiburg2_desk")
    folder.rename(named)
    for image in [*named.glob("rgb/*.png"), *named.glob("depth/*.png")]:
        picture = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(image), cv2.resize(picture, (640, 480), interpolation=cv2.INTER_NEAREST))
    with open_recording(named) as recording:
        assert recording.calibration.cameras[0].intrinsics_px.tolist() == [520.9, 521.0, 325.1, 249.7]


def test_lists_that_do_not_pair(folder: Path) -> None:
    rows = [line.split() for line in (folder / "depth.txt").read_text().splitlines() if not line.startswith("#")]
    shifted = [f"{float(stamp) + 100:.6f} {name}" for stamp, name in rows]
    (folder / "depth.txt").write_text("\n".join(shifted))
    says = r"no image of rgb\.txt has one of depth\.txt within 0\.02 s.* 99\.\d+ s apart"
    with pytest.raises(RecordingError, match=says):
        open_recording(folder, options(folder))
    (folder / "depth.txt").write_text("\n".join([*(" ".join(row) for row in rows[:2]), *shifted[2:]]))
    with open_recording(folder, options(folder)) as recording:
        assert len(recording) == 2
        assert any(issue.what == "images without their partner" for issue in recording.issues)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("noon rgb/1.png", "not a stamp in seconds and a file name"),
        ("1.0", "not a stamp in seconds and a file name"),
        ("1e300 rgb/1.png", "not a stamp in seconds and a file name"),
        ("# nothing", r"rgb\.txt names no image"),
        ("5.0 rgb/none.png", "none of the 1 images is there"),
    ],
)
def test_hostile_lists(folder: Path, line: str, words: str) -> None:
    (folder / "rgb.txt").write_text(line + "\n")
    with pytest.raises(RecordingError, match=words):
        open_recording(folder, options(folder))


@pytest.mark.parametrize(
    ("spoil", "left", "says"),
    [
        (lambda rows: [rows[0], *rows], 4, "stamps repeated"),
        (lambda rows: [rows[1], rows[0], *rows[2:]], 3, "stamps not increasing"),
        (lambda rows: [rows[0].rpartition(" ")[0] + " nan", *rows[1:]], 3, "line 1: .*NaN"),
        (lambda rows: [*rows[:-1], rows[-1][:30]], 3, "line 4: "),
        (lambda rows: [], None, "holds no pose"),
    ],
    ids=["repeated", "unsorted", "nan", "cut", "empty"],
)
def test_a_bad_row_of_the_truth_costs_itself(
    folder: Path, spoil: Callable[[list[str]], list[str]], left: int | None, says: str
) -> None:
    truth = folder / "groundtruth.txt"
    rows = [line for line in truth.read_text().splitlines() if not line.startswith("#")]
    truth.write_text("\n".join(spoil(rows)))
    with open_recording(folder, options(folder)) as recording:
        assert recording.ground_truth is None if left is None else len(recording.ground_truth or ()) == left
        (issue,) = recording.issues
        assert re.search(says, f"{issue.what} {issue.detail}")
    if left is not None:
        (folder / "estimate.tum").write_text("\n".join(rows))
        done = invoke(app, "evaluate", folder / "estimate.tum", "--ground-truth", truth)
        assert (done.exit_code, bool(re.search(says, done.stderr))) == (0, True), done.stderr


def test_what_is_missing(folder: Path) -> None:
    (folder / "accelerometer.txt").write_text("1.0 0 0 9.81\n")
    (folder / "groundtruth.txt").write_text("1.0 2 3\n")
    with open_recording(folder, options(folder)) as recording:
        assert recording.ground_truth is None
        assert {issue.what for issue in recording.issues} == {"accelerometer not used", "ground truth not used"}
    (folder / "depth.txt").unlink()
    with pytest.raises(RecordingError, match=r"depth\.txt cannot be read"):
        open_recording(folder, options(folder))
