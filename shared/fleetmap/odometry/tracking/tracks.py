"""Observations of points from frame to frame, kept as one table until the filter uses them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import StereoCamera

_FAR_DEPTH_M = 20.0
Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TrackBatch:
    """T tracks: starts (T + 1,) delimits each one's rows of clone_ids (n,), which clones saw it, and pixels (n, 3) u_left v u_right.

    A first guess of each point as clone `anchors` (T,) sees it is points_cam (T, 3) in camera axes, so that it follows the clone when an
    iterated update moves it.
    """

    starts: Ids
    clone_ids: Ids
    pixels: Array
    anchors: Ids
    points_cam: Array

    def __len__(self) -> int:
        return len(self.anchors)


class Observations:
    """Every observation that no update has used yet, in order of arrival."""

    def __init__(self) -> None:
        self._table = core.Observations()

    def add(self, frame_index: int, ids: Ids, pixels: Array) -> None:
        """What one frame saw: ids (N,), pixels (N, 3)."""
        self._table.add(frame_index, np.ascontiguousarray(ids), np.ascontiguousarray(pixels))

    def clear(self) -> None:
        """Forgets all."""
        self._table.clear()

    def take(self, alive: Ids, held: Ids, due: NDArray[np.bool_], camera: StereoCamera) -> TrackBatch:
        """Removes and returns the tracks that ended, or are due, with two observations or more in the clones `held`.

        alive (N,): ids that the newest frame saw, due (N,) which of them are to be used now. What is due but seen once
        stays; what ended so is forgotten.
        """
        far_px = camera.focal_px * max(camera.baseline_m, 0.01) / _FAR_DEPTH_M
        return TrackBatch(*self._table.take(alive, due, np.asarray(held, np.int64), camera.lens, far_px))
