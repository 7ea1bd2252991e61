"""rosbag2's SQLite: bags of rosbags' writer and of rosbag2 itself, and databases that are none."""

import pickle
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from fleetmap.errors import RecordingError, UsageError
from fleetmap.plugins.other_recorders.sqlite import SqliteFiles
from fleetmap.recordings import OpenOptions, Topics, named_topics, open_recording
from support.recordings.bag_samples import assert_same, write_rosbag2
from support.recordings.mcap_samples import SAMPLE, foreign_messages
from support.recordings.realdata import real_data
from support.storage.memory_limit import memory_at_most


def test_the_same_sensors_give_the_same_samples_through_mcap_and_sqlite(tmp_path: Path) -> None:
    messages = foreign_messages()
    bag = write_rosbag2(tmp_path / "bag", messages)
    mcap = write_rosbag2(tmp_path / "mcap", messages, storage=StoragePlugin.MCAP)
    with open_recording(bag) as recording, open_recording(bag / "bag.db3") as file, open_recording(mcap) as other:
        assert recording.issues == file.issues == other.issues == ()
        assert (recording.format, recording.name) == ("rosbag2-sqlite", "bag")
        np.testing.assert_array_equal(recording.read_frame(2).left, SAMPLE.left[2])
        assert_same(recording, other)
        assert_same(file, other)
        assert recording.content_hash() == file.content_hash()


@pytest.mark.parametrize("storage", StoragePlugin)
def test_messages_that_are_compressed_one_by_one(tmp_path: Path, storage: StoragePlugin) -> None:
    """Also one of them that is damaged: it alone is left out."""
    messages = [*foreign_messages()]
    plain = write_rosbag2(tmp_path / "plain", messages, storage=storage)
    packed = write_rosbag2(tmp_path / "packed", messages, CompressionMode.MESSAGE, storage)
    with open_recording(plain) as first, open_recording(packed) as second:
        assert_same(first, second)
        assert first.issues == second.issues == ()
    (row,) = [n for n, m in enumerate(messages) if m[1] == "sensor_msgs/Imu"][7:8]
    packed_imu = zstandard.compress(bytes(messages[row][3]))
    messages[row] = (*messages[row][:3], packed_imu[:20] + bytes(8) + packed_imu[28:])
    with open_recording(write_rosbag2(tmp_path / "torn", messages, storage=storage)) as torn:
        assert (len(torn.imu), len(torn.issues)) == (len(first.imu) - 1, 1)


def test_a_bag_of_several_files(tmp_path: Path) -> None:
    messages = foreign_messages()
    whole, split = write_rosbag2(tmp_path / "whole", messages), tmp_path / "split"
    middle = SAMPLE.stamps_ns[2]
    early = [m for m in messages if m[2] < middle]
    write_rosbag2(split, early)
    (split / "split.db3").rename(split / "split_9.db3")
    rest = write_rosbag2(tmp_path / "rest", [m for m in messages if m[2] >= middle])
    (rest / "rest.db3").rename(split / "split_10.db3")
    (split / "metadata.yaml").unlink()  # as a recorder that was killed leaves it
    with open_recording(whole) as first, open_recording(split) as second:
        assert_same(first, second)
        assert second.issues == ()


def test_a_part_is_read_apart(tmp_path: Path) -> None:
    with open_recording(write_rosbag2(tmp_path / "bag", foreign_messages())) as recording:
        part = pickle.loads(pickle.dumps(recording.part(np.array([3, 1]))))
    with part:
        np.testing.assert_array_equal(part.read_frame(1).left, SAMPLE.left[1])
    with pytest.raises(RecordingError, match="after the recording was closed"):
        part.read_frame(1)


def test_topics_are_named_as_the_message_says(tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "bag", foreign_messages(left="/a/image", right="/b/image"))
    with pytest.raises(RecordingError, match=r"name it with --topic left=/NAME\. There is .*/a/image"):
        open_recording(bag)
    topics = named_topics(["left=/a/image", "right=/b/image", "imu="], Topics(wheel="/w"))
    assert topics == Topics(left="/a/image", right="/b/image", imu="", wheel="/w")
    with open_recording(bag, OpenOptions(topics=named_topics(["left=/a/image", "right=/b/image"]))) as recording:
        np.testing.assert_array_equal(recording.read_frame(0).right, SAMPLE.right[0])
    with pytest.raises(RecordingError, match=r"has no topic /c/image.*/b/image"):
        open_recording(bag, OpenOptions(topics=named_topics(["left=/c/image"])))
    for word in ("left", "lef=/a", "/a/image"):
        with pytest.raises(UsageError, match=rf"--topic {word}: write ROLE=NAME.*left, right, depth"):
            named_topics([word])


# ------------------------------------------------------------------------------------------------------- what is no recording


def database(path: Path, *commands: str, **values: bytes) -> Path:
    with sqlite3.connect(path) as connection:
        for command in commands:
            connection.execute(command, values)
    connection.close()
    return path


TOPICS = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)"
MESSAGES = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"
TOPIC = "INSERT INTO topics VALUES (1, '/cam0/image_raw', 'sensor_msgs/msg/Image', 'cdr')"
IMAGES = (TOPICS, MESSAGES, TOPIC)


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        (["CREATE TABLE sites (id)"], r"an SQLite database, but not a rosbag2 recording: it holds sites"),
        (["CREATE TABLE topics (id)", "CREATE TABLE messages (id)"], r"cannot be read \(no such column"),
        ([TOPICS, "CREATE VIEW messages AS SELECT 1 AS topic_id, 2 AS timestamp, 3 AS data"], "not a rosbag2"),
        ([TOPICS, MESSAGES], r"no message that can be read \(it is empty\)"),
        ([*IMAGES, "INSERT INTO messages VALUES (1, 1, 'noon', x'00')"], "damaged messages: 1 rows left out"),
        ([*IMAGES, "INSERT INTO messages VALUES (1, 1, 5, x'28b52ffd00')"], "/cam0/image_raw: .*message is damaged"),
        ([*IMAGES, "INSERT INTO messages VALUES (1, 1, 5, x'0001')"], "/cam0/image_raw: .*message is damaged"),
    ],
    ids=["other tables", "other columns", "a view", "empty", "a stamp of words", "broken zstd", "a cut message"],
)
def test_other_databases_get_words_of_their_own(tmp_path: Path, commands: list[str], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        open_recording(database(tmp_path / "other.db3", *commands))


def test_values_that_are_made_while_reading_cost_no_memory(tmp_path: Path) -> None:
    made = "CREATE TABLE messages (topic_id, timestamp, data AS (zeroblob(1000000000)))"
    bombs = {
        "column": (made, "INSERT INTO messages (topic_id, timestamp) VALUES (1, 5)"),
        "packed": (MESSAGES, "INSERT INTO messages VALUES (1, 1, 5, :bomb)"),
    }
    for name, commands in bombs.items():
        bomb = zstandard.compress(bytes(400 << 20), 1)
        path = database(tmp_path / f"{name}.db3", TOPICS, TOPIC, *commands, bomb=bomb)
        with memory_at_most(300 << 20), pytest.raises(RecordingError, match=r"too big|rows left out"):
            open_recording(path)


def test_a_cut_database_is_read_as_far_as_it_is_whole_or_named(tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "bag", foreign_messages())
    data = (bag / "bag.db3").read_bytes()
    seen = set()
    for share in (0.0, 0.02, 0.3, 0.6, 0.9, 0.99):
        path = tmp_path / f"cut-{share}.db3"
        path.write_bytes(data[: int(share * len(data))])
        try:
            with open_recording(path) as recording:
                assert any("damaged" in issue.what and ".recover" in issue.detail for issue in recording.issues)
                for index in range(len(recording)):
                    np.testing.assert_array_equal(recording.read_frame(index).left, SAMPLE.left[index])
                seen.add("part")
        except RecordingError as error:
            assert str(path) in str(error)
            seen.add("error")
    assert "error" in seen


def test_files_that_are_packed_whole_name_the_command(tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "bag", foreign_messages(), CompressionMode.FILE)
    with pytest.raises(RecordingError, match=r"compressed as a whole; unpack it with `zstd -d .*bag\.db3\.zstd`"):
        open_recording(bag)


def test_a_log_that_the_recorder_left_is_named(tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "bag", foreign_messages())
    (bag / "bag.db3-wal").write_bytes(bytes(100))
    before = sorted(p.name for p in bag.iterdir())
    with open_recording(bag) as recording:
        assert any("wal_checkpoint" in issue.detail for issue in recording.issues)
    assert sorted(p.name for p in bag.iterdir()) == before, "nothing is written beside it"


# ----------------------------------------------------------------------------------------------------- rosbag2's own test bags


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cdr_test", r"/test_topic \(test_msgs/BasicTypes in cdr\)"),
        ("wrong_rmw_test", r"in (wrong_format|cdr).*known encodings are cdr"),
        ("bag_with_topics_and_service_events", r"test_msgs/Strings in cdr"),
    ],
)
def test_rosbag2s_own_bags_are_opened_and_say_what_they_hold(storage: str, name: str, words: str) -> None:
    bag = real_data("conformance/rosbag2") / "rosbag2_tests/resources" / storage / name
    with pytest.raises(RecordingError, match=words):
        open_recording(bag)


@pytest.mark.parametrize("name", ["cdr_test", "bag_with_topics_and_service_events"])
def test_rosbag2s_own_bags_give_the_same_messages_as_by_rosbags(name: str) -> None:
    bag = real_data("conformance/rosbag2") / "rosbag2_tests/resources/sqlite3" / name
    ours = SqliteFiles(sorted(bag.glob("*.db3")))
    found = [(each.topic, stamp_ns, bytes(data), ours.read(place)) for each, stamp_ns, place, data in ours.messages()]
    ours.close()
    with Reader(bag) as reader:
        theirs = [(connection.topic, stamp_ns, bytes(data)) for connection, stamp_ns, data in reader.messages()]
    assert len(theirs) >= 7
    assert sorted(row[:3] for row in found) == sorted(theirs)
    assert all(data == again for *_, data, again in found)
