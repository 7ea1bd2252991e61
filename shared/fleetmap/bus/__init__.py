"""The bus between server and robots."""

from fleetmap.bus.endpoints import check_endpoint, has_tls, is_loopback
from fleetmap.bus.tls import TlsFiles, handshake_fault
from fleetmap.bus.zenoh_bus import MAX_MESSAGE_BYTES, Answer, Bus, Handle, LatchedPublisher, Listen, RobotQuestions

__all__ = [
    "MAX_MESSAGE_BYTES",
    "Answer",
    "Bus",
    "Handle",
    "LatchedPublisher",
    "Listen",
    "RobotQuestions",
    "TlsFiles",
    "check_endpoint",
    "handshake_fault",
    "has_tls",
    "is_loopback",
]
