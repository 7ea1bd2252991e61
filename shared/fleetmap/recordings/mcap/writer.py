"""Writes recordings as MCAP in the style of rosbag2: ROS 2 messages in CDR, with the full message definitions.

Topics are those of `Topics`. The mounting of the cameras is also on /tf_static (body to cam0 and cam1, base to body),
the lenses in CameraInfo, for ROS tools; the whole calibration to the last bit is the attachment `calibration.yaml`
(format: fleetmap.recordings.calibration_files). Chunks are not compressed, images stay as they were encoded. Equal
calls make equal bytes.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from mcap.writer import CompressionType, Writer

from fleetmap.errors import RecordingError, disk_errors
from fleetmap.recordings import images
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.recordings.images import INVERSE_DEPTH, StoredFrame, StoredImage
from fleetmap.recordings.mcap.streams import CALIBRATION_ATTACHMENT
from fleetmap.recordings.ordering import UNCERTAIN_STAMPS
from fleetmap.recordings.recording import Recording
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import ros2msg
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, Trajectory, WheelSample
from fleetmap.sensors.source_settings import Topics

BODY_FRAME, BASE_FRAME, MAP_FRAME, ODOM_FRAME = "body", "base", "map", "odom"
_CHUNK_BYTES = 1 << 20  # the most that a flipped bit can destroy


class McapRecordingWriter(AbstractContextManager["McapRecordingWriter"]):
    """Writes one recording to `path`; the file appears there when it is closed, complete or not at all.

    Samples of one kind must be written in the order of their stamps; kinds may interleave in any way, ROS tools prefer them
    roughly in order. name: name of the recording when opened, the file's stem unless given.
    in_place: for live sensors: the file exists from the beginning, and can be read up to the last write even
    if it was never closed. has_uncertain_stamps: noted as an issue when the file is opened. RecordingError wherever the disk
    takes no more.
    """

    def __init__(
        self,
        path: Path,
        calibration: RigCalibration,
        *,
        topics: Topics | None = None,
        name: str = "",
        in_place: bool = False,
        has_uncertain_stamps: bool = False,
    ) -> None:
        self._path = path
        self._part = path if in_place else path.with_name(path.name + ".part")
        self._calibration = calibration
        self._topics = topics or Topics()
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._advice = "make space, or choose another place" + ("; it holds what came before" if in_place else "")
        with self._disk_errors():
            self._file = self._part.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="fleetmap")
        stamps = {"stamps": "uncertain"} if has_uncertain_stamps else {}
        self._writer.add_metadata("fleetmap", {"name": name or path.stem} | stamps)
        text = format_calibration(calibration).encode()
        self._writer.add_attachment(0, 0, CALIBRATION_ATTACHMENT, "application/yaml", text)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file, which recordings ignore."""
        self._writer.add_attachment(0, 0, name, media_type, data)

    def write_frame(self, frame: CameraFrame | StoredFrame) -> None:
        """Write one frame with its CameraInfo.

        Images that are JPEG or PNG already as CompressedImage, all others as Image.
        """
        stored = frame if isinstance(frame, StoredFrame) else images.store_frame(frame)
        topics = self._topics
        infos = {0: topics.left_info, 1: topics.right_info}
        for numbers, view in zip(self._calibration.views, (stored, *stored.others), strict=False):
            if view is None:
                continue
            for number, image in zip(numbers, (view.left, view.right), strict=False):
                if image is not None:
                    topic = topics.camera(number)
                    self._write_image(topic, view.stamp_ns, f"cam{number}", image)
                    info = infos.get(number, f"{topic.rpartition('/')[0]}/camera_info")
                    camera = self._calibration.cameras[number]
                    data = messages.encode_camera_info(view.stamp_ns, f"cam{number}", camera)
                    self._write(info, "sensor_msgs/CameraInfo", view.stamp_ns, data)
            if view.depth is not None:
                topic = topics.depth_of(numbers[0]) if numbers[0] else topics.depth
                self._write_image(topic, view.stamp_ns, f"cam{numbers[0]}", view.depth, is_depth=True)

    def write_imu(self, samples: ImuSamples) -> None:
        for stamp_ns, *values in zip(samples.stamps_ns.tolist(), samples.gyro_radps, samples.accel_mps2, strict=True):
            data = messages.encode_imu(stamp_ns, BODY_FRAME, *values)
            self._write(self._topics.imu, "sensor_msgs/Imu", stamp_ns, data)

    def write_wheel(self, samples: Iterable[WheelSample]) -> None:
        for sample in samples:
            data = messages.encode_odometry(sample, ODOM_FRAME, BASE_FRAME)
            self._write(self._topics.wheel, "nav_msgs/Odometry", sample.stamp_ns, data)

    def write_prior(self, priors: Iterable[PositionPrior]) -> None:
        for prior in priors:
            data = messages.encode_prior(prior, MAP_FRAME)
            self._write(self._topics.prior, "geometry_msgs/PoseWithCovarianceStamped", prior.stamp_ns, data)

    def write_ground_truth(self, trajectory: Trajectory) -> None:
        """Write the true frame_from_body, all of it or a part."""
        for stamp_ns, frame_from_body in zip(trajectory.stamps_ns.tolist(), trajectory.frame_from_body, strict=True):
            data = messages.encode_pose(stamp_ns, MAP_FRAME, frame_from_body)
            self._write(self._topics.ground_truth, "geometry_msgs/PoseStamped", stamp_ns, data)

    def write_all(
        self,
        frames: Iterable[CameraFrame | StoredFrame],
        imu: ImuSamples,
        wheel: Sequence[WheelSample],
        priors: Sequence[PositionPrior],
        truth: Trajectory | None,
        *,
        on_frame: Callable[[], None],
    ) -> None:
        """Write everything; samples precede the frame that follows them, so that the file is ordered in time to within one frame."""

        def write_between(start_ns: int, end_ns: int) -> None:
            self.write_prior(prior for prior in priors if start_ns <= prior.stamp_ns < end_ns)
            self.write_imu(imu.between(start_ns, end_ns))
            self.write_wheel(sample for sample in wheel if start_ns <= sample.stamp_ns < end_ns)
            if truth is not None:
                first, last = truth.stamps_ns.searchsorted([start_ns, end_ns])
                self.write_ground_truth(Trajectory(truth.stamps_ns[first:last], truth.frame_from_body[first:last]))

        start_ns = -(1 << 62)
        for frame in frames:
            write_between(start_ns, frame.stamp_ns)
            self.write_frame(frame)
            on_frame()
            start_ns = frame.stamp_ns
        write_between(start_ns, 1 << 62)

    def close(self) -> None:
        """Finish the file and give it its name. Closing twice does nothing."""
        if self._file.closed:
            return
        try:
            with self._disk_errors():
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.close()
        except RecordingError:
            if self._part != self._path:
                self.discard()
            raise
        self._part.replace(self._path)

    def discard(self) -> None:
        """Discard the written file."""
        with suppress(OSError):  # of a full disk, by what is still in the file's buffer
            self._file.close()
        self._part.unlink(missing_ok=True)

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        if error_type is None:
            self.close()
        else:
            self.discard()

    def _disk_errors(self) -> AbstractContextManager[None]:
        return disk_errors(f"{self._part} cannot be written", self._advice, RecordingError)

    def _write_image(
        self, topic: str, stamp_ns: int, frame_id: str, image: StoredImage, *, is_depth: bool = False
    ) -> None:
        kind = images.file_kind(image.data) if image.encoding == "file" else "rows"
        is_inverse = image.encoding == INVERSE_DEPTH
        if is_inverse or kind in ("jpeg", "png"):
            form = f"16UC1; {kind} compressed" if is_depth and not is_inverse else image.form or kind
            data = messages.encode_compressed_image(stamp_ns, frame_id, image, form)
            transport = "compressedDepth" if is_inverse else "compressed"
            self._write(f"{topic}/{transport}", "sensor_msgs/CompressedImage", stamp_ns, data)
            return
        rows = image
        if kind == "other" and is_depth:
            rows = images.depth_image(images.decode_depth(image))
        elif kind == "other":
            rows = images.grey_image(images.decode_grey(image))
        if rows.step_bytes == 0:
            raise RecordingError(f"{image.where or topic} at {stamp_ns}: an image in rows needs its step_bytes")
        self._write(topic, "sensor_msgs/Image", stamp_ns, messages.encode_image(stamp_ns, frame_id, rows))

    def _write(self, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        if not self._channels and type_name != "tf2_msgs/TFMessage":  # the mounting before all else
            mounted = [(f"cam{i}", camera.body_from_cam) for i, camera in enumerate(self._calibration.cameras)]
            links = [messages.FrameLink(BODY_FRAME, name, body_from_cam) for name, body_from_cam in mounted]
            links.append(messages.FrameLink(BASE_FRAME, BODY_FRAME, self._calibration.base_from_body))
            tf_data = messages.encode_frame_links(stamp_ns, links)
            self._write(self._topics.tf_static, "tf2_msgs/TFMessage", stamp_ns, tf_data)
        if type_name not in self._schemas:
            names = type_name.replace("/", "/msg/"), "ros2msg"
            self._schemas[type_name] = self._writer.register_schema(*names, ros2msg(type_name).encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_name])
        with self._disk_errors():
            self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, self._counts[topic])
        self._counts[topic] += 1


def copy_to_mcap(recording: Recording, path: Path, on_frame: Callable[[], None] = lambda: None) -> None:
    """Write all of `recording` to a new file at `path`; images keep their encoding, `on_frame` is called after every frame.

    The file appears at `path` only when it is complete.
    """
    is_uncertain, rig = UNCERTAIN_STAMPS in recording.issues, recording.calibration
    frames = (recording.stored_frame(index) for index in range(len(recording)))
    with McapRecordingWriter(path, rig, name=recording.name, has_uncertain_stamps=is_uncertain) as writer:
        writer.write_all(
            frames, recording.imu, recording.wheel, recording.priors, recording.ground_truth, on_frame=on_frame
        )
