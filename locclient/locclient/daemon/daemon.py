"""Puts the parts of `locclient run` together from its configuration, and takes them apart again."""

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2

from fleetmap.bus import Bus, ZenohBus
from fleetmap.errors import LinkError, UsageError
from fleetmap.mapformat import check_name
from fleetmap.messages import WantedVersion
from fleetmap.sensors.rectification import Rectifier
from locclient.config import LocclientConfig
from locclient.daemon.jit_warmup import gc_frozen, warm_up
from locclient.daemon.outbox import Outbox
from locclient.daemon.publishers import Output, open_output
from locclient.daemon.run_settings import RunSection
from locclient.daemon.runtime import Parts
from locclient.daemon.server_sync import ServerSync
from locclient.maps.connection import cache_folder
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import CachedMap, LocalMapSource, MapSource
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from locclient.replay.prior_option import parse_prior
from locclient.robot.robot import Robot
from locclient.sensors.intake import Intake
from locclient.sensors.source import open_source

_PATIENCE_S = 120.0  # in the middle of fetching a version; from the next part on it goes on where it was
_log = logging.getLogger(__name__)


def check_run(config: LocclientConfig) -> tuple[str, str]:
    """Names of site and robot; UsageError naming what [run] lacks or contradicts."""
    run = config.run
    if run.site is None or run.robot is None:
        raise UsageError(f"[run] {'site' if run.site is None else 'robot'} is missing: which site's map, and who asks?")
    if (run.server is None) == (run.store is None):
        raise UsageError("[run]: give either server, tcp/HOST:PORT, or store, a folder")
    if run.frame_queue < 1:
        raise UsageError(f"[run] frame_queue = {run.frame_queue}: at least one frame must be able to wait")
    if not run.trial.contradicting_looks < config.localizer.track.kidnap_fixes:
        raise UsageError(
            f"[run.trial] contradicting_looks = {run.trial.contradicting_looks} must be below [localizer.track] kidnap_fixes = "
            f"{config.localizer.track.kidnap_fixes}: a version must be given up before the robot believes that it was carried away"
        )
    return check_name(run.site, "site"), check_name(run.robot, "robot")


@contextmanager
def daemon_parts(config: LocclientConfig) -> Iterator[Parts]:
    """The parts, warmed up, with the last good version chosen and nothing waited for; closed afterwards.

    Raises FleetmapError for whatever of the configuration cannot be used.
    """
    cv2.setNumThreads(1)  # the rest of the board belongs to the robot's other programs
    site, name = check_run(config)
    with ExitStack() as stack:
        prior = parse_prior(config.run.prior)
        source = open_source(config.source, config.topics)
        stack.callback(source.close)
        calibration = source.calibration
        rectifier = Rectifier(calibration, has_depth=source.has_depth)
        bus = None if config.run.server is None else ZenohBus.connect(config.run.server)
        if bus is not None:
            stack.callback(bus.close)
        output = _output(config, bus, site, name, stack)
        spool = Outbox(spool_path(config.run, site, name), max_bytes=config.run.spool_bytes)
        if spool.set_aside is not None:
            _log.warning("the spool was damaged; it lies in %s now, and a new one was begun", spool.set_aside)
        begun_s = time.monotonic()
        warm_up(calibration, rectifier, config.localizer)
        stack.enter_context(gc_frozen())
        _log.info("warm after %.1f s", time.monotonic() - begun_s)
        link, maps, first, caches = _maps(config.run, bus, site, name)
        robot = Robot(calibration, rectifier, config.localizer, config.run.trial, time.thread_time)
        if prior is not None:
            robot.localizer.handle_prior(prior)
        intake = Intake(
            frames=config.run.frame_queue, imu_minus_cam_s=rectifier.imu_minus_cam_s, has_imu=calibration.imu is not None,
            imu_wait_s=config.run.imu_wait_s,
        )  # fmt: skip
        talk = None if link is None else ServerSync(link, spool, retry_s=config.run.trial.retry_s)
        yield Parts(
            site=site, robot_name=name, source=source, intake=intake, robot=robot, room=TileLoader(maps, config.run.window),
            spool=spool, camera=rectifier.camera, settings=config.localizer, output=output, link=link, talk=talk, first=first,
            failures_folder=None if config.run.failures is None else Path(config.run.failures),
            caches=caches,
        )  # fmt: skip


def spool_path(run: RunSection, site: str, robot: str) -> Path:
    """Where the spool lies: as set, else beside the cache, one for each robot of the machine."""
    if run.spool is not None:
        return Path(run.spool)
    return cache_folder().parent / "spool" / f"{site}.{robot}.sqlite3"


def _output(config: LocclientConfig, bus: Bus | None, site: str, name: str, stack: ExitStack) -> Output | None:
    if config.output.endpoint is not None:
        bus = ZenohBus.connect(config.output.endpoint)
        stack.callback(bus.close)
    return None if bus is None else open_output(bus, site, name, config.output)


def _maps(
    run: RunSection, bus: Bus | None, site: str, name: str
) -> tuple[MapClient | None, MapSource, WantedVersion | None, tuple[TileCache, ...]]:
    """The link to a server, what maps are read from, and the version to begin with; from the disk alone, without waiting."""
    if bus is None:
        folder = LocalMapSource(Path(run.store or ""), site)
        wanted = folder.wanted()
        if wanted.version is None:
            raise LinkError(
                f"site {site} has no published version in {run.store}; publish one with `mapserver publish`"
            )
        return None, folder, wanted, ()
    # Two views of the same folder, because a cache is not for two threads; the second only reads.
    caches = tuple(TileCache(cache_folder(run.cache), max_bytes=run.cache_bytes) for _ in range(2))
    link = MapClient(bus, caches[0], site, name, patience_s=_PATIENCE_S)
    return link, CachedMap(caches[1], site), link.active(), caches
