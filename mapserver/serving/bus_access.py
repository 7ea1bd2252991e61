"""Admission to the bus: allowed endpoints of a server, and access rules that follow the enrolled robots at run time."""

import logging
import time
from collections import Counter
from collections.abc import Callable

from fleetmap.bus.endpoints import has_tls, is_loopback
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UsageError
from fleetmap.log_lines import LogLimit
from mapserver.store import MapStore
from mapserver.trust.enrolment import RobotRegister

COPIED_AFTER_S = 20.0  # a broken connection still counts until zenoh's lease of 10 s ends
_RULES_EVERY_S = 60.0  # certificates expire
_log = logging.getLogger(__name__)


def check_binding(endpoint: str, *, insecure: bool) -> bool:
    """True if other machines can connect to an endpoint without authentication; UsageError for one, unless `insecure`."""
    if has_tls(endpoint) or is_loopback(endpoint):
        return False
    if insecure:
        return True
    raise UsageError(
        f"--zenoh {endpoint}: anyone who can connect could act as any robot or as the server. Listen with mutual "
        f"TLS: `mapserver trust init --here --host NAME --store DIR`, then --zenoh tls/{endpoint.partition('/')[2]}, and enrol the "
        "robots; --insecure is for an isolated network only"
    )


def prepare_bus(store: MapStore, endpoint: str, *, insecure: bool) -> "tuple[Bus, BusGuard | None]":
    """Return the server's bus, not yet open, and its guard; None on loopback without TLS, where everything is allowed.

    Raises UsageError as `check_binding`, StateError for TLS in a store without certificates.
    """
    is_open = check_binding(endpoint, insecure=insecure)
    if not has_tls(endpoint):
        if is_open:
            _log.warning("--insecure: at %s anyone can act as any robot or as the server", endpoint)
        return Bus(endpoint, is_server=True), None
    if endpoint.startswith("quic/") and not is_loopback(endpoint):
        _log.warning("at %s one packet of a stranger keeps robots from connecting for 30 s; use tls/", endpoint)
    register = RobotRegister(store)
    tls = register.tls
    register.authorities.check()
    bus = Bus(endpoint, is_server=True, tls=tls, access=register.access())
    return bus, BusGuard(register, bus)


class BusGuard:
    """Reopens the bus after robots were enrolled or revoked, or a certificate was replaced; reports suspicious connections."""

    def __init__(self, register: RobotRegister, bus: Bus, clock_s: Callable[[], float] = time.monotonic) -> None:
        self.register, self._bus, self._clock_s = register, bus, clock_s
        self.access = register.access()
        self._state, self._tls_state = register.state(), register.tls_state()
        self._told: frozenset[str] = frozenset()
        self._twice_s: dict[tuple[str, str], float] = {}  # start of the second connection of a robot (site, name)
        self.copied: frozenset[tuple[str, str]] = frozenset()
        self._refusals = LogLimit(_log)
        self._due_s = 0.0

    def follow(self) -> bool:
        """Apply all changes since the last call; True if the bus was reopened."""
        state, tls_state = self.register.state(), self.register.tls_state()
        if state == self._state and self._clock_s() < self._due_s:
            return False
        self._due_s = self._clock_s() + _RULES_EVERY_S
        access = self.register.access()
        # A renewal changes the register and neither of these; the previous certificate just expires.
        is_changed = access != self.access or tls_state != self._tls_state
        if is_changed:
            self._bus.reopen(access)
            _log.info("the bus was reopened for %d robots", len(access.robots))
        self._state, self._tls_state, self.access = state, tls_state, access
        return is_changed

    def look(self) -> list[str]:
        """Return suspicious connections, and log new ones: unknown certificates, one certificate on two machines.

        `copied` names the latter's robots; the connections of all servers of the store count. A robot that lost its connection counts
        twice until the old lease ends; only a longer double connection is reported. Raises StoreError.
        """
        here, now_s, before = self._bus.certificates(), self._clock_s(), self.copied
        unknown = (name[:64] for name in here if self.access.holder(name) is None)
        found = [f"certificate {name!r} is connected but not enrolled; it may send nothing" for name in unknown]
        sessions: Counter[tuple[str, str]] = Counter()
        for name in (*here, *self.register.store.files.connected(here)):
            if (holder := self.access.holder(name)) is not None and holder.robot:
                sessions[holder.site, holder.robot] += 1
        self._twice_s = {who: self._twice_s.get(who, now_s) for who, count in sessions.items() if count > 1}
        self.copied = frozenset(who for who, since_s in self._twice_s.items() if now_s - since_s >= COPIED_AFTER_S)
        for site, robot in self.copied:
            found.append(
                f"robot {robot} of site {site} is connected {sessions[site, robot]} times; if no second program runs on it, its "
                f"certificate was copied: `mapserver robots revoke {robot} --site {site}`, and enrol it again"
            )
        for words in sorted(frozenset(found) - self._told):
            self._refusals.warning(words, "%s", words)
        for site, robot in self.copied - before:
            self.register.store.audit("robot connected twice", f"{robot}: was its certificate copied?", site=site)
        self._told = frozenset(found)
        return found
