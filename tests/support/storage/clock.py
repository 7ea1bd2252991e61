"""A clock that tests set."""

from dataclasses import dataclass


@dataclass
class Clock:
    """Nanoseconds since 1970, as a store and a fleet ask for them."""

    now_ns: int = 10**18

    def __call__(self) -> int:
        return self.now_ns
