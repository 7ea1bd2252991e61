"""A survey that loses itself: another part, joined by sure revisits alone, on the way and in the draft."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import SensorSet
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions
from mapserver.plugins.live_surveys import live_survey
from mapserver.plugins.live_surveys.live_survey import LiveRequest, run_live
from mapserver.plugins.live_surveys.message import LiveSurveyState
from support.recordings.kidnapped_ride import APART_FRAMES, kidnapped
from support.recordings.live_drives import MappingHere, played
from support.recordings.recording_samples import write_mcap

SETTINGS = survey_settings(None, SensorSet.STEREO)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "kidnapped", kidnapped())


class Drive:
    """A kidnapped survey as `mapserver live` follows and builds it, mapped in this process."""

    def __init__(self, recording: Path, frames: str, store: Path) -> None:
        options = BuildOptions(use=SensorSet.STEREO)
        with pytest.MonkeyPatch.context() as patch, played(recording, frames, 0, SensorSet.STEREO) as drive:
            patch.setattr(live_survey, "MappingProcess", MappingHere)
            request = LiveRequest("lab", store / "maps", SETTINGS, options)
            built = run_live(request, drive, self._hear, lambda: False, Console(quiet=True)).built
        assert built is not None
        (self.survey,) = (surveyed.survey for surveyed in built.built.surveyed)
        self.trajectory, self.mapping = built.trajectory, MappingHere.made

    def _hear(self, state: LiveSurveyState) -> None:
        self.last = state


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(recording, "::", tmp_path_factory.mktemp("whole"))


def laid_on_truth(map_from_body: Array, frames: list[int]) -> Array:
    """(K,) metres from the truth, the first one laid upon it."""
    truth = np.array(kidnapped().world_from_body)[frames]
    laid = truth[0] @ se3_inverse(map_from_body[0]) @ map_from_body
    return np.asarray(np.linalg.norm(laid[:, :3, 3] - truth[:, :3, 3], axis=1))


def test_it_goes_on_as_another_part_until_a_sure_revisit_joins_it(whole: Drive) -> None:
    after = whole.mapping.after
    before, apart = (after[max(n for n in after if n < frame)].parts for frame in (36, APART_FRAMES))
    joined = whole.last.parts
    assert [len(parts) for parts in (before, apart, joined)] == [1, 2, 1]
    first, second = apart
    assert first.end_s < 4.0
    assert second.start_s > 7.0
    assert [first.is_map, second.is_map] == [True, False]
    assert (whole.mapping.sketch.part == 0).sum() == joined[0].keyframes
    frames, lit = list(after), np.flatnonzero(whole.mapping.sketch.part == 0).tolist()
    error_m = laid_on_truth(whole.mapping.map_from_body[lit], [frames[k] for k in lit])
    assert np.quantile(error_m, 0.9) < 0.1


def test_the_draft_has_the_parts_that_were_joined(whole: Drive) -> None:
    (kept,) = (component for component in whole.survey.components if component.kept)
    assert (kept.start_s, kept.end_s) == (0.0, pytest.approx(14, abs=1))
    inside = np.flatnonzero(whole.survey.map.trajectory_estimated).tolist()
    assert {20, 90, 140} <= set(inside)
    assert laid_on_truth(whole.trajectory.frame_from_body[inside], inside).max() < 0.05


def test_the_draft_names_the_parts_that_nothing_joined(recording: Path, tmp_path: Path) -> None:
    apart = Drive(recording, f":{APART_FRAMES}", tmp_path)
    assert len(apart.last.parts) == 2
    seen = [component for component in apart.survey.components if "saw" not in component.reason]
    assert len([component for component in seen if component.kept]) == 1
    (left_out,) = (c for c in seen if "relative to the largest part is uncertain" in c.reason)
    assert left_out.start_s > 7
