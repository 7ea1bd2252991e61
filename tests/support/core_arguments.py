"""Arguments for the functions of the compiled core, made from their signatures: plain ones, and any that Python can hand over."""

import functools
import inspect
import re
from collections.abc import Callable
from types import CodeType, SimpleNamespace

import numpy as np
from msgspec.structs import asdict

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.settings import FilterSettings, TrackerSettings
from fleetmap.relocalization.settings import FixSettings

SIZES = 0, 1, 2, 3, 4, 6, 9, 15, 40
INTEGERS = [0, 1, 2, 3, 4, 5, 8, 40, 255, 1 << 15, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 62), (1 << 63) - 1]
REALS = [0.0, 1.0, 0.1, 20.0, 320.0, 2.0**31, 1e18, 1e300, 1e-300, np.inf, np.nan]
SETTINGS = SimpleNamespace(**asdict(FilterSettings()), **asdict(TrackerSettings()))


class Arguments:
    """Arguments for nanobind's signatures, generated from a seed: valid and of one size, or arbitrary."""

    def __init__(self, seed: int, plain_size: int | None = None) -> None:
        """plain_size: that of plain ones, in place of any."""
        self.rng = np.random.default_rng(seed)
        self.size = int(self.rng.choice(SIZES))
        self.malice = self.rng.choice([0.0, 0.03, 0.3])
        # Of arrays with two free sides the second.
        self.widths = [(self.size,), (self.size,), (0, 6), (9, 15)][self.rng.integers(4)]
        self.narrow = int(self.rng.choice([0, 2, 6, self.size]))  # third side
        self.top = int(self.rng.choice([self.size, self.size, 2, 1])) or 1  # above indices
        if plain_size is not None:
            self.size, self.top, self.malice = plain_size, plain_size, 0.0
        self.name = ""

    def is_odd(self) -> bool:
        return bool(self.rng.random() < self.malice)

    def odd(self, numbers: list) -> float | int:  # type: ignore[type-arg]
        return numbers[self.rng.integers(len(numbers))] * (1 if self.rng.random() < 0.6 else -1)

    def integer(self) -> int:
        return self.odd(INTEGERS) if self.is_odd() else int(self.rng.integers(0, self.size + 2))  # type: ignore[return-value]

    def real(self) -> float:
        return self.odd(REALS) if self.is_odd() else self.rng.uniform(0.0, 4.0)

    def array(self, dtype: str, sides: str) -> Array:
        size = self.size + self.name.endswith("starts")
        lengths = [int(self.rng.choice([*SIZES, size + 1])) if self.is_odd() else size for _ in range(3)]
        if self.rng.random() < 0.1 * self.malice:
            lengths[0] = 3000
        shape = [lengths[axis] if side == "*" else int(side) for axis, side in enumerate(sides.split(", "))]
        if sides.endswith(", *") and not self.is_odd():
            shape[-1] = int(self.rng.choice(self.widths)) if len(shape) == 2 else self.narrow
        if dtype.startswith("float"):
            values = self.rng.uniform(0.0, self.rng.choice([1, 1, max(size, 1)]), shape)
            if len(shape) > 1 and shape[-1] == shape[-2]:  # nearly a rotation, or information
                values = np.eye(shape[-1]) + 0.01 * values
        elif self.name.endswith("starts"):
            values = np.sort(self.rng.integers(0, self.size + 1, shape))
            values[:1], values[-1:] = 0, self.size
        elif self.rng.random() < 0.4 and len(shape) == 1:
            values = np.arange(shape[0])
        else:
            values = self.rng.integers(0, self.rng.choice([2, 5, 256]) if dtype == "uint8" else self.top, shape)
        values, strange = values.astype(dtype), self.rng.random(shape) < self.malice / 4
        with np.errstate(all="ignore"):
            odd = [self.odd(REALS if values.dtype.kind == "f" else INTEGERS) for _ in range(int(strange.sum()))]
            values[strange] = np.array(odd, "float64" if values.dtype.kind == "f" else "int64").astype(dtype)
        return np.ascontiguousarray(values)

    def rows(self) -> Callable[..., tuple[Array, ...]]:
        """Image rows of a bundle adjustment."""
        answer = tuple(self.array("float64", sides) for sides in ("*, 4", "*, 4, 3", "*, 4, *", "*, 3"))
        return lambda *_: answer

    def of(self, function: object) -> list[object]:
        words = {
            "array": self.array,
            "whole": self.integer,
            "real": self.real,
            "some": lambda: bool(self.rng.random() < 0.5),
            "several": lambda *parts: parts,
            "rows": self.rows,
            "thrice": lambda one: [one] * 3,
            "given": lambda: {"fix": FixSettings(), "stereo": StereoSettings()}.get(self.name, SETTINGS),
        }
        made: list[object] = []
        for self.name, code in asked(function):
            made.append(eval(code, words))
        return made


# Of nanobind's types, what Arguments.of makes for them.
MAKERS = {
    r"ndarray\[dtype=(\w+), shape=\(([^)]*)\)[^\]]*\]": r"array('\1', '\2')",
    r"collections\.abc\.Sequence\[": "thrice(",
    r"collections\.abc\.Callable": "rows()",
    r"tuple\[": "several(",
    r"\]": ")",
    r" \| None": " if some() else None",
    r"\bint\b": "whole()",
    r"\bfloat\b": "real()",
    r"\bbool\b(?!')": "some()",
    r"\bobject\b": "given()",
}


@functools.cache
def asked(function: object) -> list[tuple[str, CodeType]]:
    """Names of a function's arguments and their generators, by the signature in its docstring."""
    signature = (inspect.getdoc(function) or "").splitlines()[0]
    for kind, maker in MAKERS.items():
        signature = re.sub(kind, maker, signature)
    found = re.fullmatch(r"\w+\((?:self(?:, )?)?(.*)\) -> .*", signature)
    assert found, signature
    arguments = [argument.partition(": ") for argument in re.split(r", (?=\w+: )", found[1]) if argument]
    return [(name, compile(kind.partition(" = ")[0], name, "eval")) for name, _, kind in arguments]
