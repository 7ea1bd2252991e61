"""What C libraries behind OpenCV print about an image while they decode it: libpng and libjpeg return no errors, they write to stderr."""

import ctypes
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_LOCK = threading.Lock()  # the stream is the process's own
try:
    _LIBC = ctypes.CDLL(None)
    _STDERR = ctypes.c_void_p.in_dll(_LIBC, "stderr")
    _LIBC.open_memstream.restype = ctypes.c_void_p
    _LIBC.fclose.argtypes = _LIBC.free.argtypes = [ctypes.c_void_p]
except (
    OSError,
    ValueError,
    AttributeError,
    TypeError,
):  # a system whose C library names it otherwise: nothing is caught
    _LIBC = None  # type: ignore[assignment]


def with_messages(decode: Callable[[], T]) -> tuple[T, str]:
    """The result of `decode`, and what C libraries printed meanwhile. Python's own stderr and child processes are left as they are."""
    if _LIBC is None:
        return decode(), ""
    text, size = ctypes.c_void_p(), ctypes.c_size_t()
    with _LOCK:
        stream, usual = _LIBC.open_memstream(ctypes.byref(text), ctypes.byref(size)), _STDERR.value
        if not stream:
            return decode(), ""
        _STDERR.value = stream
        try:
            result = decode()
        finally:
            _STDERR.value = usual
            _LIBC.fclose(stream)
            said = ctypes.string_at(text, size.value).decode("utf-8", "replace")
            _LIBC.free(text)
    return result, said
