"""Encoding of all output: numpy values become Python's, which MessagePack, JSON and databases support."""

from typing import Any, Literal

import msgspec
import numpy as np


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
