"""Frames of rigs with any number of cameras, and recordings of them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from fleetmap.geometry import se3_inverse
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, Image
from fleetsim.recorder import Order, prepare


@lru_cache(maxsize=3)
def simulated(rig: str, size_px: tuple[int, int] = (96, 72)) -> tuple[RigCalibration, tuple[CameraFrame, ...]]:
    """Four frames of a robot in the simulator, which has no IMU here."""
    session = prepare(Order("clip", frames=4, size_px=size_px, rig=rig))
    try:
        return replace(session.nominal, imu=None), tuple(session.frames())
    finally:
        session.renderer.close()


def write_rig(file: Path, calibration: RigCalibration, frames: Iterable[CameraFrame]) -> Path:
    with McapRecordingWriter(file, calibration) as writer:
        for frame in frames:
            writer.write_frame(frame)
    return file


def images_of(frame: CameraFrame) -> list[Image]:
    """The images of all cameras, in the order of the calibration."""
    views = [frame, *frame.others]
    return [image for view in views if view is not None for image in (view.left, view.right) if image is not None]


def write_kitti_raw(drive: Path, calibration: RigCalibration, frames: Sequence[CameraFrame]) -> Path:
    """A drive in the layout of KITTI's raw data, not rectified; camera 0 is the origin."""
    stamps = [str(np.datetime64(frame.stamp_ns, "ns")).replace("T", " ") for frame in frames]
    first_from_body, lines = se3_inverse(calibration.cameras[0].body_from_cam), ["calib_time: 01-Jan-2024 10:00:00"]
    for number, camera in enumerate(calibration.cameras):
        folder = drive / f"image_{number:02d}"
        (folder / "data").mkdir(parents=True)
        (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
        for index, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"data/{index:010d}.png"), images_of(frame)[number])
        fx, fy, cx, cy = camera.intrinsics_px
        cam_from_first = se3_inverse(first_from_body @ camera.body_from_cam)
        distortion = np.zeros(5)
        distortion[: len(camera.distortion)] = camera.distortion
        size = np.array([camera.width_px, camera.height_px])
        for name, values in (
            ("S", size),
            ("K", np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])),
            ("D", distortion),
            ("R", cam_from_first[:3, :3].ravel()),
            ("T", cam_from_first[:3, 3]),
            ("S_rect", size - 10),
            ("P_rect", np.zeros(12)),
        ):
            lines.append(f"{name}_{number:02d}: {' '.join(repr(float(value)) for value in values)}")
    (drive / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    return drive
