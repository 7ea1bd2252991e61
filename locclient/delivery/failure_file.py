"""Failure file: the ring around the onset as an MCAP recording with reduced images; writing and reading.

The recording is for inspection. An attachment holds the localizer's start pose and its percepts since, for a replay.
"""

from dataclasses import replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import msgspec
import numpy as np
import zstandard

import fleetmap
from fleetmap.encoding import to_msgpack
from fleetmap.errors import RecordingError
from fleetmap.failure_summary import FailureSummary, decode_summary
from fleetmap.features import stereo
from fleetmap.geometry import Array, se3
from fleetmap.messages import FailureReport
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY, attachments_of
from fleetmap.recordings.images import StoredFrame, StoredImage, jpeg_image
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.relocalization.relocalizer import FrameFeatures
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import MountedCamera, MountedRig, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Image
from locclient.delivery.failure_checks import MAX_ROWS, check_record
from locclient.localization.perception import Percept
from locclient.localization.pose_tracker import Start
from locclient.localization.settings import LocalizerSettings
from locclient.robot.failure_onset import block_px, reduced
from locclient.robot.failure_report import RobotProfile, without_detail
from locclient.robot.failure_ring import Commands, FailureCut, RingFrame, UsedMap

_FORMAT = 3
_WIDTH_PX = 320  # of pictures
_QUALITIES, _PICTURE_BYTES = (70, 50, 30), 24 << 10
_MAX_UNPACKED_BYTES = 64 << 20
_Shape = Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]], msgspec.Meta(max_length=2)]
_ARRAYS = ("<f8", "<f4", "<i8", "<u8", "<u4", "|u1", "|i1", "|b1")


class LocalizerRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Start state of the localizer, its map, and for each frame the preceding samples and commands and its percept."""

    format: Annotated[int, msgspec.Meta(ge=_FORMAT, le=_FORMAT)] = _FORMAT
    settings: LocalizerSettings
    camera: StereoCamera
    body_from_cam: Array
    base_from_body: Array
    start: Start
    used: UsedMap | None
    frames: Annotated[list[tuple[Commands, Percept]], msgspec.Meta(min_length=1, max_length=2000)]
    others: Annotated[tuple[MountedCamera, ...], msgspec.Meta(max_length=15)] = ()  # the rig's other cameras


def failure_file(cut: FailureCut, report: FailureReport, profile: RobotProfile) -> bytes:
    """Return the MCAP file of a complete cut, with pictures by the profile, full or blurred."""
    assert cut.frames
    used = cut.used or next((f.commands.used for f in cut.frames if f.commands.used is not None), None)
    summary = FailureSummary(
        site=report.site,
        robot=report.robot,
        id=report.id,
        began_ns=report.stamp_ns,
        version=None if used is None else used.version,
        manifest_sha256=None if used is None else used.manifest_sha256,
        client=str(fleetmap.__version__),
        pictures=profile.pictures,
        moments=tuple(frame.moment for frame in cut.frames),
    )
    (camera, body_from_cam), *others = profile.rig.mounted
    calibration = profile.rig.calibration
    record = LocalizerRecord(
        settings=profile.settings,
        camera=camera,
        body_from_cam=body_from_cam,
        base_from_body=calibration.base_from_body,
        start=cut.start,
        used=cut.used,
        frames=[(frame.commands, _with_depth(frame, profile)) for frame in cut.frames],
        others=tuple(others),
    )
    packed = zstandard.ZstdCompressor(level=3).compress(msgspec.msgpack.encode(record, enc_hook=_encoded_array))
    has_right = any(frame.picture is not None and frame.picture.right is not None for frame in cut.frames)
    pairs = [has_right, *(each.camera.baseline_m > 0 for each in others)]
    views = (_reduced_view(profile.rig, view, is_pair=is_pair) for view, is_pair in enumerate(pairs))
    cameras = tuple(camera for view in views for camera in view)
    rig = RigCalibration(cameras, calibration.imu, calibration.base_from_body)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "failure.mcap"
        with McapRecordingWriter(path, rig, name=f"{report.robot} {report.id}") as writer:
            writer.attach(SUMMARY, "application/msgpack", to_msgpack(summary))
            writer.attach(LOCALIZER, "application/zstd", packed)
            for frame in cut.frames:
                for samples in frame.imu if calibration.imu is not None else ():
                    writer.write_imu(samples)
                writer.write_wheel(frame.wheel)
                writer.write_prior(frame.commands.priors)
                if frame.picture is not None:
                    view = 0 if frame.percept.query is None else frame.percept.query.view
                    writer.write_frame(_reduced(frame.picture, profile.pictures, view))
        return path.read_bytes()


def read_failure_file(path: Path) -> tuple[FailureSummary, LocalizerRecord]:
    """Read, decode and validate both attachments; RecordingError if no client of this version can have written them."""
    attachments = attachments_of(path)
    with zstandard.ZstdDecompressor().stream_reader(attachments[LOCALIZER]) as reader:
        try:
            data = reader.read(_MAX_UNPACKED_BYTES + 1)
        except zstandard.ZstdError as error:
            raise RecordingError(
                f"{path}: the localizer's part cannot be unpacked ({error}); fetch it again"
            ) from error
    if len(data) > _MAX_UNPACKED_BYTES:
        raise RecordingError(
            f"{path}: the localizer's part has more than {_MAX_UNPACKED_BYTES} bytes; no robot writes that"
        )
    summary = decode_summary(attachments[SUMMARY])
    try:
        record = msgspec.msgpack.decode(data, type=LocalizerRecord, dec_hook=_decoded_array)
        check_record(record)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError, TypeError) as error:
        raise RecordingError(
            f"{path}: the localizer's part cannot be read ({error}); it was written by another fleetmap, replay it with that one; "
            "Foxglove opens the recording"
        ) from error
    if [percept.odometry.stamp_ns for _, percept in record.frames] != [each.stamp_ns for each in summary.moments]:
        raise RecordingError(f"{path}: the summary is of other frames than the localizer's part; fetch it again")
    return summary, record


# --- the localizer's part ---------------------------------------------------------------------------------------------


def _with_depth(frame: RingFrame, profile: RobotProfile) -> Percept:
    """Add the depth of every feature if the images were kept: another version matches other features."""
    query = frame.percept.query
    if query is None or query.features is None:
        return frame.percept
    found, pixels = query.features.features, query.features.pixels.copy()
    shown = None if frame.picture is None else frame.picture.view(query.view)
    if shown is not None:
        camera, is_tried = profile.rig.mounted[query.view].camera, query.features.is_tried
        untried = np.ones(len(found), bool) if is_tried is None else ~is_tried
        left = found.pixels[untried]
        pixels[untried, 2] = left[:, 0] - stereo.disparities(shown, camera, left, profile.settings.stereo)[:, 0]
    return replace(frame.percept, query=replace(query, features=FrameFeatures(found, pixels)))


def _encoded_array(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(type(value))
    form = value.dtype.newbyteorder("<").str
    if form == "<f8" and np.array_equal(value.astype("<f4").astype("<f8"), value, equal_nan=True):
        return form, value.shape, value.astype("<f4").tobytes()  # half of the bytes without loss
    return form, value.shape, value.astype(form).tobytes()


def _decoded_array(kind: type, value: Any) -> Any:
    form, shape, data = msgspec.convert(value, tuple[str, _Shape, bytes])
    if form not in _ARRAYS:
        raise ValueError(f"an array of {form!r:.20}")
    is_short = form == "<f8" and len(data) == 4 * prod(shape)
    stored = "<f4" if is_short else "|u1" if form == "|b1" else form
    return np.frombuffer(data, stored).astype(form).reshape(shape)


# --- the recording's part ---------------------------------------------------------------------------------------------


def _reduced_view(rig: MountedRig, view: int, *, is_pair: bool) -> list[CameraCalibration]:
    """Return the rectified cameras of a view at the pictures' size."""
    camera, body_from_cam = rig.mounted[view]
    step = block_px(camera.width_px, _WIDTH_PX)
    center = [(value + 0.5) / step - 0.5 for value in (camera.cx_px, camera.cy_px)]
    left = CameraCalibration(
        "radial-tangential",
        camera.width_px // step,
        camera.height_px // step,
        np.array([camera.focal_px / step, camera.focal_px / step, *center]),
        np.zeros(4),
        body_from_cam,
        rig.imu_minus_cam_s,
    )
    body_from_right = body_from_cam @ se3(np.eye(3), np.array([camera.baseline_m, 0.0, 0.0]))
    return [left, replace(left, body_from_cam=body_from_right)] if is_pair else [left]


def _reduced(frame: RectifiedFrame, pictures: str, view: int = 0) -> StoredFrame:
    """Return the pictures of the first view, and of the one whose features were compared with the map."""
    left, right = (None if image is None else _jpeg(image, pictures) for image in (frame.left, frame.right))
    assert left is not None
    shown = [frame.view(number) if number == view else None for number in range(1, len(frame.others) + 1)]
    others = tuple(None if each is None else _reduced(each, pictures) for each in shown)
    return StoredFrame(frame.stamp_ns, left, right, None, others)


def _jpeg(image: Image, pictures: str) -> StoredImage:
    small = reduced(image, _WIDTH_PX)
    if pictures == "blurred":
        small = without_detail(small)
    return jpeg_image(small, *_QUALITIES, most_bytes=_PICTURE_BYTES)
