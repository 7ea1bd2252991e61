"""Files whose chunks, parts and channels are not in the order of time: messages count as they were logged."""

import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from mcap.writer import CompressionType
from rosbags.rosbag2 import StoragePlugin

from fleetmap.recordings import open_recording
from support.recordings.bag_samples import assert_same, write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import SAMPLE, Message, foreign_messages, write_foreign

MESSAGES = sorted(foreign_messages(), key=lambda message: message[2])


def shuffled(window: int) -> list[Message]:
    """Each message up to `window` places late."""
    late = Random(7)
    numbers = sorted(range(len(MESSAGES)), key=lambda n: n + late.uniform(0, window))
    return [MESSAGES[n] for n in numbers]


def parts(folder: Path, storage: StoragePlugin) -> Path:
    """Three files of one bag, whose numbers are not in the order of time, and whose times overlap."""
    bag, suffix, late = folder / "drive", ".db3" if storage is StoragePlugin.SQLITE3 else ".mcap", shuffled(30)
    bag.mkdir()
    for number, chosen in ((10, late[:80]), (2, late[80:110]), (9, late[110:])):
        write_rosbag2(folder / f"part{number}", chosen, storage=storage)
        shutil.move(folder / f"part{number}/part{number}{suffix}", bag / f"drive_{number}{suffix}")
    return bag


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_foreign(folder / "a.mcap", shuffled(40), compression=CompressionType.ZSTD),
        lambda folder: write_foreign(folder / "a.mcap", MESSAGES[::-1], chunk_size=1000),
        lambda folder: write_foreign(folder / "a.mcap", MESSAGES, publishers=2),
        lambda folder: write_foreign(folder / "a.mcap", shuffled(40), publishers=3),
        lambda folder: parts(folder, StoragePlugin.SQLITE3),
        lambda folder: parts(folder, StoragePlugin.MCAP),
        lambda folder: write_rosbag1(folder / "a.bag", shuffled(40), publishers=2),
        # the recorder's clock was set back by 0.1 s, the sensors' was not
        lambda folder: write_foreign(
            folder / "a.mcap", MESSAGES, log_delay_ns=lambda stamp_ns: -100_000_000 * (stamp_ns > SAMPLE.stamps_ns[2])
        ),
    ],
    ids=["neighbours", "backwards", "publishers", "both", "sqlite parts", "mcap parts", "ros1", "recorder's clock"],
)
def test_messages_count_as_they_were_logged(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    sorted_file = write_foreign(tmp_path / "plain.mcap", MESSAGES)
    with open_recording(write(tmp_path)) as recording, open_recording(sorted_file) as plain:
        assert recording.issues == plain.issues == ()
        assert_same(recording, plain)
