"""--frames A:B:C means what Python's slices mean."""

from pathlib import Path

import pytest

from fleetmap.errors import UsageError
from fleetmap.recordings import FrameSelection, open_recording
from support.recordings.recording_samples import make_sample, write_mcap

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
