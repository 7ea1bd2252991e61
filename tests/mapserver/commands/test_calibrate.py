"""`mapserver calibrate` over a recording with a damaged picture."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from mapserver.cli import app
from support.recordings.recording_samples import write_euroc
from support.worlds.box_room import out_and_back, ride_sample


@pytest.mark.parametrize("image_type", ["jpg", "png"])
def test_a_damaged_picture_costs_its_frame(tmp_path: Path, image_type: str) -> None:
    folder = write_euroc(tmp_path / "ride", ride_sample(out_and_back(6.0), 31, 0.1), image_type=image_type)
    file = folder / f"mav0/cam1/data/image9.{image_type}"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 3] + data[len(data) // 2 :])
    done = CliRunner().invoke(app, ["calibrate", str(folder)])
    assert done.exit_code == 0, done.output
    assert "damaged" in done.stderr
    assert "corrections to the calibration" in done.stdout
