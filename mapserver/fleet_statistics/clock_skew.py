"""Estimate of a robot's wall clock offset against the server's, from the stamps of its messages. Pure."""

_WINDOW_NS = 60_000_000_000


class ClockSkew:
    """The largest of (robot's stamp - server's clock) over the last one to two minutes: the message with the least delay.

    The remaining error is that delay, a few milliseconds on a local network.
    """

    def __init__(self, ahead_s: float | None = None) -> None:
        """ahead_s: earlier estimate, used until the first message."""
        self._known_s = ahead_s if isinstance(ahead_s, int | float) else None
        self._begun_ns: int | None = None
        self._best_ns: list[int | None] = [None, None]

    def take(self, robot_ns: int, server_ns: int) -> None:
        ahead_ns = robot_ns - server_ns
        if self._begun_ns is None or not 0 <= server_ns - self._begun_ns < _WINDOW_NS:
            # Differences to a clock that was set back are invalid.
            is_set_back = self._begun_ns is not None and server_ns < self._begun_ns
            self._begun_ns = server_ns
            self._best_ns = [None, None if is_set_back else self._best_ns[0]]
        newest = self._best_ns[0]
        self._best_ns[0] = ahead_ns if newest is None else max(newest, ahead_ns)

    @property
    def ahead_s(self) -> float | None:
        """Seconds that the robot's clock is ahead; negative if it is late, None if unknown."""
        known = [best for best in self._best_ns if best is not None]
        return max(known) / 1e9 if known else self._known_s


def server_time_ns(robot_ns: int, ahead_s: float | None, now_ns: int, oldest_ns: int) -> int:
    """Return a robot's stamp on the server's clock: at most now; now if the robot's clock cannot be right."""
    happened_ns = robot_ns - round((ahead_s or 0.0) * 1e9)
    return min(now_ns, happened_ns) if happened_ns >= oldest_ns else now_ns
