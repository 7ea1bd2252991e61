"""Admission to the bus: which endpoint a server may listen on, and rules that follow the enrolled robots while it runs."""

import logging
from collections import Counter

from fleetmap.bus import MemoryBus, ZenohBus, has_tls, is_loopback
from fleetmap.errors import UsageError
from fleetmap.log_lines import LogLimit
from mapserver.store import MapStore
from mapserver.trust.enrolment import RobotRegister

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


def prepare_bus(store: MapStore, endpoint: str, *, insecure: bool) -> "tuple[ZenohBus, BusGuard | None]":
    """The server's bus, not open yet, and who keeps its rules; nobody on loopback without TLS, where everything is allowed.

    Raises UsageError as `check_binding`, StateError for TLS in a store without certificates.
    """
    is_open = check_binding(endpoint, insecure=insecure)
    if not has_tls(endpoint):
        if is_open:
            _log.warning("--insecure: at %s anybody can speak as any robot, and answer in the server's place", endpoint)
        return ZenohBus(endpoint, is_server=True), None
    register = RobotRegister(store)
    bus = ZenohBus(endpoint, is_server=True, tls=register.tls, access=register.access())
    return bus, BusGuard(register, bus)


class BusGuard:
    """Opens the bus anew when robots were enrolled or revoked, or a certificate was replaced; says who is there and should not be."""

    def __init__(self, register: RobotRegister, bus: ZenohBus | MemoryBus) -> None:
        self.register, self._bus = register, bus
        self.access = register.access()
        self._state, self._tls_state = register.state(), register.tls_state()
        self._told: frozenset[str] = frozenset()
        self._refusals = LogLimit(_log)

    def follow(self) -> bool:
        """Takes what changed since the last call, all of it at once; whether the bus was opened anew."""
        state, tls_state = self.register.state(), self.register.tls_state()
        if state == self._state:
            return False
        access = self.register.access()
        # A renewal changes the register and neither of these.
        is_changed = access != self.access or tls_state != self._tls_state
        if is_changed:
            self._bus.reopen(access)
            _log.info("the bus was opened anew for %d robots", access.robot_count)
        self._state, self._tls_state, self.access = state, tls_state, access
        return is_changed

    def look(self) -> list[str]:
        """What is odd about who is connected now, also into the log when it is new: unknown certificates, one on two machines."""
        found = []
        for name, count in Counter(self._bus.certificates()).items():
            holder = self.access.holder(name)
            if holder is None:
                found.append(f"certificate {name[:64]!r} is connected and not enrolled; it may say nothing")
            elif count > 1 and holder.robot:
                found.append(
                    f"robot {holder.robot} of site {holder.site} is connected {count} times; was its certificate copied?"
                )
        for words in sorted(frozenset(found) - self._told):
            self._refusals.warning(words, "%s", words)
        self._told = frozenset(found)
        return found
