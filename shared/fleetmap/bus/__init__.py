"""The bus between server and robots."""

from fleetmap.bus.endpoints import TlsFiles, check_endpoint, handshake_fault, has_tls, is_loopback
from fleetmap.bus.zenoh_bus import MAX_MESSAGE_BYTES, Answer, Bus, Handle, LatchedPublisher, Listen

__all__ = [
    "MAX_MESSAGE_BYTES",
    "Answer",
    "Bus",
    "Handle",
    "LatchedPublisher",
    "Listen",
    "TlsFiles",
    "check_endpoint",
    "handshake_fault",
    "has_tls",
    "is_loopback",
]
