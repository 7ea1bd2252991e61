"""Copies a recording of any format into an MCAP file."""

from collections.abc import Callable
from pathlib import Path

from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.recordings.recording import Recording
from fleetmap.sensors.samples import Trajectory


def copy_to_mcap(recording: Recording, path: Path, on_frame: Callable[[], None] = lambda: None) -> None:
    """Writes all of `recording` to a new file at `path`; images keep their encoding, `on_frame` follows every frame.

    Samples go before the frame that follows them, so that the file is in the order of time to within one frame. The
    file appears at `path` only when it is complete.
    """
    with McapRecordingWriter(path, recording.calibration, name=recording.name) as writer:
        since_ns = -(1 << 62)
        for index, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
            _write_between(recording, writer, since_ns, stamp_ns)
            writer.write_frame(recording.stored_frame(index))
            since_ns = stamp_ns
            on_frame()
        _write_between(recording, writer, since_ns, 1 << 62)


def _write_between(recording: Recording, writer: McapRecordingWriter, start_ns: int, end_ns: int) -> None:
    """Everything but frames with start_ns <= stamp < end_ns."""
    writer.write_imu(recording.imu.between(start_ns, end_ns))
    writer.write_wheel(sample for sample in recording.wheel if start_ns <= sample.stamp_ns < end_ns)
    writer.write_prior(prior for prior in recording.priors if start_ns <= prior.stamp_ns < end_ns)
    truth = recording.ground_truth
    if truth is not None:
        first, last = truth.stamps_ns.searchsorted([start_ns, end_ns])
        writer.write_ground_truth(Trajectory(truth.stamps_ns[first:last], truth.frame_from_body[first:last]))
