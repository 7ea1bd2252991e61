"""Assembly of the parts of `locclient run` from its configuration."""

import logging
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import cv2

from fleetmap.bus import Bus
from fleetmap.errors import LinkError, UsageError
from fleetmap.free_memory import give_back_free_memory
from fleetmap.messages import WantedVersion
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import open_source
from locclient.config import LocclientConfig, RunSection, image_priors_of, links_of
from locclient.daemon.publishers import output_of
from locclient.daemon.runtime import RuntimeParts
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.failure_file import PICTURES
from locclient.delivery.outbox import Outbox
from locclient.delivery.report_delivery import ReplayQueue
from locclient.delivery.survey_drives import SurveyDrives
from locclient.hooks import LinkedRobot, RobotLink
from locclient.identity import GivenAddress, MapAddress, check_reach
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.connection import cache_folder, open_bus, outbox_path, replay_outbox, trusted_map
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import CachedMap, LocalMapSource, MapSource
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from locclient.prior_option import parse_prior
from locclient.publisher import Publisher
from locclient.robot.failure_report import RobotProfile
from locclient.robot.gc_freeze import gc_frozen
from locclient.robot.robot import Robot

_PATIENCE_S = 120.0  # without an answer during a download; the next attempt resumes it
_log = logging.getLogger(__name__)


class _OpenMap(NamedTuple):
    """The map, its version to begin with, its caches, and the exchange with the server."""

    maps: MapSource
    first: WantedVersion | None
    caches: tuple[TileCache, ...]
    server: ServerSync | None


def check_run(config: LocclientConfig) -> MapAddress:
    """Check the configuration and return the map's address; UsageError names missing or contradicting settings of [run]."""
    run, links = config.run, links_of(config)
    try:
        address = GivenAddress(
            site=run.site,
            robot=run.robot,
            server=run.server,
            store=run.store,
            root=run.root,
            identity=run.identity,
            insecure=run.insecure,
        ).resolve(may_be_alone=bool(links))
    except UsageError as error:
        raise UsageError(f"[run] {error}") from error
    topics = None if config.source.kind == "recording" else config.source.endpoint
    for section, endpoint in (("source", topics), ("output", config.output.endpoint)):
        try:
            check_reach(endpoint, insecure=run.insecure)
        except UsageError as error:
            raise UsageError(f"[{section}] endpoint = {error}") from error
    output_of(config.output).check(config.output, config.topics)
    if run.replays not in ("off", *PICTURES):
        raise UsageError(f"[run] replays = {run.replays!r}: choose off, {' or '.join(PICTURES)}")
    if run.frame_queue < 1:
        raise UsageError(f"[run] frame_queue = {run.frame_queue}: must be at least 1")
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
    site, name = address.site, address.robot
    is_alone = address.server is None and address.store is None
    with ExitStack() as stack:
        prior = parse_prior(run.prior)
        source = open_source(config.source, config.topics, config.output.map_frame)
        stack.callback(source.close)
        calibration = source.calibration
        rectifier = Rectifier(calibration, has_depth=source.has_depth)
        bus = None if address.store is not None else open_bus(address)
        if bus is not None:
            stack.callback(bus.close)
        intake = Intake(
            frames=run.frame_queue,
            imu_minus_cam_s=rectifier.imu_minus_cam_s,
            has_imu=calibration.imu is not None,
            imu_wait_s=run.imu_wait_s,
        )
        outbox_file = configured_outbox(run, site, name)
        outbox = _opened_outbox(outbox_file, run.outbox_bytes)
        give_back_free_memory()
        stack.enter_context(gc_frozen())
        maps, first, caches, server = _local_map(run, site) if bus is None else _server_map(run, address, bus, outbox)
        keeps_replay = server is not None and not is_alone and run.replays != "off"
        robot = _new_robot(config, calibration, rectifier, keeps_replay=keeps_replay)
        if prior is not None:
            robot.localizer.handle_prior(prior)
        publisher = _opened_publisher(stack, config, address, None if is_alone else bus, calibration, intake)
        if server is not None:
            server.links = _links(config, site, server, caches[0], intake)
            server.client.takes_grids = publisher is not None and publisher.grid_height_m is not None
        building = _building_maps(config, address, bus, caches, server, maps, publisher)
        mounting = (robot.base_from_body, rectifier.body_from_cam, rectifier.camera)
        clock = (calibration.imu, rectifier.imu_minus_cam_s)
        profile = RobotProfile(site, name, *mounting, config.localizer, *clock, run.replays, rectifier.mounted[1:])
        replays = _keep_recordings(server, outbox_file, profile, run) if server and keeps_replay else None
        if server is not None and run.surveys:
            server.drives = SurveyDrives(outbox_file.with_name(f"{outbox_file.stem}.drives"), calibration)
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
            building=building,
            drives=None if server is None else server.drives,
        )


def _new_robot(
    config: LocclientConfig, calibration: RigCalibration, rectifier: Rectifier, *, keeps_replay: bool
) -> Robot:
    return Robot(
        calibration,
        rectifier,
        config.localizer,
        config.run.trial,
        time.thread_time,
        keeps_replay=keeps_replay,
        image_priors=image_priors_of(config, rectifier.mounted[0], calibration.base_from_body),
    )


def _opened_outbox(file: Path, max_bytes: int) -> Outbox:
    outbox = Outbox(file, max_bytes=max_bytes, is_needed=False)
    if outbox.fault:
        _log.error("failures are not kept: %s", outbox.fault)
    if outbox.set_aside is not None:
        _log.warning("the spool was damaged; it was moved to %s, and a new one was started", outbox.set_aside)
    return outbox


def _keep_recordings(server: ServerSync, outbox_file: Path, profile: RobotProfile, run: RunSection) -> ReplayQueue:
    """Keep recordings of failures until the server has them."""
    server.replays = Outbox(replay_outbox(outbox_file), max_bytes=run.replays_bytes, is_needed=False)
    return ReplayQueue(server.replays, profile, run.replays)


def _opened_publisher(
    stack: ExitStack,
    config: LocclientConfig,
    address: MapAddress,
    bus: Bus | None,
    calibration: RigCalibration,
    intake: Intake,
) -> Publisher | None:
    """Return the publisher at [output] endpoint, else on the map server's bus, which the stack closes; None without either."""
    output = output_of(config.output)
    if config.output.endpoint is not None:
        bus = output.connect(config.output.endpoint)
        stack.callback(bus.close)
    if bus is None:
        return None
    publisher = output.open(config.output, bus, address.site, address.robot, calibration, intake)
    stack.callback(publisher.close)
    return publisher


def _server_map(run: RunSection, address: MapAddress, bus: Bus, outbox: Outbox) -> _OpenMap:
    """Return the map that the disk holds, and the exchange with its server, if there is one."""
    is_alone = address.server is None
    # Two caches of the same folder, because one is not thread-safe; the second only reads.
    caches = tuple(TileCache(cache_folder(run.cache), max_bytes=run.cache_bytes) for _ in range(2))
    client = MapClient(bus, caches[0], address.site, address.robot, patience_s=_PATIENCE_S)
    client.require(None if is_alone else trusted_map(bus, address, cache_folder(run.cache)))
    server = ServerSync(client, outbox, retry_s=run.trial.retry_s, upkeep=_upkeep(address, bus))
    server.is_alone = is_alone
    return _OpenMap(CachedMap(caches[1], address.site), client.active(), caches, server)


def _building_maps(
    config: LocclientConfig,
    address: MapAddress,
    bus: Bus | None,
    caches: tuple[TileCache, ...],
    server: ServerSync | None,
    maps: MapSource,
    publisher: Publisher | None,
) -> BuildingMaps:
    """Return the maps of the other sites of the robot's building, as far as its disk has them."""
    folder, grid_height_m = Path(config.run.store or ""), None if publisher is None else publisher.grid_height_m

    def over_the_bus(site: str) -> MapSource:
        assert bus is not None
        client = MapClient(bus, caches[0], site, address.robot, patience_s=_PATIENCE_S)
        client.takes_grids = grid_height_m is not None
        client.require(trusted_map(bus, replace(address, site=site), cache_folder(config.run.cache)))
        return client

    if server is None:
        building = BuildingMaps(maps, lambda site: LocalMapSource(folder, site))
    else:
        building = server.building = BuildingMaps(server.client, over_the_bus)
    building.grid_height_m = grid_height_m
    building.refresh(asks=server is None)
    return building


def _upkeep(address: MapAddress, bus: Bus) -> Callable[[], None]:
    """Renew the certificate of an enrolled robot once it is a month old."""
    identity = address.identity

    def renew() -> None:
        if identity is not None and identity.is_renewal_due(datetime.now(UTC)):
            identity.renew(bus)
            _log.info("the certificate is renewed until %s", identity.certificate().ends)

    return renew


def _links(config: LocclientConfig, site: str, server: ServerSync, cache: TileCache, intake: Intake) -> list[RobotLink]:
    robot = LinkedRobot(
        site=site,
        insecure=config.run.insecure,
        lost_radius_m=config.localizer.track.lost_radius_m,
        cache=cache,
        folder=cache_folder(config.run.cache) / "incoming",
        active=server.client.active,
        check_admitted=None if server.is_alone else server.client.check_admitted,
        offer=server.fetched.append,
        put_prior=intake.put_prior,
    )
    return [hook.open(section, robot) for hook, section in links_of(config)]


def configured_outbox(run: RunSection, site: str, robot: str) -> Path:
    """Return the file of the spool: as set, else beside the default cache."""
    return outbox_path(site, robot) if run.outbox is None else Path(run.outbox)


def _local_map(run: RunSection, site: str) -> _OpenMap:
    source = LocalMapSource(Path(run.store or ""), site)
    wanted = source.wanted()
    if wanted.version is None:
        raise LinkError(
            f"site {site} has no published version in {run.store}; "
            f"publish one with `mapserver publish --site {site} --store {shlex.quote(run.store or '')}`"
        )
    return _OpenMap(source, wanted, (), None)
