"""Points that odometry followed, as all frames of a survey saw them: compact, since a long survey has millions of observations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.odometry import OdometryEstimate

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FrameTracks:
    """Observations of F frames: starts (F + 1,) delimits each one's track ids (M,) and pixels (M, 3), u_left v u_right."""

    starts: Indices
    ids: NDArray[np.int32]
    pixels: NDArray[np.float32]

    @classmethod
    def of_frame(cls, estimate: OdometryEstimate) -> "FrameTracks":
        """What one frame saw."""
        pixels = np.zeros((0, 3)) if estimate.track_pixels is None else estimate.track_pixels
        ids = estimate.track_ids[: len(pixels)].astype(np.int32)
        return cls(np.array([0, len(ids)]), ids, pixels.astype(np.float32))

    @classmethod
    def joined(cls, frames: "Sequence[FrameTracks]") -> "FrameTracks":
        """What frames saw that come one after the other."""
        ids = [np.zeros(0, np.int32), *(f.ids for f in frames)]
        pixels = np.concatenate([np.zeros((0, 3), np.float32), *(f.pixels for f in frames)])
        return cls(np.cumsum([len(i) for i in ids]), np.concatenate(ids), pixels)

    def part(self, first: int, end: int) -> "FrameTracks":
        """Those of the frames first..end - 1."""
        a, b = self.starts[[first, end]]
        return FrameTracks(self.starts[first : end + 1] - a, self.ids[a:b], self.pixels[a:b])

    def of(self, frames: Indices) -> tuple[Indices, Indices, Array]:
        """What some frames saw: track ids (m,), which of the frames (m,) by its place in `frames`, pixels (m, 3)."""
        counts = self.starts[frames + 1] - self.starts[frames]
        which = np.repeat(np.arange(len(frames)), counts)
        rows = np.arange(len(which)) + (self.starts[frames] - np.cumsum(counts) + counts)[which]
        return self.ids[rows].astype(np.int64), which, self.pixels[rows].astype(np.float64)
