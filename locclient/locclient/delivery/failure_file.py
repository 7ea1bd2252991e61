"""The file of a failure: the ring around its onset as an MCAP recording with reduced images, and its way back.

The recording is for people and for clients that see otherwise. The attachment of the localizer holds what it perceived, to the bit.
"""

from dataclasses import replace
from itertools import chain
from math import atan2, prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

import fleetmap
from fleetmap.encoding import to_msgpack
from fleetmap.errors import RecordingError
from fleetmap.failure_summary import FailureSummary, Moment, decode_summary
from fleetmap.features import stereo
from fleetmap.features.orb import Features
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3
from fleetmap.messages import FailureReport
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.recordings.failure_recording import LOCALIZER, SUMMARY, attachments_of
from fleetmap.recordings.images import StoredFrame, StoredImage
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Image, PositionPrior
from locclient.delivery.failure_checks import MAX_ROWS, check_record
from locclient.localization.calibration.parameters import CalibrationState
from locclient.localization.image_quality import ImageQuality
from locclient.localization.localizer_state import LocalizerState
from locclient.localization.settings import LocalizerSettings
from locclient.robot.failure_report import RobotProfile, without_detail
from locclient.robot.failure_ring import FailureCut, KeptFrame, KeptQuery, Said, Segment, UsedMap

PICTURES = ("full", "blurred")
_FORMAT = 1
_WIDTH_PX = 320  # of pictures
_QUALITIES, _PICTURE_BYTES = (70, 50, 30), 24 << 10
_MAX_UNPACKED_BYTES = 64 << 20
_Shape = Annotated[list[Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]], msgspec.Meta(max_length=2)]
_ARRAYS = ("<f8", "<f4", "<i8", "<u8", "<u4", "|u1", "|i1", "|b1")


class QueryRecord(msgspec.Struct, frozen=True, array_like=True):
    """A map query: features (N), the columns of the right image (N,), NaN where unknown, and which of them the robot had measured."""

    slices: Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]
    pixels: Array | None = None
    octaves: NDArray[np.int8] | None = None
    angles_deg: NDArray[np.float32] | None = None
    descriptors: NDArray[np.uint8] | None = None
    right_px: Array | None = None
    is_tried: NDArray[np.bool_] | None = None


class KeptFrameRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A KeptFrame without pictures and samples. calibration: None where it is that of the frame before."""

    odometry: OdometryEstimate
    image: ImageQuality
    used: UsedMap | None
    forgets: bool
    priors: list[PositionPrior]
    motions: dict[int, tuple[Array, Array] | None]
    forgotten: dict[int, bool]
    is_reversed: bool
    calibration: CalibrationState | None
    query: QueryRecord | None
    said: Said


class LocalizerRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The localizer at the beginning, in the map that it used, and what it perceived since."""

    format: Annotated[int, msgspec.Meta(ge=_FORMAT, le=_FORMAT)] = _FORMAT
    settings: LocalizerSettings
    camera: StereoCamera
    body_from_cam: Array
    base_from_body: Array
    state: LocalizerState
    used: UsedMap | None
    frames: Annotated[list[KeptFrameRecord], msgspec.Meta(min_length=1, max_length=2000)]


def failure_file(cut: FailureCut, report: FailureReport, profile: RobotProfile, pictures: str) -> bytes:
    """The MCAP file of a cut that is complete. pictures: one of PICTURES."""
    assert cut.segments
    frames = list(chain.from_iterable(segment.frames for segment in cut.segments))
    summary = _summary(cut.segments, frames, report, pictures)
    state = _packed(_localizer_record(cut.segments[0], frames, profile))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "failure.mcap"
        with McapRecordingWriter(path, _reduced_rig(frames, profile), name=f"{report.robot} {report.id}") as writer:
            writer.attach(SUMMARY, "application/msgpack", to_msgpack(summary))
            writer.attach(LOCALIZER, "application/zstd", state)
            for frame in frames:
                for samples in frame.inputs.imu if profile.imu is not None else ():
                    writer.write_imu(samples)
                writer.write_wheel(frame.inputs.wheel)
                writer.write_prior(frame.inputs.priors)
                if frame.picture is not None:
                    writer.write_frame(_reduced(frame.picture, pictures))
        return path.read_bytes()


def read_failure_file(path: Path) -> tuple[FailureSummary, LocalizerRecord]:
    """Both attachments, decoded and checked; RecordingError for what no client of this version has written."""
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
        return summary, decode_record(data, summary)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


def decode_record(data: bytes, summary: FailureSummary) -> LocalizerRecord:
    """The localizer's part, unpacked, decoded and checked; RecordingError for what no client of this version has written."""
    try:
        record = msgspec.msgpack.decode(data, type=LocalizerRecord, dec_hook=_decoded_array)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError, TypeError) as error:
        raise RecordingError(
            f"the localizer's part cannot be read ({error}); it was written by another fleetmap, the recording itself plays "
            "with `locclient replay`"
        ) from error
    check_record(record)
    if [frame.odometry.stamp_ns for frame in record.frames] != [each.stamp_ns for each in summary.moments]:
        raise RecordingError("the summary is of other frames than the localizer's part; fetch it again")
    return record


# --- the localizer's part ---------------------------------------------------------------------------------------------


def _localizer_record(first: Segment, frames: list[KeptFrame], profile: RobotProfile) -> LocalizerRecord:
    records, calibration = [], None
    for frame in frames:
        assert frame.said is not None
        records.append(
            KeptFrameRecord(
                odometry=frame.odometry,
                image=frame.image,
                used=frame.inputs.used,
                forgets=frame.inputs.forgets,
                priors=frame.inputs.priors,
                motions=frame.motions,
                forgotten=frame.forgotten,
                is_reversed=frame.is_reversed,
                calibration=None if frame.calibration is calibration else frame.calibration,
                query=None if frame.query is None else _query_record(frame.query, frame.picture, profile),
                said=frame.said,
            )
        )
        calibration = frame.calibration
    return LocalizerRecord(
        settings=profile.settings,
        camera=profile.camera,
        body_from_cam=profile.body_from_cam,
        base_from_body=profile.base_from_body,
        state=first.state,
        used=first.used,
        frames=records,
    )


def _query_record(query: KeptQuery, picture: RectifiedFrame | None, profile: RobotProfile) -> QueryRecord:
    """With the depth of every feature where the images were kept: another version matches others of them."""
    kept = query.features
    if kept is None:
        return QueryRecord(query.slices)
    features: Features = kept.features
    tried = np.zeros(len(features), bool) if kept.is_tried is None else kept.is_tried
    right_px = kept.pixels[:, 2].copy()
    if picture is not None:
        settings: StereoSettings = profile.settings.stereo
        found = stereo.disparities(picture, profile.camera, features.pixels[~tried], settings)[:, 0]
        right_px[~tried] = features.pixels[~tried, 0] - found
    arrays = (features.pixels, features.octaves, features.angles_deg, features.descriptors, right_px, tried)
    return QueryRecord(query.slices, *arrays)


def _packed(record: LocalizerRecord) -> bytes:
    return zstandard.ZstdCompressor(level=3).compress(msgspec.msgpack.encode(record, enc_hook=_encoded_array))


def _encoded_array(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(type(value))
    form = value.dtype.newbyteorder("<").str
    if form == "<f8" and np.array_equal(value.astype("<f4").astype("<f8"), value, equal_nan=True):
        return form, value.shape, value.astype("<f4").tobytes()  # half of the bytes, and no bit less
    return form, value.shape, value.astype(form).tobytes()


def _decoded_array(kind: type, value: Any) -> Any:
    form, shape, data = msgspec.convert(value, tuple[str, _Shape, bytes])
    if form not in _ARRAYS:
        raise ValueError(f"an array of {form!r:.20}")
    is_short = form == "<f8" and len(data) == 4 * prod(shape)
    stored = "<f4" if is_short else "|u1" if form == "|b1" else form
    return np.frombuffer(data, stored).astype(form).reshape(shape)


# --- the recording's part ---------------------------------------------------------------------------------------------


def _summary(
    segments: tuple[Segment, ...], frames: list[KeptFrame], report: FailureReport, pictures: str
) -> FailureSummary:
    used = segments[0].used or next((f.inputs.used for f in frames if f.inputs.used is not None), None)
    return FailureSummary(
        site=report.site,
        robot=report.robot,
        id=report.id,
        began_ns=report.stamp_ns,
        version=None if used is None else used.version,
        manifest_sha256=None if used is None else used.manifest_sha256,
        client=str(fleetmap.__version__),
        pictures=pictures,
        moments=tuple(moment(frame.stamp_ns, frame.said) for frame in frames if frame.said is not None),
    )


def moment(stamp_ns: int, said: Said) -> Moment:
    """What was said of a frame, for people."""
    map_from_body = said.map_from_body
    if map_from_body is None:
        return Moment(stamp_ns, said.status, said.cause)
    position_m = (float(map_from_body[0, 3]), float(map_from_body[1, 3]), float(map_from_body[2, 3]))
    return Moment(
        stamp_ns, said.status, said.cause, position_m, atan2(map_from_body[1, 0], map_from_body[0, 0]), said.radius_95_m
    )


def _step(width_px: int) -> int:
    return max(1, width_px // _WIDTH_PX)


def _reduced_rig(frames: list[KeptFrame], profile: RobotProfile) -> RigCalibration:
    """The rectified rig at the pictures' size."""
    camera, step = profile.camera, _step(profile.camera.width_px)
    center = [(value + 0.5) / step - 0.5 for value in (camera.cx_px, camera.cy_px)]
    left = CameraCalibration(
        "radial-tangential",
        camera.width_px // step,
        camera.height_px // step,
        np.array([camera.focal_px / step, camera.focal_px / step, *center]),
        np.zeros(4),
        profile.body_from_cam,
        profile.imu_minus_cam_s,
    )
    has_right = any(frame.picture is not None and frame.picture.right is not None for frame in frames)
    right_from_body = profile.body_from_cam @ se3(np.eye(3), np.array([camera.baseline_m, 0.0, 0.0]))
    cameras = (left, replace(left, body_from_cam=right_from_body)) if has_right else (left,)
    return RigCalibration(cameras, profile.imu, profile.base_from_body)


def _reduced(frame: RectifiedFrame, pictures: str) -> StoredFrame:
    left, right = (None if image is None else _jpeg(image, pictures) for image in (frame.left, frame.right))
    assert left is not None
    return StoredFrame(frame.stamp_ns, left, right, None)


def _jpeg(image: Image, pictures: str) -> StoredImage:
    step = _step(image.shape[1])
    size = image.shape[1] // step, image.shape[0] // step
    small = cv2.resize(image[: size[1] * step, : size[0] * step], size, interpolation=cv2.INTER_AREA)
    if pictures == "blurred":
        small = without_detail(np.asarray(small, np.uint8))
    data = b""
    for quality in _QUALITIES:
        data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= _PICTURE_BYTES:
            break
    return StoredImage("file", data)
