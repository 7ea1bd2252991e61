"""Log lines: one line per message, whatever text robots and browsers send, and a rate limit."""

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType

_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_MINUTE_S = 60.0
_MAX_KEYS = 60  # lines a minute of all keys together: a flood under invented names gets no more


def log_to_stderr(level: int, line_format: str = _FORMAT) -> None:
    """Send the log of this program to stderr, each message as one line."""
    handler = logging.StreamHandler()
    handler.setFormatter(LineFormatter(line_format))
    logging.basicConfig(level=level, handlers=[handler])


def printable(words: str) -> str:
    """Escape unprintable characters as Python does: line breaks, control characters, lone surrogates."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in words)


class LineFormatter(logging.Formatter):
    """Escapes what is not printable; the lines of a traceback are indented, so that none of them begins as a line of the log does."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        return printable(super().formatMessage(record))

    def formatException(  # noqa: N802
        self, ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
    ) -> str:
        """The lines of a traceback."""
        return "\n".join(f"    {printable(line)}" for line in super().formatException(ei).split("\n"))


class LogLimit:
    """Limits the log to one line per key and minute for events caused by clients; methods may be called from any thread."""

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        self._lock = threading.Lock()
        self._begun_s = -_MINUTE_S
        self._counts: dict[str, int] = {}
        self._others = 0

    def warning(self, key: str, words: str, *values: object) -> None:
        """Log the text unless this key has a line in the current minute, or too many other keys have."""
        key = key[:200]
        with self._lock:
            now_s, told = self._clock_s(), ""
            if now_s - self._begun_s >= _MINUTE_S:
                most = sorted(((count, key) for key, count in self._counts.items() if count > 1), reverse=True)[:5]
                parts = [f"{count - 1} more of {key!r}" for count, key in most]
                told = ", ".join([*parts, *([f"{self._others} of further keys"] if self._others else [])])
                self._begun_s, self._counts, self._others = now_s, {}, 0
            if key not in self._counts and len(self._counts) >= _MAX_KEYS:
                self._others += 1
                return
            self._counts[key] = self._counts.get(key, 0) + 1
            is_first = self._counts[key] == 1
        if told:
            self._log.warning("in the minute before: %s", told)
        if is_first:
            self._log.warning(words, *values)
