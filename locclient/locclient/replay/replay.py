"""A recording played to the localizer as a robot would live it: map fetched, frames handled, reports sent."""

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from fleetmap.bow import decode_vocabulary
from fleetmap.errors import LinkError
from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.mapformat import Manifest
from fleetmap.messages import PoseMessage, RobotHealth
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import PositionPrior, SensorSet, Trajectory
from locclient.daemon.jit_warmup import gc_frozen
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer
from locclient.localization.settings import LocalizerSettings
from locclient.maps.connection import MapConnection
from locclient.maps.map_client import FetchedTiles, MapClient
from locclient.replay.replay_sources import ReplaySource
from locclient.replay.run_metrics import METRICS, FrameRecord, localised
from locclient.robot.dock_check import DockCheck
from locclient.robot.health_report import FixFigures

_HEALTH_EVERY_S, _POSE_EVERY_S = 1.0, 0.5
TRUTH_FLAG = "frame_from_ground_truth"  # key of the configuration: the map lies in the frame of the recordings' truth


@dataclass(frozen=True)
class ReplayResult:
    """A finished replay: one record a frame, the estimates, the map that was used, and what was said on the way."""

    frames: list[FrameRecord]
    estimates: list[Estimate]
    truths: list[Array | None]
    manifest: Manifest
    tiles: FetchedTiles
    notes: list[str] = field(default_factory=list)

    def report(self) -> dict[str, object]:
        """The stable keys of a replay report, and the tiles that were refused with their reasons."""
        built: dict[str, object] = {name: metric(self.frames) for name, metric in METRICS.items()}
        built["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        built["map_version"] = self.manifest.version
        built["site"] = self.manifest.site
        built["tiles"] = len(self.tiles.tiles)
        built["tiles_refused"] = {f"{x},{y}": reason for (x, y), reason in sorted(self.tiles.refused.items())}
        built["notes"] = self.notes
        return built

    def trajectory(self) -> Trajectory:
        """map_from_body of the localised frames."""
        kept = [
            e
            for e, good in zip(self.estimates, localised(self.frames), strict=True)
            if good and e.map_from_body is not None
        ]
        stamps = np.array([e.stamp_ns for e in kept], np.int64)
        return Trajectory(stamps, np.array([e.map_from_body for e in kept]).reshape(-1, 4, 4))


@gc_frozen()
def replay(
    source: ReplaySource, link: MapConnection, settings: LocalizerSettings, prior: PositionPrior | None, *, realtime: bool,
    progress: Callable[[int], None],
) -> ReplayResult:  # fmt: skip
    """Plays the source; raises LinkError where no map can be had, RecordingError for frames that cannot be read."""
    cv2.setNumThreads(1)  # one robot, one thread: figures are then those of the board's core
    ready = link.source.ready()
    manifest = link.source.manifest(ready.wanted)
    tiles = link.source.tiles(manifest)
    if not tiles.tiles:
        raise LinkError(
            f"none of the {len(manifest.tiles)} tiles of version {manifest.version} is usable: {tiles.refused}"
        )
    rectifier = Rectifier(source.calibration, has_depth=source.recording.sensor_set is SensorSet.RGBD)
    localizer = Localizer(
        source.calibration,
        rectifier.camera,
        rectifier.body_from_cam,
        rectifier.imu_minus_cam_s,
        settings,
        time.process_time,
    )
    localizer.handle_version(
        manifest.version,
        tiles.tiles.values(),
        decode_vocabulary(link.source.vocabulary(manifest)),
        manifest.camera.focal_px,
    )
    if prior is not None:
        localizer.handle_prior(prior)
    result = ReplayResult([], [], [], manifest, tiles, [ready.note] if ready.note else [])
    reporter, docks = _Reporter(link, result), DockCheck(source.calibration.base_from_body)
    begun_s, first_ns = time.monotonic(), None
    for number, imu in enumerate(source.imu_before_each()):
        decode_s = time.process_time()
        raw = source.frame(number)
        decode_s = time.process_time() - decode_s
        first_ns = raw.stamp_ns if first_ns is None else first_ns
        if realtime:
            time.sleep(max(0.0, (raw.stamp_ns - first_ns) * 1e-9 - (time.monotonic() - begun_s)))
        wall_s, cpu_s = time.monotonic(), time.process_time()
        localizer.handle_imu(imu)
        localizer.handle_wheel(source.wheel_before(number))
        priors = source.priors_before(number)
        for coarse in priors:
            localizer.handle_prior(coarse)
        frame = rectifier.rectify(raw)
        rectified_s = time.process_time()
        estimate = localizer.handle_stereo(frame)
        cpu = time.process_time() - cpu_s
        stages = {"decode": decode_s, "rectify": rectified_s - cpu_s, **estimate.stage_s}
        truth = source.truth_map_from_body(number) if manifest.configuration.get(TRUTH_FLAG) else None
        dock_error_m = docks.handle(priors, estimate)
        result.frames.append(_record(estimate, truth, cpu, time.monotonic() - wall_s, stages))
        result.estimates.append(estimate)
        result.truths.append(truth)
        reporter.after_frame(estimate, source.calibration.base_from_body, dock_error_m)
        progress(number)
    reporter.finish()
    return result


def _record(
    estimate: Estimate, truth: Array | None, cpu_s: float, wall_s: float, stages: dict[str, float]
) -> FrameRecord:
    error, angle = None, None
    if truth is not None and estimate.map_from_body is not None:
        error = estimate.map_from_body[:3, 3] - truth[:3, 3]
        angle = rotation_angle_rad(estimate.map_from_body[:3, :3].T @ truth[:3, :3])
    return FrameRecord(
        estimate.stamp_ns,
        estimate.status,
        estimate.fix is not None,
        estimate.cov_rot_trans,
        error,
        angle,
        cpu_s,
        wall_s,
        stages,
    )


class _Reporter:
    """Sends acknowledgement, poses and health, thinned by sensor time; a link that breaks is noted and costs the replay nothing."""

    def __init__(self, link: MapConnection, result: ReplayResult) -> None:
        self._link, self._result = link, result
        self._fixes = FixFigures()
        self._health_ns = self._pose_ns = -(2**62)
        self._broken = False
        refused = "; ".join(f"tile {x},{y}: {reason}" for (x, y), reason in result.tiles.refused.items())
        self._send(lambda to: to.ack(result.manifest.version, stamp_ns=time.time_ns(), refused=refused))

    def after_frame(self, estimate: Estimate, base_from_body: Array, dock_error_m: float | None) -> None:
        """Publishes what is due."""
        self._fixes.handle(estimate, dock_error_m)
        if (
            estimate.map_from_body is not None
            and estimate.cov_rot_trans is not None
            and self._due(estimate.stamp_ns, self._pose_ns, _POSE_EVERY_S)
        ):
            self._pose_ns = estimate.stamp_ns
            map_from_base = estimate.map_from_body @ se3_inverse(base_from_body)
            message = PoseMessage.of(
                estimate.stamp_ns, map_from_base, estimate.cov_rot_trans, estimate.status, estimate.map_version
            )
            self._send(lambda to: to.publish_pose(message))
        if self._due(estimate.stamp_ns, self._health_ns, _HEALTH_EVERY_S):
            self._health_ns = estimate.stamp_ns
            self._publish_health(estimate)

    def finish(self) -> None:
        """The last report, with the whole run's figures."""
        if self._result.estimates:
            self._publish_health(self._result.estimates[-1])

    def _publish_health(self, estimate: Estimate) -> None:
        figures: dict[str, float | int | str | bool | None] = {
            name: value for name, value in self._result.report().items() if isinstance(value, int | float | str | bool)
        }
        for group in ("error_m", "frame_ms"):
            spread = METRICS[group](self._result.frames)
            if isinstance(spread, dict):
                figures.update({f"{group}_{name}": value for name, value in spread.items()})
        figures.update(self._fixes.take())
        health = RobotHealth(
            site=self._link.site, robot=self._link.robot, stamp_ns=estimate.stamp_ns, version=estimate.map_version,
            status=estimate.status.value, flags=("tiles_refused",) if self._result.tiles.refused else (), metrics=figures,
        )  # fmt: skip
        self._send(lambda to: to.publish_health(health))

    def _due(self, now_ns: int, last_ns: int, every_s: float) -> bool:
        return now_ns - last_ns >= every_s * 1e9

    def _send(self, act: Callable[[MapClient], None]) -> None:
        if self._link.client is None or self._broken:
            return
        try:
            act(self._link.client)
        except LinkError as error:
            self._broken = True
            self._result.notes.append(f"reports are no longer sent: {error}")
