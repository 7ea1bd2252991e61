"""Whatever computed a value, what is written holds Python's: all messages and records, calibrations, and every place that writes."""

import importlib
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import inspect

from fleetmap.config import Section
from fleetmap.encoding import to_json, to_msgpack, to_plain
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise
from support.fleet.contracts_documents import REPOSITORY

ROOMS = "shared", "locclient", "mapserver"
SOURCES = [path for room in ROOMS for path in sorted((REPOSITORY / room).rglob("*.py"))]
# Texts and whole numbers in a form that a hash or another program's parser asks for.
OWN_JSON = {"database.py", "kernel_cache.py", "zenoh_bus.py", "keys.py"}


def records() -> list[type[msgspec.Struct]]:
    """Every record of the three packages, without settings, which nothing computes."""
    for path in SOURCES:
        if "(msgspec.Struct" in path.read_text("utf-8"):
            module = ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
            importlib.import_module(module.removeprefix("shared."))
    found, waiting = [], [msgspec.Struct]
    while waiting:
        kinds = [kind for kind in waiting.pop().__subclasses__() if kind is not Section]
        waiting += kinds
        found += [kind for kind in kinds if kind.__module__.split(".")[0] in {"fleetmap", "locclient", "mapserver"}]
    return sorted(set(found), key=lambda kind: (kind.__module__, kind.__name__))


PLAIN: dict[type, Any] = {
    inspect.IntType: np.int64(3), inspect.FloatType: np.float64(0.1), inspect.BoolType: np.True_, inspect.StrType: np.str_("name"),
    inspect.AnyType: np.arange(6.0).reshape(2, 3),
}  # fmt: skip


def value_of(kind: Any, *, from_numpy: bool) -> Any:
    """A value of this type as numpy would leave it, or the same as Python's."""
    again = lambda inner: value_of(inner, from_numpy=from_numpy)  # noqa: E731
    if type(kind) in PLAIN:
        value = PLAIN[type(kind)]
        return value if from_numpy else value.tolist()
    match kind:
        case inspect.UnionType():
            return again(next(one for one in kind.types if not isinstance(one, inspect.NoneType)))
        case inspect.ListType() | inspect.VarTupleType():
            return [again(kind.item_type)] * 2
        case inspect.TupleType():
            return tuple(map(again, kind.item_types))
        case inspect.DictType():
            return {"key": again(kind.value_type)}
        case inspect.StructType():
            return kind.cls(**{field.name: again(field.type) for field in kind.fields})
        case inspect.EnumType():
            return next(iter(kind.cls))
        case inspect.BytesType():
            return b"bytes"
        case _:
            return None


def test_every_record_may_hold_values_that_numpy_left() -> None:
    kinds = records()
    assert len(kinds) > 60
    for kind in kinds:
        given, expected = (value_of(inspect.type_info(kind), from_numpy=numpy) for numpy in (True, False))
        for write in (to_msgpack, to_json, to_plain):
            assert write(given) == write(expected), kind


@pytest.mark.parametrize(
    "value", [np.float32(0.5), np.int32(-4), np.uint8(7), np.bool_(False), np.array([1, 2]), np.array(2.5)]
)
def test_every_scalar_and_array(value: Any) -> None:
    assert to_json({"value": value}) == to_json({"value": value.tolist()})


def test_what_no_encoder_knows_is_named() -> None:
    with pytest.raises(TypeError, match=r"pathlib\.\w+ cannot be written"):
        to_json({"path": Path("x")})


def test_calibrations_hold_python_numbers() -> None:
    eye = np.eye(4)
    camera = CameraCalibration("equidistant", np.int64(640), np.float64(480.0), eye[0], eye[1], eye, np.float32(0.25))
    assert [type(value) for value in (camera.width_px, camera.height_px, camera.imu_minus_cam_s)] == [int, int, float]
    assert type(ImuNoise(gyro_noise_radps_rthz=np.float64(1e-3)).gyro_noise_radps_rthz) is float


def test_nothing_is_written_by_another_way() -> None:
    own = r"\bmsgspec\.(json|msgpack)\.encode\((?!record, enc_hook=)"
    other = re.compile(rf"{own}|\bto_builtins\(|\bEncoder\(|\bjson\.dumps?\(")
    found = {path.name for path in SOURCES if other.search(path.read_text("utf-8"))}
    assert found - OWN_JSON == {"encoding.py"}
