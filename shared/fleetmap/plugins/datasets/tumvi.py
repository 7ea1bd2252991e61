"""TUM-VI folders with cam0/images, cam1/images, times.txt, a Kalibr camchain.yaml, imu.txt and gt_imu.csv."""

from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.plugins.datasets.layout import existing_images, read_ground_truth, read_imu, read_table, rig_frames
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.files import natural_key
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize, logged_calibration
from fleetmap.recordings.image_series import ImageSeries
from fleetmap.recordings.ordering import ReadLog, check_seconds
from fleetmap.recordings.tum import parse_stamp_ns


def recognises(path: Path) -> bool:
    """True for a folder with cam0/images or cam1/images."""
    return (path / "cam0/images").is_dir() or (path / "cam1/images").is_dir()


def open_tumvi(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a TUM-VI folder. The body is the IMU, as in Kalibr's camchain."""
    log = ReadLog()
    if not (path / "cam0/images").is_dir():
        raise RecordingError(f"{path / 'cam0/images'} is missing, cam1 is there; copy the recording again")
    present = [name for name in ("cam0", "cam1") if (path / name / "images").is_dir()]
    cameras = [_images(path / name, name, log) for name in present]
    given, camchain = calibration_of_options(options, log), path / "camchain.yaml"
    if given is None and not camchain.is_file():
        raise CalibrationError(f"{camchain} is missing; pass a calibration with --calibration FILE")
    frames = rig_frames(path, log, cameras, given or logged_calibration(camchain, log).calibration)
    imu, truth = read_imu(path / "imu.txt", log), read_ground_truth(path / "gt_imu.csv", log)
    return finalize(RecordingParts(path, "tumvi", *frames, imu=imu, ground_truth=truth), log)


def _images(folder: Path, name: str, log: ReadLog) -> ImageSeries:
    """List the images by times.txt (`name seconds exposure`), or by their names in ns if that is absent."""
    files = {p.stem: p for p in (folder / "images").iterdir() if p.is_file()}
    times = folder / "times.txt"
    if times.is_file():
        log.files.append(times)
        rows = [line.split() for line in read_table(times).splitlines() if not line.startswith("#")]
        stamp_of = {row[0]: _stamp_ns(row[1], times) for row in rows if len(row) >= 2}
    else:
        numbers = [stem for stem in sorted(files, key=natural_key) if stem.isdecimal() and int(stem) < 1 << 63]
        stamp_of = {stem: int(stem) for stem in numbers}
    listed = [stem for stem in stamp_of if stem in files]
    if not listed:
        lack = f"holds none of the {len(stamp_of)} images listed"
        raise RecordingError(f"{folder / 'images'} {lack}; copy the recording again")
    if len(listed) < len(stamp_of):
        log.note(f"{name}: images missing", f"{len(stamp_of) - len(listed)} of {len(stamp_of)} in times.txt")
    stamps_ns = np.array([stamp_of[stem] for stem in listed], np.int64)
    return existing_images(stamps_ns, [files[stem] for stem in listed], name, log)


def _stamp_ns(seconds: str, where: Path) -> int:
    if seconds.replace(".", "", 1).isdecimal():
        check_seconds(float(seconds), str(where))
        return parse_stamp_ns(seconds)
    raise RecordingError(f"{where}: {seconds[:80]!r} is not a time in seconds; copy the recording again")


FORMAT = RecordingFormat("a folder with cam0/images and camchain.yaml", recognises, open_tumvi, rank=-5)
