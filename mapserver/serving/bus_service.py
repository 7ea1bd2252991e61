"""The server's side of the bus: answers queries for versions and bytes, receives robots' messages, announces versions, sends poses."""

import logging
import math
import threading
from collections.abc import Callable
from typing import Any

import msgspec

from fleetmap import messages
from fleetmap.bus.zenoh_bus import Bus, Handle
from fleetmap.errors import FleetmapError, LinkError, StateError, UsageError
from fleetmap.failure_summary import ReplayPart
from fleetmap.log_lines import LogLimit
from fleetmap.mapformat.names import check_name
from mapserver.fleet.fleet import Fleet
from mapserver.fleet.rate_limit import RateLimit
from mapserver.serving.bus_access import BusGuard
from mapserver.store import Actor, MapStore
from mapserver.trust import SignedLists

TakeDrive = Callable[[str, str, ReplayPart], messages.FailureAck]
Count = Callable[[str, str, int], None]
"""Counts for metrics: (what, "ok", "refused" or "dropped", bytes sent)."""

_log = logging.getLogger(__name__)
MAX_REPORT_BYTES = 16 << 10  # a complete health report has 3 kB, a pose 0.5 kB
# A robot's limit of messages, at once and per second: health once a second, poses with every frame, an ack per version.
RENEWAL_RATE = (5, 1 / 60)  # per robot: each costs a signature and a line in the log
REPORT_RATES = {"ack": (20, 1.0), "health": (20, 4.0), "pose": (80, 60.0)}
REPORTS: dict[str, type[Any]] = {"ack": messages.RobotAck, "health": messages.RobotHealth, "pose": messages.PoseMessage}
_MOST_AREAS = 20  # told to a robot, the oldest requests first
_CACHED_BYTES = 64_000_000
_ENTRY_BYTES = 200  # overhead of a cache entry, so that empty ones are limited too
# Robots report every second. One without its liveliness token has left.
_HEARD_WITHIN_S, _LEFT_S = 10.0, 3.0


class BusService:
    """Serves a store on a bus from construction to `close`. Also receives publications of other processes.

    Bytes are sent in parts; the latest ones are cached in memory, because robots query the same ones at the same time.
    """

    def __init__(
        self,
        store: MapStore,
        fleet: Fleet,
        bus: Bus,
        count: Count,
        guard: BusGuard | None = None,
        take_drive: TakeDrive | None = None,
    ) -> None:
        """guard: of the enrolled robots, if only those may connect; None: no restriction. take_drive: receives a part of a robot's drive
        through a requested area; None: this server has no inbox for them, and asks robots for none.
        """
        self._take_drive = take_drive
        self._guard = guard
        self._store = store
        self._fleet = fleet
        self._bus = bus
        self._count = count
        self._refusals = LogLimit(_log)
        self._rates = {what: RateLimit(burst, per_s, store.now_ns) for what, (burst, per_s) in REPORT_RATES.items()}
        self._rates["renew"] = RateLimit(*RENEWAL_RATE, store.now_ns)
        self._lists, self._restored_ns = SignedLists(store.folder), store.restored_ns()
        self._announced: dict[tuple[str, str], str | None] = {}
        self._recent = ByteCache(_CACHED_BYTES, store.blob)
        self._handles: list[Handle] = [
            bus.queryable(messages.robot_key("*", "*", keys), self._counted(what, answer))
            for keys, what, answer in (
                ("wanted", "wanted", self._wanted),
                ("failures", "failure", self._failure),
                ("replays", "replay", self._replay),
                ("manifests/*", "manifest", self._parts(self._manifest)),
                ("blobs/*", "blob", self._parts(self._blob)),
                ("trust/*", "trust", self._parts(self._list_file)),
                *([] if guard is None else [("renew", "renewal", self._renew)]),
            )
        ]
        for what in REPORT_RATES:
            self.hear(messages.robot_key("*", "*", what), what, self._take)

    def announce_changes(self) -> list[str]:
        """Notify every known robot whose wanted version changed since the last call; return the sites of notified robots.

        The first call notifies all of them, because they may have missed changes while no server ran.
        """
        changed, known = [], set()
        for info in self._store.sites():
            for robot, newest in self._fleet.wanted_versions(info.site).items():
                wanted = self._lists.admitted_or_current(newest)
                key, address = (info.site, robot), wanted.manifest_sha256
                known.add(key)
                if key not in self._announced or self._announced[key] != address:
                    self._bus.publish(messages.robot_key(info.site, robot, "wanted"), messages.encode_message(wanted))
                    self._announced[key] = address
                    changed.append(info.site)
        self._announced = {key: address for key, address in self._announced.items() if key in known}
        return sorted(set(changed))

    def look_for_robots(self) -> None:
        keys = (messages.split_key(key) for key in self._bus.alive(messages.robot_key("*", "*", "alive")))
        self._fleet.take_presence((site, robot) for site, robot, _ in keys)

    def close(self) -> None:
        for handle in self._handles:
            handle.close()

    def _counted(self, what: str, answer: Callable[[str, bytes], bytes]) -> Callable[[str, bytes], bytes]:
        def counted(key: str, payload: bytes) -> bytes:
            try:
                data = answer(key, payload)
            except FleetmapError:
                self._count(what, "refused", 0)
                raise
            self._count(what, "ok", len(data))
            return data

        return counted

    def _parts(self, whole: Callable[[str], bytes]) -> Callable[[str, bytes], bytes]:
        return lambda key, question: messages.part_of(whole(key), question)

    def _sender(self, key: str) -> tuple[str, str]:
        """Return site and robot of a robot's key; LinkError for one without permission, even if the bus let it through."""
        site, robot, _ = messages.split_key(key)
        check_name(site, "site")
        check_name(robot, "robot")
        if self._guard is not None and (site, robot) not in self._guard.access.robots:
            raise LinkError(
                f"robot {robot} of site {site[:64]!r} is not enrolled; `mapserver robots enrol {robot} --site {site[:64]}` enrols it"
            )
        return site, robot

    def _renew(self, key: str, payload: bytes) -> bytes:
        site, robot = self._sender(key)
        assert self._guard is not None
        if not self._rates["renew"].admits((site, robot)):
            raise LinkError(f"later: robot {robot} asked for certificates too often")
        return self._guard.register.renew(site, robot, payload)

    def _wanted(self, key: str, _: bytes) -> bytes:
        wanted = self._fleet.take_question(*self._sender(key))
        answer = self._lists.admitted_or_current(wanted)
        asked = () if self._take_drive is None else self._store.survey_requests(wanted.site)[:_MOST_AREAS]
        surveys = tuple(messages.SurveyArea(id=r.id, corners_map_m=[(x, y) for x, y in r.corners_map_m]) for r in asked)
        return messages.encode_message(msgspec.structs.replace(answer, restored_ns=self._restored_ns, surveys=surveys))

    def _failure(self, key: str, payload: bytes) -> bytes:
        site, robot = self._sender(key)
        ack = self._fleet.take_failure_bytes(site, robot, payload)
        if ack.refused:
            self._count("failure refused for good", "refused", 0)
        return messages.encode_message(ack)

    def _replay(self, key: str, payload: bytes) -> bytes:
        site, robot = self._sender(key)
        part = messages.decode_message(payload, ReplayPart)
        if part.survey is None:
            return messages.encode_message(self._fleet.replays.take(site, robot, part))
        if self._take_drive is None:
            return messages.encode_message(
                messages.FailureAck(id=part.id, refused="this server has no inbox for drives")
            )
        return messages.encode_message(self._take_drive(site, robot, part))

    def _manifest(self, key: str) -> bytes:
        site, _what, number = messages.split_key(key)
        if not number.isdecimal() or len(number) > 10:
            raise LinkError(f"invalid version number {number[:80]!r}")
        info = self._store.version(site, int(number))
        if info.state == "draft":
            raise LinkError(f"version {number} of site {site} is a draft; robots get published versions only")
        return self._recent.get(info.manifest_sha256)

    def _list_file(self, key: str) -> bytes:
        site, _what, name = messages.split_key(key)
        return self._lists.file(check_name(site, "site"), name)

    def _blob(self, key: str) -> bytes:
        site, _what, sha256 = messages.split_key(key)
        if self._store.served_kind(sha256, site) is None:
            raise LinkError(f"site {site} has no published bytes {sha256}; fetch its current manifest again")
        return self._recent.get(sha256)

    def _take(self, key: str, payload: bytes) -> str | None:
        what = key.rpartition("/")[2]
        site, robot = self._sender(key)
        if not self._rates[what].admits((site, robot)):
            self._refusals.warning(key, "too many messages under %r; the excess is dropped", key[:200])
            return "dropped"
        if len(payload) > MAX_REPORT_BYTES:
            raise LinkError(f"{len(payload)} bytes; the limit is {MAX_REPORT_BYTES}")
        getattr(self._fleet, f"take_{what}")(site, robot, messages.decode_message(payload, REPORTS[what]))
        return None

    def hear(self, keys: str, what: str, take: Callable[[str, bytes], str | None]) -> None:
        """Pass messages under these keys on, counted as `what` and "ok" or the outcome that `take` returns.

        One at which it raises a FleetmapError is logged and counted as refused: published messages have no answer.
        """

        def heard(key: str, payload: bytes) -> None:
            try:
                outcome = take(key, payload) or "ok"
            except FleetmapError as error:
                self._refusals.warning(key, "message under %r refused: %s", key[:200], error)
                outcome = "refused"
            self._count(what, outcome, 0)

        self._handles.append(self._bus.subscribe(keys, heard))


def place_robot(
    store: MapStore, fleet: Fleet, bus: Bus | None, told: messages.InitialPoseMessage, actor: Actor
) -> None:
    """Publish the pose for its robot, and log its author in the site's history. bus: None if the server has none.

    UsageError for an unknown site or robot and a position outside the map, StateError for a robot that is not connected.
    """
    current = store.current(told.site)  # raises for an unknown site
    robot = next((robot for robot in fleet.robots(told.site) if robot.robot == told.robot), None)
    if robot is None:
        raise UsageError(f"site {told.site} has no robot {told.robot[:64]!r}; /v1/robots lists its robots")
    if robot.seconds_since > (_LEFT_S if robot.is_present is False else _HEARD_WITHIN_S):
        last = f"{told.robot} was last seen {robot.seconds_since:.0f} s ago"
        raise StateError(f"{last} and is not connected; try again when it is back")
    if bus is None or bus.closed():
        raise StateError("this server has no bus to notify robots; start one with `mapserver serve`")
    version = robot.version if robot.version is not None else None if current is None else current.version
    if version is None:
        raise StateError(f"{told.robot} runs no map yet; publish one first")
    manifest = store.manifest(told.site, version)
    x, y = (math.floor(value / manifest.tile_size_m) for value in (told.x_map_m, told.y_map_m))
    if (x, y) not in {(tile.x, tile.y) for tile in manifest.tiles}:
        where = f"{told.x_map_m:.1f}, {told.y_map_m:.1f} m"
        raise UsageError(f"{where} is outside of version {version}: it has no tile {x},{y}")
    heading = "" if told.heading_rad is None else f", heading {math.degrees(told.heading_rad):.0f} degrees"
    words = f"{told.robot} is at {told.x_map_m:.2f}, {told.y_map_m:.2f} m{heading}, within {told.sigma_m:g} m"
    bus.publish(messages.robot_key(told.site, told.robot, "initial_pose"), messages.encode_message(told))
    store.audit("robot placed", words, actor=actor, site=told.site)


class ByteCache:
    """Thread-safe cache of the latest bytes. When a whole fleet queries the same tile at once, it is read once."""

    def __init__(self, max_bytes: int, read: Callable[[str], bytes]) -> None:
        self._max_bytes, self._read = max_bytes, read
        self._held: dict[str, bytes] = {}  # in the order of their last use
        self._lock, self._reading = threading.Lock(), dict[str, threading.Lock]()

    def get(self, sha256: str) -> bytes:
        """Return the bytes of an address, read if not cached; errors as of `read`."""
        with self._lock:
            reading = self._reading.setdefault(sha256, threading.Lock())
        with reading:  # of one address alone: an object store may take seconds
            try:
                with self._lock:
                    data = self._held.get(sha256)
                data = self._read(sha256) if data is None else data
                with self._lock:
                    self._held.pop(sha256, None)
                    self._held[sha256] = data
                    while self.total_bytes() > self._max_bytes:
                        del self._held[next(iter(self._held))]
            finally:
                with self._lock:
                    self._reading.pop(sha256, None)
            return data

    def total_bytes(self) -> int:
        return sum(len(data) + _ENTRY_BYTES for data in self._held.values())
