"""The configuration file of a robot that lacks nothing."""

from pathlib import Path

from mapserver.store import MapStore
from support.recordings.recording_samples import make_sample, write_mcap
from support.storage.map_samples import publish_samples


def good_robot(tmp_path: Path) -> Path:
    """A file in the folder, with the store and the recording that it names."""
    write_mcap(tmp_path / "walk", make_sample(12))
    with MapStore.open(tmp_path / "store", create=True) as maps:
        publish_samples(maps, 1)
    path = tmp_path / "robot.toml"
    path.write_text(
        f'[run]\nstore = "{tmp_path}/store"\nsite = "lab"\nrobot = "r1"\noutbox = "{tmp_path}/spool"\n'
        f'[source]\nkind = "recording"\nrecording = "{tmp_path}/walk"\nspeed = 0\n'
    )
    return path
