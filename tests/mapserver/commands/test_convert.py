"""`mapserver convert`: complete or not at all."""

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from fleetmap.errors import CalibrationError, RecordingError, UsageError
from fleetmap.recordings import open_recording
from mapserver.commands.convert import convert
from support.recordings.recording_samples import make_sample, write_euroc

SAMPLE = make_sample(3)


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(convert)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "r", SAMPLE, image_type="jpg")


def test_converts_and_keeps_jpeg_bytes(euroc: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert run(euroc, out).exit_code == 0
    with open_recording(out) as copy:
        assert len(copy) == 3
        assert copy.stored_frame(1).left.data == (euroc / "mav0/cam0/data/image1.jpg").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.mcap", "r"]


def test_refuses_to_overwrite_unless_forced(euroc: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_bytes(b"precious")
    refused = run(euroc, out)
    assert isinstance(refused.exception, UsageError)
    assert "--force" in str(refused.exception)
    assert out.read_bytes() == b"precious"
    assert run(euroc, out, "--force").exit_code == 0
    assert len(open_recording(out)) == 3


def test_refuses_other_endings_and_itself(euroc: Path, tmp_path: Path) -> None:
    assert isinstance(run(euroc, tmp_path / "out.bag").exception, UsageError)
    out = tmp_path / "out.mcap"
    run(euroc, out)
    assert "itself" in str(run(out, out, "--force").exception)


def test_a_failure_leaves_nothing_and_harms_nothing(euroc: Path, tmp_path: Path) -> None:
    """The last image is cut: the old output stays, no half file appears."""
    (euroc / "mav0/cam1/data/image2.jpg").unlink()
    (euroc / "mav0/cam1/data/image2.jpg").mkdir()
    out = tmp_path / "out.mcap"
    out.write_bytes(b"old")
    result = run(euroc, out, "--force")
    assert isinstance(result.exception, RecordingError)
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.mcap", "r"]


def test_calibration_is_stored(euroc: Path, tmp_path: Path) -> None:
    assert isinstance(
        run(euroc, tmp_path / "a.mcap", "--calibration", tmp_path / "none.yaml").exception, CalibrationError
    )
    from support.recordings.recording_samples import kalibr_text

    (tmp_path / "rig.yaml").write_text(kalibr_text() + "base_from_body: [[1,0,0,5], [0,1,0,0], [0,0,1,0], [0,0,0,1]]\n")
    assert run(euroc, tmp_path / "a.mcap", "--calibration", tmp_path / "rig.yaml").exit_code == 0
    assert open_recording(tmp_path / "a.mcap").calibration.base_from_body[0, 3] == 5
