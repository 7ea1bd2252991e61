"""A small synthetic recording with images, IMU and truth that agree, and how to write it in each folder format.

A textured wall 5 m before a stereo pair that turns about all three axes; nothing here uses the code under test.
"""

import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.geometry import Array, quat_wxyz_from_rotation, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings.images import StoredFrame, png_image
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.samples import ImuSamples, Trajectory

WIDTH, HEIGHT, FOCAL, BASELINE_M, WALL_M = 320, 240, 200.0, 0.2, 5.0
START_NS = 1_700_000_000_123_456_789
FRAME_NS, IMU_NS = 50_000_000, 5_000_000
# x forward, y left, z up of the body in the camera's axes (x right, y down, z forward)
BODY_FROM_CAM0 = se3(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.06, -0.02]))
UP_WORLD = np.array([0.0, -1.0, 0.0])


def calibration(*, has_imu: bool = True) -> RigCalibration:
    """The rig of the sample."""
    intrinsics = np.array([FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])
    cam0_from_cam1 = se3(np.eye(3), np.array([BASELINE_M, 0, 0]))
    cameras = tuple(
        CameraCalibration(
            "radial-tangential", WIDTH, HEIGHT, intrinsics, np.array([1e-9, 0.0, 0.0, 0.0]), body_from_cam
        )
        for body_from_cam in (BODY_FROM_CAM0, BODY_FROM_CAM0 @ cam0_from_cam1)
    )
    return RigCalibration(cameras, ImuNoise(1.7e-4, 1.9e-5, 2.0e-3, 3.0e-3) if has_imu else None)


def world_from_cam0(stamp_ns: int) -> Array:
    """The camera's place; world is where it began."""
    t = (stamp_ns - START_NS) * 1e-9
    turn = 0.12 * np.array([np.sin(5.1 * t), np.sin(6.3 * t + 1.0), np.sin(7.7 * t + 2.0)])
    return se3(so3_exp(turn), np.zeros(3))


@dataclass
class Sample:
    """The written content."""

    stamps_ns: NDArray[np.int64]
    left: list[NDArray[np.uint8]]
    right: list[NDArray[np.uint8]]
    imu_stamps_ns: NDArray[np.int64]
    gyro_radps: Array
    accel_mps2: Array
    world_from_body: list[Array] = field(default_factory=list)


def make_sample(frames: int = 6, *, imu_before_ns: int = 500_000_000) -> Sample:
    """Stereo pairs at 20 Hz, an IMU at 200 Hz from `imu_before_ns` before the first to 0.1 s after the last."""
    stamps_ns = START_NS + FRAME_NS * np.arange(frames, dtype=np.int64)
    left, right = ([_view(int(s), offset_m).copy() for s in stamps_ns] for offset_m in (0.0, BASELINE_M))
    imu_stamps_ns = np.arange(stamps_ns[0] - imu_before_ns, stamps_ns[-1] + 100_000_000, IMU_NS, dtype=np.int64)
    gyro, accel = zip(*(_imu(int(s)) for s in imu_stamps_ns), strict=True)
    truth = [world_from_cam0(int(s)) @ se3_inverse(BODY_FROM_CAM0) for s in stamps_ns]
    return Sample(stamps_ns, left, right, imu_stamps_ns, np.array(gyro), np.array(accel), truth)


def write_mcap(folder: Path, sample: Sample) -> Path:
    """A folder with an MCAP file of this project; the images are PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    imu = ImuSamples(sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    with McapRecordingWriter(folder / "drive.mcap", calibration(), name=folder.name) as writer:
        writer.write_imu(imu)
        for stamp_ns, *images in zip(sample.stamps_ns.tolist(), sample.left, sample.right, strict=True):
            writer.write_frame(StoredFrame(stamp_ns, *(png_image(image) for image in images)))
        writer.write_ground_truth(Trajectory(sample.stamps_ns, np.array(sample.world_from_body)))
    return folder


def write_euroc(folder: Path, sample: Sample, *, image_type: str = "png", yaml_line: bool = True) -> Path:
    """A EuRoC folder; the images have names that only data.csv knows. The test is skipped without the plug-in that reads it."""
    pytest.importorskip("fleetmap.plugins.datasets")
    rig = calibration()
    for number, images in enumerate((sample.left, sample.right)):
        camera = folder / f"mav0/cam{number}"
        (camera / "data").mkdir(parents=True)
        rows = ["#timestamp [ns],filename"]
        for index, (stamp, image) in enumerate(zip(sample.stamps_ns, images, strict=True)):
            cv2.imwrite(str(camera / f"data/image{index}.{image_type}"), image)
            rows.append(f"{stamp},image{index}.{image_type}")
        (camera / "data.csv").write_text("\r\n".join(rows) + "\r\n")
        (camera / "sensor.yaml").write_text(_euroc_yaml(rig.cameras[number], yaml_line))
    imu = folder / "mav0/imu0"
    imu.mkdir()
    write_euroc_imu(imu / "data.csv", sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    (imu / "sensor.yaml").write_text(
        ("%YAML:1.0\n" if yaml_line else "")
        + "sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, "
        "0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\nrate_hz: 200\n"
        "gyroscope_noise_density: 1.7e-4\ngyroscope_random_walk: 1.9e-5\n"
        "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    )
    truth = folder / "mav0/state_groundtruth_estimate0"
    truth.mkdir()
    head = "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v,v,v,bw,bw,bw,ba,ba,ba"
    rows = [[*place[:3, 3], *quat_wxyz_from_rotation(place[:3, :3]), *np.zeros(9)] for place in sample.world_from_body]
    (truth / "data.csv").write_text(_rows(head, ",", sample.stamps_ns, rows) + "\n")
    return folder


def write_euroc_imu(file: Path, stamps_ns: NDArray[np.int64], gyro_radps: Array, accel_mps2: Array) -> None:
    """A EuRoC imu0/data.csv."""
    head, values = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z", np.hstack([gyro_radps, accel_mps2])
    file.write_text(_rows(head, ",", stamps_ns, values) + "\n")


def _rows(head: str, between: str, stamps: Iterable[object], values: Iterable[Sequence[float]]) -> str:
    rows = zip(stamps, values, strict=True)
    return "\n".join([head, *(between.join([str(stamp), *(repr(float(v)) for v in row)]) for stamp, row in rows)])


def write_tumvi(folder: Path, sample: Sample) -> Path:
    """A TUM-VI folder with 16-bit images, whose upper bytes are the sample's."""
    for number, images in enumerate((sample.left, sample.right)):
        (folder / f"cam{number}/images").mkdir(parents=True)
        rows = ["# filename timestamp[s] exposuretime[ms]"]
        for stamp, image in zip(sample.stamps_ns, images, strict=True):
            cv2.imwrite(str(folder / f"cam{number}/images/{stamp}.png"), image.astype(np.uint16) * 256 + 77)
            rows.append(f"{stamp} {stamp // 10**9}.{stamp % 10**9:09d} 1.5")
        (folder / f"cam{number}/times.txt").write_text("\n".join(rows))
    (folder / "camchain.yaml").write_text(kalibr_text())
    (folder / "imu_config.yaml").write_text(
        "rostopic: /imu0\nupdate_rate: 200.0\naccelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
        "gyroscope_noise_density: 1.7e-4\ngyroscope_random_walk: 1.9e-5\n"
    )
    felt = np.hstack([sample.gyro_radps, sample.accel_mps2])
    (folder / "imu.txt").write_text(_rows("# timestamp[ns] w.x w.y w.z a.x a.y a.z", " ", sample.imu_stamps_ns, felt))
    rows = [[*place[:3, 3], *quat_wxyz_from_rotation(place[:3, :3])] for place in sample.world_from_body]
    (folder / "gt_imu.csv").write_text(_rows("# timestamp[ns],tx,ty,tz,qw,qx,qy,qz", ",", sample.stamps_ns, rows))
    return folder


def kalibr_text() -> str:
    """The sample's rig as a Kalibr camchain; cam1 by T_cn_cnm1 alone."""
    text = ""
    for number, camera in enumerate(calibration().cameras):
        cam_from_body = se3_inverse(camera.body_from_cam)
        cam1_from_cam0 = se3(np.eye(3), np.array([-BASELINE_M, 0, 0]))
        key, matrix = ("T_cam_imu", cam_from_body) if number == 0 else ("T_cn_cnm1", cam1_from_cam0)
        text += (
            f"cam{number}:\n  {key}:\n"
            + "".join(f"  - {[float(v) for v in row]}\n" for row in matrix)
            + f"  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [1e-9, 0.0, 0.0, 0.0]\n"
            f"  intrinsics: {[float(v) for v in camera.intrinsics_px]}\n  resolution: [{WIDTH}, {HEIGHT}]\n"
            f"  rostopic: /cam{number}/image_raw\n"
        )
    return text


def write_kitti(folder: Path, sample: Sample) -> Path:
    """A KITTI folder with labelled rows in calib.txt and no times.txt."""
    for name, images in (("image_0", sample.left), ("image_1", sample.right)):
        (folder / name).mkdir(parents=True)
        for index, image in enumerate(images):
            cv2.imwrite(str(folder / name / f"{index:06d}.png"), image)
    fx, fy, cx, cy = calibration().cameras[0].intrinsics_px
    rows = [f"P{i}: {fx} 0 {cx} {-fx * baseline} 0 {fy} {cy} 0 0 0 1 0" for i, baseline in ((0, 0.0), (1, BASELINE_M))]
    (folder / "calib.txt").write_text("\n".join([*rows, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]))
    places = [world_from_cam0(int(s))[:3].ravel() for s in sample.stamps_ns]
    (folder / "poses.txt").write_text("\n".join(" ".join(repr(float(v)) for v in row) for row in places))
    return folder


def write_seven_scenes(folder: Path, sample: Sample) -> Path:
    """An RGB-D folder; depth is the wall as seen by a lens of 585 px per 640, 25 mm left of the colour camera."""
    folder.mkdir(parents=True, exist_ok=True)
    cam0_from_depth = se3(np.eye(3), np.array([-0.025, 0.0, 0.0]))
    for index, (image, stamp) in enumerate(zip(sample.left, sample.stamps_ns, strict=True)):
        stem = folder / f"frame-{index * 5:06d}"
        cv2.imwrite(f"{stem}.color.png", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        depth = np.full((HEIGHT, WIDTH), 5000, np.uint16)
        depth[:, : WIDTH // 2] = 2000
        depth[:20], depth[-20:] = 0, 65535
        cv2.imwrite(f"{stem}.depth.png", depth)
        np.savetxt(f"{stem}.pose.txt", world_from_cam0(int(stamp)) @ cam0_from_depth)
    return folder


def write_tum_rgbd(folder: Path, sample: Sample) -> Path:
    """A TUM RGB-D folder without accelerometer, and beside it the camera as a camchain; depth comes 5 ms later."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    depth = np.full((HEIGHT, WIDTH), 25000, np.uint16)
    depth[:, : WIDTH // 2], depth[:20] = 10000, 0
    for image, stamp in zip(sample.left, sample.stamps_ns.tolist(), strict=True):
        pictures = {"rgb": (stamp, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)), "depth": (stamp + 5_000_000, depth)}
        for name, (stamp_ns, picture) in pictures.items():
            text = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
            cv2.imwrite(str(folder / name / f"{text}.png"), picture)
            lists[name].append(f"{text} {name}/{text}.png")
    for name, rows in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
    places = [world_from_cam0(stamp) for stamp in sample.stamps_ns.tolist()]
    rows = [[*at[:3, 3], *np.roll(quat_wxyz_from_rotation(at[:3, :3]), -1)] for at in places]
    stamps = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in sample.stamps_ns.tolist()]
    (folder / "groundtruth.txt").write_text(_rows("# timestamp tx ty tz qx qy qz qw", " ", stamps, rows) + "\n")
    return folder


def write_video(path: Path, images: Sequence[NDArray[np.uint8]], times_ms: Sequence[int], **options: str) -> Path:
    """An MP4 of grey images by PyAV's encoder, without loss unless options of x264 say otherwise; key frames every five."""
    movflags = options.pop("movflags", "")
    chosen = {"qp": "0", "g": "5", "bf": "0", **options}
    height, width = images[0].shape
    with av.open(str(path), "w", options={"movflags": movflags} if movflags else {}) as container:
        stream = container.add_stream("libx264", rate=20, options={k: v for k, v in chosen.items() if v})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for image, time_ms in zip(images, times_ms, strict=True):
            planes = np.vstack([image, np.full((height // 2, width), 128, np.uint8)])
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def png_of(*chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of chunks, each a kind and its content, whose checksums are right."""
    made = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


def grey_png(stream: bytes, width: int, height: int) -> bytes:
    """A PNG of 8 bits, whatever its stream of pixels is."""
    return png_of((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", stream), (b"IEND", b""))


def _euroc_yaml(camera: CameraCalibration, yaml_line: bool) -> str:
    data = ", ".join(repr(float(v)) for v in camera.body_from_cam.ravel())
    return (
        ("%YAML:1.0\n" if yaml_line else "")
        + f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
        f"resolution: [{camera.width_px}, {camera.height_px}]\ncamera_model: pinhole\n"
        f"intrinsics: {[float(v) for v in camera.intrinsics_px]}\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [1e-9, 0.0, 0.0, 0.0]\n"
    )


@cache
def _imu(stamp_ns: int) -> tuple[Array, Array]:
    half = 100_000
    before, after = world_from_cam0(stamp_ns - half)[:3, :3], world_from_cam0(stamp_ns + half)[:3, :3]
    rate_cam = so3_log(before.T @ after) / (2 * half * 1e-9)
    body_from_cam = BODY_FROM_CAM0[:3, :3]
    up_cam = world_from_cam0(stamp_ns)[:3, :3].T @ UP_WORLD
    return body_from_cam @ rate_cam, 9.81 * body_from_cam @ up_cam


@cache
def _texture() -> NDArray[np.uint8]:
    rng = np.random.default_rng(7)
    noise = [cv2.resize(rng.random((n, n)), (1600, 1600), interpolation=cv2.INTER_CUBIC) for n in (40, 130, 400)]
    mixed = sum(noise) - np.min(sum(noise))
    return np.asarray(255 * mixed / mixed.max(), np.uint8)


@cache
def _view(stamp_ns: int, offset_m: float) -> NDArray[np.uint8]:
    """The picture of a camera so far right of the left one."""
    world_from_cam = world_from_cam0(stamp_ns) @ se3(np.eye(3), np.array([offset_m, 0, 0]))
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - (WIDTH / 2 - 0.5)) / FOCAL, (v - (HEIGHT / 2 - 0.5)) / FOCAL, np.ones_like(u, float)], -1)
    rays_world = rays @ world_from_cam[:3, :3].T
    distance = (WALL_M - world_from_cam[2, 3]) / rays_world[..., 2]
    points = world_from_cam[:3, 3] + rays_world * distance[..., None]
    pixels = (points[..., :2] * 80 + 800).astype(np.float32)
    return np.asarray(cv2.remap(_texture(), pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.uint8)
