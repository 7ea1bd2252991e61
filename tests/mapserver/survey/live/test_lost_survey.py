"""A survey that loses itself: another part, joined by sure revisits alone, on the way and in the draft."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.build.survey_recordings import RecordingOptions
from mapserver.config import survey_settings
from mapserver.survey.live.live_map import LiveMap
from mapserver.survey.live.live_values import LiveParts, LiveRig
from mapserver.survey.live.tracking import LiveTracking
from mapserver.survey.odometry_pass import SampleFeed
from mapserver.survey.pipeline import Survey, survey
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs
from support.recordings.kidnapped_ride import APART_FRAMES, FRAMES, kidnapped
from support.recordings.recording_samples import write_euroc

SETTINGS = survey_settings(None, SensorSet.STEREO)
CONFIG = SurveyConfig(SETTINGS, default_vocabulary())


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("recordings") / "kidnapped", kidnapped())


class Followed:
    """The growing map of a recording, and what its parts were after so many frames."""

    def __init__(self, path: Path) -> None:
        self.after: dict[int, LiveParts] = {}
        self.frames: list[int] = []
        with RecordingOptions(use=SensorSet.STEREO).open(path) as (opened, indices):
            rectifier = Rectifier(opened.calibration)
            tracking = LiveTracking(opened.calibration, rectifier, SETTINGS)
            feed = SampleFeed(opened.imu, (), 0.0)
            self.map = LiveMap(CONFIG, LiveRig(rectifier.camera, rectifier.body_from_cam))
            for index in indices.tolist():
                frame = rectifier.rectify(opened.read_frame(index))
                tracked = tracking.handle(frame, *feed.until(frame.stamp_ns))
                if tracked.keyframe is not None:
                    self.map.add(frame, tracked.keyframe)
                    self.frames.append(index)
                self.after[index + 1] = self.map.parts()


@pytest.fixture(scope="module")
def followed(recording: Path) -> Followed:
    return Followed(recording)


def built(recording: Path, frames: str) -> Survey:
    with RecordingOptions(frames, use=SensorSet.STEREO).open(recording) as (opened, indices):
        rectifier = Rectifier(opened.calibration)
        pictures = (rectifier.rectify(opened.read_frame(int(index))) for index in indices)
        inputs = SurveyInputs(pictures, len(indices), opened.imu, opened.calibration, rectifier, (), None)
        return survey(inputs, CONFIG)


def laid_on_truth(map_from_body: Array, frames: list[int]) -> Array:
    """(K,) metres from the truth, the first one laid upon it."""
    truth = np.array(kidnapped().world_from_body)[frames]
    laid = truth[0] @ se3_inverse(map_from_body[0]) @ map_from_body
    return np.asarray(np.linalg.norm(laid[:, :3, 3] - truth[:, :3, 3], axis=1))


def test_it_goes_on_as_another_part_until_a_sure_revisit_joins_it(followed: Followed) -> None:
    before, apart, joined = (followed.after[n] for n in (36, APART_FRAMES, FRAMES))
    assert [len(parts.spans) for parts in (before, apart, joined)] == [1, 2, 1]
    first, second = apart.spans
    assert first.end_s < 4.0
    assert second.start_s > 7.0
    assert [first.is_map, second.is_map] == [True, False]
    assert set(apart.labels[: first.keyframes].tolist()) == {0}
    assert (joined.labels >= 0).sum() == joined.spans[0].keyframes
    lit = [k for k, label in enumerate(joined.labels.tolist()) if label == 0]
    error_m = laid_on_truth(followed.map.map_from_body[lit], [followed.frames[k] for k in lit])
    assert np.quantile(error_m, 0.9) < 0.1


def test_the_draft_has_the_parts_that_were_joined_and_names_those_that_were_not(recording: Path) -> None:
    apart, joined = built(recording, f":{APART_FRAMES}"), built(recording, "::")
    seen = [component for component in apart.components if "saw" not in component.reason]
    kept = [component for component in seen if component.kept]
    assert len(kept) == 1
    (left_out,) = (c for c in apart.components if "nothing says for sure where it lies" in c.reason)
    assert left_out.start_s > 7
    (whole,) = (component for component in joined.components if component.kept)
    assert (whole.start_s, whole.end_s) == (0.0, pytest.approx(14, abs=1))
    inside = np.flatnonzero(joined.map.trajectory_estimated).tolist()
    assert {20, 90, 140} <= set(inside)
    assert laid_on_truth(joined.map.trajectory.frame_from_body[inside], inside).max() < 0.05
