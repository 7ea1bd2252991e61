"""ROS 1 bags of rosbags' writer: the samples of MCAP; cut, locked, packed and lying ones."""

import bz2
import pickle
import re
import struct
import sys
from collections.abc import Sequence
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader, Writer

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import se3
from fleetmap.plugins.other_recorders import ros1
from fleetmap.recordings import open_recording
from fleetmap.recordings.ros2.messages import FrameLink, encode_frame_links
from fleetmap.sensors.rectification import Rectifier
from support.recordings.bag_samples import assert_same, edited, write_rosbag1
from support.recordings.mcap_samples import SAMPLE, Message, foreign_messages, write_foreign
from support.recordings.recording_samples import BASELINE_M, FOCAL
from support.storage.memory_limit import memory_at_most


@pytest.mark.parametrize("compression", [None, *Writer.CompressionFormat])
def test_the_same_sensors_give_the_same_samples_through_mcap_and_bag(
    tmp_path: Path, compression: Writer.CompressionFormat | None
) -> None:
    bag = write_rosbag1(tmp_path / "a.bag", foreign_messages(), compression)
    with open_recording(bag) as first, open_recording(write_foreign(tmp_path / "a.mcap", foreign_messages())) as second:
        assert (first.issues, first.format, first.name) == ((), "rosbag1", "a")
        assert_same(first, second)
        np.testing.assert_array_equal(first.read_frame(2).left, SAMPLE.left[2])
        with pickle.loads(pickle.dumps(first.part(np.array([3, 1])))) as part:
            np.testing.assert_array_equal(part.read_frame(1).left, SAMPLE.left[1])


def test_ros_1_messages_in_mcap(tmp_path: Path) -> None:
    """As `mcap convert` makes them of a bag."""
    bag = write_rosbag1(tmp_path / "a.bag", foreign_messages())
    with Reader(bag) as reader, (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1", library="test")
        channels = {}
        for c in reader.connections:
            schema = writer.register_schema(c.msgtype.replace("/msg/", "/"), "ros1msg", c.msgdef.data.encode())
            channels[c.id] = writer.register_channel(c.topic, "ros1", schema)
        for c, stamp_ns, data in reader.messages():
            writer.add_message(channels[c.id], stamp_ns, bytes(data), stamp_ns)
        writer.finish()
    with open_recording(tmp_path / "a.bag") as first, open_recording(tmp_path / "a.mcap") as second:
        assert_same(first, second)


def test_messages_of_one_moment_are_told_apart(tmp_path: Path) -> None:
    """A recorder that stamps two images alike."""
    now = int(SAMPLE.stamps_ns[-1])
    same = [(topic, name, now, data) for topic, name, _, data in foreign_messages()]
    with open_recording(write_rosbag1(tmp_path / "a.bag", same)) as recording:
        for index in (2, 0, 3):
            np.testing.assert_array_equal(recording.read_frame(index).left, SAMPLE.left[index])


def spoiled(path: Path, before: bytes, after: bytes) -> Path:
    data = path.read_bytes()
    assert before in data and len(before) == len(after)
    path.write_bytes(data.replace(before, after))
    return path


def header(**fields: bytes) -> bytes:
    rows = [f"{name}=".encode() + value for name, value in fields.items()]
    content = b"".join(struct.pack("<I", len(row)) + row for row in rows)
    return struct.pack("<I", len(content)) + content


def test_what_cannot_be_read_gets_the_command_that_makes_it_readable(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path / "a.bag", foreign_messages())
    sound = bag.read_bytes()
    at = sound.index(b"index_pos=") + len(b"index_pos=")
    cases = {
        "open.bag": (sound[:at] + bytes(8) + sound[at + 8 :], "not indexed.*`rosbag reindex .*open.bag`"),
        "zip.bag": (sound.replace(b"compression=none", b"compression=zipp"), "Compression 'zipp'.*`rosbag decompress"),
        "old.bag": (sound.replace(b"#ROSBAG V2.0", b"#ROSBAG V1.2"), "version"),
        "empty.bag": (b"", "empty"),
        "other.bag": (b"\0" * 5000, "magic"),
        "cut.bag": (sound[:-500], "damaged: `rosbag reindex"),
        "half.bag": (sound[: len(sound) // 2], "`rosbag reindex"),
    }
    fixed = {"op": b"\x03", "index_pos": bytes(8), "conn_count": bytes(4), "chunk_count": bytes(4)}
    locked = b"#ROSBAG V2.0\n" + header(**fixed, encryptor=b"rosbag/Aes") + bytes(4)
    cases["locked.bag"] = (locked, "encryption 'rosbag/Aes'.*`rosbag decrypt")
    for name, (data, words) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(RecordingError, match=words) as caught:
            open_recording(tmp_path / name)
        assert name in str(caught.value)


def test_other_definitions_and_types_are_not_guessed(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path / "a.bag", foreign_messages())
    digest = ros1.ros1_digest("sensor_msgs/Imu").encode()
    with open_recording(spoiled(bag, digest, b"0" * 32)) as recording:
        assert len(recording.imu) == 0
        assert any("another definition" in i.what and "/imu0" in i.detail for i in recording.issues)
    other = write_rosbag1(tmp_path / "b.bag", [m for m in foreign_messages() if m[0] == "/imu0"])
    spoiled(other, b"sensor_msgs/Imu", b"sensor_msgs/Umi")
    with pytest.raises(RecordingError, match=r"no topic of a known type: /imu0 \(sensor_msgs/msg/Umi\)"):
        open_recording(other)


@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_a_chunk_unpacks_to_no_more_than_its_limit(tmp_path: Path, kind: str) -> None:
    image = [m for m in foreign_messages() if m[0] == "/cam0/image_raw"][:1]
    bag = write_rosbag1(tmp_path / "a.bag", image, Writer.CompressionFormat[kind.upper()])
    sound = bag.read_bytes()
    at = sound.index(b"compression=" + kind.encode())
    size_at = sound.index(b"size=", at) + 5 + 4  # the uncompressed size, then that of the data
    (size,) = struct.unpack_from("<I", sound, size_at)
    zeros = bytes(80 << 20)
    bomb = bz2.compress(zeros, 1) if kind == "bz2" else lz4.frame.compress(zeros)
    grown = len(bomb) - size
    data = sound[:size_at] + struct.pack("<I", len(bomb)) + bomb + sound[size_at + 4 + size :]
    index_at = data.index(b"index_pos=") + 10
    (index_pos,) = struct.unpack_from("<Q", data, index_at)
    bag.write_bytes(data[:index_at] + struct.pack("<Q", index_pos + grown) + data[index_at + 8 :])
    with memory_at_most(300 << 20), pytest.raises(RecordingError, match=r"unpack to more than"):
        open_recording(bag)


def test_a_record_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse.bag"
    with path.open("wb") as file:
        file.write(b"#ROSBAG V2.0\n" + struct.pack("<I", 1 << 31))
        file.truncate(3 << 30)
    with memory_at_most(300 << 20), pytest.raises(RecordingError, match="record of 2147483648 bytes"):
        open_recording(path)
    with path.open("wb") as file:
        file.truncate(3 << 30)
    with memory_at_most(300 << 20), pytest.raises(RecordingError, match="magic"):
        open_recording(path)


def test_an_index_that_counts_a_chunk_again_and_again_is_refused(tmp_path: Path) -> None:
    few = [m for m in foreign_messages() if m[0] == "/imu0"][:30]
    bag = write_rosbag1(tmp_path / "a.bag", few)
    data = bag.read_bytes()
    (count,) = struct.unpack_from("<I", data, data.index(b"chunk_count=") + 12)
    infos = [m.start() for m in re.finditer(rb"chunk_pos=", data)]
    assert count == 1, "one chunk, whose place in the index is the rest of the file"
    first = data[data.rindex(b"\x04\x00\x00\x00op=\x06", 0, infos[0]) - 4 :]
    at = data.index(b"chunk_count=") + 12
    bag.write_bytes(data[:at] + struct.pack("<I", 400) + data[at + 4 :] + 399 * first)
    with pytest.raises(RecordingError, match="index is larger than the file"):
        open_recording(bag)


def test_without_the_library_the_message_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_rosbag1(tmp_path / "a.bag", foreign_messages())
    ros1._bounded_reader.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(RecordingError, match=r"pip install .\.\[bags\]"):
        open_recording(bag)
    ros1._bounded_reader.cache_clear()


# Static transforms and CameraInfo as robots publish them: the last transform of a frame counts, and a pair has its baseline.

Link = tuple[str, str, float]  # parent, child, metres to the right
IMU, LEFT, RIGHT = "imu_link", "cam0_optical", "cam1_optical"
TREE = (IMU, LEFT, 0.1), (LEFT, RIGHT, BASELINE_M)


def static_links(stamp_ns: int, *links: Link) -> Message:
    said = [FrameLink(parent, child, se3(np.eye(3), np.array([x_m, 0.0, 0.0]))) for parent, child, x_m in links]
    return "/tf_static", "tf2_msgs/TFMessage", stamp_ns, encode_frame_links(stamp_ns, said)


@pytest.mark.parametrize(
    ("said", "names"),
    [
        ([TREE[:1], TREE[1:]], ()),
        ([TREE, TREE], ()),
        ([((IMU, LEFT, 0.1), (LEFT, RIGHT, 0.11)), TREE[1:]], ("[0.11, 0.0, 0.0]", "[0.2, 0.0, 0.0]")),
        ([(*TREE[:1], (IMU, RIGHT, 0.5)), TREE[1:]], ("imu_link -> cam1_optical", "cam0_optical -> cam1_optical")),
        ([TREE, ((IMU, LEFT, float("nan")),)], ("nan",)),
        ([TREE, ((RIGHT, RIGHT, 0.0),)], ()),
    ],
    ids=["parts", "again", "another place", "another parent", "not a place", "itself"],
)
def test_the_last_transform_of_a_frame_counts(
    tmp_path: Path, said: Sequence[Sequence[Link]], names: tuple[str, ...]
) -> None:
    """As in tf2; the file holds them backwards, and on two channels."""
    links = [static_links(stamp_ns, *each) for stamp_ns, each in enumerate(said, start=1)]
    messages = [*reversed(links), *foreign_messages(tf=False)]
    with open_recording(write_foreign(tmp_path / "a.mcap", messages, publishers=2)) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and recording.calibration.cameras[0].body_from_cam[0, 3] == pytest.approx(0.1)
        details = [issue.detail for issue in recording.issues]
        assert len(details) == bool(names) and all(name in details[0] for name in names)


@pytest.mark.parametrize("in_projection_m", [0.0, BASELINE_M])
@pytest.mark.parametrize("right_frame", [LEFT, RIGHT])
@pytest.mark.parametrize("right", [(), (LEFT, RIGHT, 0.0), (IMU, RIGHT, 0.1), TREE[1]])
def test_a_pair_has_the_baseline_of_its_transforms_or_of_its_projection(
    tmp_path: Path, right: Link | tuple[()], right_frame: str, in_projection_m: float
) -> None:
    messages = [*foreign_messages(tf=False), static_links(1, TREE[0], *([right] if right else []))]
    projection = np.array([FOCAL, 0, 0, -FOCAL * in_projection_m, 0, FOCAL, 0, 0, 0, 0, 1, 0])
    messages = edited(messages, "/cam1/camera_info", {"header.frame_id": right_frame, "p": projection})
    file = write_foreign(tmp_path / "a.mcap", messages)
    if not in_projection_m and (right_frame == LEFT or right != TREE[1]):
        with pytest.raises(CalibrationError, match=r"the pose of the right camera is unknown .* no baseline in its"):
            open_recording(file)
        return
    with open_recording(file) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and not recording.issues
