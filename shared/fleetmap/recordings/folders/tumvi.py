"""TUM-VI folders with cam0/images, cam1/images, times.txt, a Kalibr camchain.yaml, imu.txt and gt_imu.csv."""

from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.calibration_files import load_calibration
from fleetmap.recordings.finalize import RecordingParts, finalize
from fleetmap.recordings.folders.image_files import FileFrames, ImageFiles, existing_images, paired_cameras
from fleetmap.recordings.folders.table_files import natural_key, read_ground_truth, read_imu, read_table_text
from fleetmap.recordings.ordering import ReadLog, check_seconds
from fleetmap.recordings.recording import OpenOptions, Recording

_CAMERAS = ("cam0", "cam1")


def recognises(path: Path) -> bool:
    """Whether `path` holds cam0/images or cam1/images."""
    return any((path / name / "images").is_dir() for name in _CAMERAS)


def open_tumvi(path: Path, options: OpenOptions) -> Recording:
    """The recording in a TUM-VI folder. The body is the IMU, as in Kalibr's camchain."""
    log = ReadLog()
    if not (path / "cam0/images").is_dir():
        raise RecordingError(f"{path / 'cam0/images'} is missing, cam1 is there; copy the recording again")
    present = [name for name in _CAMERAS if (path / name / "images").is_dir()]
    left, right = paired_cameras([_images(path / name, name, log) for name in present], log)
    calibration_file = options.calibration_file or path / "camchain.yaml"
    if options.calibration_file is None and not calibration_file.is_file():
        raise CalibrationError(f"{calibration_file} is missing; pass a calibration with --calibration FILE")
    log.files.append(calibration_file)
    parts = RecordingParts(
        path=path,
        format="tumvi",
        calibration=load_calibration(calibration_file).calibration,
        frame_stamps_ns=left.stamps_ns,
        frames=FileFrames(path, log.files, left, right),
        has_right=right is not None,
        imu=read_imu(path / "imu.txt", log),
        ground_truth=read_ground_truth(path / "gt_imu.csv", log),
    )
    return finalize(parts, log)


def _images(folder: Path, name: str, log: ReadLog) -> ImageFiles:
    """The images by times.txt (`name seconds exposure`), or by their names in ns where there is no such file."""
    files = {p.stem: p for p in (folder / "images").iterdir() if p.is_file()}
    times = folder / "times.txt"
    if times.is_file():
        log.files.append(times)
        rows = [line.split() for line in read_table_text(times).splitlines() if not line.startswith("#")]
        stamp_of = {row[0]: _stamp_ns(row[1], times) for row in rows if len(row) >= 2}
    else:
        stamp_of = {stem: int(stem) for stem in sorted(files, key=natural_key) if stem.isdigit()}
    listed = [stem for stem in stamp_of if stem in files]
    if not listed:
        raise RecordingError(
            f"{folder / 'images'} holds none of the {len(stamp_of)} images listed; copy the recording again"
        )
    if len(listed) < len(stamp_of):
        log.note(f"{name}: images missing", f"{len(stamp_of) - len(listed)} of {len(stamp_of)} in times.txt")
    stamps_ns = np.array([stamp_of[stem] for stem in listed], np.int64)
    return existing_images(ImageFiles(stamps_ns, tuple(files[stem] for stem in listed)), name, log)


def _stamp_ns(seconds: str, where: Path) -> int:
    """Nanoseconds of a decimal number of seconds, without rounding it to a float on the way."""
    whole, _, part = seconds.partition(".")
    if not whole.isdecimal() or (part and not part.isdecimal()):
        raise RecordingError(f"{where}: {seconds!r} is no time in seconds; copy the recording again")
    check_seconds(float(whole), str(where))
    return int(whole) * 1_000_000_000 + int(part[:9].ljust(9, "0"))
