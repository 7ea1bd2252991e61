"""Observations of points from frame to frame, kept as one table until the filter uses them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.odometry.tracking import tracks_kernels
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
        self._ids, self._frames, self._pixels = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))

    def add(self, frame_index: int, ids: Ids, pixels: Array) -> None:
        """What one frame saw: ids (N,), pixels (N, 3)."""
        self._ids = np.concatenate([self._ids, ids])
        self._frames = np.concatenate([self._frames, np.full(len(ids), frame_index)])
        self._pixels = np.concatenate([self._pixels, pixels])

    def clear(self) -> None:
        """Forgets all."""
        self._keep(np.zeros(len(self._ids), bool))

    def take(self, alive: Ids, held: Ids, due: NDArray[np.bool_], camera: StereoCamera) -> TrackBatch:
        """Removes and returns the tracks that ended, or are due, with two observations or more in the clones `held`.

        alive (N,): ids that the newest frame saw, due (N,) which of them are to be used now. What is due but seen once
        stays; what ended so is forgotten.
        """
        order = np.argsort(self._ids, kind="stable")
        if len(alive) > 1 and not (alive[1:] > alive[:-1]).all():
            rank = np.argsort(alive)
            alive, due = alive[rank], due[rank]
        size = len(order)
        stays, rows, starts, anchors = np.zeros(size, bool), *np.empty((3, size + 1), np.int64)
        points_cam = np.empty((size, 3))
        far_px = camera.focal_px * max(camera.baseline_m, 0.01) / _FAR_DEPTH_M
        seen = self._ids, self._frames, self._pixels, order, alive, due, np.asarray(held, np.int64)
        out = stays, rows, starts, anchors, points_cam
        count = tracks_kernels.take(*seen, camera.lens, far_px, *out)
        used = rows[: starts[count]]
        batch = TrackBatch(
            starts[: count + 1], self._frames[used], self._pixels[used], anchors[:count], points_cam[:count]
        )
        self._keep(stays)
        return batch

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self._ids, self._frames, self._pixels = self._ids[keep], self._frames[keep], self._pixels[keep]
