"""What image_transport and its plugins send: read in bags and live alike, or named with what to record in its place."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.typesys import Stores, get_typestore

from fleetmap.errors import RecordingError
from fleetmap.recordings import open_recording
from fleetmap.recordings.images import decode_frame
from fleetmap.recordings.mcap.writer import copy_to_mcap
from fleetmap.sensors.source_settings import Topics
from fleetmap.sources.intake import Intake
from locclient.plugins.ros2_node.sensor_messages import SensorMessages
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import SAMPLE, Message, foreign_messages, write_foreign
from support.recordings.recording_samples import HEIGHT, WIDTH, calibration

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "sensor_msgs/msg/CompressedImage"
STAMPS_NS = SAMPLE.stamps_ns.tolist()
DEPTH_M = np.tile(np.linspace(0.4, 9.0, WIDTH, dtype=np.float32), (HEIGHT, 1))
DEPTH_M[:5] = np.nan
DEPTH_MM = np.nan_to_num(DEPTH_M * 1000).astype(np.uint16)
A, B = 10100.0, -1009.0  # compressed_depth_image_transport's for 10 m in 100 steps
QUANTIZED = np.nan_to_num(A / DEPTH_M + B).astype(np.uint16)


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def head(a: float = A, b: float = B) -> bytes:
    return struct.pack("<iff", 0, a, b)


def compressed(stamp_ns: int, form: str, data: bytes) -> bytes:
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id="cam0_optical")
    message = STORE.types[TYPE](header=header, format=form, data=np.frombuffer(data, np.uint8))
    return bytes(STORE.serialize_cdr(message, TYPE))


def with_images(topic: str, form: str, data: bytes) -> list[Message]:
    messages = [m for m in foreign_messages() if m[0].startswith(("/cam0/", "/imu0", "/tf")) and m[0] != topic]
    return messages + [(topic, "sensor_msgs/CompressedImage", s, compressed(s, form, data)) for s in STAMPS_NS]


def live_depth(form: str, data: bytes) -> np.ndarray:
    queue = Intake(frames=9, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
    rig, topics = replace(calibration(), cameras=calibration().cameras[:1], imu=None), Topics()
    sensors = SensorMessages(topics, rig, has_depth=True)
    for topic, payload in (
        (f"{topics.left}/compressed", compressed(50, "mono8; png compressed", png(SAMPLE.left[0]))),
        (f"{topics.depth}/compressedDepth", compressed(50, form, data)),
    ):
        (take,) = (take for names, _, take in sensors.topics if topic in names)
        take(queue, True, payload)
    return decode_frame(queue.take(1.0).frame).depth_m


@pytest.mark.parametrize(
    ("form", "data", "step_m2"),
    [
        ("32FC1; compressedDepth", head() + png(QUANTIZED), 1 / A),
        ("32FC1; compressedDepth png", head() + png(QUANTIZED), 1 / A),
        ("16UC1; compressedDepth", head(0, 0) + png(DEPTH_MM), 0.0),
        ("16UC1; compressedDepth png", head() + png(DEPTH_MM), 0.0),
        ("mono16; compressedDepth png", head(0, 0) + png(DEPTH_MM), 0.0),
        ("16UC1; compressedDepth", png(DEPTH_MM), 0.0),
    ],
)
def test_compressed_depth_is_metres_in_bags_and_live(tmp_path: Path, form: str, data: bytes, step_m2: float) -> None:
    messages = with_images("/depth/image_raw/compressedDepth", form, data)
    paths = [write_foreign(tmp_path / "a.mcap", messages), write_rosbag2(tmp_path / "rosbag2", messages)]
    paths += [write_rosbag1(tmp_path / "a.bag", messages), tmp_path / "copy.mcap"]
    with open_recording(paths[0]) as recording:
        copy_to_mcap(recording, paths[-1])
    found = [live_depth(form, data), *(open_recording(path).read_frame(1).depth_m for path in paths)]
    wanted = np.nan_to_num(DEPTH_M)
    for depth_m in found:
        np.testing.assert_array_equal(depth_m > 0, wanted > 0)
        assert (np.abs(depth_m - wanted) <= 0.0011 + step_m2 * wanted**2).all()


GREY = SAMPLE.left[0]
TINTED = cv2.merge([GREY // 2, GREY, GREY])


@pytest.mark.parametrize(
    ("form", "suffix", "pixels", "wanted"),
    [
        ("rgb8; jpeg compressed bgr8", ".jpg", TINTED, cv2.cvtColor(TINTED, cv2.COLOR_BGR2GRAY)),
        ("jpeg", ".jpg", GREY, GREY),
        ("png", ".png", GREY, GREY),
        ("mono16; png compressed ", ".png", GREY.astype(np.uint16) * 256, GREY),
        ("bgr8; tiff compressed bgr8", ".tiff", TINTED, cv2.cvtColor(TINTED, cv2.COLOR_BGR2GRAY)),
        ("bayer_rggb8; png compressed ", ".png", GREY, cv2.cvtColor(GREY, cv2.COLOR_BayerRGGB2GRAY)),
    ],
)
def test_pictures_of_image_transport(
    tmp_path: Path, form: str, suffix: str, pixels: np.ndarray, wanted: np.ndarray
) -> None:
    messages = with_images("/cam0/image_raw/compressed", form, cv2.imencode(suffix, pixels)[1].tobytes())
    messages = [m for m in messages if m[0] != "/cam0/image_raw"]
    with open_recording(write_foreign(tmp_path / "a.mcap", messages)) as recording:
        copy_to_mcap(recording, tmp_path / "copy.mcap")
        for opened in (recording, open_recording(tmp_path / "copy.mcap")):
            assert np.abs(opened.read_frame(1).left.astype(int) - wanted).mean() < (2.0 if suffix == ".jpg" else 0.01)


COLOUR, DEPTH = "/cam0/image_raw/compressed", "/depth/image_raw/compressedDepth"


@pytest.mark.parametrize(
    ("topic", "form", "data", "says"),
    [
        (DEPTH, "16UC1; compressedDepth rvl", head() + bytes(40), r"packed as RVL; .*compressedDepth\.format to png"),
        (DEPTH, "32FC1; compressedDepth rvl", head() + bytes(40), "packed as RVL"),
        (DEPTH, "32FC1; compressedDepth png", head(np.nan, 0) + png(QUANTIZED), r"are nan and 0; record raw depth"),
        (DEPTH, "32FC1; compressedDepth png", head() + png(GREY), "uint8 pixels.*16 bits and one channel"),
        (DEPTH, "32FC1; compressedDepth png", head()[:9], "a depth image of 9 bytes"),
        (DEPTH, "32FC1; compressedDepth", png(QUANTIZED), "their format is '32FC1; compressedDepth'"),
        (DEPTH, "16UC1; jpeg compressed ", cv2.imencode(".jpg", GREY)[1].tobytes(), "not a depth image; use 16UC1"),
        (COLOUR, "h264", b"\0\0\0\1\x67" + bytes(40), r"H\.264 video; .*republish ffmpeg compressed"),
        (COLOUR, "hevc", b"\0\0\0\1\x40" + bytes(40), r"H\.265 video"),
        (COLOUR, "", b"\0\0\1\x67" + bytes(40), r"H\.264 or H\.265 video"),
        (COLOUR, "webp", cv2.imencode(".webp", GREY)[1].tobytes(), "a WebP image; record JPEG, PNG"),
        (COLOUR, "zstd", b"\x28\xb5\x2f\xfd" + bytes(40), "their format is 'zstd'"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, topic: str, form: str, data: bytes, says: str) -> None:
    unused = ("/imu0", "/cam0/image_raw") if topic == COLOUR else ()
    messages = [m for m in with_images(topic, form, data) if m[0] not in unused]
    for path in (write_foreign(tmp_path / "a.mcap", messages), write_rosbag1(tmp_path / "a.bag", messages)):
        with pytest.raises(RecordingError, match=rf"{topic}.*{says}"):
            open_recording(path)


def test_packets_of_a_video_are_named(tmp_path: Path) -> None:
    """By Foxglove's own class, whose recordings hold one message a picture that cannot be read alone."""
    with (tmp_path / "a.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        for stamp_ns in STAMPS_NS:
            packet = CompressedVideo(data=b"\0\0\0\1\x67", format="h264")
            writer.write_message("/cam0/video", packet, stamp_ns, stamp_ns)
    says = r"video not read: /cam0/video \(foxglove.CompressedVideo\); record JPEG or raw"
    with pytest.raises(RecordingError, match=says):
        open_recording(tmp_path / "a.mcap")
