"""A build reads all views of a rig: its checks take the first one, its survey and the frames that judge it all."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from fleetmap.geometry import se3_exp
from fleetmap.recordings import Recording
from fleetmap.recordings.sensor_subset import with_other_views
from fleetmap.sensors.rectification import RGBD_BASELINE_M, Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.drafting.admission import CheckedRecording
from mapserver.drafting.draft_evidence import MappedSession, ProbedFrame
from mapserver.drafting.survey_recordings import OpenRecordings, RecordingOptions, _admission
from mapserver.quality.figures import RigEvidence
from mapserver.survey.keyframes.keyframes import make_keyframes
from mapserver.survey.rig import CameraKind, rig_of, used_cameras
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools
from support.recordings.rig_samples import images_of, simulated, write_rig

SIZE_PX = (160, 120)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    return write_rig(tmp_path / "rig.mcap", *simulated("front-rear", SIZE_PX))


def test_frames_keep_all_views_when_they_are_read_again(recorded: Path, tmp_path: Path) -> None:
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        for _ in range(2):
            with reading.open(recorded) as (recording, _indices):
                images = images_of(recording.read_frame(1))
                expected = images_of(simulated("front-rear", SIZE_PX)[1][1])
                assert len(recording.calibration.cameras) == 4
                assert all(np.array_equal(a, b) for a, b in zip(images, expected, strict=True))
                assert len(recording.view(0).calibration.cameras) == 2


def test_a_smaller_set_of_sensors_is_that_of_the_first_view(recorded: Path, tmp_path: Path) -> None:
    with OpenRecordings(RecordingOptions(use=SensorSet.MONO), tmp_path).open(recorded) as (recording, _):
        assert len(recording.calibration.cameras) == 1
        assert len(images_of(recording.read_frame(0))) == 1


def test_a_corrected_clock_is_that_of_all_views() -> None:
    whole = simulated("front-rear", SIZE_PX)[0]
    later_s = whole.cameras[0].imu_minus_cam_s + 0.01
    first = replace(whole, cameras=tuple(replace(c, imu_minus_cam_s=later_s) for c in whole.cameras[:2]))
    assert [c.imu_minus_cam_s for c in with_other_views(first, whole).cameras] == [later_s] * 4
    assert with_other_views(first, replace(whole, cameras=whole.cameras[:2])) is first


def test_a_keyframe_has_the_views_of_its_pinhole() -> None:
    calibration, frames = simulated("front-rear", SIZE_PX)
    rectifier = Rectifier(calibration)
    frame = rectifier.rectify(frames[0])
    cameras = used_cameras(rectifier)
    assert [number for number, _ in cameras] == [0, 1] and rig_of(rectifier).body_from_cam.shape == (2, 4, 4)
    single = Rectifier(replace(calibration, cameras=(*calibration.cameras[:2], calibration.cameras[2])))
    assert rig_of(single).kinds == (CameraKind.STEREO, CameraKind.SINGLE)
    rows = [(0, single.rectify(frames[0]))]
    (seen,) = next(make_keyframes(rows, used_cameras(single), SurveySettings(), SurveyTools())).others
    assert len(seen.features) > 0 and np.isnan(seen.disparities).all()
    assert len(used_cameras(Rectifier(replace(calibration, cameras=calibration.cameras[1:])))) == 1
    rows = [(0, frame), *((n, replace(frame, others=(None,))) for n in (1, 2))]
    first, alone, again = make_keyframes(rows, cameras, SurveySettings(), SurveyTools())
    assert alone.others[0].image_number == again.others[0].image_number, "one picture of nothing is enough"
    assert alone.image_number != again.image_number and alone.others[0].stamp_ns == frame.stamp_ns
    assert [len(view.features) > 0 for view in first.others] == [True]
    assert [len(view.features) for view in alone.others] == [0]
    assert first.others[0].frame.left.tobytes() != first.frame.left.tobytes() and not first.frame.others


def test_a_shorter_baseline_of_another_view_is_converted_to_the_first_one() -> None:
    """What the view measures is as far away as before."""
    calibration, frames = simulated("front-rear", SIZE_PX)
    rectifier = Rectifier(calibration)
    frame, cameras = rectifier.rectify(frames[0]), used_cameras(rectifier)
    first, (number, rear) = cameras
    short = [first, (number, replace(rear, baseline_m=rear.baseline_m / 2))]
    (same,), (nearer,) = (
        next(make_keyframes([(0, frame)], how, SurveySettings(), SurveyTools())).others for how in (cameras, short)
    )
    known = np.isfinite(same.points_cam).all(axis=1) & np.isfinite(nearer.points_cam).all(axis=1)
    np.testing.assert_allclose(nearer.points_cam[known], same.points_cam[known] / 2, rtol=1e-9)


def test_depth_of_another_view_is_read_as_disparities_of_the_first_baseline() -> None:
    """As far away as the sensor says, with the sensor's noise; also where an adjustment reads its picture again."""
    calibration, frames = simulated("front-depth", SIZE_PX)
    rectifier, settings = Rectifier(calibration), SurveySettings()
    assert rig_of(rectifier).kinds == (CameraKind.STEREO, CameraKind.DEPTH)
    rows = [(0, rectifier.rectify(frames[0]))]
    (rear,) = next(make_keyframes(rows, used_cameras(rectifier), settings, SurveyTools())).others
    seen = np.flatnonzero(np.isfinite(rear.disparities[:, 0]))
    pixels = rear.features.pixels[seen]
    columns, lines = np.rint(pixels).astype(int).T
    depth_m = frames[0].others[0].depth_m[lines, columns]  # type: ignore[union-attr, index]
    assert len(seen) > 20
    np.testing.assert_allclose(np.median(rear.points_cam[seen, 2] / depth_m), 1.0, atol=0.01)
    scale = rectifier.camera.baseline_m / RGBD_BASELINE_M
    np.testing.assert_allclose(rear.disparities[seen, 1], scale * settings.stereo.depth_sigma_px)
    again = rear.with_pyramid().measured_at(seen, pixels, settings.stereo)
    np.testing.assert_array_equal(again, rear.disparities[seen])


@pytest.mark.parametrize("recordings", [1, 2])
def test_all_views_of_a_frame_either_judge_a_draft_or_choose_its_landmarks(recordings: int) -> None:
    nothing: Any = None
    probed = [
        ProbedFrame(number, nothing, np.eye(4), nothing, is_held_out=number not in (0, 19), view=view)
        for number in range(20)
        for view in (0, 1)
    ]
    session = MappedSession(nothing, probed, nothing)
    parts = session.asked(recordings), session.judging(recordings)
    asked, judging = ([(f.number, f.view) for f in part] for part in parts)
    assert not {number for number, _ in asked} & {number for number, _ in judging}
    assert {view for _, view in judging} == {0, 1} and len(judging) == 2 * len({number for number, _ in judging})
    assert {0, 19} <= {number for number, _ in asked}


def test_further_views_are_examined_beside_the_corrected_first_one(recorded: Path, tmp_path: Path, monkeypatch) -> None:
    """A plate of cameras that is turned as a whole agrees with itself, and no longer once its first view is corrected."""
    turn, further = se3_exp(np.array([0, 0, 0.02, 0, 0, 0])), Mock(return_value=[])

    def checked(recording: Recording, *_: object) -> CheckedRecording:
        rig = recording.calibration
        turned = tuple(replace(c, body_from_cam=turn @ c.body_from_cam) for c in rig.cameras)
        return CheckedRecording(replace(rig, cameras=turned), [], RigEvidence(""), {})

    monkeypatch.setattr("mapserver.drafting.survey_recordings.checked", checked)
    monkeypatch.setattr("mapserver.drafting.admission.further_findings", further)
    with OpenRecordings(RecordingOptions(), tmp_path) as reading:
        _admission(
            recorded, reading, Console(quiet=True), needs_truth=False, settings=None, tools=SurveyTools(), is_only=True
        )
        with reading.open(recorded) as (recording, _):
            whole = recording.calibration.cameras
    seen = further.call_args.args[0].calibration
    for camera, nominal, motion in zip(seen.cameras, whole, (turn, turn, np.eye(4), np.eye(4)), strict=True):
        np.testing.assert_allclose(camera.body_from_cam, motion @ nominal.body_from_cam)
