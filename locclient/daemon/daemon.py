"""Assembly of the parts of `locclient run` from its configuration."""

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import cv2

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import StoreError, UsageError
from fleetmap.free_memory import gc_frozen
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import open_source
from locclient.config import LocclientConfig, RunSection, image_priors_of, links_of
from locclient.daemon.publishers import output_of
from locclient.daemon.runtime import RuntimeParts
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox
from locclient.delivery.report_delivery import ReplayQueue
from locclient.delivery.survey_drives import SurveyDrives
from locclient.hooks import LinkedRobot
from locclient.identity import MapAddress, check_reach
from locclient.localization.priors.given import parse_prior
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_client import cache_folder, map_client, open_bus
from locclient.maps.map_source import CachedMap, LocalMapSource, MapSource, address_of
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from locclient.outputs import NoPublisher, Publisher
from locclient.robot.failure_report import RobotProfile
from locclient.robot.robot import Robot

_log = logging.getLogger(__name__)


def check_run(config: LocclientConfig) -> MapAddress:
    """Check the configuration and return the map's address; UsageError names missing or contradicting settings of [run]."""
    run, links = config.run, links_of(config)
    address = MapAddress.of(run, sign="[run] ", may_be_alone=bool(links))
    check_reach(config.output.endpoint, insecure=run.insecure, sign="[output] endpoint = ")
    output_of(config.output).check(config.output, config.topics)
    if not run.trial.contradicting_looks < config.localizer.track.kidnap_fixes:
        raise UsageError(
            f"[run.trial] contradicting_looks = {run.trial.contradicting_looks} must be below [localizer.track] kidnap_fixes = "
            f"{config.localizer.track.kidnap_fixes}: a new version must be dropped before the robot concludes that it was carried"
        )
    for hook, linked in links:
        hook.check(linked, address, run.insecure)
    return address


@contextmanager
def daemon_parts(config: LocclientConfig) -> Iterator[RuntimeParts]:
    """Open the parts of the daemon, with the last good version selected, without waiting for the server; close them afterwards.

    Raises FleetmapError for unusable settings.
    """
    cv2.setNumThreads(1)  # leave the other cores to the robot's other programs
    run, address = config.run, check_run(config)
    with ExitStack() as stack:
        prior = parse_prior(run.prior)
        source = open_source(config.source, config.topics, config.output.map_frame)
        stack.callback(source.close)
        calibration = source.calibration
        rectifier = Rectifier(calibration, has_depth=source.has_depth)
        bus = None if address.store is not None else stack.enter_context(open_bus(address))
        intake = Intake(
            frames=run.frame_queue,
            imu_minus_cam_s=rectifier.imu_minus_cam_s,
            has_imu=calibration.imu is not None,
            imu_wait_s=run.imu_wait_s,
        )
        spool = outbox_file(run, address)
        outbox = _opened_outbox(spool, run.outbox_bytes)
        stack.enter_context(gc_frozen())
        caches: tuple[TileCache, ...] = ()
        server: ServerSync | None = None
        maps: MapSource
        if bus is not None:
            # Two caches of the same folder, because one is not thread-safe; the second only reads.
            caches = tuple(TileCache(cache_folder(run.cache), max_bytes=run.cache_bytes) for _ in range(2))
            server = _server(config, address, bus, outbox, caches[0], intake)
            maps, first = CachedMap(caches[1], address.site), server.client.active()
        else:
            maps = LocalMapSource(Path(run.store or ""), address.site)
            first = maps.wanted()
            address_of(first)  # LinkError without one
        keeps = address.server is not None and run.replays != "off"
        priors = image_priors_of(config, rectifier.mounted[0], calibration.base_from_body)
        robot = Robot(rectifier, config.localizer, run.trial, time.thread_time, keeps_replay=keeps, image_priors=priors)
        if prior is not None:
            robot.localizer.handle_prior(prior)
        publisher = _opened_publisher(stack, config, address, bus, calibration, intake)
        profile = RobotProfile(address.site, address.robot, rectifier.rig, config.localizer, run.replays)
        replays = None if server is None else _keep_recordings(server, run, spool, profile, publisher)
        yield RuntimeParts(
            profile=profile,
            source=source,
            intake=intake,
            robot=robot,
            tile_loader=TileLoader(maps, run.window),
            outbox=outbox,
            replays=replays,
            publisher=publisher,
            server=server,
            first=first,
            failures_folder=None if run.failures is None else Path(run.failures),
            caches=caches,
            building=_building_maps(address, caches, server, maps),
            drives=None if server is None else server.drives,
            stop_above_m=config.output.stop_above_m,
        )


def _opened_outbox(file: Path, max_bytes: int) -> Outbox:
    outbox = Outbox(file, max_bytes=max_bytes)
    try:
        outbox.counts()
    except StoreError as error:
        _log.error("failures or their recordings are not kept: %s", error)
    if outbox.set_aside is not None:
        _log.warning("the spool was damaged; it was moved to %s, and a new one was started", outbox.set_aside)
    return outbox


def _keep_recordings(
    server: ServerSync, run: RunSection, spool: Path, profile: RobotProfile, publisher: Publisher
) -> ReplayQueue | None:
    """Keep recordings of failures, None if none are wanted, and of drives until the server has them; fetch what the publisher needs."""
    server.client.takes_grids = publisher.grid_height_m is not None
    if run.surveys:
        server.drives = SurveyDrives(spool.with_name(f"{spool.stem}.drives"), profile.rig.calibration)
    if server.is_alone or run.replays == "off":
        return None
    server.replays = _opened_outbox(spool.with_name(f"{spool.stem}.replays{spool.suffix}"), run.replays_bytes)
    return ReplayQueue(server.replays, profile)


def _opened_publisher(
    stack: ExitStack, config: LocclientConfig, address: MapAddress, bus: Bus | None, rig: RigCalibration, intake: Intake
) -> Publisher:
    """Return the publisher at [output] endpoint, else on the map server's bus, which the stack closes; to nobody without one it needs."""
    output = output_of(config.output)
    if config.output.endpoint is not None:
        bus = stack.enter_context(Bus(config.output.endpoint).open())
    elif output.needs_bus and (bus is None or address.server is None):
        return NoPublisher()
    publisher = output.open(config.output, bus, address.site, address.robot, rig, intake)
    stack.callback(publisher.close)
    return publisher


def _building_maps(
    address: MapAddress, caches: tuple[TileCache, ...], server: ServerSync | None, maps: MapSource
) -> BuildingMaps:
    """Return the maps of the other sites of the robot's building, as far as its disk has them."""

    def opened(site: str) -> MapSource:
        if server is None:
            return LocalMapSource(Path(address.store or ""), site)
        client = map_client(server.client.bus, caches[0], replace(address, site=site))
        client.takes_grids = server.client.takes_grids
        return client

    building = BuildingMaps(maps if server is None else server.client, opened)
    building.refresh(asks=server is None)
    if server is not None:
        server.building = building
    return building


def _server(
    config: LocclientConfig, address: MapAddress, bus: Bus, outbox: Outbox, cache: TileCache, intake: Intake
) -> ServerSync:
    """Return the exchange with the map server, and with the links that the file asks for."""
    client = map_client(bus, cache, address)
    retry_s = config.run.trial.retry_s
    server = ServerSync(client, outbox, retry_s=retry_s, identity=address.identity, put_prior=intake.put_prior)
    server.is_alone = address.server is None
    lost_radius_m = config.localizer.track.lost_radius_m
    hands = server.fetched.append, intake.put_prior
    robot = LinkedRobot(client, config.run.insecure, lost_radius_m, *hands, config.output.stop_above_m)
    server.links = [hook.open(section, robot) for hook, section in links_of(config)]
    return server


def outbox_file(run: RunSection, address: MapAddress) -> Path:
    """Return the file of the spool: as set, else beside the default cache, one for each robot of the machine."""
    default = cache_folder().parent / "spool" / f"{address.site}.{address.robot}.sqlite3"
    return default if run.outbox is None else Path(run.outbox)
