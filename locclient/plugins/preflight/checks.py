"""Checks of a robot before it drives: each finding is ok, warn or fail, and names the next step."""

import shutil
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from fleetmap.bus.endpoints import handshake_fault
from fleetmap.errors import FleetmapError, LinkError, UnreachableError
from fleetmap.features.settings import OrbSettings
from fleetmap.recordings import StoredFrame
from fleetmap.recordings.images import decode_frame
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import Source, open_source
from locclient.config import LocclientConfig
from locclient.daemon.daemon import check_run, outbox_file
from locclient.delivery.outbox import Outbox
from locclient.identity import MapAddress, RobotIdentity
from locclient.localization.calibration.monitor import FAULTS, PairOrder, pair_order
from locclient.maps.map_client import cache_folder, map_client, open_bus
from locclient.maps.map_source import LocalMapSource
from locclient.maps.tile_cache import TileCache

OK, WARN, FAIL = "ok", "warn", "fail"
_ANSWER_S = 5.0  # of a server, also of one that starts
_BASELINE_M = (0.03, 0.6)
_MIN_FREE_BYTES = 200_000_000
_OLD_NS = 1_700_000_000_000_000_000  # an earlier time is a wrong clock
_SKEW_S = 0.5
_CERTIFICATE_DAYS = 60  # robots renew after a month, with eleven left
_MIN_FRAME_HZ, _MIN_IMU_HZ = 5.0, 90.0
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")


class Finding(NamedTuple):
    """Result of a check. level: ok, warn or fail; text: the result and, unless ok, the next step."""

    level: str
    what: str
    text: str


def run_preflight(config: LocclientConfig, listen_s: float) -> Iterator[Finding]:
    """Yield findings one by one; never raise for a fault of the robot. listen_s: seconds to receive its sensors."""
    try:
        address = check_run(config)
    except FleetmapError as error:
        yield Finding(FAIL, "configuration", str(error))
        return
    yield Finding(OK, "configuration", f"{address.robot} at {address.site}, source {config.source.kind}")
    clock = _clock(time.time_ns(), _SYNCHRONISED.exists())
    checks = {"calibration": _sensors(config, listen_s), "clock": clock, "spool": _outbox(config, address)}
    if address.store is not None:
        checks["store"] = _store(address)
    else:
        if address.identity is not None:
            checks["identity"] = _identity(address.identity)
        checks["cache"] = _cache_and_server(config, address)
    for what, findings in checks.items():
        try:
            yield from findings
        except FleetmapError as error:
            yield Finding(FAIL, what, str(error))


def _sensors(config: LocclientConfig, listen_s: float) -> Iterator[Finding]:
    source = open_source(config.source, config.topics, config.output.map_frame)
    try:
        rectifier = Rectifier(source.calibration, has_depth=source.has_depth)
        yield _calibration(source.calibration, rectifier)
        if listen_s > 0:
            yield from _streams(source, config, listen_s, rectifier)
    finally:
        source.close()


def _calibration(calibration: RigCalibration, rectifier: Rectifier) -> Finding:
    camera = rectifier.camera
    text = f"{camera.width_px}x{camera.height_px} px, focal {camera.focal_px:.0f} px, baseline {1000 * camera.baseline_m:.0f} mm"
    if len(calibration.views[0]) > 1 and not _BASELINE_M[0] < camera.baseline_m < _BASELINE_M[1]:
        return Finding(WARN, "calibration", f"{text}: is the baseline in metres? Calibrate again")
    if calibration.imu is None:
        hint = "no IMU: darkness and fast turns will lose the robot; calibrate with its IMU"
        return Finding(WARN, "calibration", f"{text}, {hint}")
    return Finding(OK, "calibration", f"{text}, IMU {1e3 * rectifier.imu_minus_cam_s:+.1f} ms from the camera")


def _streams(source: Source, config: LocclientConfig, listen_s: float, rectifier: Rectifier) -> Iterator[Finding]:
    until_s = time.monotonic() + listen_s
    intake = _StampRecorder(has_imu=source.calibration.imu is not None)

    def wait(seconds: float) -> bool:
        time.sleep(max(0.0, min(seconds, until_s - time.monotonic())))
        return time.monotonic() >= until_s

    source.run(intake, wait)
    counts, stamps = intake.counts, intake.stamps_ns
    is_live = config.source.kind != "recording"
    frame_hz = (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * 1e-9) if len(stamps) > 1 else 0.0
    text = f"{frame_hz:.1f} Hz of frames"
    if frame_hz < _MIN_FRAME_HZ:
        why = f" ({intake.unreadable_why})" if counts.unreadable else ""
        faults = "".join(f"; {fault}" for fault in intake.source_faults)
        hint = f"{counts.unreadable} unreadable messages{why}{faults}; check the camera and [topics]"
        yield Finding(FAIL, "frames", f"{text} in {listen_s:g} s, {hint}")
    else:
        bad = counts.frames_disordered + counts.unreadable
        hint = f", {bad} of them out of order or unreadable: check the driver" if bad else ""
        yield Finding(WARN if bad else OK, "frames", text + hint)
    yield from _pair(intake.last_frame, rectifier)
    if source.calibration.imu is not None and is_live:
        imu_hz = counts.imu_samples / listen_s
        is_enough = imu_hz >= _MIN_IMU_HZ
        hint = "" if is_enough else f"; at least {_MIN_IMU_HZ:g} Hz are needed, check [topics] imu"
        yield Finding(OK if is_enough else FAIL, "imu", f"{imu_hz:.0f} Hz{hint}")
    if stamps and is_live:
        skew_s = (time.time_ns() - stamps[-1]) * 1e-9
        is_off = abs(skew_s) > _SKEW_S + 1.0 / max(frame_hz, 1.0)
        text = f"{1e3 * skew_s:.0f} ms behind the system's clock"
        if is_off:
            text = f"frames are stamped {skew_s:.2f} s before now; let the driver stamp with the system's clock"
        yield Finding(WARN if is_off else OK, "stamps", text)


def _pair(raw: CameraFrame | StoredFrame | None, rectifier: Rectifier) -> Iterator[Finding]:
    """Check by the last frame that left and right images are not swapped."""
    if raw is None:
        return
    frame = rectifier.rectify(decode_frame(raw) if isinstance(raw, StoredFrame) else raw)
    if frame.right is None:
        return
    order, level, text = pair_order(frame, OrbSettings()), OK, "the left image is the left one"
    if order in FAULTS:
        level, text = FAIL, FAULTS[order]
    elif order is not PairOrder.RIGHT:
        level, text = WARN, "not judged: too few features near the robot; check again with objects within 5 m"
    yield Finding(level, "left and right", text)


class _StampRecorder(Intake):
    """Records the stamps of accepted frames, and the last frame."""

    def __init__(self, *, has_imu: bool) -> None:
        super().__init__(frames=1, imu_minus_cam_s=0.0, has_imu=has_imu, imu_wait_s=0.0)
        self.stamps_ns: list[int] = []
        self.last_frame: CameraFrame | StoredFrame | None = None

    def _queue(self, certain: list[CameraFrame | StoredFrame]) -> None:
        super()._queue(certain)
        for self.last_frame in certain:
            self.stamps_ns.append(self.last_frame.stamp_ns)

    def wait_for_room(self, timeout_s: float) -> bool:
        """Return True: there is always room (see Intake)."""
        return True


def _clock(now_ns: int, synchronised: bool) -> Iterator[Finding]:
    if now_ns < _OLD_NS:
        text = f"the system's clock says {now_ns // 10**9} s since 1970; set it, and enable its synchronisation"
        yield Finding(FAIL, "clock", text)
    elif not synchronised:
        hint = "enable NTP or PTP (timedatectl); the server measures how far this robot's clock is off"
        yield Finding(WARN, "clock", f"not known to be synchronised; {hint}")
    else:
        yield Finding(OK, "clock", "synchronised")


def _outbox(config: LocclientConfig, address: MapAddress) -> Iterator[Finding]:
    path = outbox_file(config.run, address)
    outbox = Outbox(path, max_bytes=config.run.outbox_bytes)
    counts = outbox.counts()
    text = f"{path}: {counts['waiting']} reports wait, {counts['delivered']} delivered, {counts['dropped']} dropped"
    if outbox.set_aside is not None:
        yield Finding(WARN, "spool", f"was damaged and started anew; its content is in {outbox.set_aside}")
    elif counts["dropped"]:
        yield Finding(WARN, "spool", f"{text}; raise [run] outbox_bytes or check the connection")
    else:
        yield Finding(OK, "spool", text)


def _store(address: MapAddress) -> Iterator[Finding]:
    source = LocalMapSource(Path(str(address.store)), address.site)
    wanted = source.wanted()
    tiles, refused = source.tiles(source.manifest(wanted))
    yield _pieces("store", wanted.version, len(tiles), list(refused.values()))


def _identity(identity: RobotIdentity) -> Iterator[Finding]:
    about = identity.certificate()
    days = (about.ends - datetime.now(UTC)).total_seconds() / 86_400
    is_old = days < _CERTIFICATE_DAYS
    hint = "; the running robot renews it, let it reach its server" if is_old else ""
    yield Finding(WARN if is_old else OK, "identity", f"{about.name}, certificate for {days:.0f} days{hint}")


def _cache_and_server(config: LocclientConfig, address: MapAddress) -> Iterator[Finding]:
    run, site = config.run, address.site
    cache = TileCache(cache_folder(run.cache), max_bytes=run.cache_bytes)
    folder = cache.folder
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < _MIN_FREE_BYTES:
        yield Finding(WARN, "disk", f"{free_bytes / 1e6:.0f} MB free beside {folder}; make room for new versions")
    active = cache.active(site)
    if active is None:
        hint = "the robot needs its server, or a fleet manager, for the first one"
        yield Finding(WARN, "cache", f"{folder} holds no whole version yet; {hint}")
    else:
        damaged = sum(cache.get(sha256) is None for sha256 in active.blobs)
        reasons = ["missing or damaged, fetched again at the next start"] * damaged
        yield _pieces("cache", active.version, len(active.blobs) - damaged, reasons)
    if address.server is None:
        return
    try:
        tls = None if address.identity is None else address.identity.tls
        if fault := handshake_fault(address.server, tls, _ANSWER_S):
            yield Finding(FAIL, "connection", f"{address.server}: {fault}")
            return
        with open_bus(address) as bus:
            client = map_client(bus, cache, address, timeout_s=_ANSWER_S)
            wanted = client.wanted()
    except UnreachableError as error:
        hint = "" if active is None else f"; version {active.version} works without it"
        yield Finding(FAIL if active is None else WARN, "connection", f"{error}{hint}")
        return
    if wanted.version is None:
        hint = f"publish one with `mapserver publish --site {site} --store DIR` on the server"
        yield Finding(FAIL, "connection", f"site {site} has no published version; {hint}")
        return
    is_here = active is not None and wanted == active.wanted(site)
    hint = ", which is here" if is_here else "; it is fetched when the robot runs"
    yield Finding(OK, "connection", f"{address.server} wants version {wanted.version}{hint}")
    assert client.trust is not None
    try:
        client.trust.admitted(wanted)
    except LinkError as error:
        yield Finding(WARN if is_here else FAIL, "signed list", str(error))
    else:
        yield Finding(OK, "signed list", f"admits version {wanted.version}")


def _pieces(what: str, version: int | None, good: int, refused: list[str]) -> Finding:
    if not refused:
        return Finding(OK, what, f"version {version} is whole: {good} pieces verified")
    text = f"version {version}: {len(refused)} pieces cannot be used, {good} can; the first: {refused[0]}"
    return Finding(WARN if good else FAIL, what, text)
