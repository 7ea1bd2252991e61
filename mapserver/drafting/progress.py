"""Progress of a build: bars on a terminal, one line for each stage elsewhere; and the seconds of each stage."""

from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


class StageTimes:
    """Seconds of each stage, from calls (stage, done, total) and the time between them.

    The time before a call counts for the previous call's stage, unless that was finished and another one has begun.
    """

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self.seconds: dict[str, float] = {}
        self._clock_s, self._last_s = clock_s, clock_s()
        self._stage, self._finished = "", True

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Record that `done` of `total` parts of a stage are done."""
        self._spend(stage if self._finished and done > 0 else self._stage or stage)
        self._stage, self._finished = stage, done >= total

    def begin(self, stage: str) -> None:
        """End the current stage and begin another one without further calls."""
        self._spend(self._stage or stage)
        self._stage, self._finished = stage, False

    def _spend(self, stage: str) -> None:
        now_s = self._clock_s()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now_s - self._last_s
        self._last_s = now_s


class ProgressView(Progress):
    """Shows calls (stage, done, total) on a console until it is closed."""

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description:<18}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._shown, self._bars = "", dict[str, TaskID]()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` parts of a stage are done."""
        if self.console.is_terminal:
            if stage not in self._bars:
                self._bars[stage] = self.add_task(stage, total=total)
            if self._shown and stage != self._shown:  # "matching again" occurs twice: close the previous bar
                last = self.tasks[self._bars[self._shown]]
                self.update(last.id, completed=last.total)
            self.update(self._bars[stage], completed=done, total=total)
        elif stage != self._shown:
            self.console.print(f"{stage}: {total}" if total > 1 else stage, markup=False, highlight=False)
        self._shown = stage
