"""Recordings of camera robots: folders of data sets, MCAP, rosbag2 in SQLite, ROS 1 bags, videos.

To add a format: a module whose function reads the folder or file into `RecordingParts` and hands them to `finalize`,
and a line in RECORDING_FORMATS (examples/new_recording_format.py is one).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.recordings import video
from fleetmap.recordings.bags import ros1, sqlite
from fleetmap.recordings.calibration_files import format_calibration, read_calibration
from fleetmap.recordings.files import what_file_instead
from fleetmap.recordings.folders import euroc, kitti, seven_scenes, tum_rgbd, tumvi
from fleetmap.recordings.images import StoredFrame, StoredImage
from fleetmap.recordings.mcap import reader
from fleetmap.recordings.recording import FrameSelection, FrameSource, OpenOptions, Recording, named_topics
from fleetmap.sensors.source_settings import Topics

__all__ = [
    "FILE_SUFFIXES",
    "RECORDING_FORMATS",
    "FrameSelection",
    "FrameSource",
    "OpenOptions",
    "Recording",
    "RecordingFormat",
    "StoredFrame",
    "StoredImage",
    "Topics",
    "format_calibration",
    "named_topics",
    "open_recording",
    "read_calibration",
]


@dataclass(frozen=True, slots=True)
class RecordingFormat:
    """Functions that recognise and open one format; `layout` describes it as text."""

    layout: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, OpenOptions], Recording]


RECORDING_FORMATS = {
    "euroc": RecordingFormat("a folder with mav0/cam0/data.csv in it", euroc.recognises, euroc.open_euroc),
    "tumvi": RecordingFormat("a folder with cam0/images and camchain.yaml", tumvi.recognises, tumvi.open_tumvi),
    "kitti": RecordingFormat("a folder with image_l or image_0 and calib.txt", kitti.recognises, kitti.open_kitti),
    "kitti-raw": RecordingFormat(
        "a folder with image_00/data and calib_cam_to_cam.txt", kitti.recognises_raw, kitti.open_kitti_raw
    ),
    "7scenes": RecordingFormat(
        "a folder with frame-NNNNNN.color.* and .depth.png", seven_scenes.recognises, seven_scenes.open_seven_scenes
    ),
    "tum-rgbd": RecordingFormat(
        "a folder with rgb.txt, depth.txt and their images", tum_rgbd.recognises, tum_rgbd.open_tum_rgbd
    ),
    "mcap": RecordingFormat("an .mcap file, or a folder with the parts of one", reader.recognises, reader.open_mcap),
    "rosbag2-sqlite": RecordingFormat("a rosbag2 .db3 file, or its folder", sqlite.recognises, sqlite.open_sqlite),
    "rosbag1": RecordingFormat("a ROS 1 .bag file", ros1.recognises, ros1.open_bag),
    "video": RecordingFormat("an .mp4 video of one camera", video.recognises, video.open_video),
}
# For unreadable files: the command that makes them readable
_ADVICE = {
    (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz", ".tar.zst"): "`tar xf {path}` unpacks it",
    (".7z", ".rar"): "`7z x {path}` unpacks it",
    (".mcap.zst", ".mcap.zstd", ".bag.zst"): "`zstd -d {path}` unpacks it",
    (".avi", ".mkv", ".webm", ".ts", ".h264", ".264", ".265"): (
        "`ffmpeg -i {path} -c copy {stem}.mp4` makes a video that can be read"
    ),
    (".bag.active",): "`rosbag reindex {path}` finishes it",
}
FILE_SUFFIXES = (".mcap", ".db3", ".bag", *video.SUFFIXES)  # of recordings that are one file


def open_recording(path: Path | str, options: OpenOptions | None = None) -> Recording:
    """Open the recording at `path`; its format is recognised from its files.

    >>> with open_recording("survey.mcap") as recording:
    ...     print(recording.sensor_set, len(recording), recording.read_frame(0).left.shape)

    RecordingError for a missing or inconsistent recording or an unknown format; CalibrationError for a missing
    or invalid calibration.
    """
    path, options = Path(path), options or OpenOptions()
    if not path.exists():
        raise RecordingError(
            f"{path} does not exist; a recording is a folder (the parent of mav0 for EuRoC) or a file such as .mcap"
        )
    if path.is_file() and (fault := what_file_instead(path)):
        raise RecordingError(f"{path} is {fault}")
    found = next((each for each in RECORDING_FORMATS.values() if each.recognises(path)), None)
    if found is not None:
        return found.open(path, options)
    if path.is_dir() and not any(path.iterdir()):
        raise RecordingError(f"{path} is an empty folder; copy the recording again")
    for suffixes, advice in _ADVICE.items():
        if path.name.lower().endswith(suffixes):
            words = advice.format(path=path, stem=path.stem)
            raise RecordingError(f"{path} has an unknown format; {words}")
    known = "; ".join(f"{name}: {recording_format.layout}" for name, recording_format in RECORDING_FORMATS.items())
    raise RecordingError(f"{path} has an unknown format. Known are {known}")
