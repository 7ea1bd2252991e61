"""`mapserver convert`: complete or not at all."""

import errno
import os
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from fleetmap.errors import CalibrationError, UsageError
from fleetmap.recordings import open_recording
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from mapserver.commands.recordings import convert
from support.recordings.recording_samples import kalibr_text, make_sample, write_euroc

SAMPLE = make_sample(3)


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(convert)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "r", SAMPLE, image_type="jpg")


def test_converts_and_keeps_jpeg_bytes(euroc: Path, tmp_path: Path) -> None:
    assert isinstance(run(euroc, tmp_path / "out.bag").exception, UsageError)
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
    assert "itself" in str(run(out, out, "--force").exception)


def test_a_failure_leaves_nothing_and_harms_nothing(euroc: Path, tmp_path: Path, monkeypatch) -> None:
    """The disk is full in the middle: the old output stays, no half file appears."""
    written = []

    def write_frame(writer: McapRecordingWriter, frame: object) -> None:
        written.append(frame)
        if len(written) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(McapRecordingWriter, "write_frame", write_frame)
    out = tmp_path / "out.mcap"
    out.write_bytes(b"old")
    assert "No space left" in str(run(euroc, out, "--force").exception)
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.mcap", "r"]


def test_calibration_is_stored(euroc: Path, tmp_path: Path) -> None:
    refused = run(euroc, tmp_path / "a.mcap", "--calibration", tmp_path / "none.yaml")
    assert isinstance(refused.exception, CalibrationError)
    (tmp_path / "rig.yaml").write_text(kalibr_text() + "base_from_body: [[1,0,0,5], [0,1,0,0], [0,0,1,0], [0,0,0,1]]\n")
    assert run(euroc, tmp_path / "a.mcap", "--calibration", tmp_path / "rig.yaml").exit_code == 0
    assert open_recording(tmp_path / "a.mcap").calibration.base_from_body[0, 3] == 5
