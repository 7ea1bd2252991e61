"""Opens MCAP files of any recorder: CDR and Foxglove's protobuf, with the topics and calibrations that they have."""

from functools import partial
from pathlib import Path

from fleetmap.plugins.other_recorders.decoders import AnyEncoding
from fleetmap.plugins.other_recorders.streams import open_messages
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.mcap.reader import McapFiles, parts_at, recognises


class AnyMcap(AnyEncoding, McapFiles):
    """The parts of one recording of any recorder."""


def open_mcap(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in an MCAP file, or in a folder of its parts."""
    return open_messages(path, "mcap", partial(AnyMcap, parts_at(path)), options)


FORMAT = RecordingFormat("an .mcap file, or a folder with the parts of one", recognises, open_mcap, (".mcap",))
