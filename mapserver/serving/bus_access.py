"""Admission to the bus: which endpoint a server may listen on, and rules that follow the enrolled robots while it runs."""

import logging
import time
from collections import Counter
from collections.abc import Callable

from fleetmap.bus import Bus, has_tls, is_loopback
from fleetmap.errors import UsageError
from fleetmap.log_lines import LogLimit
from mapserver.store import MapStore
from mapserver.trust.enrolment import RobotRegister

COPIED_AFTER_S = 20.0  # zenoh's lease is 10 s: so long a connection that broke is still counted
_RULES_EVERY_S = 60.0  # certificates end with time
_log = logging.getLogger(__name__)


def check_binding(endpoint: str, *, insecure: bool) -> bool:
    """Whether other machines reach an endpoint that tells nobody apart; UsageError for one, unless that is wanted."""
    if has_tls(endpoint) or is_loopback(endpoint):
        return False
    if insecure:
        return True
    raise UsageError(
        f"--zenoh {endpoint}: whoever reaches it could speak as any robot, and answer robots in the server's place. Listen with mutual "
        f"TLS: `mapserver trust init --here --host NAME --store DIR`, then --zenoh tls/{endpoint.partition('/')[2]}, and enrol the "
        "robots; --insecure is for a network that nobody else can reach"
    )


def prepare_bus(store: MapStore, endpoint: str, *, insecure: bool) -> "tuple[Bus, BusGuard | None]":
    """The server's bus, not open yet, and who keeps its rules; nobody on loopback without TLS, where everything is allowed.

    Raises UsageError as `check_binding`, StateError for TLS in a store without certificates.
    """
    is_open = check_binding(endpoint, insecure=insecure)
    if not has_tls(endpoint):
        if is_open:
            _log.warning("--insecure: at %s anybody can speak as any robot, and answer in the server's place", endpoint)
        return Bus(endpoint, is_server=True), None
    register = RobotRegister(store)
    tls = register.tls
    register.authorities.check()
    bus = Bus(endpoint, is_server=True, tls=tls, access=register.access())
    return bus, BusGuard(register, bus)


class BusGuard:
    """Opens the bus anew when robots were enrolled or revoked, or a certificate was replaced; says who is there and should not be."""

    def __init__(self, register: RobotRegister, bus: Bus, clock_s: Callable[[], float] = time.monotonic) -> None:
        self.register, self._bus, self._clock_s = register, bus, clock_s
        self.access = register.access()
        self._state, self._tls_state = register.state(), register.tls_state()
        self._told: frozenset[str] = frozenset()
        self._twice_s: dict[tuple[str, str], float] = {}  # since when a robot (site, name) has more than one connection
        self.copied: frozenset[tuple[str, str]] = frozenset()
        self._audited = self.copied
        self._refusals = LogLimit(_log)
        self._due_s = 0.0

    def follow(self) -> bool:
        """Takes what changed since the last call, all of it at once; whether the bus was opened anew."""
        state, tls_state = self.register.state(), self.register.tls_state()
        if state == self._state and self._clock_s() < self._due_s:
            return False
        self._due_s = self._clock_s() + _RULES_EVERY_S
        access = self.register.access()
        # A renewal changes the register and neither of these; the certificate before ends with time alone.
        is_changed = access != self.access or tls_state != self._tls_state
        if is_changed:
            self._bus.reopen(access)
            _log.info("the bus was opened anew for %d robots", access.robot_count)
        self._state, self._tls_state, self.access = state, tls_state, access
        return is_changed

    def look(self) -> list[str]:
        """What is odd about who is connected now, also into the log when it is new: unknown certificates, one on two machines.

        `copied` names the latter's robots. A robot that lost its connection counts twice until the old one's lease is over; who counts
        twice for longer is no such.
        """
        found, now_s = [], self._clock_s()
        sessions: Counter[tuple[str, str]] = Counter()
        for name in self._bus.certificates():
            holder = self.access.holder(name)
            if holder is None:
                found.append(f"certificate {name[:64]!r} is connected and not enrolled; it may say nothing")
            elif holder.robot:
                sessions[holder.site, holder.robot] += 1
        self._twice_s = {who: self._twice_s.get(who, now_s) for who, count in sessions.items() if count > 1}
        self.copied = frozenset(who for who, since_s in self._twice_s.items() if now_s - since_s >= COPIED_AFTER_S)
        for site, robot in self.copied:
            found.append(
                f"robot {robot} of site {site} is connected {sessions[site, robot]} times; if no second program runs on it, its "
                f"certificate was copied: `mapserver robots revoke {robot} --site {site}`, and enrol it anew"
            )
        for words in sorted(frozenset(found) - self._told):
            self._refusals.warning(words, "%s", words)
        for site, robot in self.copied - self._audited:
            self.register.note_copied(site, robot)
        self._told, self._audited = frozenset(found), self.copied
        return found
