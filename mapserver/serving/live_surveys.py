"""Surveys under way: the last state that each site's survey sent."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from fleetmap.live_survey import LiveSurveyState

_MOST_SITES = 32
SILENT_S = 5.0  # surveys tell twice a second while they drive


class LiveSurvey(NamedTuple):
    """A state, and for how long nothing newer has come."""

    state: LiveSurveyState
    seconds_since: float

    @property
    def is_silent(self) -> bool:
        return self.state.phase == "tracking" and self.seconds_since > SILENT_S


class LiveSurveys:
    """Thread-safe; the sites that were heard last, each with its newest state."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._states: dict[str, tuple[LiveSurveyState, float]] = {}
        self._lock = threading.Lock()

    def take(self, state: LiveSurveyState) -> None:
        """Keeps a state; LinkError for arrays that are none, of which nothing is kept."""
        state.path(), state.part_numbers(), state.landmarks(), state.loop_lines(), state.covered()
        with self._lock:
            self._states.pop(state.site, None)
            self._states[state.site] = state, self._clock_s()
            if len(self._states) > _MOST_SITES:
                del self._states[next(iter(self._states))]

    def sites(self) -> list[str]:
        with self._lock:
            return sorted(self._states)

    def of(self, site: str) -> LiveSurvey | None:
        """The site's survey, None where none was heard since the server's start."""
        with self._lock:
            found = self._states.get(site)
            return None if found is None else LiveSurvey(found[0], self._clock_s() - found[1])
