"""Add a recording format: python examples/new_recording_format.py FOLDER

The format is a folder of numbered stereo pairs, NNN_left.png and NNN_right.png at 10 Hz, with `calibration.yaml` (a
Kalibr camchain). Every program of the project reads it once it is in RECORDING_FORMATS.
"""

import sys
from pathlib import Path

import numpy as np

import fleetmap
from fleetmap.recordings.finalize import RecordingParts, finalize
from fleetmap.recordings.image_series import ImageReader, ImageSeries, SeriesFrames, paired
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ordering import ReadLog

PERIOD_NS = 100_000_000


class FileReader(ImageReader):
    """Reads image files by their paths; the recording's content hash covers read_files."""

    def read(self, source: Path, stamp_ns: int) -> StoredImage:
        """Return an image, encoded."""
        return StoredImage("file", source.read_bytes(), str(source))

    def apart(self) -> "FileReader":
        """Return a reader for a process that reads in parallel to others: no file is open between reads."""
        return self


def open_numbered_pairs(path: Path, options: fleetmap.OpenOptions) -> fleetmap.Recording:
    """Open a folder of numbered pairs."""
    log = ReadLog()
    calibration = fleetmap.read_calibration(options.calibration_file or path / "calibration.yaml")
    lefts, rights = (sorted(path.glob(f"*_{side}.png")) for side in ("left", "right"))
    left, right = (
        ImageSeries(np.array([int(file.name[:3]) for file in files], np.int64) * PERIOD_NS, tuple(files))
        for files in (lefts, rights)
    )
    frames = SeriesFrames(FileReader([*lefts, *rights]), (paired(left, {"right": right}, log),))
    return finalize(RecordingParts(path, "numbered-pairs", calibration, frames), log)  # checks the first image, too


fleetmap.RECORDING_FORMATS["numbered-pairs"] = fleetmap.RecordingFormat(
    "a folder of NNN_left.png and NNN_right.png with calibration.yaml",
    lambda path: path.is_dir() and any(path.glob("*_left.png")),
    open_numbered_pairs,
)

if __name__ == "__main__":
    try:
        with fleetmap.open_recording(sys.argv[1]) as recording:
            found = f"{len(recording)} frames of {recording.sensor_set}, {recording.content_hash()[:12]}"
            print(f"{recording.format}: {found}")
    except fleetmap.FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
