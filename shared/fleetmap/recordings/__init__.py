"""Recordings of camera robots. MCAP files that this project wrote are read here; plug-ins read other files.

To add a format: a module whose function reads the folder or file into `RecordingParts` and hands them to `finalize`, and an entry point of
`fleetmap.recordings`, or a line in RECORDING_FORMATS (examples/new_recording_format.py is one).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.hooks import plugins
from fleetmap.recordings.calibration_files import format_calibration as format_calibration
from fleetmap.recordings.calibration_files import read_calibration as read_calibration
from fleetmap.recordings.files import what_file_instead
from fleetmap.recordings.images import StoredFrame as StoredFrame
from fleetmap.recordings.images import StoredImage as StoredImage
from fleetmap.recordings.mcap import reader
from fleetmap.recordings.recording import FrameSelection as FrameSelection
from fleetmap.recordings.recording import FrameSource as FrameSource
from fleetmap.recordings.recording import OpenOptions as OpenOptions
from fleetmap.recordings.recording import Recording as Recording
from fleetmap.recordings.recording import named_topics as named_topics
from fleetmap.sensors.source_settings import Topics as Topics


@dataclass(frozen=True, slots=True)
class RecordingFormat:
    """Functions that recognise and open one format; `layout` describes it as text. suffixes: of recordings that are one file.

    rank: formats of a lower one are asked first. advice: for files that cannot be read, by their suffixes: what makes them readable, of
    `{path}` and its `{stem}`.
    """

    layout: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, OpenOptions], Recording]
    suffixes: tuple[str, ...] = ()
    rank: int = 0
    advice: Mapping[tuple[str, ...], str] = field(default_factory=dict)


# For unreadable files of any format: the command that makes them readable
_ADVICE = {
    (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz", ".tar.zst"): "`tar xf {path}` unpacks it",
    (".7z", ".rar"): "`7z x {path}` unpacks it",
    (".mcap.zst", ".mcap.zstd", ".bag.zst"): "`zstd -d {path}` unpacks it",
}
RECORDING_FORMATS = {
    "mcap": RecordingFormat("an .mcap file of fleetmap's", reader.recognises, reader.open_mcap, (".mcap",))
}
_installed = cache(plugins)


def recording_formats() -> dict[str, RecordingFormat]:
    """Return RECORDING_FORMATS and those of plug-ins, in the order in which they are asked."""
    known = RECORDING_FORMATS | _installed("fleetmap.recordings")
    return dict(sorted(known.items(), key=lambda item: item[1].rank))


def file_suffixes() -> tuple[str, ...]:
    """Return the suffixes of recordings that are one file."""
    return tuple(suffix for each in recording_formats().values() for suffix in each.suffixes)


def open_recording(path: Path | str, options: OpenOptions | None = None) -> Recording:
    """Open the recording at `path`; its format is recognised from its files.

    >>> with open_recording("survey.mcap") as recording:
    ...     print(recording.sensor_set, len(recording), recording.read_frame(0).left.shape)

    RecordingError for a missing or inconsistent recording or an unknown format; CalibrationError for a missing
    or invalid calibration.
    """
    path, options = Path(path), options or OpenOptions()
    if not path.exists():
        what = "a recording is a folder (the parent of mav0 for EuRoC) or a file such as .mcap"
        raise RecordingError(f"{path} does not exist; {what}")
    if path.is_file() and (fault := what_file_instead(path)):
        raise RecordingError(f"{path} is {fault}")
    formats = recording_formats()
    found = next((each for each in formats.values() if each.recognises(path)), None)
    if found is not None:
        return found.open(path, options)
    if path.is_dir() and not any(path.iterdir()):
        raise RecordingError(f"{path} is an empty folder; copy the recording again")
    for suffixes, advice in chain(_ADVICE.items(), *(each.advice.items() for each in formats.values())):
        if path.name.lower().endswith(suffixes):
            raise RecordingError(f"{path} has an unknown format; {advice.format(path=path, stem=path.stem)}")
    known = "; ".join(f"{name}: {each.layout}" for name, each in formats.items())
    raise RecordingError(f"{path} has an unknown format. Known are {known}")
