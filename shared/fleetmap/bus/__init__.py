"""The bus between server and robots: `Bus` is the contract, `ZenohBus` the network."""

from fleetmap.bus.endpoints import check_endpoint, has_tls, is_loopback
from fleetmap.bus.protocol import MAX_MESSAGE_BYTES, Answer, Bus, Handle, LatchedPublisher, Listen
from fleetmap.bus.robot_questions import RobotQuestions
from fleetmap.bus.tls import TlsFiles, handshake_fault
from fleetmap.bus.zenoh_bus import ZenohBus

__all__ = [
    "MAX_MESSAGE_BYTES",
    "Answer",
    "Bus",
    "Handle",
    "LatchedPublisher",
    "Listen",
    "RobotQuestions",
    "TlsFiles",
    "ZenohBus",
    "check_endpoint",
    "handshake_fault",
    "has_tls",
    "is_loopback",
]
