"""Token buckets: a rate limit for each of many keys."""

import threading
from collections.abc import Callable, Hashable

_MAX_KEYS = 20_000
_SEARCHED_EVERY_NS = 1_000_000_000


class RateLimit:
    """`burst` events at once per key, then `per_s` per second; methods may be called from any thread.

    Keys with a full bucket are dropped; beyond the maximum number of keys, new ones are refused.
    """

    def __init__(self, burst: float, per_s: float, clock_ns: Callable[[], int]) -> None:
        self._burst, self._per_ns, self._clock_ns = burst, per_s * 1e-9, clock_ns
        self._lock = threading.Lock()
        self._buckets: dict[Hashable, tuple[float, int]] = {}
        self._searched_ns: int | None = None

    def admits(self, key: Hashable) -> bool:
        now_ns = self._clock_ns()
        with self._lock:
            if key not in self._buckets and len(self._buckets) >= _MAX_KEYS:
                if self._searched_ns is None or abs(now_ns - self._searched_ns) >= _SEARCHED_EVERY_NS:
                    self._forget(now_ns)
                if len(self._buckets) >= _MAX_KEYS:
                    return False
            level, then_ns = self._buckets.get(key, (self._burst, now_ns))
            level = min(self._burst, level + max(0, now_ns - then_ns) * self._per_ns)
            self._buckets[key] = (max(0.0, level - 1.0) if level >= 1.0 else level, now_ns)
            return level >= 1.0

    def _forget(self, now_ns: int) -> None:
        """Drop full buckets: a missing key counts as full."""
        self._searched_ns = now_ns
        self._buckets = {
            key: (level, then_ns)
            for key, (level, then_ns) in self._buckets.items()
            if level + abs(now_ns - then_ns) * self._per_ns < self._burst
        }
