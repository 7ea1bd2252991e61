"""Capture of decoder messages of the C libraries behind OpenCV: libpng and libjpeg report errors only on stderr."""

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
_text, _size = ctypes.c_void_p(), ctypes.c_size_t()
try:
    _LIBC = ctypes.CDLL(None)
    _STDERR = ctypes.c_void_p.in_dll(_LIBC, "stderr")
    _USUAL = _STDERR.value
    _LIBC.open_memstream.restype = ctypes.c_void_p
    _LIBC.rewind.argtypes = _LIBC.fflush.argtypes = [ctypes.c_void_p]
    # Never closed: another thread may still print to it
    _CAUGHT = _LIBC.open_memstream(ctypes.byref(_text), ctypes.byref(_size))
except (OSError, ValueError, AttributeError, TypeError):
    _CAUGHT = None  # a C library with another symbol name: nothing is captured


def with_messages(decode: Callable[[], T]) -> tuple[T, str]:
    """Return the result of `decode` and the output of C libraries during it. Python's own stderr and child processes are not affected.

    Several threads may decode at once. If one of them has printed, it is unknown which: all of them then decode again, one by one.
    """
    if not _CAUGHT:
        return decode(), ""
    with _stream.caught(alone=False):
        before = _written()
        result = decode()
        if _written() == before:
            return result, ""
    with _stream.caught(alone=True):
        _LIBC.rewind(_CAUGHT)
        result = decode()
        return result, ctypes.string_at(_text, _written()).decode("utf-8", "replace")


def _written() -> int:
    _LIBC.fflush(_CAUGHT)
    return _size.value


class _Stream:
    """The stderr of C libraries, shared by the whole process."""

    def __init__(self) -> None:
        self._turn = threading.Condition()
        self._inside = self._waiting = 0  # threads that capture it, and threads that wait for exclusive use
        self._is_alone = False
        if _CAUGHT:
            _STDERR.value = _USUAL

    @contextmanager
    def caught(self, *, alone: bool) -> Iterator[None]:
        """Redirect it to memory; alone: exclusively for this thread."""
        with self._turn:
            self._waiting += alone
            self._turn.wait_for(lambda: not (self._is_alone or (self._inside if alone else self._waiting)))
            self._waiting -= alone
            if not self._inside:
                _STDERR.value = _CAUGHT
            self._inside, self._is_alone = self._inside + 1, alone
        try:
            yield
        finally:
            with self._turn:
                self._inside, self._is_alone = self._inside - 1, False
                if not self._inside:
                    _STDERR.value = _USUAL
                self._turn.notify_all()


_stream = _Stream()
os.register_at_fork(after_in_child=_stream.__init__)  # type: ignore[misc]  # threads inside the block do not exist in the child
