"""Add a recording format: python examples/new_recording_format.py FOLDER

The format is a folder of numbered stereo pairs, NNN_left.png and NNN_right.png at 10 Hz, with `calibration.yaml` (a
Kalibr camchain). Every program of the project reads it once it is in RECORDING_FORMATS.
"""

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap import (
    RECORDING_FORMATS,
    FleetmapError,
    OpenOptions,
    Recording,
    RecordingFormat,
    open_recording,
    read_calibration,
)
from fleetmap.recordings.finalize import RecordingParts, finalize
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_frame
from fleetmap.recordings.ordering import ReadLog
from fleetmap.sensors.samples import CameraFrame

PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class NumberedPairs:
    """Random access to the images, encoded or decoded (a FrameSource)."""

    lefts: list[Path]
    stamps_ns: NDArray[np.int64]

    def stored(self, index: int) -> StoredFrame:
        """Return an encoded pair."""
        left = self.lefts[index]
        right = left.with_name(left.name.replace("left", "right"))
        images = [StoredImage("file", file.read_bytes(), str(file)) for file in (left, right)]
        return StoredFrame(int(self.stamps_ns[index]), *images)

    def frame(self, index: int) -> CameraFrame:
        """Return a decoded pair."""
        return decode_frame(self.stored(index))

    def part(self, indices: NDArray[np.int64]) -> "NumberedPairs":
        """Return a subset of the pairs, for a process that reads it in parallel to others."""
        return NumberedPairs([self.lefts[int(index)] for index in indices], self.stamps_ns[indices])

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """Feed every input byte to the recording's content hash."""
        for index in range(len(self.lefts)):
            frame = self.stored(index)
            for image in (frame.left, frame.right):
                digest.update(b"" if image is None else image.data)

    def close(self) -> None:
        """Do nothing: no file is open."""


def open_numbered_pairs(path: Path, options: OpenOptions) -> Recording:
    """Open a folder of numbered pairs."""
    log, lefts = ReadLog(), sorted(path.glob("*_left.png"))
    calibration = read_calibration(options.calibration_file or path / "calibration.yaml")
    stamps_ns = np.arange(len(lefts), dtype=np.int64) * PERIOD_NS
    parts = RecordingParts(
        path, "numbered-pairs", calibration, stamps_ns, NumberedPairs(lefts, stamps_ns), has_right=True
    )
    return finalize(parts, log)  # checks the first image against the calibration


RECORDING_FORMATS["numbered-pairs"] = RecordingFormat(
    "a folder of NNN_left.png and NNN_right.png with calibration.yaml",
    lambda path: path.is_dir() and any(path.glob("*_left.png")),
    open_numbered_pairs,
)

if __name__ == "__main__":
    try:
        with open_recording(sys.argv[1]) as recording:
            found = f"{len(recording)} frames of {recording.sensor_set}, {recording.content_hash()[:12]}"
            print(f"{recording.format}: {found}")
    except FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
