"""The bus between server and robots: `Bus` is the contract, `ZenohBus` the network, `MemoryBus` the same in one process."""

from fleetmap.bus.memory import MemoryBus, MemoryHub
from fleetmap.bus.protocol import MAX_MESSAGE_BYTES, Answer, Bus, Handle, Listen, key_matches
from fleetmap.bus.zenoh_bus import ZenohBus, check_endpoint, is_loopback

__all__ = [
    "MAX_MESSAGE_BYTES",
    "Answer",
    "Bus",
    "Handle",
    "Listen",
    "MemoryBus",
    "MemoryHub",
    "ZenohBus",
    "check_endpoint",
    "is_loopback",
    "key_matches",
]
