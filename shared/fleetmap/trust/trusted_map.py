"""The robot's side of signed lists: allowed versions, age of the last verified lists, and protection against wrong clocks."""

import fcntl
import logging
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from fleetmap.errors import LinkError, StoreError, UntrustedError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat.names import check_name
from fleetmap.messages import ChunkRequest, Part, WantedVersion, decode_message, encode_message, robot_key
from fleetmap.trust.site_list import AdmittedVersion, Signed, SiteList, read_site_list, site_role

if TYPE_CHECKING:
    from fleetmap.bus.zenoh_bus import Bus

Ask = Callable[[str], bytes | None]
"""Returns the bytes of a file of the signed lists, None if the server reports that it is absent; UnreachableError without a reply."""

FIRST_ROOT = "1.root.json"
_MAX_ROOT_BYTES = 64_000
_TIMESTAMP_S = 86_400.0  # validity of a timestamp after its signature
_CLOCK_EVERY_S = 600.0  # largest age of the clock on the disk: it is not written at every query
_log = logging.getLogger(__name__)


class _File(msgspec.Struct, frozen=True):
    signed: Signed


class _Clock(NamedTuple):
    """heard_s: time of the last verified lists by the robot's clock; signed_s: signature time of timestamp `number`. Seconds since 1970."""

    heard_s: float
    signed_s: float
    number: int


class TrustedMap:
    """Versions of a site that may be run. `refresh` updates; without fresh lists no new version may start, a running one continues.

    The folder belongs to one robot and site: files of python-tuf's client, and `clock`: time of the last verified lists by the robot's
    clock, with number and signature time of the timestamp. A robot's clock before that time cannot make expired lists valid again; one
    far ahead makes all lists expired, until it is right again. If a later timestamp was signed at an earlier time, the server's
    clock was wrong and has been corrected: numbers define the order, not clocks.
    """

    def __init__(
        self, folder: Path, site: str, root: bytes | None, ask: Ask, wall_s: Callable[[], float] = time.time
    ) -> None:
        """root: bytes of the trusted root; None pins the first one received, for a server on the same machine.

        Without a usable folder no list is fresh: `admitted` raises the reason until it is usable.
        """
        self._folder, self._site, self._ask, self._wall_s = folder, check_name(site, "site"), ask, wall_s
        self._pinned_root, self._is_first_use = root, root is None
        self._list: SiteList | None = None
        self._fault: LinkError | StoreError | None = None
        self._clock, self._kept_clock_s = _Clock(0.0, 0.0, 0), 0.0
        self._is_open = False
        try:
            self._open()
        except StoreError as error:
            self._fault = error
            _log.warning("no new map can be taken for site %s: %s", site, error)

    def _open(self) -> None:
        with disk_errors(
            f"the folder {self._folder} for signed lists cannot be used", "check the disk and whose it is"
        ):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                heard, signed, number = (self._folder / "clock").read_text("ascii").split()
                self._clock = _Clock(max(0.0, float(heard)), max(0.0, float(signed)), int(number))
            except (FileNotFoundError, ValueError):
                self._clock = _Clock(0.0, 0.0, 0)
            self._kept_clock_s = self._clock.heard_s
        self._is_open = True

    def refresh(self) -> None:
        """Fetch the server's lists. Errors of fetching and verification are raised by `admitted`, not here."""
        try:
            if not self._is_open:
                self._open()
            with (
                disk_errors(f"the signed lists in {self._folder} cannot be written", "make space"),
                (self._folder / "lock").open("a") as lock,  # of a cache shared by programs of one machine
            ):
                fcntl.flock(lock, fcntl.LOCK_EX)
                self._refresh()
            self._fault = None
        except (LinkError, StoreError) as error:
            fault = error
            if isinstance(error, UntrustedError):
                step = "look at `mapserver trust status` on the server, and at both clocks"
                if error.kind == "signature" and self._is_first_use:
                    step = f"if the server's store was recreated, remove {self._folder}; else another server replies instead"
                fault = UntrustedError(error.kind, f"{error.words}; {step}")
            if str(fault) != str(self._fault):
                hours = self.word_hours
                age = "" if hours is None else f", last word {hours:.1f} h ago"
                _log.warning("no fresh word on the maps of site %s%s: %s", self._site, age, fault)
            self._fault = fault

    def admitted(self, wanted: WantedVersion) -> AdmittedVersion:
        """Return the entry of a version by its number and manifest's address.

        Raises UntrustedError if the lists do not contain it or are not fresh, UnreachableError if the server did not reply.
        """
        if self._list is None and self._fault is None:
            self.refresh()
        if self._fault is not None:
            raise self._fault
        assert self._list is not None
        for entry in self._list.admitted:
            if (entry.about.version, entry.sha256) == (wanted.version, wanted.manifest_sha256):
                return entry
        numbers = [entry.about.version for entry in self._list.admitted]
        is_old = bool(numbers) and wanted.version is not None and wanted.version < max(numbers)
        words = (
            f"version {wanted.version} ({str(wanted.manifest_sha256)[:12]}) of site {self._site} is not in signed list"
        )
        raise UntrustedError(
            "rollback" if is_old else "signature",
            f"{words} {self._list.serial}, which admits {numbers or 'none'}; `mapserver trust status` on the server shows why",
        )

    def current(self) -> WantedVersion:
        """Fetch the lists and return the site's current version; errors as of `admitted`."""
        self.refresh()
        if self._fault is not None:
            raise self._fault
        entry = None if self._list is None else self._list.state("current")
        if entry is None:
            raise UntrustedError("signature", f"the signed list of site {self._site} names no current version")
        return WantedVersion(site=self._site, version=entry.about.version, manifest_sha256=entry.sha256)

    @property
    def files(self) -> dict[str, str] | None:
        """Addresses of the site's further files, by kind; None without fresh lists."""
        if self._list is None or self._fault is not None or not self._list.admitted:
            return None
        return self._list.admitted[-1].about.files

    @property
    def word_hours(self) -> float | None:
        """Hours since the last verified lists; None if there were none."""
        return None if self._clock.heard_s == 0 else max(0.0, self._wall_s() - self._clock.heard_s) / 3600

    def _refresh(self) -> None:
        from fleetmap.trust.tuf_client import update_lists

        before = self._files()
        update_lists(self._folder, self._site, self._root(), self._ask)
        wall_s, clock = self._wall_s(), self._clock
        files = ("root", "timestamp", "snapshot", "targets", site_role(self._site))
        # A site without a signing key: its last list stays in the folder, and python-tuf does not check it.
        data = msgspec.json.decode((self._folder / "targets.json").read_bytes())
        roles = (data["signed"].get("delegations") or {}).get("roles", [])
        if site_role(self._site) not in {role["name"] for role in roles}:
            raise UntrustedError("signature", f"no key may sign maps of site {self._site}")
        signed = {
            name: msgspec.json.decode((self._folder / f"{name}.json").read_bytes(), type=_File).signed for name in files
        }
        if signed["timestamp"].version >= clock.number:
            moment_s = signed["timestamp"].expires.timestamp() - _TIMESTAMP_S
            if moment_s < clock.signed_s - _CLOCK_EVERY_S:
                _log.warning(
                    "the server's clock said %s when it signed timestamp %d, and %s when it signed %d: the latter is believed",
                    *(_time(clock.signed_s), clock.number, _time(moment_s), signed["timestamp"].version),
                )
            clock = _Clock(clock.heard_s, moment_s, signed["timestamp"].version)
        for name in files:
            expires_s = signed[name].expires.timestamp()
            if expires_s <= max(wall_s, clock.signed_s):
                by = f"this robot's clock says {_time(wall_s)}"
                if clock.signed_s > wall_s:
                    by += f", and the server signed its last lists at {_time(clock.signed_s)}"
                raise UntrustedError("freeze", f"{name} expired at {_time(expires_s)}; {by}")
        self._list = read_site_list((self._folder / f"{files[-1]}.json").read_bytes(), self._site)
        self._clock = _Clock(wall_s, clock.signed_s, clock.number)
        if self._files() != before or abs(wall_s - self._kept_clock_s) > _CLOCK_EVERY_S:
            write_atomically(self._folder / "clock", [" ".join(map(str, self._clock)).encode()], mode=0o666)
            self._kept_clock_s = wall_s
            # python-tuf renames without fsync: after a power cut the guard against rollback would be gone.
            changed = [path for path, data in self._files().items() if before.get(path) != data]
            for path in [*changed, *sorted({path.parent for path in changed})]:
                sync_path(path)

    def _root(self) -> bytes:
        if self._pinned_root is None:
            path = self._folder / "pinned.root.json"
            if not path.is_file():
                data = self._ask(FIRST_ROOT)
                if data is None or len(data) > _MAX_ROOT_BYTES:
                    raise UntrustedError("signature", "the server has no signed lists; update it, or serve it anew")
                write_atomically(path, [data], mode=0o666)
                _log.warning("first use: the keys of site %s are trusted from now on, pinned in %s", self._site, path)
            self._pinned_root = path.read_bytes()
        return self._pinned_root

    def _files(self) -> dict[Path, bytes]:
        """Content of the folder; every file is small."""
        names = [*self._folder.glob("*.json"), *self._folder.glob("root_history/*.json"), *self._folder.glob("clock")]
        return {path: path.read_bytes() for path in names if not path.is_symlink()}


def _time(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M} UTC"


def ask_over(bus: "Bus", site: str, robot: str, timeout_s: float = 5.0) -> Ask:
    """Fetch from the server over a bus. A file must come in one reply, so that no server can delay a robot byte by byte."""

    def ask(name: str) -> bytes | None:
        answer = bus.get(robot_key(site, robot, f"trust/{name}"), encode_message(ChunkRequest()), timeout_s=timeout_s)
        part = decode_message(answer, Part)
        if part.offset or part.total_bytes != len(part.data):
            raise UntrustedError("size", f"{name} has {part.total_bytes} bytes, {len(part.data)} came in one answer")
        return part.data or None

    return ask
