"""A robot's questions for maps, asked in its own name, so that the server can serve robots in turn."""

import time
from collections.abc import Callable
from contextlib import suppress

from fleetmap.bus.protocol import Bus
from fleetmap.errors import UnreachableError
from fleetmap.messages import own_map_key

_AGAIN_AFTER_S = 600.0


class RobotQuestions:
    """Asks under the robot's own keys; a server of before, which is silent there, under the ones that all robots share."""

    def __init__(self, bus: Bus, robot: str, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._bus, self._robot, self._clock_s = bus, robot, clock_s
        self._shared_until_s = 0.0

    def get(self, key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """As Bus.get, with the shared key."""
        if self._clock_s() >= self._shared_until_s:
            with suppress(UnreachableError):
                return self._bus.get(own_map_key(key, self._robot), payload, timeout_s=timeout_s)
        answer = self._bus.get(key, payload, timeout_s=timeout_s)
        self._shared_until_s = self._clock_s() + _AGAIN_AFTER_S
        return answer
