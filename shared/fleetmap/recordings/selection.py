"""Selection of a recording's frames, A:B:C."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError
from fleetmap.recordings.recording import Recording


@dataclass(frozen=True, slots=True)
class FrameSelection:
    """A slice of the frame indices with Python's meaning; the default takes all."""

    start: int | None = None
    stop: int | None = None
    step: int = 1

    @classmethod
    def parse(cls, text: str) -> "FrameSelection":
        """The selection written `A:B:C`, each part may be left out.

        UsageError for anything else and for steps below 1.
        """
        parts = text.strip().split(":")
        try:
            start, stop, step = (int(part) if part.strip() else None for part in (*parts, "", "")[:3])
        except ValueError:
            parts = []
        if not 2 <= len(parts) <= 3:
            raise UsageError(
                f"--frames {text!r} is no A:B:C slice of frame numbers; write for example 0:600:2, 100: or ::2"
            )
        if step is not None and step < 1:
            raise UsageError(f"--frames {text!r}: the step {step} must be 1 or more; use --reverse to play backwards")
        return cls(start, stop, step or 1)

    def apply(self, recording: Recording) -> NDArray[np.int64]:
        """The selected frame indices (K,), increasing; UsageError where none is left."""
        indices = np.arange(len(recording), dtype=np.int64)[self.start : self.stop : self.step]
        if len(indices) == 0:
            raise UsageError(f"--frames {self} selects none of the {len(recording)} frames of {recording.path}")
        return indices

    def __str__(self) -> str:
        start, stop = ("" if v is None else str(v) for v in (self.start, self.stop))
        return f"{start}:{stop}:{self.step}"
