"""One bad value costs one value, and a choice that cannot be made is a note with the names: messages written by rosbags."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, Recording, named_topics, open_recording
from fleetmap.recordings.images import StoredImage, grey_image
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.sensors.samples import WheelSample
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import IMU, SAMPLE, Message, foreign_messages, write_foreign
from support.recordings.recording_samples import FRAME_NS, HEIGHT, WIDTH, calibration

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMPS_NS = SAMPLE.stamps_ns.tolist()


def drive() -> list[Message]:
    """Stereo, IMU, transforms and wheels, in the order of writing."""
    wheels = [WheelSample(s + 1000, np.array([0.5, 0.0, 0.0]), 0.1, 0.1, 0.1) for s in STAMPS_NS]
    encoded = [
        ("/odom", "nav_msgs/Odometry", w.stamp_ns, ros_messages.encode_odometry(w, "odom", "base_link")) for w in wheels
    ]
    return [*foreign_messages(), *encoded]


def edited(topic: str, rows: slice, change: Callable[[Any], None]) -> list[Message]:
    """The drive, its messages of a topic changed in those rows and written by rosbags."""
    messages = drive()
    numbers = [number for number, message in enumerate(messages) if message[0] == topic][rows]
    for number in numbers:
        name, kind, stamp_ns, data = messages[number]
        message = STORE.deserialize_cdr(data, kind.replace("/", "/msg/"))
        change(message)
        messages[number] = (name, kind, stamp_ns, bytes(STORE.serialize_cdr(message, kind.replace("/", "/msg/"))))
    return messages


def cut(topic: str, row: int, kept_bytes: int) -> list[Message]:
    messages = drive()
    number = [number for number, message in enumerate(messages) if message[0] == topic][row]
    name, kind, stamp_ns, data = messages[number]
    messages[number] = (name, kind, stamp_ns, data[:kept_bytes])
    return messages


def no_stamp(message: Any) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def quaternion(scale: float) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        turn = message.transforms[2].transform.rotation
        turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, scale

    return change


def no_lens(message: Any) -> None:
    message.k, message.p = np.zeros(9), np.zeros(12)


def nan_rate(message: Any) -> None:
    message.angular_velocity.y = float("nan")


def nan_speed(message: Any) -> None:
    message.twist.twist.linear.x = float("nan")


def smaller(message: Any) -> None:
    message.width, message.step = message.width // 2, message.step // 2
    message.data = message.data[: message.height * message.step]


FRAMES, SAMPLES = len(STAMPS_NS), len(IMU)
FIRST, ALL = slice(0, 1), slice(None)
LEFT, TF = "/cam0/image_raw", "/tf_static"
STRANGE = [
    (topic, kind, 1, data)
    for topic, kind, data in ((LEFT, *foreign_messages()[-2][1::2]), ("/imu0", *foreign_messages()[0][1::2]))
]


@pytest.mark.parametrize(
    ("messages", "frames", "samples", "wheels", "says"),
    [
        (edited("/imu0", slice(5, 6), no_stamp), FRAMES, SAMPLES, FRAMES, "imu: stamps of zero.* 1 of"),
        (edited("/imu0", slice(0, 20), no_stamp), FRAMES, SAMPLES, FRAMES, "imu: stamps of zero.* 20 of .*logging"),
        (edited("/imu0", ALL, no_stamp), FRAMES, SAMPLES, FRAMES, "imu: stamps of zero"),
        (edited("/odom", ALL, no_stamp), FRAMES, SAMPLES, FRAMES, "wheel odometry: stamps of zero"),
        (edited(LEFT, FIRST, no_stamp), FRAMES, SAMPLES, FRAMES, "left images: stamps of zero"),
        (edited(TF, ALL, quaternion(0.99)), FRAMES, SAMPLES, FRAMES, "cam0_optical -> cam1_optical.*0.99.*normalised"),
        (edited("/cam0/camera_info", FIRST, no_lens), FRAMES, SAMPLES, FRAMES, ""),
        (edited("/imu0", FIRST, nan_rate), FRAMES, SAMPLES - 1, FRAMES, "imu: impossible values 1 of"),
        (edited("/odom", FIRST, nan_speed), FRAMES, SAMPLES, FRAMES - 1, "/odom: damaged messages 1 left out"),
        (edited(LEFT, slice(1, 2), smaller), FRAMES - 1, SAMPLES, FRAMES, rf"1 of {WIDTH // 2}x\d+ left out"),
        (edited(LEFT, FIRST, smaller), FRAMES - 1, SAMPLES, FRAMES, "left images: images of another size"),
        (cut(LEFT, 0, 900), FRAMES - 1, SAMPLES, FRAMES, "left images left out 1 of 4; the first: .*ends before"),
        (cut("/imu0", 3, 60), FRAMES, SAMPLES - 1, FRAMES, "/imu0: damaged messages 1 left out"),
        (cut("/odom", 1, 3), FRAMES, SAMPLES, FRAMES - 1, "/odom: damaged messages 1 left out"),
        (
            STRANGE + drive(),
            FRAMES,
            SAMPLES,
            FRAMES,
            "messages of another type /cam0/image_raw: sensor_msgs/Imu left out",
        ),
    ],
)
def test_one_bad_value_costs_one_value(
    tmp_path: Path, messages: list[Message], frames: int, samples: int, wheels: int, says: str
) -> None:
    paths = [write_foreign(tmp_path / "a.mcap", messages)]
    if "another type" not in says:  # rosbags' writers have one type a topic
        paths.append(write_rosbag2(tmp_path / "bag", messages))
    # Nor do they make ROS 1 of a broken message
    if not any(word in says for word in ("ends before", "damaged", "another type")):
        paths.append(write_rosbag1(tmp_path / "a.bag", messages))
    for path in paths:
        with open_recording(path) as recording:
            assert (len(recording), len(recording.imu), len(recording.wheel)) == (frames, samples, wheels), path
            for index in range(len(recording)):
                recording.read_frame(index)
            assert says_so(recording, says), [*recording.issues]
            assert np.abs(recording.imu.stamps_ns - IMU.stamps_ns[-len(recording.imu) :]).max() < 20_000_000


def zoomed(message: Any) -> None:
    message.k = message.k * np.array([1.3, 1, 1, 1, 1.3, 1, 1, 1, 1])


@pytest.mark.parametrize(
    ("rows", "left_out", "focal_scale"), [(slice(1, 2), 1, 1.0), (slice(1, None), 1, 1.3), (slice(2, 4), 2, 1.0)]
)
def test_a_lens_that_changes_leaves_its_frames_out(
    tmp_path: Path, rows: slice, left_out: int, focal_scale: float
) -> None:
    """As by zoom or autofocus: the lens of most frames is used, and the first of two that have as many."""
    messages = edited("/cam0/camera_info", rows, zoomed)
    paths = [write_foreign(tmp_path / "a.mcap", messages), write_rosbag1(tmp_path / "a.bag", messages)]
    for path in paths:
        with open_recording(path) as recording:
            assert len(recording) == FRAMES - left_out
            focal_px = calibration().cameras[0].intrinsics_px[0]
            assert recording.calibration.cameras[0].intrinsics_px[0] == pytest.approx(focal_px * focal_scale)
            assert says_so(
                recording, rf"left images: the CameraInfo changes {left_out} of 4 left out.*fx cx cy.*keep zoom"
            )


def always_zooming() -> list[Message]:
    lens, messages = calibration().cameras[0], [m for m in drive() if m[0] != "/cam0/camera_info"]
    for number in range(25):
        info = replace(lens, intrinsics_px=lens.intrinsics_px * (1 + 0.01 * number))
        data = ros_messages.encode_camera_info(number, "cam0_optical", info)
        messages.append(("/cam0/camera_info", "sensor_msgs/CameraInfo", number, data))
    return messages


def setting(
    binning: tuple[int, int], roi: tuple[int, int, int, int], size_px: tuple[int, int] = (0, 0)
) -> list[Message]:
    """One camera whose driver tells binning and roi (x, y, width, height), with images of `size_px`; of what they make for (0, 0)."""

    def tell(message: Any) -> None:
        message.binning_x, message.binning_y = binning
        message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = roi

    def cut_out(message: Any) -> None:
        image = message.data.reshape(message.height, message.width)
        (x, y, width, height), (bin_x, bin_y) = roi, (max(each, 1) for each in binning)
        part = image[y : y + (height or message.height), x : x + (width or message.width)]
        part = cv2.resize(part, size_px if any(size_px) else (part.shape[1] // bin_x, part.shape[0] // bin_y))
        (message.height, message.width), message.data = part.shape, part.ravel()
        message.step = message.width

    changed = edited("/cam0/camera_info", ALL, tell), edited(LEFT, ALL, cut_out)
    return [
        m for topic, found in zip(("/cam0/camera_info", LEFT), changed, strict=True) for m in found if m[0] == topic
    ]


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
    with open_recording(write_foreign(tmp_path / "a.mcap", messages)) as recording:
        camera, whole = recording.calibration.cameras[0], calibration().cameras[0]
        frame = recording.read_frame(0)
        assert frame.left.shape == (camera.height_px, camera.width_px)
        for axis in (0, 1):
            back = (camera.intrinsics_px[2 + axis] + 0.5) * scale[axis] - 0.5 + offset[axis]
            assert back == pytest.approx(whole.intrinsics_px[2 + axis])
            assert camera.intrinsics_px[axis] * scale[axis] == pytest.approx(whole.intrinsics_px[axis])
        assert says_so(recording, says)


@pytest.mark.parametrize(
    ("late_ns", "says"), [(12_000_000, r"\+(11\.999|12\.00[01])"), (FRAME_NS // 2, r"[+-]\d\d\.\d\d\d")]
)
def test_cameras_of_two_clocks_are_told_by_how_much(tmp_path: Path, late_ns: int, says: str) -> None:
    """Half a period apart the nearest partner is now before, now after: the distance stays."""
    messages = [m for m in drive() if m[0] != "/cam1/image_raw"]
    for n, (topic, kind, stamp_ns, data) in enumerate(m for m in drive() if m[0] == "/cam1/image_raw"):
        image = ros_messages.decode_image(data, "")
        late = ros_messages.encode_image(stamp_ns + late_ns + (-1) ** n * 1000, "cam1_optical", image)
        messages.append((topic, kind, stamp_ns, late))
    with pytest.raises(
        RecordingError, match=rf"the second is {says} ms from the first in the median, 5 ms are allowed: trigger"
    ):
        open_recording(write_foreign(tmp_path / "a.mcap", messages))


def test_repeated_stamps_do_not_go_backwards(tmp_path: Path) -> None:
    few, many = drive(), drive()
    repeated = [message for message in few if message[0] == "/imu0"][7]
    with open_recording(
        write_foreign(tmp_path / "a.mcap", [*few[: few.index(repeated)], repeated, *few[few.index(repeated) :]])
    ) as one:
        assert says_so(one, "imu: stamps repeated 1 of .* the first is")
        assert len(one.imu) == SAMPLES
    many = [message for message in drive() for _ in range(3 if message[0] == "/imu0" else 1)]
    with pytest.raises(RecordingError, match=r"imu: .* stamps repeat the one before.*let it stamp each one"):
        open_recording(write_foreign(tmp_path / "a.mcap", many))


def test_a_camera_frame_with_the_axes_of_a_body_is_noted(tmp_path: Path) -> None:
    """As of a driver that stamps images with camera_link in place of camera_color_optical_frame."""
    lens = ros_messages.encode_camera_info(1, "cam_link", calibration().cameras[0])
    turned = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for base_from_cam, is_noted in ((np.eye(4), True), (turned, False)):
        links = ros_messages.encode_frame_links(1, [ros_messages.FrameLink("base_link", "cam_link", base_from_cam)])
        messages = [m for m in camera(LEFT) if "info" not in m[0]]
        messages += [("/cam0/camera_info", "sensor_msgs/CameraInfo", 1, lens), (TF, "tf2_msgs/TFMessage", 1, links)]
        with open_recording(write_foreign(tmp_path / "a.mcap", messages)) as recording:
            noted = says_so(
                recording, "camera frame not optical cam_link .* z axis up in base_link.*x right, y down, z forward"
            )
        assert noted == is_noted


def says_so(recording: Recording, says: str) -> bool:
    lines = [f"{issue.what} {issue.detail}" for issue in recording.issues]
    return any(re.search(says, line) for line in lines) if says else not lines


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        (
            edited("/cam0/camera_info", ALL, no_lens),
            r"every CameraInfo beside /cam0/image_raw holds zeros.*--calibration",
        ),
        (edited(TF, ALL, quaternion(0.0)), r"no transform from cam0_optical.*cam0_optical -> cam1_optical.*left out"),
        (
            [m for m in drive() if m[0] != LEFT] + [cut(LEFT, 0, 900)[0]],
            r"ends before .* \(none of 1 left images can be read\)",
        ),
        (always_zooming(), r"/cam0/camera_info describes more than 20 lenses.*autofocus"),
        (
            setting((2, 2), (0, 0, 0, 0), (100, 80)),
            r"100x80 px, which the CameraInfo \(.*binning 2 x 2\) does not make.*roi",
        ),
        (setting((1, 1), (116, 68, 120, 100), (100, 50)), r"100x50 px.*roi 120x100 at \(116, 68\)"),
    ],
)
def test_a_value_that_nothing_stands_in_for_is_named(tmp_path: Path, messages: list[Message], says: str) -> None:
    with pytest.raises((CalibrationError, RecordingError), match=says):
        open_recording(write_foreign(tmp_path / "a.mcap", messages))


def camera(*topics: str, focal_scale: float = 1.0) -> list[Message]:
    """One camera on each of the topics, its lens beside them; depths where the name says depth, PNG where it says compressed."""
    found: list[Message] = []
    png = cv2.imencode(".png", SAMPLE.left[0])[1].tobytes()
    depth = cv2.imencode(".png", np.full(SAMPLE.left[0].shape, 2000, np.uint16))[1].tobytes()
    for topic in topics:
        packed = depth if "depth" in topic else png if "compressed" in topic else None
        info = f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
        lens = calibration().cameras[0]
        lens = replace(lens, intrinsics_px=lens.intrinsics_px * [focal_scale, focal_scale, 1, 1])
        for row, stamp_ns in enumerate(STAMPS_NS):
            image = grey_image(SAMPLE.left[row]) if packed is None else StoredImage("file", packed)
            encode = (
                ros_messages.encode_image
                if packed is None
                else partial(ros_messages.encode_compressed_image, form="png")
            )
            kind = "sensor_msgs/Image" if packed is None else "sensor_msgs/CompressedImage"
            found.append((topic, kind, stamp_ns, encode(stamp_ns, "cam0_optical", image)))
            found.append(
                (
                    info,
                    "sensor_msgs/CameraInfo",
                    stamp_ns,
                    ros_messages.encode_camera_info(stamp_ns, "cam0_optical", lens),
                )
            )
    return found


def renamed(topic: str, name: str) -> list[Message]:
    return [(name, *message[1:]) for message in drive() if message[0] == topic]


COLOR, DEPTH, ALIGNED = "/d/color/image_raw", "/d/depth/image_rect_raw", "/d/aligned_depth_to_color/image_raw"
INFRA = ("/d/infra1/image_rect_raw", "/d/infra2/image_rect_raw")


@pytest.mark.parametrize(
    ("messages", "used", "says"),
    [
        (
            camera(COLOR, DEPTH, ALIGNED),
            "mono",
            f"images not used .*{ALIGNED}, {DEPTH}; {COLOR} is used.*--topic.*depth=/NAME",
        ),
        (camera(COLOR, ALIGNED), "rgbd", ""),
        (
            camera(COLOR) + camera(DEPTH, focal_scale=0.8),
            "rgbd",
            f"depth not registered {DEPTH} .* not that of {COLOR} .*depth=/NAME",
        ),
        (camera(COLOR, f"{COLOR}/compressed"), "mono", f"{COLOR}/compressed; {COLOR} is used"),
        (camera("/d/left/image_raw", "/d/left/image_rect"), "mono", "/d/left/image_rect; /d/left/image_raw is used"),
        (camera("/cam0/image_raw", "/cam0/image_raw/compressed"), "mono", "/cam0/image_raw/compressed; .* is used"),
        (
            [m for m in drive() if "imu" not in m[0]] + renamed("/imu0", "/a/imu") + renamed("/imu0", "/b/imu"),
            "stereo",
            "imu not chosen /a/imu, /b/imu could be it; name one with --topic imu=/NAME",
        ),
        (
            [m for m in drive() if "odom" not in m[0]] + renamed("/odom", "/a/odom") + renamed("/odom", "/b/odom"),
            "stereo-inertial",
            "wheel not chosen /a/odom, /b/odom could be it",
        ),
        (foreign_messages() + camera(COLOR), "stereo-inertial", f"{COLOR}; /cam0/image_raw, /cam1/image_raw are used"),
    ],
)
def test_a_choice_is_noted_with_the_names(tmp_path: Path, messages: list[Message], used: str, says: str) -> None:
    with open_recording(write_foreign(tmp_path / "a.mcap", messages)) as recording:
        assert recording.sensor_set.value == used
        assert says_so(recording, says), recording.issues


def test_two_pairs_of_cameras_are_not_told_apart(tmp_path: Path) -> None:
    pairs = [f"/{name}/{side}/image_raw" for name in ("front", "rear") for side in ("left", "right")]
    path = write_foreign(tmp_path / "a.mcap", camera(*pairs))
    with pytest.raises(
        RecordingError, match=r"--topic left=/NAME. There is .*/front/left/image_raw .*/rear/left/image_raw"
    ):
        open_recording(path)
    with open_recording(path, OpenOptions(topics=named_topics([f"left={pairs[0]}"]))) as recording:
        assert says_so(recording, f"images not used {pairs[1]}.*right=/NAME")


def test_a_pair_beside_a_colour_camera_is_noted(tmp_path: Path) -> None:
    """As a RealSense records: the infrared pair is used, colour and depth are named."""
    messages = camera(*INFRA, COLOR)
    messages += [m for m in drive() if m[0] == TF]
    with pytest.raises(CalibrationError, match="the pose of the right camera is unknown"):
        open_recording(write_foreign(tmp_path / "a.mcap", messages))
    with open_recording(
        write_foreign(tmp_path / "a.mcap", messages), OpenOptions(topics=named_topics([f"left={COLOR}"]))
    ) as recording:
        assert says_so(recording, f"images not used {INFRA[0]}, {INFRA[1]}; {COLOR} is used")


def test_wheels_are_left_out_where_nothing_says_how_the_body_is_mounted_on_the_base(tmp_path: Path) -> None:
    def rename_base(message: Any) -> None:
        for link in message.transforms:
            link.header.frame_id = link.header.frame_id.replace("base_link", "chassis")

    for messages, count in ((edited(TF, ALL, rename_base), 0), (drive(), FRAMES)):
        with open_recording(write_foreign(tmp_path / "a.mcap", messages)) as recording:
            assert len(recording.wheel) == count
            assert says_so(recording, "wheels not used .*add base_from_body") == (count == 0)
            assert recording.calibration.assumed == (("imu",) if count else ("imu", "base_from_body"))
