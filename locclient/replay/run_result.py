"""Result of a replay: estimates, ground truth, report, trajectory and picture."""

import resource
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fleetmap.geometry import Array, align_points, transform_points
from fleetmap.messages import Status
from fleetmap.sensors.samples import Stamps, Trajectory
from locclient.localization.estimate import Estimate
from locclient.maps.loaded_map import LoadedMap
from locclient.replay.plots import RunPlot, draw_run, save_picture
from locclient.replay.run_metrics import METRICS, FrameRecord, localised, spread
from locclient.robot.health_report import SearchWay

_MIN_ALIGNED = 3  # minimum number of frames for a fit


@dataclass
class ReplayResult:
    """A finished replay, one entry per frame: records, estimates, and the true pose of the body (4, 4), None if unknown.

    truth_in_map: True if the ground truth is in the frame `map`; else it has its own frame, and errors are known only after a fit.

    loaded: the map that was used. notes: texts for users about the run. failures: number detected by the robot.
    search: distance driven without localization at the end.
    """

    frames: list[FrameRecord]
    estimates: list[Estimate]
    truths: list[Array | None]
    loaded: LoadedMap
    notes: list[str] = field(default_factory=list)
    failures: int = 0
    truth_in_map: bool = True
    search: SearchWay = field(default_factory=SearchWay)

    @property
    def stamps_ns(self) -> Stamps:
        return np.array([estimate.stamp_ns for estimate in self.estimates], np.int64)

    @property
    def map_from_body(self) -> Array:
        """Return estimated poses (N, 4, 4); NaN if absent."""
        return _stacked([estimate.map_from_body for estimate in self.estimates], 4)

    @property
    def cov_rot_trans(self) -> Array:
        """Return covariances of the poses (N, 6, 6) in map axes, rotation first; NaN if absent."""
        return _stacked([estimate.cov_rot_trans for estimate in self.estimates], 6)

    @property
    def statuses(self) -> list[Status]:
        return [estimate.status for estimate in self.estimates]

    def aligned_error_m(self) -> dict[str, float] | None:
        """Return position errors of localized frames with ground truth after a rigid fit to it; None below 3 frames.

        frames: their number. scale: factor of the estimate for the best fit; it is not applied.
        """
        found = [
            (estimate.map_from_body[:3, 3], truth[:3, 3])
            for estimate, truth, good in zip(self.estimates, self.truths, localised(self.frames), strict=True)
            if good and truth is not None and estimate.map_from_body is not None
        ]
        if len(found) < _MIN_ALIGNED:
            return None
        mine, true = (np.array(positions) for positions in zip(*found, strict=True))
        truth_from_map, _ = align_points(true, mine)
        errors_m = np.linalg.norm(transform_points(truth_from_map, mine) - true, axis=1)
        return {
            **(spread(errors_m.tolist(), ("median", "p95", "p99", "max")) or {}),
            "frames": len(found),
            "scale": align_points(true, mine, with_scale=True)[1],
        }

    def alignment_note(self) -> str:
        """Return a note for users on errors against ground truth in another frame."""
        found = self.aligned_error_m()
        words = "the ground truth is in another frame than the map: error_m is unknown"
        if found is None:
            return f"{words}, and fewer than {_MIN_ALIGNED} localized frames have ground truth for a fit"
        return f"{words}; aligned_error_m is after a rigid fit of {found['frames']} localized frames with ground truth"

    @property
    def report(self) -> dict[str, object]:
        return {
            **{name: metric(self.frames) for name, metric in METRICS.items()},
            "aligned_error_m": self.aligned_error_m(),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            "map_version": self.loaded.version,
            "site": self.loaded.manifest.site,
            "tiles": len(self.loaded.tiles),
            "tiles_refused": {f"{x},{y}": reason for (x, y), reason in sorted(self.loaded.refused.items())},
            "not_localised_m": self.search.metres,
            "failures_detected": self.failures,
            "notes": self.notes,
        }

    @property
    def trajectory(self) -> Trajectory:
        """Return map_from_body of the localized frames."""
        kept = np.array(localised(self.frames), bool) & ~np.isnan(self.map_from_body[:, 0, 0])
        return Trajectory(self.stamps_ns[kept], self.map_from_body[kept])

    def save_picture(self, path: str | Path) -> None:
        """Draw path, landmarks and errors into a PNG file; UsageError if it cannot be written."""
        plot = RunPlot(
            title=f"{self.loaded.manifest.site}, version {self.loaded.version}",
            frames=self.frames,
            positions_map_m=self.map_from_body[:, :3, 3],
            truths_map_m=_stacked([truth if self.truth_in_map else None for truth in self.truths], 4)[:, :3, 3],
            landmarks_map_m=np.concatenate([tile.points_map for tile in self.loaded.tiles.values()]),
        )
        save_picture(draw_run(plot), Path(path))


def _stacked(matrices: list[Array | None], size: int) -> Array:
    """Return matrices as (N, size, size), NaN for those that are absent."""
    return np.array([np.full((size, size), np.nan) if m is None else m for m in matrices]).reshape(-1, size, size)
