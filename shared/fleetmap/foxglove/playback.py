"""Playback that a viewer controls: messages by time, played, paused, faster, slower, and from anywhere."""

import threading
from bisect import bisect_right, insort
from collections.abc import Iterator
from enum import Enum
from heapq import merge
from math import isfinite
from typing import NamedTuple

from fleetmap.foxglove.channels import Shown

_FASTEST = 100.0


class PlaybackPhase(Enum):
    """By the names of Foxglove's protocol. BUFFERING: what comes next is not known yet."""

    PLAYING = "Playing"
    PAUSED = "Paused"
    BUFFERING = "Buffering"
    ENDED = "Ended"


class PlaybackPoint(NamedTuple):
    """Where a player is; speed: seconds of the recording in one of the viewer."""

    phase: PlaybackPhase
    at_ns: int
    speed: float


class Timeline:
    """What is to be shown from first_ns to last_ns. It grows while a replay goes on; thread-safe."""

    def __init__(self, first_ns: int, last_ns: int) -> None:
        self.first_ns, self.last_ns = first_ns, last_ns
        self._known_ns = first_ns - 1
        self._topics: dict[str, list[Shown]] = {}
        self._lock = threading.Lock()

    @property
    def known_ns(self) -> int:
        """Until when nothing is missing."""
        return self._known_ns

    def add(self, shown: Shown) -> None:
        """One more message, at or after first_ns."""
        with self._lock:
            insort(self._topics.setdefault(shown.topic, []), shown, key=_stamp)

    def know_until(self, stamp_ns: int) -> None:
        """Nothing is missing until then."""
        self._known_ns = max(self._known_ns, stamp_ns)

    def finish(self) -> None:
        """Nothing more comes."""
        with self._lock:
            ends = [entries[-1].stamp_ns for entries in self._topics.values()]
        self._known_ns = self.last_ns = max(ends, default=self.first_ns)

    def between(self, after_ns: int, until_ns: int) -> Iterator[Shown]:
        """Messages after one moment until another, in order."""
        with self._lock:
            found = [
                each[bisect_right(each, after_ns, key=_stamp) : bisect_right(each, until_ns, key=_stamp)]
                for each in self._topics.values()
            ]
        return merge(*found, key=_stamp)

    def latest(self, until_ns: int) -> list[Shown]:
        """The last message of each topic until a moment: what stands there then."""
        with self._lock:
            ends = [(each, bisect_right(each, until_ns, key=_stamp)) for each in self._topics.values()]
        return sorted((each[end - 1] for each, end in ends if end), key=_stamp)


def _stamp(shown: Shown) -> int:
    return shown.stamp_ns


class Player:
    """Goes through a timeline with the clock that it is given, paused at first; thread-safe."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self._at_ns, self._speed, self._plays, self._has_jumped = timeline.first_ns, 1.0, False, True
        self._looked_s: float | None = None
        self._lock = threading.Lock()

    @property
    def point(self) -> PlaybackPoint:
        """Where it is."""
        timeline, at_ns = self.timeline, self._at_ns
        if at_ns >= timeline.last_ns <= timeline.known_ns:
            phase = PlaybackPhase.ENDED
        elif not self._plays:
            phase = PlaybackPhase.PAUSED
        else:
            phase = PlaybackPhase.PLAYING if at_ns < timeline.known_ns else PlaybackPhase.BUFFERING
        return PlaybackPoint(phase, at_ns, self._speed)

    def control(self, *, plays: bool, speed: float, seek_ns: int | None) -> PlaybackPoint:
        """What a viewer asks for.

        A moment outside is the nearest inside, a speed that is none changes nothing; from the end it plays from the beginning.
        """
        with self._lock:
            if isfinite(speed) and speed > 0:
                self._speed = min(speed, _FASTEST)
            if seek_ns is None and plays and self.point.phase is PlaybackPhase.ENDED:
                seek_ns = self.timeline.first_ns
            if seek_ns is not None:
                self._at_ns = min(max(seek_ns, self.timeline.first_ns), self.timeline.last_ns)
                self._has_jumped = True
            self._plays = plays
            return self.point

    def advance(self, now_s: float) -> list[Shown]:
        """What is to be shown since the last call: what stands there after a jump, else what became due."""
        with self._lock:
            passed_s = 0.0 if self._looked_s is None else now_s - self._looked_s
            self._looked_s = now_s
            if self._has_jumped:
                if self._at_ns > self.timeline.known_ns:
                    return []
                self._has_jumped = False
                return self.timeline.latest(self._at_ns)
            if not self._plays:
                return []
            after_ns = self._at_ns
            due_ns = min(after_ns + int(passed_s * 1e9 * self._speed), self.timeline.known_ns)
            self._at_ns = max(after_ns, due_ns)
            return list(self.timeline.between(after_ns, self._at_ns))
