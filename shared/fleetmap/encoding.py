"""Encoding of all output: numpy values become Python's, which MessagePack, JSON and databases support; limits of decoded numbers."""

import math
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from fleetmap.errors import FleetmapError, MapFormatError

T = TypeVar("T")
MOST = 1e12
"""Largest magnitude of a stranger's number with decimals: far above any metre or covariance, and its products stay finite."""
_UNIT_WITHIN = 1e-3


def python_value(value: Any) -> Any:
    """Convert a numpy scalar or array to Python; TypeError for any other object, with its type."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__module__}.{type(value).__qualname__} cannot be written; convert it first")


def to_plain(value: object) -> Any:
    """Convert messages, dataclasses and arrays to dicts, lists, strings and numbers, ready for any encoder."""
    return msgspec.to_builtins(value, enc_hook=python_value)


def to_msgpack(value: object) -> bytes:
    """Encode as MessagePack."""
    return msgspec.msgpack.encode(value, enc_hook=python_value)


def to_json(value: object, *, indent: int = 0, order: Literal["deterministic", "sorted"] | None = None) -> bytes:
    """Encode as JSON, with null for NaN and infinity. indent: spaces; 0 writes one line. order: of keys, as in msgspec's encoder."""
    data = msgspec.json.encode(value, enc_hook=python_value, order=order)
    return msgspec.json.format(data, indent=indent) if indent else data


def decode_json(data: bytes, kind: type[T], refusal: str, error: type[FleetmapError] = MapFormatError) -> T:
    """Decode JSON as a type; the error for anything else: its text is `refusal`, with the reason in place of {}."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as reason:
        raise error(refusal.replace("{}", str(reason))) from reason


def bounded(value: T) -> T:
    """Return a stranger's decoded value. ValueError, naming the field, for a number in it that is not finite, beyond MOST, or an
    integer beyond 64 bits, and for a quaternion (a struct's `quat_wxyz`) that is not of unit length.
    """
    if isinstance(value, float):
        if not abs(value) <= MOST:
            raise ValueError(f" is {value}, the limit is {MOST:g}")
    elif isinstance(value, int):
        if not -(1 << 63) <= value < 1 << 63:
            raise ValueError(" is an integer of more than 64 bits")
    elif isinstance(value, dict | list | tuple | msgspec.Struct):
        parts: Any = msgspec.structs.asdict(value) if isinstance(value, msgspec.Struct) else value
        for name, item in parts.items() if isinstance(parts, dict) else enumerate(parts):
            try:
                bounded(item)
            except ValueError as error:
                raise ValueError(f".{name}{error}") from None
            if name == "quat_wxyz" and parts is not value and not abs(math.hypot(*item) - 1) <= _UNIT_WITHIN:
                raise ValueError(f".{name} is {item}, not a unit quaternion")
    return value
