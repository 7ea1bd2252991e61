"""One bad value costs one value, and a choice that cannot be made is a note with the names: messages that rosbags changed."""

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import count, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, Recording, named_topics, open_recording
from fleetmap.recordings.images import StoredImage, grey_image
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import WheelSample
from support.recordings.bag_samples import edited, write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import IMU, SAMPLE, Message, foreign_messages, write_foreign
from support.recordings.recording_samples import FRAME_NS, HEIGHT, WIDTH, calibration

STAMPS_NS = SAMPLE.stamps_ns.tolist()
LEFT, RIGHT, INFO = "/cam0/image_raw", "/cam1/image_raw", "/cam0/camera_info"
GYRO, WHEEL, TF = "/imu0", "/odom", "/tf_static"
WHEELS = [WheelSample(s + 1000, np.array([0.5, 0.0, 0.0]), 0.1, 0.1, 0.1) for s in STAMPS_NS]
# Stereo, IMU, transforms and wheels, in the order of writing.
ROLLED = ((w.stamp_ns, ros_messages.encode_odometry(w, "odom", "base_link")) for w in WHEELS)
DRIVE: list[Message] = foreign_messages() + [(WHEEL, "nav_msgs/Odometry", *rolled) for rolled in ROLLED]
REPEATED = [message for message in DRIVE for _ in range(3 if message[0] == GYRO else 1)]
FIRST, LENS = slice(0, 1), calibration().cameras[0]


def of(*topics: str) -> list[Message]:
    return [message for message in DRIVE if message[0] in topics]


def without(topic: str) -> list[Message]:
    return [message for message in DRIVE if message[0] != topic]


EXCHANGED = (LEFT, *of(GYRO)[0][1:]), (GYRO, *of(LEFT)[0][1:])


def twice(topic: str, *names: str) -> list[Message]:
    """A topic's messages under other names."""
    return without(topic) + [(name, *message[1:]) for name in names for message in of(topic)]


def cut(topic: str, row: int, kept_bytes: int) -> list[Message]:
    whole = of(topic)[row]
    return [(*message[:3], message[3][: kept_bytes if message is whole else None]) for message in DRIVE]


def opened(folder: Path, messages: list[Message], *topics: str) -> Recording:
    return open_recording(write_foreign(folder / "a.mcap", messages), OpenOptions(topics=named_topics([*topics])))


def says_so(recording: Recording, says: str) -> bool:
    lines = [f"{issue.what} {issue.detail}" for issue in recording.issues]
    return any(re.search(says, line) for line in lines) if says else not lines


NO_STAMP = {"header.stamp.sec": 0, "header.stamp.nanosec": 0}
NO_LENS = {"k": np.zeros(9), "p": np.zeros(12)}
HALF = {"width": WIDTH // 2, "step": WIDTH // 2, "data": np.zeros(HEIGHT * (WIDTH // 2), np.uint8)}
NAN_SPEED = {"twist.twist.linear.x": float("nan")}


def quaternion(scale: float) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        turn = message.transforms[2].transform.rotation
        turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, scale

    return change


@pytest.mark.parametrize(
    ("messages", "lost", "says"),
    [
        (edited(DRIVE, GYRO, NO_STAMP, slice(5, 6)), (0, 0, 0), "imu: stamps of zero.* 1 of"),
        (edited(DRIVE, GYRO, NO_STAMP, slice(0, 20)), (0, 0, 0), "imu: stamps of zero.* 20 of .*logging"),
        (edited(DRIVE, GYRO, NO_STAMP), (0, 0, 0), "imu: stamps of zero"),
        (edited(DRIVE, WHEEL, NO_STAMP), (0, 0, 0), "wheel odometry: stamps of zero"),
        (edited(DRIVE, LEFT, NO_STAMP, FIRST), (0, 0, 0), "left images: stamps of zero"),
        (edited(DRIVE, TF, quaternion(0.99)), (0, 0, 0), "cam0_optical -> cam1_optical.*0.99.*normalised"),
        (edited(DRIVE, INFO, NO_LENS, FIRST), (0, 0, 0), ""),
        (edited(DRIVE, GYRO, {"angular_velocity.y": float("nan")}, FIRST), (0, 1, 0), "imu: impossible values 1 of"),
        (edited(DRIVE, WHEEL, NAN_SPEED, FIRST), (0, 0, 1), "/odom: damaged messages 1 left out"),
        (edited(DRIVE, LEFT, HALF, slice(1, 2)), (1, 0, 0), rf"1 of {WIDTH // 2}x\d+ left out"),
        (edited(DRIVE, LEFT, HALF, FIRST), (1, 0, 0), "left images: images of another size"),
        (cut(LEFT, 0, 900), (1, 0, 0), "left images left out 1 of 4; the first: .*ends before"),
        (cut(GYRO, 3, 60), (0, 1, 0), "/imu0: damaged messages 1 left out"),
        (cut(WHEEL, 1, 3), (0, 0, 1), "/odom: damaged messages 1 left out"),
        ([*EXCHANGED, *DRIVE], (0, 0, 0), f"another type {LEFT}: sensor_msgs/Imu left out"),
    ],
)
def test_one_bad_value_costs_one_value(
    tmp_path: Path, messages: list[Message], lost: tuple[int, int, int], says: str
) -> None:
    paths = [write_foreign(tmp_path / "a.mcap", messages)]
    if "another type" not in says:  # rosbags' writers have one type a topic
        paths.append(write_rosbag2(tmp_path / "bag", messages))
    # Nor do they make ROS 1 of a broken message
    if not any(word in says for word in ("ends before", "damaged", "another type")):
        paths.append(write_rosbag1(tmp_path / "a.bag", messages))
    for path in paths:
        with open_recording(path) as recording:
            samples = len(recording), len(recording.imu), len(recording.wheel)
            assert np.add(samples, lost).tolist() == [len(STAMPS_NS), len(IMU), len(WHEELS)], path
            for index in range(len(recording)):
                recording.read_frame(index)
            assert says_so(recording, says), [*recording.issues]
            assert np.abs(recording.imu.stamps_ns - IMU.stamps_ns[-len(recording.imu) :]).max() < 20_000_000


@pytest.mark.parametrize(
    ("rows", "left_out", "focal_scale"), [(slice(1, 2), 1, 1.0), (slice(1, None), 1, 1.3), (slice(2, 4), 2, 1.0)]
)
def test_a_lens_that_changes_leaves_its_frames_out(
    tmp_path: Path, rows: slice, left_out: int, focal_scale: float
) -> None:
    """As by zoom or autofocus: the lens of most frames is used, and the first of two that have as many."""
    fx, fy, cx, cy = LENS.intrinsics_px
    messages = edited(DRIVE, INFO, {"k": np.array([1.3 * fx, 0, cx, 0, 1.3 * fy, cy, 0, 0, 1.0])}, rows)
    for path in (write_foreign(tmp_path / "a.mcap", messages), write_rosbag1(tmp_path / "a.bag", messages)):
        with open_recording(path) as recording:
            assert len(recording) == len(STAMPS_NS) - left_out
            assert recording.calibration.cameras[0].intrinsics_px[0] == pytest.approx(fx * focal_scale)
            says = rf"left images: the CameraInfo changes {left_out} of 4 left out.*fx cx cy.*keep zoom"
            assert says_so(recording, says)


def always_zooming() -> list[Message]:
    lenses = [replace(LENS, intrinsics_px=LENS.intrinsics_px * (1 + 0.01 * number)) for number in range(25)]
    return without(INFO) + [info(INFO, number, lens) for number, lens in enumerate(lenses)]


def info(topic: str, stamp_ns: int, lens: CameraCalibration, frame: str = "cam0_optical") -> Message:
    return topic, "sensor_msgs/CameraInfo", stamp_ns, ros_messages.encode_camera_info(stamp_ns, frame, lens)


def setting(
    binning: tuple[int, int], roi: tuple[int, int, int, int], size_px: tuple[int, int] | None = None
) -> list[Message]:
    """One camera whose driver tells binning and roi (x, y, width, height), with images of `size_px`; None: of what they make."""
    x, y, width, height = roi
    image = SAMPLE.left[0][y : y + (height or HEIGHT), x : x + (width or WIDTH)]
    columns, rows = size_px or (image.shape[1] // max(binning[0], 1), image.shape[0] // max(binning[1], 1))
    told = {"binning_x": binning[0], "binning_y": binning[1], "roi.x_offset": x, "roi.y_offset": y}
    lens = edited(of(INFO, LEFT), INFO, told | {"roi.width": width, "roi.height": height})
    data = cv2.resize(image, (columns, rows)).ravel()
    return edited(lens, LEFT, {"width": columns, "height": rows, "step": columns, "data": data})


@pytest.mark.parametrize(
    ("messages", "scale", "offset", "says"),
    [
        (setting((0, 0), (0, 0, 0, 0)), (1, 1), (0, 0), ""),
        (setting((1, 1), (0, 0, WIDTH, HEIGHT)), (1, 1), (0, 0), ""),
        (setting((2, 2), (0, 0, 0, 0)), (2, 2), (0, 0), ""),
        (setting((2, 1), (0, 0, 0, 0)), (2, 1), (0, 0), ""),
        (setting((0, 0), (116, 68, 120, 100)), (1, 1), (116, 68), ""),
        (setting((2, 2), (116, 68, 121, 101)), (2, 2), (116, 68), ""),
        (setting((2, 2), (0, 0, 0, 0), (WIDTH, HEIGHT)), (1, 1), (0, 0), "binning or roi not used .*binning 2 x 2"),
    ],
)
def test_binning_and_roi_are_used(
    tmp_path: Path, messages: list[Message], scale: tuple[int, int], offset: tuple[int, int], says: str
) -> None:
    """The centre of pixel 0 of a binned image lies between the whole picture's pixels that it joins."""
    with opened(tmp_path, messages) as recording:
        camera = recording.calibration.cameras[0]
        assert recording.read_frame(0).left.shape == (camera.height_px, camera.width_px)
        focal, centre = camera.intrinsics_px[:2] * scale, (camera.intrinsics_px[2:] + 0.5) * scale - 0.5 + offset
        np.testing.assert_allclose([*focal, *centre], LENS.intrinsics_px)
        assert says_so(recording, says)


def test_a_camera_frame_with_the_axes_of_a_body_is_noted(tmp_path: Path) -> None:
    """As of a driver that stamps images with camera_link in place of camera_color_optical_frame."""
    lens = info(INFO, 1, LENS, "cam_link")
    turned = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for base_from_cam, is_noted in ((np.eye(4), True), (turned, False)):
        links = ros_messages.encode_frame_links(1, [ros_messages.FrameLink("base_link", "cam_link", base_from_cam)])
        with opened(tmp_path, [*of(LEFT), lens, (TF, "tf2_msgs/TFMessage", 1, links)]) as recording:
            says = "camera frame not optical cam_link .* z axis up in base_link.*x right, y down, z forward"
            assert says_so(recording, says) == is_noted


def camera(*topics: str, focal_scale: float = 1.0) -> list[Message]:
    """One camera on each of the topics, its lens beside them; depths where the name says depth, PNG where it says compressed."""
    found: list[Message] = []
    lens = replace(LENS, intrinsics_px=LENS.intrinsics_px * [focal_scale, focal_scale, 1, 1])
    for topic, (row, stamp_ns) in product(topics, enumerate(STAMPS_NS)):
        found.append(info(f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info", stamp_ns, lens))
        if "depth" in topic or "compressed" in topic:
            pixels = np.full((HEIGHT, WIDTH), 2000, np.uint16) if "depth" in topic else SAMPLE.left[row]
            image = StoredImage("file", cv2.imencode(".png", pixels)[1].tobytes())
            data = ros_messages.encode_compressed_image(stamp_ns, "cam0_optical", image, "png")
            found.append((topic, "sensor_msgs/CompressedImage", stamp_ns, data))
        else:
            data = ros_messages.encode_image(stamp_ns, "cam0_optical", grey_image(SAMPLE.left[row]))
            found.append((topic, "sensor_msgs/Image", stamp_ns, data))
    return found


COLOR, DEPTH, ALIGNED = "/d/color/image_raw", "/d/depth/image_rect_raw", "/d/aligned_depth_to_color/image_raw"
INFRA = ("/d/infra1/image_rect_raw", "/d/infra2/image_rect_raw")
PAIRS = [f"/{name}/{side}/image_raw" for name in ("front", "rear") for side in ("left", "right")]


def late(late_ns: int) -> Callable[[Any], None]:
    """Half a period apart the nearest partner is now before, now after: the distance stays."""
    number = count()

    def change(image: Any) -> None:
        image.header.stamp.nanosec += late_ns + (-1) ** next(number) * 1000

    return change


LATE = "the second is {} ms from the first.*5 ms are allowed"
UNALIGNED = camera(COLOR) + camera(DEPTH, focal_scale=0.8)


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        (edited(DRIVE, INFO, NO_LENS), r"every CameraInfo beside /cam0/image_raw holds zeros.*--calibration"),
        (edited(DRIVE, TF, quaternion(0.0)), r"no transform from cam0_optical.*cam0_optical -> cam1_optical.*left out"),
        (without(LEFT) + cut(LEFT, 0, 900)[:1], r"ends before .* \(none of 1 left images can be read\)"),
        (always_zooming(), r"/cam0/camera_info describes more than 20 lenses.*autofocus"),
        (setting((2, 2), (0, 0, 0, 0), (100, 80)), r"100x80 px, which.*binning 2 x 2\) does not make.*roi"),
        (setting((1, 1), (116, 68, 120, 100), (100, 50)), r"100x50 px.*roi 120x100 at \(116, 68\)"),
        (edited(DRIVE, RIGHT, late(12_000_000)), LATE.format(r"\+(11\.999|12\.00[01])") + ": trigger"),
        (edited(DRIVE, RIGHT, late(FRAME_NS // 2)), LATE.format(r"[+-]\d\d\.\d\d\d")),
        (REPEATED, r"imu: .* stamps repeat.*let it stamp each one"),
        (camera(*PAIRS), r"--topic left=/NAME. There is .*/front/left/image_raw .*/rear/left/image_raw"),
        (camera(*INFRA, COLOR) + of(TF), "the pose of the right camera is unknown"),
    ],
)
def test_a_value_that_nothing_stands_in_for_is_named(tmp_path: Path, messages: list[Message], says: str) -> None:
    with pytest.raises((CalibrationError, RecordingError), match=says):
        opened(tmp_path, messages)


@pytest.mark.parametrize(
    ("messages", "used", "says"),
    [
        (camera(COLOR, DEPTH, ALIGNED), "mono", f"images not used .*{ALIGNED}, {DEPTH}; {COLOR} is used.*depth=/NAME"),
        (camera(COLOR, ALIGNED), "rgbd", ""),
        (UNALIGNED, "rgbd", f"depth not registered {DEPTH} .* not that of {COLOR} .*depth=/NAME"),
        (camera(COLOR, f"{COLOR}/compressed"), "mono", f"{COLOR}/compressed; {COLOR} is used"),
        (camera("/d/left/image_raw", "/d/left/image_rect"), "mono", "/d/left/image_rect; /d/left/image_raw is used"),
        (camera(LEFT, f"{LEFT}/compressed"), "mono", "/cam0/image_raw/compressed; .* is used"),
        (twice(GYRO, "/a/imu", "/b/imu"), "stereo", "imu not chosen /a/imu, /b/imu could be it; name.*imu=/NAME"),
        (twice(WHEEL, "/a/odom", "/b/odom"), "stereo-inertial", "wheel not chosen /a/odom, /b/odom could be it"),
        (foreign_messages() + camera(COLOR), "stereo-inertial", f"{COLOR}; /cam0/image_raw, /cam1/image_raw are used"),
        (DRIVE + of(GYRO)[7:8], "stereo-inertial", "imu: stamps repeated 1 of .* the first is"),
    ],
)
def test_a_choice_is_noted_with_the_names(tmp_path: Path, messages: list[Message], used: str, says: str) -> None:
    with opened(tmp_path, messages) as recording:
        assert recording.sensor_set.value == used
        assert says_so(recording, says), recording.issues
        assert len(recording.imu) == (len(IMU) if "inertial" in used else 0)


@pytest.mark.parametrize(
    ("messages", "left", "says"),
    [
        (camera(*PAIRS), PAIRS[0], f"images not used {PAIRS[1]}.*right=/NAME"),
        (camera(*INFRA, COLOR) + of(TF), COLOR, f"images not used {INFRA[0]}, {INFRA[1]}; {COLOR} is used"),
    ],
)
def test_a_choice_can_be_made(tmp_path: Path, messages: list[Message], left: str, says: str) -> None:
    """As of what a RealSense records: infrared pair, colour and depth."""
    with opened(tmp_path, messages, f"left={left}") as recording:
        assert says_so(recording, says)


def test_wheels_are_left_out_where_nothing_says_how_the_body_is_mounted_on_the_base(tmp_path: Path) -> None:
    def rename_base(message: Any) -> None:
        for link in message.transforms:
            link.header.frame_id = link.header.frame_id.replace("base_link", "chassis")

    for messages, wheels in ((edited(DRIVE, TF, rename_base), 0), (DRIVE, len(WHEELS))):
        with opened(tmp_path, messages) as recording:
            assert len(recording.wheel) == wheels
            assert says_so(recording, "wheels not used .*add base_from_body") == (wheels == 0)
            assert recording.calibration.assumed == (("imu",) if wheels else ("imu", "base_from_body"))
