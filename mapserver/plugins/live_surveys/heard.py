"""Live surveys: the last received state of each site's survey."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from fleetmap.errors import LinkError
from fleetmap.mapformat.names import check_name
from fleetmap.messages import decode_message, split_key
from mapserver.plugins.live_surveys.message import LiveSurveyState

_MOST_SITES = 32
SILENT_S = 5.0  # surveys report twice a second during the drive


class LiveSurvey(NamedTuple):
    """A state, the time since it was received, and its number: of all states that differ from the one before."""

    state: LiveSurveyState
    seconds_since: float
    number: int

    @property
    def is_silent(self) -> bool:
        return self.state.phase == "tracking" and self.seconds_since > SILENT_S


class LiveSurveys:
    """Thread-safe; the latest sites, each with its newest state."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._states: dict[str, tuple[LiveSurveyState, float, int]] = {}
        self._last_number = 0
        self._lock = threading.Lock()

    def hear(self, key: str, payload: bytes) -> None:
        """Store a survey's message; LinkError for one that is invalid, or of another site than its key."""
        site, _, _ = split_key(key)
        state = decode_message(payload, LiveSurveyState)
        if state.site != check_name(site, "site"):
            raise LinkError(f"a survey of {state.site[:64]!r} under the key of another site; check its sender")
        self.take(state)

    def take(self, state: LiveSurveyState) -> None:
        """Store a state; LinkError for invalid arrays, which are not stored."""
        state.path(), state.part_numbers(), state.landmarks(), state.loop_lines(), state.covered()
        with self._lock:
            before = self._states.pop(state.site, None)
            is_new = before is None or before[0] != state
            self._last_number += is_new
            number = self._last_number if is_new or before is None else before[2]
            self._states[state.site] = state, self._clock_s(), number
            if len(self._states) > _MOST_SITES:
                del self._states[next(iter(self._states))]

    def sites(self) -> list[str]:
        with self._lock:
            return sorted(self._states)

    def of(self, site: str) -> LiveSurvey | None:
        """Return the site's survey, None if none was received since the server's start."""
        with self._lock:
            found = self._states.get(site)
            return None if found is None else LiveSurvey(found[0], self._clock_s() - found[1], found[2])
