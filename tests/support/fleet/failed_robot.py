"""A robot that fails in the painted room, and the recording of its failure. Made once."""

import time
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import msgspec

from fleetmap.errors import LinkError
from fleetmap.failure_summary import FailureSummary, Moment, ReplayPart
from fleetmap.messages import PART_BYTES, FailureAck, FailureReport
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY
from fleetmap.recordings.images import StoredFrame, StoredImage
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.delivery.failure_file import failure_file
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.robot import Robot
from mapserver.fleet.fleet import Fleet
from support.recordings.recording_samples import calibration
from support.worlds import robot_world


def profile(rig: Rectifier | None = None, pictures: str = "blurred") -> RobotProfile:
    return RobotProfile("room", "r1", (rig or robot_world.rectifier()).rig, robot_world.SETTINGS, pictures)


def failed(
    ride: Iterable[SensorBundle], loaded: LoadedMap, pictures: str = "full", rig: RigCalibration | None = None
) -> tuple[FailureReport, bytes, list[str]] | None:
    """The first failure of a ride: its report, its recording, and the robot's estimates for its frames."""
    rectifier = robot_world.rectifier() if rig is None else Rectifier(rig)
    robot = Robot(rectifier, robot_world.SETTINGS, robot_world.TRIAL, keeps_replay=True)
    robot.use(loaded)
    context, said = None, {}
    for bundle in ride:
        outcome = robot.handle(bundle)
        said[outcome.estimate.stamp_ns] = outcome.estimate.status.value
        context = context or outcome.failure
        if context is not None and context.cut is not None and context.cut.frames is not None:
            break
    if context is None:
        return None
    robot.ring.finish()
    stamps = [frame.stamp_ns for frame in context.cut.frames]
    report = failure_report(context, profile(rectifier), report_id="f1", wall_ns=10**18)
    data = failure_file(context.cut, report, profile(rectifier, pictures))
    return report, data, [said[stamp_ns] for stamp_ns in stamps]


@lru_cache(maxsize=1)
def _jpeg() -> bytes:
    import cv2
    import numpy as np

    size = calibration().cameras[0]
    image = np.random.default_rng(0).integers(0, 255, (size.height_px, size.width_px), np.uint8)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 30])[1].tobytes()


def small_file(
    path: Path,
    *,
    jpegs: list[bytes] | None = None,
    attached: bool = True,
    moments: tuple[Moment, ...] | None = None,
    stamps_ns: tuple[int, ...] = (0, 2 * 10**8, 4 * 10**8),
    **named: object,
) -> bytes:
    """A recording as a server sees it: the summary counts, the localizer's part is not looked at. stamps_ns: of the pictures."""
    if moments is None:
        moments = tuple(
            Moment(k * 10**8, "LOST" if k > 2 else "TRACKING", "", (0.1 * k, 0.0, 0.0), 0.0, 0.05) for k in range(6)
        )
    given = {"site": "lab", "robot": "r1", "id": "f1", "began_ns": 3 * 10**8} | named
    summary = FailureSummary(version=1, manifest_sha256="0" * 64, client="1", pictures="full", moments=moments, **given)
    with McapRecordingWriter(path, calibration(has_imu=False)) as writer:
        if attached:
            writer.attach(SUMMARY, "application/msgpack", msgspec.msgpack.encode(summary))
            writer.attach(LOCALIZER, "application/zstd", b"for robots")
        for stamp_ns, jpeg in zip(stamps_ns, [_jpeg()] * 3 if jpegs is None else jpegs, strict=False):
            image = StoredImage("file", jpeg)
            writer.write_frame(StoredFrame(stamp_ns, image, image))
    return path.read_bytes()


def send_replay(fleet: Fleet, site: str, robot: str, report_id: str, data: bytes) -> None:
    """Gives a server a failure's recording, as a robot sends it."""
    for offset in range(0, len(data), PART_BYTES):
        part = ReplayPart(id=report_id, total_bytes=len(data), offset=offset, data=data[offset : offset + PART_BYTES])
        assert not asked(fleet, site, robot, part).refused


def asked(fleet: Fleet, site: str, robot: str, part: ReplayPart) -> FailureAck:
    """The answer to a part, once the recording is judged."""
    while True:
        try:
            return fleet.replays.take(site, robot, part)
        except LinkError as error:
            if "being judged" not in str(error):
                raise
            time.sleep(0.05)
