"""What C libraries behind OpenCV print about an image while they decode it: libpng and libjpeg return no errors, they write to stderr."""

import ctypes
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_LOCK = threading.Lock()  # the stream is the process's own
_text, _size = ctypes.c_void_p(), ctypes.c_size_t()
try:
    _LIBC = ctypes.CDLL(None)
    _STDERR = ctypes.c_void_p.in_dll(_LIBC, "stderr")
    _LIBC.open_memstream.restype = ctypes.c_void_p
    _LIBC.rewind.argtypes = _LIBC.fflush.argtypes = [ctypes.c_void_p]
    # Never closed: another thread may still print to it
    _CAUGHT = _LIBC.open_memstream(ctypes.byref(_text), ctypes.byref(_size))
except (
    OSError,
    ValueError,
    AttributeError,
    TypeError,
):  # a system whose C library names it otherwise: nothing is caught
    _CAUGHT = None


def with_messages(decode: Callable[[], T]) -> tuple[T, str]:
    """The result of `decode`, and what C libraries printed meanwhile. Python's own stderr and child processes are left as they are."""
    if not _CAUGHT:
        return decode(), ""
    with _LOCK:
        usual = _STDERR.value
        _LIBC.rewind(_CAUGHT)
        _STDERR.value = _CAUGHT
        try:
            result = decode()
        finally:
            _STDERR.value = usual
        _LIBC.fflush(_CAUGHT)
        said = ctypes.string_at(_text, _size.value).decode("utf-8", "replace") if _size.value else ""
    return result, said
