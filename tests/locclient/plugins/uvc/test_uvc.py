"""A side-by-side camera, played by a test: cut in two, stamped, opened again after it was unplugged."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fleetmap.errors import RecordingError, UsageError
from fleetmap.recordings import Topics
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import open_source
from locclient.plugins.uvc import UvcSource, split_frame
from support.recordings.recording_samples import calibration


class PlayedCamera:
    """Delivers its pictures and is gone; driver_s: the stamps that its driver gives."""

    def __init__(self, pictures: list[Any], driver_s: float | None = None) -> None:
        self.pictures, self.driver_s = list(pictures), driver_s
        self.asked: dict[int, float] = {}
        self.released = False

    def isOpened(self) -> bool:  # noqa: N802
        return bool(self.pictures)

    def set(self, prop: int, value: float) -> bool:
        self.asked[prop] = value
        return True

    def get(self, prop: int) -> float:
        return 0.0 if self.driver_s is None else 1e3 * self.driver_s

    def read(self) -> tuple[bool, Any]:
        return (True, self.pictures.pop(0)) if self.pictures else (False, None)

    def release(self) -> None:
        self.released = True


def played(cameras: list[PlayedCamera], *, delay_s: float = 0.0) -> tuple[Intake, list[float]]:
    """What the intake holds after the cameras were opened one after another, and how long was waited between."""
    intake = Intake(frames=20, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
    waits: list[float] = []
    left = list(cameras)
    clock = iter(range(10**9, 10**12, 10**6))
    section, wall_ns = SourceSection(width_px=640, height_px=240, delay_s=delay_s), lambda: next(clock)
    source = UvcSource(lambda: left.pop(0), calibration(), section, None, monotonic_s=lambda: 50.0, wall_ns=wall_ns)

    def wait(seconds: float) -> bool:
        waits.append(seconds)
        return seconds > 0 and not left

    source.run(intake, wait)
    return intake, [seconds for seconds in waits if seconds]


def test_pictures_are_cut_and_the_camera_is_opened_again() -> None:
    grey = np.arange(240 * 640, dtype=np.uint32).reshape(240, 640).astype(np.uint8)
    colour = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    cameras = [PlayedCamera([grey, np.zeros((4, 5), np.uint8)]), PlayedCamera([]), PlayedCamera([colour])]
    intake, waits = played(cameras)
    assert intake.counts.frames == 2
    assert intake.counts.unreadable == 1
    assert len(waits) == 3
    assert all(camera.released for camera in cameras)
    assert cameras[0].asked[cv2.CAP_PROP_FRAME_WIDTH] == 640
    for _ in range(2):
        frame = intake.take(0).frame
        np.testing.assert_array_equal(frame.left, grey[:, :320])
        np.testing.assert_array_equal(frame.right, grey[:, 320:])


@pytest.mark.parametrize(("driver_s", "age_s"), [(None, 0.0), (49.97, 0.03), (7.0, 0.0), (50.2, 0.0)])
def test_stamps_are_the_drivers_where_its_clock_is_known(driver_s: float | None, age_s: float) -> None:
    intake, _ = played([PlayedCamera([np.zeros((240, 640), np.uint8)], driver_s)], delay_s=0.004)
    assert intake.take(0).frame.stamp_ns == pytest.approx(10**9 - (age_s + 0.004) * 1e9, abs=1000)


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 5), np.uint8), np.zeros((4, 6), np.float32), np.zeros((0, 6), np.uint8)]
)
def test_what_is_no_pair_is_refused(picture: Callable[[], None]) -> None:
    with pytest.raises(RecordingError, match="side by side"):
        split_frame(picture, 0)  # type: ignore[arg-type]


def test_without_ros_a_camera_runs_alone_unless_its_rig_has_an_imu(tmp_path: Path) -> None:
    for imu in (None, calibration().imu):
        (tmp_path / "rig.yaml").write_text(format_calibration(replace(calibration(), imu=imu)))
        section = SourceSection(kind="uvc", calibration=str(tmp_path / "rig.yaml"))
        with nullcontext() if imu is None else pytest.raises(UsageError, match="source /opt/ros"):
            open_source(section, Topics()).close()


def test_a_uvc_camera_has_a_pair() -> None:
    with pytest.raises(UsageError, match="uvc camera sends pairs"):
        open_source(SourceSection(kind="uvc", sensors="mono"), Topics())
