"""Brightness that goes up and down from frame to frame: light of the mains, or a lamp that flashes."""

from collections.abc import Callable

import numpy as np

from fleetmap.recordings import Recording
from fleetmap.sensors.samples import CameraFrame
from mapserver.doctor.findings import Finding, Limits, judge, not_judged
from mapserver.doctor.timing import SPARSE_S

NAME = "flicker"
_RUNS, _RUN_FRAMES, _BANDS = 6, 4, 8
_LIMITS = Limits(0.03, 0.15, "of the brightness (median)")  # scenes that a camera drives past reach 0.01


def flicker_check(recording: Recording, read: Callable[[int], CameraFrame | None]) -> Finding:
    """Amplitude by which bands of rows are brighter and darker in turn, in short runs of frames. read: a frame, None if damaged.

    Bands, because a rolling shutter shows such light as stripes that wander.
    """
    amplitudes = []
    for first in np.unique(np.linspace(0, max(len(recording) - _RUN_FRAMES, 0), _RUNS).astype(int)):
        indices = range(first, min(first + _RUN_FRAMES, len(recording)))
        if len(indices) < 3 or (np.diff(recording.frame_stamps_ns[indices]) > SPARSE_S * 1e9).any():
            continue
        frames = [frame for frame in map(read, indices) if frame is not None]
        if len(frames) == len(indices):
            means = np.array([[band.mean() for band in np.array_split(frame.left, _BANDS)] for frame in frames])
            bends = np.abs(means[:-2] - 2.0 * means[1:-1] + means[2:])
            amplitudes.append(bends / np.maximum(4.0 * means.mean(axis=0), 1.0))
    if not amplitudes:
        return not_judged(NAME, "no frames follow each other closely", "record every frame")
    amplitude = float(np.median(np.concatenate(amplitudes)))
    bad = (
        f"the images are {amplitude:.0%} brighter and darker in turn from frame to frame; set the exposure to a whole number of the "
        "light's periods (10 ms where the mains have 50 Hz, 8.33 ms with 60 Hz), switch on the driver's power line frequency, and "
        "switch off lamps that flash"
    )
    return judge(NAME, amplitude, _LIMITS, "the brightness is steady from frame to frame", bad)
