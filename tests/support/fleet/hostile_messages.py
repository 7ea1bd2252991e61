"""Messages with every field filled, and with each number replaced by one that no sender means."""

import inspect
import math
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import msgspec
import pytest
from msgspec import inspect as types

from fleetmap.encoding import MOST
from fleetmap.errors import FleetmapError
from fleetmap.messages import decode_message

FLOATS = (math.inf, -math.inf, math.nan, 1e308, -1e308)
INTEGERS = (1 << 63, (1 << 64) - 1)
EXTREMES = (MOST, -MOST), ((1 << 63) - 1, -(1 << 63), 0)
NAMES = {"site": "lab", "robot": "r1", "quat_wxyz": [1.0, 0.0, 0.0, 0.0], "version": 1}


def structs_of(*modules: ModuleType) -> list[type[msgspec.Struct]]:
    """The messages that modules define."""
    return [
        kind
        for module in modules
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, msgspec.Struct) and kind.__module__ == module.__name__
    ]


def whole(kind: types.Type, name: str = "") -> Any:
    """A plain value of a type with all of its fields."""
    match kind:
        case _ if name in NAMES:
            return NAMES[name]
        case types.StructType():
            values = [whole(field.type, field.name) for field in kind.fields]
            return values if kind.array_like else dict(zip((f.name for f in kind.fields), values, strict=True))
        case types.UnionType():
            return whole(kind.types[0], name)
        case types.TupleType():
            return [whole(item) for item in kind.item_types]
        case types.ListType() | types.VarTupleType():
            return [whole(kind.item_type)] * (kind.min_length or 1)
        case types.DictType():
            return {"k": whole(kind.value_type)}
    usual = {types.IntType: 1, types.StrType: "x", types.BytesType: b"\xff\xd8\xff\xd9", types.BoolType: True}
    return usual.get(type(kind), 0.5)


def spoiled(value: Any, floats: tuple[float, ...] = FLOATS, integers: tuple[int, ...] = INTEGERS) -> Iterator[Any]:
    """The value with each of its numbers replaced by each hostile one."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else list(enumerate(value)):
            for other in spoiled(item, floats, integers):
                changed = value.copy()
                changed[key] = other
                yield changed
    elif isinstance(value, float | int) and not isinstance(value, bool):
        yield from floats if isinstance(value, float) else (*floats, *integers)


def extremes(kind: type[msgspec.Struct]) -> Iterator[bytes]:
    """Encoded messages, each with one number at the end of what it may be."""
    return map(msgspec.msgpack.encode, spoiled(whole(types.type_info(kind)), *EXTREMES))


def check_refusals(kind: type[msgspec.Struct]) -> None:
    """Every number that none can mean is refused where it is decoded."""
    plain = whole(types.type_info(kind))
    decode_message(msgspec.msgpack.encode(plain), kind)
    for changed in spoiled(plain):
        with pytest.raises(FleetmapError):
            decode_message(msgspec.msgpack.encode(changed), kind)
            pytest.fail(f"{changed} was taken")
