"""Recordings of rigs with several views: every format that has them gives the images of all cameras."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import se3, se3_inverse
from fleetmap.recordings import OpenOptions, Recording, format_calibration, open_recording, read_calibration
from fleetmap.recordings.images import StoredImage, decode_frame, store_frame
from fleetmap.recordings.mcap import writer
from fleetmap.recordings.mcap.writer import McapRecordingWriter, copy_to_mcap
from fleetmap.recordings.ros2 import messages
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from support.plugins import needs_plugin
from support.recordings.mcap_samples import Message, write_foreign
from support.recordings.recording_samples import START_NS, make_sample, write_euroc
from support.recordings.rig_samples import images_of, simulated, write_kitti_raw, write_rig


def written(file: Path, rig: str, frames: tuple[CameraFrame, ...] | None = None) -> Recording:
    calibration, recorded = simulated(rig)
    return open_recording(write_rig(file, calibration, frames or recorded))


def shows_the_same(one: CameraFrame, other: CameraFrame) -> bool:
    shown = zip(images_of(one), images_of(other), strict=True)
    return one.stamp_ns == other.stamp_ns and all(np.array_equal(a, b) for a, b in shown)


@pytest.mark.parametrize(("rig", "views"), [("front-rear", ((0, 1), (2, 3))), ("front-sides", ((0, 1), (2,), (3,)))])
def test_a_simulated_rig_is_written_read_and_copied(
    tmp_path: Path, rig: str, views: tuple[tuple[int, ...], ...]
) -> None:
    calibration, frames = simulated(rig)
    with written(tmp_path / "a.mcap", rig) as recording:
        assert recording.calibration.views == calibration.views == views
        assert recording.sensor_set is SensorSet.STEREO and not recording.issues
        assert all(shows_the_same(recording.read_frame(k), frame) for k, frame in enumerate(frames))
        copy_to_mcap(recording, tmp_path / "b.mcap")
        part = recording.part(np.array([2, 3]))
        assert shows_the_same(part.read_frame(1), frames[3])
    with open_recording(tmp_path / "b.mcap") as copy:
        assert shows_the_same(copy.read_frame(3), frames[3])
    assert len({image.tobytes() for image in images_of(frames[0])}) == 4


def test_views_look_where_the_robot_turns_them() -> None:
    rear = simulated("front-rear")[0].cameras
    turned = se3_inverse(rear[0].body_from_cam) @ rear[2].body_from_cam
    assert turned[2, 2] == pytest.approx(-1.0, abs=0.01)
    for rig, baselines_m in (("front-rear", [0.12, 0.12]), ("front-sides", [0.12, 0.0, 0.0])):
        mounted = Rectifier(simulated(rig)[0]).mounted
        assert [camera.baseline_m for camera, _ in mounted] == pytest.approx(baselines_m)


def test_a_view_without_images_at_a_moment_is_none_there(tmp_path: Path) -> None:
    _, frames = simulated("front-rear")
    gone = (frames[0], replace(frames[1], others=(None,)), *frames[2:])
    with written(tmp_path / "a.mcap", "front-rear", gone) as recording:
        assert [recording.read_frame(k).others[0] is None for k in range(4)] == [False, True, False, False]


def test_cameras_with_stamps_of_their_own_are_the_nearest_of_each_frame(tmp_path: Path) -> None:
    """The rear pair is 20 ms late; the rectified frame has the first view's clock."""
    calibration, frames = simulated("front-rear")
    rear = [tuple(replace(o, stamp_ns=o.stamp_ns + 20_000_000) for o in frame.others if o) for frame in frames]
    later = tuple(replace(frame, others=others) for frame, others in zip(frames, rear, strict=True))
    with written(tmp_path / "a.mcap", "front-rear", later) as recording:
        frame = recording.read_frame(2)
        assert frame.others[0] is not None and frame.others[0].stamp_ns == frame.stamp_ns + 20_000_000
        offset = [replace(c, imu_minus_cam_s=-0.02 if n > 1 else 0.0) for n, c in enumerate(calibration.cameras)]
        rear = Rectifier(replace(calibration, cameras=tuple(offset))).rectify(frame).view(1)
        assert rear is not None and rear.stamp_ns == frame.stamp_ns


@needs_plugin("kitti-raw")
def test_a_drive_of_kittis_raw_data_is_a_rig_of_two_pairs(tmp_path: Path) -> None:
    calibration, frames = simulated("front-rear")
    drive = write_kitti_raw(tmp_path / "2024_01_01_drive_0001", calibration, frames)
    with open_recording(drive) as recording:
        assert recording.format == "kitti-raw" and recording.calibration.views == ((0, 1), (2, 3))
        assert all(shows_the_same(recording.read_frame(k), frame) for k, frame in enumerate(frames))
        first = se3_inverse(calibration.cameras[0].body_from_cam)
        for ours, wanted in zip(recording.calibration.cameras, calibration.cameras, strict=True):
            np.testing.assert_allclose(ours.body_from_cam, first @ wanted.body_from_cam, atol=1e-9)
            np.testing.assert_allclose(ours.intrinsics_px, wanted.intrinsics_px)
    shutil.move(drive / "calib_cam_to_cam.txt", tmp_path)  # where one of all drives of a day is
    with open_recording(drive) as recording:
        assert len(recording.calibration.cameras) == 4
    (tmp_path / "calib_cam_to_cam.txt").write_text("K_00: 1 2 3\n")
    with pytest.raises(CalibrationError, match="has no S_rect_00; it describes K_00"):
        open_recording(drive)
    (drive / "image_01/timestamps.txt").write_text("yesterday\n")
    with pytest.raises(Exception, match="line 1: 'yesterday' is not a date"):
        open_recording(drive)


@needs_plugin("kitti-raw")
def test_rectified_images_of_kittis_raw_data_are_described_by_p_rect(tmp_path: Path) -> None:
    calibration, frames = simulated("front-rear")
    drive = write_kitti_raw(tmp_path / "drive", calibration, frames)
    file = drive / "calib_cam_to_cam.txt"
    text = file.read_text().replace("S_rect_", "was_S_rect_").replace("P_rect_", "was_P_rect_")
    for number in range(4):
        shift = -70.0 * 0.5 * number
        text += f"S_rect_{number:02d}: 96 72\nP_rect_{number:02d}: 70 0 48 {shift} 0 70 36 0 0 0 1 0\n"
    file.write_text(text)
    with open_recording(drive) as recording:
        assert [c.body_from_cam[0, 3] for c in recording.calibration.cameras] == pytest.approx([0.0, 0.5, 1.0, 1.5])


def test_eurocs_folder_with_four_cameras(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "drive", make_sample(3))
    with open_recording(folder) as recording:
        kept = recording.calibration
    turned = se3(np.diag([-1.0, -1.0, 1.0]), np.array([-0.3, 0.0, 0.0]))  # body_from_turned
    for number in (0, 1):
        shutil.copytree(folder / f"mav0/cam{number}", folder / f"mav0/cam{number + 2}")
    rear = tuple(replace(camera, body_from_cam=turned @ camera.body_from_cam) for camera in kept.cameras)
    rig = replace(kept, cameras=kept.cameras + rear)
    file = tmp_path / "camchain.yaml"
    file.write_text(format_calibration(rig))
    assert read_calibration(file).views == ((0, 1), (2, 3))
    with open_recording(folder, OpenOptions(calibration_file=file)) as recording:
        frame = recording.read_frame(1)
        assert frame.others[0] is not None and np.array_equal(frame.others[0].left, frame.left)
        assert recording.sensor_set is SensorSet.STEREO_INERTIAL
    file.write_text(format_calibration(kept))
    with pytest.raises(CalibrationError, match="4 cameras are recorded, the calibration describes 2"):
        open_recording(folder, OpenOptions(calibration_file=file))
    exchanged = replace(rig, cameras=(*rig.cameras[:2], rig.cameras[3], rig.cameras[2]))
    with pytest.raises(CalibrationError, match=r"cam3 lies at .* in cam2's axes"):
        Rectifier(exchanged)


def test_a_damaged_or_wrong_image_of_another_view_leaves_the_first_one_usable(tmp_path: Path) -> None:
    calibration, frames = simulated("front-rear")
    stored = store_frame(frames[1])
    (rear,) = stored.others
    damaged = replace(stored, others=(replace(rear, left=StoredImage("file", b"\xff\xd8 no more")),))
    assert decode_frame(damaged).others == (None,)
    large = np.zeros((100, 100), np.uint8)
    other = replace(frames[1], others=(CameraFrame(frames[1].stamp_ns, large, large),))
    rectified = Rectifier(calibration).rectify(other)
    assert rectified.view(1) is None and rectified.left.any()
    wrong = tuple(replace(f, others=(CameraFrame(f.stamp_ns, large, large),)) for f in frames)
    with pytest.raises(RecordingError, match=r"cam2 image at .* is 100x100 px, the calibration says 96x72"):
        written(tmp_path / "a.mcap", "front-rear", wrong)


@pytest.mark.parametrize(
    ("lacks", "cameras", "issue"),
    [
        ((), 4, None),
        (("cam3", "/tf_static"), 3, "cam3: no transform connects cam3 to cam0"),
        (("cam2", "/camera_info"), 3, "cam2: no CameraInfo beside /cam2/image_raw"),
        (("cam2", "/image_raw"), 3, "cam2: none of the images on /cam2/image_raw can be read"),
    ],
)
def test_a_rig_is_described_by_camera_info_and_transforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacks: tuple[str, ...], cameras: int, issue: str | None
) -> None:
    pytest.importorskip("fleetmap.plugins.other_recorders")
    calibration, frames = simulated("front-rear")
    monkeypatch.setattr(writer, "CALIBRATION_ATTACHMENT", "something else.yaml")
    written_as = McapRecordingWriter._write

    def some(self: McapRecordingWriter, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        if lacks and topic == "/tf_static" and lacks[1] == topic:
            links = [link for link in messages.decode_frame_links(data) if lacks[0] not in (link.parent, link.child)]
            data = messages.encode_frame_links(stamp_ns, links)
        is_lacking = lacks != () and topic == f"/{lacks[0]}{lacks[1]}"
        if not is_lacking or lacks[1] == "/image_raw":
            written_as(self, topic, type_name, stamp_ns, data[:60] if is_lacking else data)

    monkeypatch.setattr(McapRecordingWriter, "_write", some)
    with written(tmp_path / "a.mcap", "front-rear") as recording:
        assert len(recording.calibration.cameras) == cameras
        first = se3_inverse(calibration.cameras[0].body_from_cam)
        shown = [c for n, c in enumerate(calibration.cameras) if not lacks or f"cam{n}" != lacks[0]]
        for ours, wanted in zip(recording.calibration.cameras, shown, strict=True):
            np.testing.assert_allclose(ours.body_from_cam, first @ wanted.body_from_cam, atol=1e-9)
        assert recording.calibration.views == (((0, 1), (2, 3)) if cameras == 4 else ((0, 1), (2,)))
        (other,) = recording.read_frame(1).others
        (recorded,) = frames[1].others
        assert np.array_equal(other.left, recorded.right if lacks[:1] == ("cam2",) else recorded.left)
        assert any(issue in each.detail for each in recording.issues) if issue else not recording.issues


INTERLEAVED = [0, 2, 1, 3]  # front left, rear left, front right, rear right


def interleaved() -> tuple[RigCalibration, tuple[CameraFrame, ...]]:
    calibration, frames = simulated("front-rear")
    return replace(calibration, cameras=tuple(calibration.cameras[number] for number in INTERLEAVED)), frames


@pytest.mark.parametrize(
    ("rostopic", "recorded"),
    [
        ("/rig/cam_{}", "/rig/cam_{}/compressed"),
        ("/rig/cam_{}", "/rig/cam_{}/image_raw/compressed"),
        ("/rig/cam_{}/image_raw", "/rig/cam_{}/image_raw/compressed"),
        ("/rig/cam_{}/compressed", "/rig/cam_{}"),
    ],
)
@pytest.mark.parametrize(
    ("silent", "first_s", "last_s"),
    [(9, 0.0, 0.0), (1, 1.0, 9.0), (0, 1.0, 9.0), (0, 0.0, 2.0), (1, 1.0, 2.2), (3, 1.0, 9.0)],
    ids=["none", "right dies", "left dies", "left starts late", "right pauses", "rear dies"],
)
def test_pairs_are_those_of_the_mounting_and_a_silent_camera_costs_its_own(
    tmp_path: Path, rostopic: str, recorded: str, silent: int, first_s: float, last_s: float
) -> None:
    """Frames are those of the first pair that sees all the time; the other one is missing while one of its cameras is silent."""
    calibration, frames = interleaved()
    text = format_calibration(calibration)
    for number in range(4):
        text = text.replace(f"cam{number}:\n", f"cam{number}:\n  rostopic: {rostopic.format(number)}\n")
    (tmp_path / "camchain.yaml").write_text(text)
    topics, sent = [recorded.format(number) for number in INTERLEAVED], list[Message]()
    for moment in range(30):
        for number, image in enumerate(images_of(frames[moment % 4])):
            if number != silent or not first_s <= 0.1 * moment < last_s:
                stamp_ns = START_NS + moment * 100_000_000
                png = StoredImage("file", cv2.imencode(".png", image)[1].tobytes())
                data = messages.encode_compressed_image(stamp_ns, "camera", png, "png")
                sent.append((topics[number], "sensor_msgs/CompressedImage", stamp_ns, data))
    file = write_foreign(tmp_path / "a.mcap", sent)
    with open_recording(file, OpenOptions(calibration_file=tmp_path / "camchain.yaml")) as recording:
        mounted = Rectifier(recording.calibration).mounted
        assert [camera.baseline_m for camera, _ in mounted] == pytest.approx([0.12, 0.12]) and len(recording) == 30
        front, rear = images_of(frames[2])[:2], images_of(frames[2])[2:]
        expected = [*rear, *front] if silent < 2 else [*front, *rear]
        whole = next(k for k in (2, 22, 26) if not first_s <= 0.1 * k < last_s)
        assert all(map(np.array_equal, images_of(recording.read_frame(whole)), expected))
        shown = [len(images_of(recording.read_frame(k))) for k in range(30)]
        assert shown == [2 if first_s <= 0.1 * k < last_s else 4 for k in range(30)]
        said = [issue.detail for issue in recording.issues if issue.what == "camera silent"]
        when = f"{max(first_s - 0.1, 0.0):.1f} to {min(last_s, 2.9):.1f} s after the start"
        assert all(f"{topics[silent]}) has no images from {when}" in each for each in said)
        assert len(said) == (silent < 9)
        copy_to_mcap(recording, tmp_path / "b.mcap")
    with open_recording(tmp_path / "b.mcap") as copy:
        assert [len(images_of(copy.read_frame(k))) for k in range(30)] == shown


def test_a_robot_and_its_recordings_pair_by_mounting(tmp_path: Path) -> None:
    calibration, frames = interleaved()
    live, complete = pytest.importorskip("locclient.plugins.ros2_node.sensor_messages").RigFrames(calibration), []
    for frame in map(store_frame, frames):
        (rear,) = frame.others
        for number, image in ((1, rear.left), (3, rear.right), (0, frame.left), (2, frame.right)):
            complete += live.add(number, frame.stamp_ns, image)
    with open_recording(write_rig(tmp_path / "a.mcap", calibration, map(decode_frame, complete))) as recording:
        assert recording.calibration.views == ((0, 1), (2, 3)) and len(recording) == 4
        assert all(shows_the_same(recording.read_frame(k), frame) for k, frame in enumerate(frames))


@pytest.mark.parametrize(
    ("places_m", "views"),
    [
        ([(0, 0), (0, 0.1), (0.1, 0)], ((0, 2), (1,))),  # one above the pair
        ([(0, 0), (0.1, 0), (0.2, 0), (0.3, 0)], ((0, 1), (2, 3))),
    ],
)
def test_cameras_that_look_the_same_way(
    places_m: list[tuple[float, float]], views: tuple[tuple[int, ...], ...]
) -> None:
    camera = simulated("front-rear")[0].cameras[0]
    places = [camera.body_from_cam @ se3(np.eye(3), np.array([*place, 0.0])) for place in places_m]
    assert RigCalibration(tuple(replace(camera, body_from_cam=place) for place in places)).views == views
    with pytest.raises(CalibrationError, match=r"cam0 and cam1 are 0\.000 mm apart"):
        Rectifier(RigCalibration((camera, camera)))
