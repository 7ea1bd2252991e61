"""The compiled core is what its types say: same functions, arguments and results; other arrays are refused by the argument's name."""

import ast
import faulthandler
import inspect
import operator
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleetmap import _core, core  # type: ignore[attr-defined]
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.settings import TrackerSettings
from support.core_arguments import MEMBERS, Arguments
from support.fleet.contracts_documents import text
from support.storage.memory_limit import memory_at_most

MODULE = ast.parse(text("shared/fleetmap/_core.pyi")).body
CONSTANTS = {ast.unparse(node.target) for node in MODULE if isinstance(node, ast.AnnAssign)}
CLASSES = {node.name: node for node in MODULE if isinstance(node, ast.ClassDef)}
STUB = {node.name: node for node in MODULE if isinstance(node, ast.FunctionDef)} | {
    f"{name}.{method.name}": method
    for name, held in CLASSES.items()
    for method in held.body
    if isinstance(method, ast.FunctionDef) and not method.decorator_list
}
# What nanobind calls the types of the stub's names.
DTYPES = {
    "_Descriptors": "uint64",
    "_Grey": "uint8",
    "_Numbers": "int32",
    "_Indices": "int64",
    "_Pixels": "float32",
    "_Reals": "float64",
    "_Flags": "bool",
    "_Floats": "float32",
    "_Octaves": "int8",
    "_Features": "tuple[dtype=float64, dtype=int8, dtype=uint64, dtype=float64, dtype=float64, bool]",
    "_Pyramid": "tuple[dtype=uint8, dtype=uint8, dtype=uint8]",
    "_Depths": "tuple[dtype=float32, int, float, dtype=float64, dtype=float64, float, float]",
    "_Gaussians": "tuple[dtype=float64, dtype=float64, dtype=float64, dtype=float64, dtype=float64]",
    "_Counts": "uint16",
    "_Rows": "collections.abc.Callable",
}


def named(annotation: ast.expr | None) -> str:
    """A stub's type in nanobind's words."""
    written = ast.unparse(annotation) if annotation is not None else "?"
    for name, dtype in DTYPES.items():
        written = re.sub(rf"\b{name}\b", dtype if "[" in dtype or "." in dtype else f"dtype={dtype}", written)
    return re.sub(r"NDArray\[np\.(\w+)\]", r"dtype=\1", written)


def compiled(name: str) -> tuple[list[tuple[str, str]], str]:
    """Arguments with their types, and the result's type, of a function of the module, as its signature says."""
    function = operator.attrgetter(name)(_core)
    signature = re.sub(r"(?:numpy\.)?ndarray\[(dtype=\w+)[^\]]*\]", r"\1", inspect.getdoc(function) or "")
    found = re.fullmatch(rf"{name.rpartition('.')[2]}\((?:self(?:, )?)?(.*)\) -> (.*)", signature.splitlines()[0])
    assert found, signature
    arguments = [part.split(": ", 1) for part in re.split(r", (?=\w+: )", found[1]) if part]
    return [(argument, kind.partition(" = ")[0]) for argument, kind in arguments], found[2]


def tracker(**changed: float) -> core.Tracker:
    settings = TrackerSettings(**changed)  # type: ignore[arg-type]
    return core.Tracker(np.array([9.0, 15.0, 10.0, 9.0]), settings, StereoSettings(), 8.0, REFINEMENT)


def tracked(image: Array, pixels: Array) -> tuple[object, float]:
    """Points followed from anywhere to anywhere."""
    held = tracker()
    held.begin(image)
    held.add(pixels)
    found, share = held.track(image[::-1].copy(), (image, image, image), None, np.eye(4), True, pixels)
    return {name: getattr(found, name) for name in public(found)}, share


def public(held: object) -> set[str]:
    return {name for name in dir(held) if not name.startswith("_")}


def test_the_stub_names_everything() -> None:
    assert {name for name in STUB if "." not in name} | set(CLASSES) | CONSTANTS == public(_core)
    for name, held in CLASSES.items():
        members = {member.name for member in held.body if isinstance(member, ast.FunctionDef)} - {"__init__"}
        members |= {ast.unparse(member.target) for member in held.body if isinstance(member, ast.AnnAssign)}
        assert members == public(getattr(_core, name))


@pytest.mark.parametrize("name", STUB)
def test_arguments_and_results_are_those_of_the_stub(name: str) -> None:
    wanted = [(argument.arg, named(argument.annotation)) for argument in STUB[name].args.args if argument.arg != "self"]
    assert compiled(name) == (wanted, named(STUB[name].returns))


@pytest.mark.parametrize("name", STUB)
def test_an_array_of_another_type_is_refused(name: str) -> None:
    """Not converted, which would cost a copy in each frame without a word."""
    strange = np.zeros((2, 2, 2), np.complex128)
    with pytest.raises(TypeError, match=rf"{name.rpartition('.')[2]}\(\): incompatible function arguments"):
        operator.attrgetter(name)(_core)(*[strange] * max(1, len(STUB[name].args.args)))


NO_FACES = np.zeros((0, 9)), np.zeros((0, 6), np.int32), np.zeros((0, 2), np.int32)
UNLIT = np.ones((0, 5)), 1.0, True, np.zeros((1, 4), np.float32)
WORDS, NUMBERS = np.zeros((3, 4), np.uint64), np.zeros(3, np.int32)
IMAGE, PLACES = np.zeros((20, 30), np.uint8), np.full((4, 2), 9.0)
BOX, SAMPLES, ZERO, ONES = np.ones((1, 8)), np.zeros((3, 3)), np.zeros(3), np.ones(3)
REFINEMENT = 4.0, 11.0, (10, 5)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: core.descend(WORDS, WORDS[:0], NUMBERS[:0], NUMBERS[:0], NUMBERS[:0]), "root"),
        (lambda: core.BoxGrid(BOX, ZERO, np.array([1.0, 1.0, 5e3]), 1.0), "cell_m"),
        (lambda: core.BoxGrid(np.full((9, 8), 2e3), ZERO, np.array([256.0, 256.0, 256.0]), 1.0), "boxes"),
        (lambda: core.BoxGrid(BOX, ZERO, ONES, 1.0).bake(*NO_FACES, np.iinfo(np.int64).max, *UNLIT), "owner_shift"),
        (lambda: core.centroid_angles_deg(IMAGE[:0], np.zeros((3, 2), np.float32), 15), "image"),
        (lambda: core.reduced(IMAGE, len(IMAGE) + 1, 1), "size"),
        (lambda: core.follow_pixels(IMAGE, IMAGE[:0], PLACES, PLACES, 7, 1, 1.0, 0.0), "images"),
        (lambda: tracker().begin(IMAGE[:0]), "images"),
        (lambda: tracker().track(IMAGE, None, None, np.eye(4), True, SAMPLES), "points_cam"),
        (lambda: tracker().track(IMAGE, None, None, np.eye(4), True, None), "cam_from_previous"),
        (lambda: tracker(min_distance_px=0.0).track(IMAGE, None, None, None, False, None), "distance_px"),
        (lambda: tracker().track(NOISE, (NOISE, None, NOISE), None, None, False, None), "incompatible"),  # type: ignore[arg-type]
        (lambda: tracker(window_px=17), "half"),
        (lambda: tracker(pyramid_levels=-1), "levels"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call: object, told: str) -> None:
    with pytest.raises((TypeError, ValueError), match=told):
        call()  # type: ignore[operator]


@pytest.mark.parametrize("strange", [np.nan, np.inf, 1e200, 0.0])
@pytest.mark.parametrize("lens", [np.ones(8), np.ones(4)])
def test_a_depth_image_of_strange_numbers_gives_values(strange: float, lens: Array) -> None:
    depth, rays, pinhole = np.full((2, 2), np.float32(strange)), np.full((4, 3), strange), np.full(4, strange)
    registered = core.register_depth(depth, rays, np.eye(4), pinhole, lens * strange, strange, 9, 9)
    assert not registered.any(), "no depth that a planner would take for one"


# Calls with places (4, 2) of any numbers, at which they read a noisy image.
HOSTILE = {
    "match_rows": lambda image, places: core.match_rows(
        *[image] * 4, places, places[:, 0].copy(), StereoSettings(), 8.0
    ),
    "match_rows, without a limit": lambda image, places: core.match_rows(
        *[image] * 4, places, places[:, 1].copy(), ANY_MATCH, 8.0
    ),
    "follow_pixels": lambda image, places: core.follow_pixels(
        image, image[:5, :9].copy(), places, places[::-1].copy(), 3, 9, 3.0, -np.inf
    ),
    "tracker": lambda image, places: tracked(image, np.column_stack([places, places[::-1, 0]])),
}
NOISE = np.random.default_rng(1).integers(0, 256, (20, 30), np.uint8)
ANY_MATCH = StereoSettings(
    min_correlation=-np.inf, uniqueness=np.inf, wide_half_px=7, narrow_half_px=7, agreement_px=np.inf
)
ANY = st.one_of(st.floats(-9.0, 40.0), st.floats(), st.sampled_from([1e18, -1e18, 1e308, 29.999999999999996, -1e-300]))


@pytest.mark.parametrize("name", HOSTILE)
@given(places=arrays(np.float64, (4, 2), elements=ANY))
@settings(max_examples=200, deadline=None)
def test_no_number_leads_out_of_an_image(name: str, places: Array) -> None:
    """What lies before and behind it in memory changes no result."""
    results = []
    for around in (0, 255):
        memory = np.full((60, 30), around, np.uint8)
        memory[20:40] = NOISE
        results.append(HOSTILE[name](memory[20:40], places))
    np.testing.assert_equal(*results)


def test_products_are_rounded_before_they_are_added() -> None:
    """No processor's fused additions, so that every machine computes the same bits."""
    rng = np.random.default_rng(0)
    points, cam_from_map = rng.normal(size=(2000, 3)).astype(np.float32), np.eye(4)
    cam_from_map[:3, :3] = rng.normal(size=(3, 3))
    numbers, points_cam, _ = core.discs_before(points, -points, cam_from_map, -9.0, 99.0, np.zeros(4), 9, 9)
    x, y, z = points[numbers].astype(np.float64).T
    assert len(numbers) > 1900
    rounded = np.transpose([row[0] * x + row[1] * y + row[2] * z for row in cam_from_map[:3, :3]])
    assert np.array_equal(points_cam, rounded)


@pytest.mark.parametrize(("error", "told"), [("ModuleNotFoundError", "make core"), ("ImportError", "AVX2")])
def test_a_core_that_is_missing_or_cannot_run_says_what_to_do(error: str, told: str) -> None:
    script = f"""
import sys
class Finder:
    def find_spec(name, path, target=None):
        if name == "fleetmap._core": raise {error}("needs AVX2")
sys.meta_path.insert(0, Finder)
from fleetmap.cli_exit import run_cli
def start():
    import fleetmap.features.orb
run_cli(start)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert told in done.stderr


# Nothing that Python hands to the compiled core harms the process: each call ends in values or a refusal, soon and in bounded memory.

EXAMPLES = int(os.environ.get("FLEETMAP_HOSTILE_EXAMPLES", "6"))  # of each function; of a class, times its methods
SECONDS, BYTES = 5.0, 1 << 30  # the most that a call may take


def bounded(function: Callable[..., object], arguments: list[object]) -> object:
    """The result, or None where it was refused."""
    started = time.process_time()
    # Of a sanitized core memory is shadowed; there ASAN_OPTIONS limits the allocations.
    limit = nullcontext() if "FLEETMAP_CORE" in os.environ else memory_at_most(BYTES)
    faulthandler.dump_traceback_later(20 * SECONDS, exit=True)
    try:
        with limit:
            return function(*arguments)
    except (ValueError, TypeError):
        return None
    finally:
        faulthandler.cancel_dump_traceback_later()
        assert time.process_time() - started < SECONDS


@pytest.mark.parametrize("name", MEMBERS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=EXAMPLES, database=None)
def test_every_call_ends_in_values_or_a_refusal(name: str, seed: int) -> None:
    arguments, member = Arguments(seed), MEMBERS[name]
    if not isinstance(member, type):
        bounded(member, arguments.of(member))
        return
    held = bounded(member, arguments.of(member.__init__))
    if held is None:
        return
    methods = sorted(public(member))
    for method in arguments.rng.choice(methods, len(methods)):
        found = getattr(held, method)
        if callable(found):
            bounded(found, arguments.of(getattr(member, method)))
