"""Arguments for the functions of the compiled core, made from their signatures: plain ones, and any that Python can hand over."""

import functools
import inspect
import re
from collections.abc import Callable, Iterator
from functools import partial
from types import CodeType, SimpleNamespace
from typing import Any

import numpy as np
from msgspec.structs import asdict

from fleetmap import _core  # type: ignore[attr-defined]
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.settings import FilterSettings, TrackerSettings
from fleetmap.pnp.pnp import REFINEMENT
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
        lengths = [
            int(self.rng.choice([*SIZES, size + 1])) if self.is_odd() else size
            for _ in range(max(3, sides.count(",") + 1))
        ]
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
        answer = tuple(self.array("float64", sides) for sides in ("*, 4", "*, 4, 3", "*, 4, *", "*, 3", "4"))
        return lambda *_: answer

    def of(self, function: object) -> list[object]:
        words = {
            "array": self.array, "whole": self.integer, "real": self.real, "rows": self.rows,
            "some": lambda: bool(self.rng.random() < 0.5),
            "several": lambda *parts: tuple(None if self.malice and self.is_odd() else part for part in parts),
            "thrice": lambda one: [one] * 3,
            "given": lambda: {"fix": FixSettings(), "stereo": StereoSettings()}.get(self.name, SETTINGS),
        }  # fmt: skip
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


def callables(held: object) -> dict[str, Any]:
    names = (name for name in dir(held) if name == "__init__" or not name.startswith("_"))
    return {name: getattr(held, name) for name in names if callable(getattr(held, name))}


MEMBERS = callables(_core)
CLASSES = {name: member for name, member in MEMBERS.items() if isinstance(member, type)}
CALLS = MEMBERS.keys() - CLASSES | {f"{name}.{method}" for name, kind in CLASSES.items() for method in callables(kind)}
NUMBER, SINGLES = np.zeros(1, np.int32), np.ones((5, 3), np.float32)
CONES, WORDS = (np.ones((5, 3)), SINGLES, SINGLES[:, 0].copy(), SINGLES[:, 0].copy()), np.zeros((5, 4), np.uint64)
QUADS, SIXES, FACES = np.ones((0, 9)), np.zeros((0, 6)), np.zeros((0, 6), np.int32)
TEXTURES = np.zeros(1 << 18, np.uint8), np.zeros((1, 14), np.int32), np.zeros((1, 1), np.int32), np.zeros(2, np.int32)
PICTURE = np.zeros((4, 4)), np.zeros((4, 4), np.float32)
# Arguments that hold together where those from signatures do not, of the object that a method belongs to.
GIVEN: dict[str, Callable[[Any], tuple[object, ...]]] = {
    "BoxGrid.bake": lambda _: (QUADS, FACES, FACES[:, :2].copy(), 0, np.ones((0, 5)), 1.0, True, np.zeros((1, 4), np.float32)),
    "BundleSolver.factorise_sparsely": lambda solver: (np.arange(len(solver.nodes()[0])),),
    "FixFinder": lambda _: (
        *(CONES, CONES[2], WORDS, np.eye(4)[None], np.arange(2), np.array([0, 2]), np.ones(6), 1.0, 1.2),
        *(FixSettings(), StereoSettings(), 0.35, REFINEMENT),
    ),
    "FixFinder.by_projection": lambda _: ((np.ones((5, 3)), np.ones((5, 2)), np.zeros(5, np.int8), WORDS), None, np.eye(4), 9.0),
    "Remap": lambda _: (np.zeros((8, 8, 2), np.int16), np.zeros((8, 8), np.uint16), 4, 9),
    "Remap.resample": lambda _: (np.zeros((4, 9), np.uint8),),
    "ScenePainter": lambda _: (np.full(6, 4.0), np.zeros((0, 0, 4), np.float32)),
    "ScenePainter.add": lambda _: (
        *((QUADS, SIXES, FACES, SINGLES[0], np.ones(1)), (FACES[:, :2].copy(), SIXES), TEXTURES, np.eye(3), np.zeros(3)),
        *(1, (0.0, 0.0), 1.0, 1, 1.0, np.zeros((0, 3)), False, *PICTURE),
    ),
    "descend": lambda _: (WORDS, WORDS[:1], NUMBER, NUMBER, NUMBER),
    "draw_discs": lambda _: (
        *(NUMBER[:0], np.zeros((0, 3)), np.zeros((0, 2)), np.eye(4), SINGLES[:0], TEXTURES[0][:0], TEXTURES[0][:0]),
        *(1.0, 1.0, np.zeros((4, 4, 3)), PICTURE[1]),
    ),
    "register_depth": lambda _: (PICTURE[1], np.ones((16, 3)), np.eye(4), np.ones(4), np.zeros(8), 1.0, 9, 9),
}  # fmt: skip


def call_of(name: str, seed: int) -> partial[object] | None:
    """A function or method with plain arguments, of an object that was made with such; None where that was refused."""
    owner, _, method = name.rpartition(".")
    made, arguments = MEMBERS[owner or name], Arguments(seed, plain_size=8)
    call = partial(made, *given(owner or name, arguments, made.__init__ if owner else made))
    if not owner or method == "__init__":
        return call
    try:
        held: Any = call()
    except ValueError:
        return None
    if owner == "Filter":
        held.add_clone(0, np.zeros(3))
    function = getattr(held, method)
    return partial(function, *given(name, arguments, function, held))


def given(name: str, arguments: Arguments, function: object, held: object = None) -> tuple[object, ...]:
    """Arguments for a function, or a method of an object that is held."""
    return GIVEN[name](held) if name in GIVEN else tuple(arguments.of(function))


def refusals(name: str) -> str:
    """What is refused where plain arguments are accepted: in each an array without its last row, or a number that cannot be."""
    for seed in range(1000):
        plain = call_of(name, seed)
        if plain is not None and not is_refused(plain):
            break
    else:
        return "all"
    signature = MEMBERS[name.partition(".")[0]].__init__ if name.endswith("__init__") else plain.func
    found: dict[str, list[str]] = {"short": [], "below": [], "above": [], "nan": []}
    for place, (argument, _) in enumerate(asked(signature)[: len(plain.args)]):
        for path, value in leaves(plain.args[place], argument):
            for fault, wrong in faults(value):
                call = call_of(name, seed)
                changed = replaced(call.args[place], argument, path, wrong)
                if is_refused(partial(call.func, *call.args[:place], changed, *call.args[place + 1 :])):
                    found[fault].append(path)
    return "; ".join(f"{fault} {' '.join(paths)}" for fault, paths in found.items() if paths)


def is_refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except (ValueError, TypeError):
        return True
    return False


def leaves(value: object, name: str) -> Iterator[tuple[str, object]]:
    """What a tuple of tuples holds, with its place."""
    if not isinstance(value, tuple):
        yield name, value
        return
    for number, part in enumerate(value):
        yield from leaves(part, f"{name}.{number}")


def replaced(value: object, name: str, path: str, wrong: object) -> object:
    if name == path or not isinstance(value, tuple):
        return wrong if name == path else value
    return tuple(replaced(part, f"{name}.{number}", path, wrong) for number, part in enumerate(value))


def faults(value: object) -> Iterator[tuple[str, object]]:
    """Wrong values in place of a right one, by their kind."""
    if isinstance(value, np.ndarray) and value.size:
        yield "short", value[:-1].copy()
        numbers = {"nan": np.nan} if value.dtype.kind == "f" else {}
        if value.dtype.kind in "iu":
            numbers = {"below": -1} if value.dtype.kind == "i" else {}
            numbers["above"] = np.iinfo(value.dtype).max
        for fault, number in numbers.items():
            wrong = value.copy()
            wrong[-1] = number
            yield fault, wrong
    elif isinstance(value, int) and not isinstance(value, bool):
        yield from (("below", -1), ("above", 1 << 30))
    elif isinstance(value, float):
        yield "nan", np.nan
