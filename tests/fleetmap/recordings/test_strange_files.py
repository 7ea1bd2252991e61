"""Files of every format that are cut, empty, flipped or something else: a message with the file's name, of no library, and no traceback."""

import re
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from contracts.test_recordings import WITHOUT_CALIBRATION, WRITERS
from fleetmap.errors import FleetmapError, RecordingError
from fleetmap.recordings import OpenOptions, open_recording, recording_formats
from fleetmap.recordings.ros2 import messages as ros_messages
from support.command_line import status
from support.recordings.bag_samples import write_rosbag1
from support.recordings.mcap_samples import SAMPLE, foreign_messages, write_foreign
from support.recordings.recording_samples import HEIGHT, WIDTH, kalibr_text, make_sample, write_euroc

RNG = np.random.default_rng(0)


def flipped(data: bytes, first: int = 0) -> bytes:
    """Some of the bytes from the first one on are others."""
    spoiled, first = bytearray(data), max(first, 0)
    for at in RNG.integers(first, len(data), max(3, (len(data) - first) // 500)):
        spoiled[at] = RNG.integers(256)
    return bytes(spoiled)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "cut": lambda data: data[:-7],
    "text": lambda data: b"hello, this is a note\nand more\n",
    "utf-16": lambda data: "hello".encode("utf-16"),
    "page": lambda data: b"\n<!DOCTYPE html><html><body>Sign in</body></html>",
    "pointer": lambda data: b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\nsize 3\n",
    "flipped": flipped,
    "flipped again": flipped,
}
OF_CONTAINERS = {f"flipped in its head {n}": lambda data: flipped(data[:4096], 13) + data[4096:] for n in range(10)}
OF_CONTAINERS |= {f"flipped in its end {n}": lambda data: flipped(data, len(data) - 4096) for n in range(10)}
CONTAINERS = (".bag", ".db3", ".mcap", ".mp4")
OF_A_LIBRARY = re.compile(
    r"Traceback|could not convert|requires a buffer|NoneType|codec can't|not enough values|invalid literal|out of bounds|while parsing|"
    r"while scanning|unicode string|malformed|reshape|list index|Errno|invalid start byte|Error parsing|Invalid data found|usecols",
    re.IGNORECASE,
)


@pytest.mark.parametrize("name", list(recording_formats()))
def test_damaged_files_of_every_format(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.yaml").write_text(kalibr_text().partition("cam1:")[0])
    rig = tmp_path / "rig.yaml" if name in WITHOUT_CALIBRATION else None
    options, calibration = OpenOptions(rig), [] if rig is None else ["--calibration", str(rig)]
    path = WRITERS[name](tmp_path / "recording")
    files = [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.is_file()]
    made = [file for file in reversed(files) if "source" not in file.parts]
    # The first of many images, and of one camera
    for file in {re.sub(r"\d+", "", str(file.relative_to(tmp_path))): file for file in made}.values():
        sound = file.read_bytes()
        for damage, spoil in (DAMAGES | (OF_CONTAINERS if file.suffix in CONTAINERS else {})).items():
            file.write_bytes(spoil(sound))
            try:
                with open_recording(path, options) as recording:
                    told = " ".join(f"{issue.what} {issue.detail}" for issue in recording.issues)
                    if file.suffix in CONTAINERS:
                        with suppress(RecordingError):
                            for index in range(len(recording)):
                                recording.read_frame(index)
            except FleetmapError as error:
                told = str(error)
                assert path.name in told, (file.name, damage, told)
                if damage == "text":  # as the command tells it
                    status("mapserver", "doctor", path, *calibration)
                    assert capsys.readouterr().err == f"error: {told}\n"
            assert not OF_A_LIBRARY.search(told), (file.name, damage, told)
            if damage in ("page", "pointer") and file.name not in ("metadata.yaml", "frame-000000.pose.txt"):
                assert "git lfs pull" in told, (file.name, damage, told)
        file.write_bytes(sound)


@pytest.mark.parametrize("name", ["drive.zip", "drive.mcap"])
def test_zip_files_are_to_be_unpacked(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.writestr("mav0/cam0/data.csv", "")
    with pytest.raises(RecordingError, match=f"{name} is a zip file; `unzip` it"):
        open_recording(tmp_path / name)


def rewritten(file: Path, change: Callable[[list[list[str]]], list[list[str]]], joint: str = ",") -> None:
    rows = [line.split(",") for line in file.read_text().splitlines()]
    file.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(joint.join(row) for row in change(rows)).encode())


@pytest.mark.parametrize("joint", [",", ";", "\t", ", "])
def test_tables_of_euroc_as_other_programs_write_them(tmp_path: Path, joint: str) -> None:
    sample = make_sample(4)
    wanted, folder = write_euroc(tmp_path / "a", sample), write_euroc(tmp_path / "b", sample)
    images, imu = folder / "mav0/cam0/data.csv", folder / "mav0/imu0/data.csv"
    rewritten(images, lambda rows: [["stamp", "file", "exposure"], *([*row, "0.01"] for row in rows[1:])], joint)
    accel, gyro = "a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z", "w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z"
    header = f"timestamp,{accel},{gyro},temperature".split(",")
    swapped = lambda rows: [[row[0], *row[4:7], *row[1:4], "21"] for row in rows if row[0].isdecimal()]  # noqa: E731
    rewritten(imu, lambda rows: [header, *swapped(rows)], joint)
    with open_recording(folder) as found, open_recording(wanted) as right:
        assert found.issues == ()
        assert found.frame_stamps_ns.tolist() == right.frame_stamps_ns.tolist()
        np.testing.assert_array_equal(found.imu.gyro_radps, right.imu.gyro_radps)
        np.testing.assert_array_equal(found.imu.accel_mps2, right.imu.accel_mps2)


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_bits_of_grey_images_of_16(tmp_path: Path, bits: int) -> None:
    """As drivers of machine vision cameras send them: the sensor's 10 or 12 bits in the lower ones."""
    messages = []
    for topic, kind, stamp_ns, data in foreign_messages():
        if kind == "sensor_msgs/Image":
            grey = ros_messages.decode_image(data, "").data
            wide = np.frombuffer(grey, np.uint8).astype("<u2") << (bits - 8)
            image = ros_messages.StoredImage("mono16", wide.tobytes(), "", WIDTH, HEIGHT, 2 * WIDTH)
            data = ros_messages.encode_image(stamp_ns, "cam0_optical", image)  # noqa: PLW2901
        messages.append((topic, kind, stamp_ns, data))
    for path in (write_foreign(tmp_path / "a.mcap", messages), write_rosbag1(tmp_path / "a.bag", messages)):
        with open_recording(path) as recording:
            np.testing.assert_array_equal(recording.read_frame(1).left, SAMPLE.left[1])
            np.testing.assert_array_equal(recording.part(np.array([2])).read_frame(0).right, SAMPLE.right[2])
            assert [issue.what for issue in recording.issues] == ([] if bits == 16 else [f"{bits} bits in 16"])
