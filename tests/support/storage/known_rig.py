"""Options for sites whose rig is known: their short rides cannot judge the calibration, and their tests are about something else."""

from pathlib import Path


def known_rig(folder: Path) -> list[str]:
    """`--config` with a file in `folder` that lets the gate publish a first version of whose calibration something was not judged."""
    path = folder / "known_rig.toml"
    path.write_text("[gate]\nallow_unjudged_calibration = true\n")
    return ["--config", str(path)]
