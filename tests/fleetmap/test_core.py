"""The compiled core is what its types say: same functions, arguments and results; other arrays are refused by the argument's name."""

import ast
import inspect
import operator
import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleetmap import _core, core  # type: ignore[attr-defined]
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.filter.msckf import InvariantFilter
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.odometry.settings import FilterSettings, TrackerSettings
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.rectification import StereoCamera
from support.fleet.contracts_documents import text

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
    return core.Tracker(np.array([9.0, 15.0, 10.0, 9.0]), settings, StereoSettings(), 8.0, GUIDANCE[3])


def tracked(pixels: Array) -> tuple[object, float]:
    """Points followed from anywhere to anywhere."""
    held = tracker()
    held.begin(NOISE)
    held.add(pixels)
    return held.track(NOISE[::-1].copy(), (NOISE, NOISE, NOISE), None, np.eye(4), True, pixels)


def test_the_stub_names_everything() -> None:
    functions = {name for name in STUB if "." not in name}
    assert functions | set(CLASSES) | CONSTANTS == {name for name in dir(_core) if not name.startswith("_")}
    for name, held in CLASSES.items():
        members = {member.name for member in held.body if isinstance(member, ast.FunctionDef)} - {"__init__"}
        members |= {ast.unparse(member.target) for member in held.body if isinstance(member, ast.AnnAssign)}
        assert members == {member for member in dir(getattr(_core, name)) if not member.startswith("_")}


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


POINTS = np.ones((5, 3))
DEPTH, COLOUR = np.ones((2, 2), np.float32), (np.eye(4), np.ones(4), np.zeros(8))
SEEN = POINTS, POINTS, np.ones((5, 2)), np.ones(4), (4.0, 11.0, (10, 5))  # as PnP takes it
THREE, BOUNDS, NEIGHBOURS = np.arange(3), np.arange(4), np.array([[0, 1]])
HEIGHTS, PLANE, UNSET, LEVELS = np.ones(3), np.ones((3, 2)), np.zeros(3, bool), np.zeros(3, np.int8)
CELL_MODEL = 2.0, 0.05, 0.15, 0.01, 1.25
FARTHEST = np.iinfo(np.int64).max
BAKED = (
    np.ones((1, 9)),
    np.zeros((1, 6), np.int32),
    np.zeros((1, 2), np.int32),
    np.ones((0, 5)),
    1.0,
    True,
    np.zeros((1, 4), np.float32),
)
BUDGET = THREE, np.full(3, 9), 3, np.zeros(3, np.int64), UNSET, np.full(3, 9), 1  # of choose_landmarks
CONES = POINTS, np.ones((5, 3), np.float32), np.ones(5, np.float32), np.ones(5, np.float32)

VIEW = 1.0, 10.0, np.pi, 1.2  # scale of distances, margin, angle, scale of octaves
WORDS, NUMBERS = np.zeros((3, 4), np.uint64), np.zeros(3, np.int32)
IMAGE, PIXELS = np.zeros((20, 30), np.uint8), np.zeros((3, 2), np.float32)
STAMPS, SAMPLES, ZERO = np.arange(3), np.zeros((3, 3)), np.zeros(3)
OUTSIDE = np.full((3, 2), np.nan, np.float32)
PLACES = np.full((4, 2), 9.0)
STEREO_LIMITS = 8.0, 0.75, 0.93, 5, 4, 0.25
OCTAVES = np.zeros(4, np.int8)
NEAR = PLACES[:3], PLACES[:3, 0].copy(), WORDS, np.zeros((3, 2), np.int64), PLACES[:3], OCTAVES[:3], WORDS, 64, 0.9
PATCHES = (IMAGE, IMAGE, IMAGE), PLACES, OCTAVES
PAIRED = PLACES[:3], OCTAVES[:3], WORDS, PLACES[:3], np.ones((3, 3)), True
GUIDANCE = np.ones(4), (30.0, 20.0), 1.5, (4.0, 11.0, (10, 5)), 60
CHOSEN = (*PATCHES, np.zeros(4, np.float32), np.arange(4))
POSES, ONE = np.tile(np.eye(4), (2, 1, 1)), np.zeros(1, np.int64)
FILTER = InvariantFilter(
    NavState(), np.eye(15), FilterSettings(), [(StereoCamera(300.0, 9.0, 9.0, 0.1, 20, 20), np.eye(4))]
)


def fix_finder(shown: tuple[int, ...] = (0, 1), shown_from: tuple[int, ...] = (0, 2)) -> core.FixFinder:
    """In a map of five landmarks and one place."""
    held = (
        CONES,
        np.ones(5, np.float32),
        np.zeros((5, 4), np.uint64),
        np.eye(4)[None],
        np.array(shown),
        np.array(shown_from),
    )
    return core.FixFinder(*held, np.ones(6), 1.0, 1.2, FixSettings(), StereoSettings(), 0.35, REFINEMENT)


def frame_features(count: int) -> tuple[Array, Array, Array, Array]:
    return np.ones((count, 3)), np.ones((count, 2)), np.zeros(count, np.int8), np.zeros((count, 4), np.uint64)


def unmeasured(count: int) -> tuple[Array, Array, Array, Array]:
    image = np.zeros((8, 8), np.uint8)
    return image, image, np.ones((count, 3)), np.zeros(count, bool)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: core.mutual_within(WORDS, np.full((3, 2), -1, np.int32), WORDS, NUMBERS, 64, 0.8), "nodes"),
        (lambda: core.mutual_within(WORDS, np.zeros((2, 2), np.int32), WORDS, NUMBERS, 64, 0.8), "node for each"),
        (lambda: core.descend(WORDS, WORDS, NUMBERS, NUMBERS + 5, NUMBERS), "children"),
        (lambda: core.descend(WORDS, WORDS[:0], NUMBERS[:0], NUMBERS[:0], NUMBERS[:0]), "root"),
        (lambda: core.descend(WORDS, WORDS, NUMBERS[:2], NUMBERS, NUMBERS), "one number for each node"),
        (lambda: core.InvertedFile(0), "words"),
        (lambda: core.InvertedFile(3).add(NUMBERS + 3, CONES[3][:3]), "word_ids"),
        (lambda: core.InvertedFile(3).scores(NUMBERS - 1, CONES[3][:3]), "word_ids"),
        (lambda: core.InvertedFile(3).scores(NUMBERS, CONES[3]), "weights"),
        (lambda: core.refine_pnp(POINTS, POINTS[:2], *SEEN[2:], np.eye(4), None), "pixels"),
        (lambda: core.ransac_pnp(*SEEN[:2], np.ones((2, 2)), *SEEN[3:], 1.0, 4, POINTS / 2, 0.9), "weights"),
        (lambda: core.ransac_pnp(*SEEN, 1.0, 4, POINTS, 0.9), "draws"),
        (lambda: core.refine_pnp(*SEEN[:4], (4.0, 11.0, (10, 1001)), np.eye(4), None), "refinement"),
        (lambda: core.pnp_with_rotation(POINTS[:2], *SEEN[1:], 1.0, 4, np.eye(3), 0.1), "one row for each point"),
        (lambda: fix_finder(shown=(0, 5)), "shown: rows of landmarks"),
        (lambda: fix_finder(shown_from=(0, 1)), "shown_from"),
        (lambda: fix_finder().by_projection(frame_features(3), unmeasured(2), np.eye(4), 9.0), "a row for each feature"),
        (lambda: core.visible_landmarks((POINTS, *CONES[1:3], CONES[3][:2]), np.eye(4), np.ones(6), *VIEW), "cones"),
        (lambda: core.nearest_cells(WORDS, WORDS, 0), "cells"),
        (lambda: core.near_descriptors(WORDS, WORDS, 1, WORDS, np.array([0, 1, 3]), 9), "starts: one more"),
        (lambda: core.near_descriptors(WORDS, WORDS, 1, WORDS, np.array([0, 2, 1, 3]), 9), "starts: rising"),
        (lambda: core.near_descriptors(WORDS, WORDS, 1, WORDS, np.array([0, 1, 2, 4]), 9), "starts: rising"),
        (lambda: core.lookalikes(WORDS, POINTS[:2, 0].copy(), WORDS, POINTS[:3], 0, 3, 9), "heights_m"),
        (lambda: core.lookalikes(WORDS, HEIGHTS, WORDS, POINTS, 0, 3, 9), "points_map"),
        (lambda: core.lookalikes(WORDS, HEIGHTS, WORDS, POINTS[:3], 2, 4, 9), "first, last"),
        (lambda: core.lookalikes(WORDS, HEIGHTS, WORDS, POINTS[:3], 0, 3, -1), "room"),
        (lambda: core.camera_votes(np.full((1, 2), 3, np.int32), PLANE, POINTS, PLANE[0], 0.5, 9, 9), "pairs"),
        (lambda: core.camera_votes(np.full((1, 2), -1, np.int32), PLANE, POINTS, PLANE[0], 0.5, 9, 9), "pairs"),
        (lambda: core.camera_votes(np.zeros((1, 2), np.int32), PLANE, POINTS, PLANE[0], 0.5, 1 << 20, 1 << 20), "cells"),
        (lambda: core.mark_shared((POINTS[:2], WORDS, np.zeros(2, bool)), (POINTS[:3], WORDS, UNSET), 1.0, 9), "one, other"),
        (lambda: core.block_log_odds((POINTS, PLANE, UNSET), (POINTS[:3], PLANE, UNSET), PLANE, CELL_MODEL, 1.0, 9), "one, other"),
        (lambda: core.block_log_odds(*[(POINTS[:3], PLANE, UNSET)] * 2, PLANE, CELL_MODEL, 1.0, -1), "room"),
        (lambda: core.thin(IMAGE, 0, 250), "every"),
        (lambda: core.row_steps(IMAGE, -1), "every"),
        (lambda: core.undistort(np.ones(8), HEIGHTS, HEIGHTS[:2]), "goals_y"),
        (lambda: core.register_depth(DEPTH, POINTS[:3], *COLOUR, 1.0, 9, 9), "rays"),
        (lambda: core.register_depth(DEPTH, POINTS[:4], *COLOUR[:2], np.ones(5), 1.0, 9, 9), "lens"),
        (lambda: core.register_depth(DEPTH, POINTS[:4], *COLOUR, 1.0, 9, -1), "width, height"),
        (lambda: core.register_depth(DEPTH, POINTS[:4], *COLOUR, 1.0, 1 << 14, 1 << 14), "width, height"),
        (lambda: core.blend(PLANE, POINTS[:3], PLANE, HEIGHTS, HEIGHTS, 1 << 14, 1 << 14), "width, height"),
        (lambda: core.BoxGrid(np.ones((1, 8)), ZERO, np.array([1.0, 1.0, 5e3]), 1.0), "cell_m"),
        (lambda: core.BoxGrid(np.full((9, 8), 2e3), ZERO, np.array([256.0, 256.0, 256.0]), 1.0), "boxes"),
        (lambda: core.BoxGrid(np.ones((1, 8)), ZERO, THREE * 1.0, 1.0).bake(*BAKED[:3], FARTHEST, *BAKED[3:]), "owner_shift"),
        (lambda: core.ScenePainter(np.full(6, np.nan), np.zeros((0, 0, 4), np.float32)), "plane"),
        (lambda: core.spare_keyframes(THREE, BOUNDS, THREE[:2], BOUNDS, THREE, LEVELS, 1, 1, 0.5, 1), "keyframes: one"),
        (lambda: core.spare_keyframes(THREE, BOUNDS, THREE, BOUNDS, THREE, LEVELS[:2], 1, 1, 0.5, 1), "octaves: one"),
        (lambda: core.spare_keyframes(THREE, BOUNDS + 1, THREE, BOUNDS, THREE, LEVELS, 1, 1, 0.5, 1), "row_starts"),
        (lambda: core.spare_keyframes(THREE, BOUNDS, THREE, -BOUNDS, THREE, LEVELS, 1, 1, 0.5, 1), "starts: rising"),
        (lambda: core.spare_keyframes(THREE + 1, BOUNDS, THREE, BOUNDS, THREE, LEVELS, 1, 1, 0.5, 1), "rows: of"),
        (lambda: core.spare_keyframes(THREE, BOUNDS, THREE - 1, BOUNDS, THREE, LEVELS, 1, 1, 0.5, 1), "tracks: of"),
        (lambda: core.spare_keyframes(THREE, BOUNDS, THREE, BOUNDS, THREE + 1, LEVELS, 1, 1, 0.5, 1), "keyframes: of"),
        (lambda: core.duplicate_landmarks(NEIGHBOURS, POINTS[:3], HEIGHTS[:2], BOUNDS, NUMBERS, WORDS, 9), "sigmas_m"),
        (lambda: core.duplicate_landmarks(NEIGHBOURS, POINTS[:3], HEIGHTS, BOUNDS, NUMBERS, WORDS[:2], 9), "descriptors"),
        (lambda: core.duplicate_landmarks(NEIGHBOURS, POINTS[:3], HEIGHTS, BOUNDS[:2], NUMBERS, WORDS, 9), "starts: one more"),
        (lambda: core.duplicate_landmarks(NEIGHBOURS, POINTS[:3], HEIGHTS, BOUNDS, NUMBERS[:2], WORDS, 9), "starts: rising"),
        (lambda: core.duplicate_landmarks(NEIGHBOURS + 2, POINTS[:3], HEIGHTS, BOUNDS, NUMBERS, WORDS, 9), "near"),
        (lambda: core.redundant_keyframes(THREE, THREE, BOUNDS, NUMBERS, NUMBERS[:2], THREE, BOUNDS, 3, 0.9), "obs_keyframe"),
        (lambda: core.redundant_keyframes(THREE, THREE, BOUNDS, NUMBERS, NUMBERS, THREE[:2], BOUNDS, 3, 0.9), "octaves"),
        (lambda: core.redundant_keyframes(THREE + 1, THREE, BOUNDS, NUMBERS, NUMBERS, THREE, BOUNDS, 3, 0.9), "order"),
        (lambda: core.redundant_keyframes(THREE, THREE - 1, BOUNDS, NUMBERS, NUMBERS, THREE, BOUNDS, 3, 0.9), "rows"),
        (lambda: core.redundant_keyframes(THREE, THREE, BOUNDS, NUMBERS + 3, NUMBERS, THREE, BOUNDS, 3, 0.9), "obs_landmark"),
        (lambda: core.redundant_keyframes(THREE, THREE, BOUNDS, NUMBERS, NUMBERS - 1, THREE, BOUNDS, 3, 0.9), "obs_keyframe"),
        (lambda: core.medoids(WORDS, np.array([0, 2, 1])), "starts"),
        (lambda: core.medoids(WORDS, np.zeros(0, np.int64)), "starts"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS[:2], *BUDGET), "weights"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS, THREE[:2], *BUDGET[1:]), "cells: one"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS, *BUDGET[:4], UNSET[:2], *BUDGET[5:]), "chosen"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS, *BUDGET[:-1], 0), "bins_per_view"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS, *BUDGET[:3], THREE - FARTHEST, *BUDGET[4:]), "counts, needs"),
        (lambda: core.choose_landmarks(THREE + 1, BOUNDS, THREE, HEIGHTS, *BUDGET), "candidates"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE, HEIGHTS, THREE + 1, *BUDGET[1:]), "cells: of"),
        (lambda: core.choose_landmarks(THREE, BOUNDS, THREE + 1, HEIGHTS, *BUDGET), "bins: of"),
        (lambda: core.twins(WORDS, POINTS, 6, 9, 60, 0.1, 2.0), "points_map"),
        (lambda: core.twins(WORDS, POINTS[:3], 6, 0, 60, 0.1, 2.0), "most"),
        (lambda: core.spread_corners(IMAGE, 9, 5.0, 300, 3, PIXELS), "threshold"),
        (lambda: core.spread_corners(IMAGE, 9, 5.0, 20, 2, PIXELS), "border_px"),
        (lambda: core.spread_corners(IMAGE, -1, 5.0, 20, 3, PIXELS), "count"),
        (lambda: core.spread_corners(IMAGE, 9, float("nan"), 20, 3, PIXELS), "distance_px"),
        (lambda: core.select_spread(PIXELS, np.array([3]), PIXELS, 5.0, 9, 30, 20), "order"),
        (lambda: core.select_spread(OUTSIDE, np.array([1]), PIXELS, 5.0, 9, 30, 20), "pixels"),
        (lambda: core.select_spread(PIXELS, np.array([1]), PIXELS, float("nan"), 9, 30, 20), "distance_px"),
        (lambda: core.select_spread(PIXELS, np.array([1]), PIXELS, 0.1, 9, 1 << 30, 1 << 30), "width, height"),
        (lambda: core.centroid_angles_deg(IMAGE[:0], PIXELS, 15), "image"),
        (lambda: core.match_rows(IMAGE, IMAGE[:9], IMAGE, IMAGE, PLACES, PLACES[:, 0].copy(), *STEREO_LIMITS), "right"),
        (lambda: core.match_rows(*[IMAGE] * 4, PLACES, PLACES[:2, 0].copy(), *STEREO_LIMITS), "prior_px"),
        (lambda: core.match_rows(*[IMAGE] * 4, PLACES, PLACES[:, 0].copy(), np.inf, *STEREO_LIMITS[1:]), "max_dis"),
        (lambda: core.match_rows(*[IMAGE] * 4, PLACES, PLACES[:, 0].copy(), 8.0, 0.75, 0.93, 5, 8, 0.25), "narrow_half"),
        (lambda: core.match_projected(*NEAR[:3], NEAR[3][:1], *NEAR[4:]), "octave_range"),
        (lambda: core.match_projected(*NEAR[:5], NEAR[5][:1], *NEAR[6:]), "octaves"),
        (lambda: core.follow_pixels(IMAGE, IMAGE, PLACES, PLACES, 8, 1, 1.0, 0.0), "half"),
        (lambda: core.follow_pixels(IMAGE, IMAGE, PLACES, PLACES[:3], 7, 1, 1.0, 0.0), "predicted"),
        (lambda: core.follow_pixels(IMAGE, IMAGE[:0], PLACES, PLACES, 7, 1, 1.0, 0.0), "images"),
        (lambda: core.follow_pixels(IMAGE, IMAGE, PLACES, PLACES, 7, 31, 1.0, 0.0), "levels"),
        (lambda: core.halvings(IMAGE, -1), "levels"),
        (lambda: tracker().begin(IMAGE[:0]), "images"),
        (lambda: tracker().track(IMAGE, (IMAGE, IMAGE, IMAGE[:9]), None, None, False, None), "pair"),
        (lambda: tracker().track(IMAGE, None, np.zeros((3, 3), np.float32), None, False, None), "disparity_px"),
        (lambda: tracker().track(IMAGE, None, None, np.eye(4), True, SAMPLES), "points_cam"),
        (lambda: tracker().track(IMAGE, None, None, np.eye(4), True, None), "cam_from_previous"),
        (lambda: tracker(min_distance_px=0.0).track(IMAGE, None, None, None, False, None), "distance_px"),
        (lambda: tracker(window_px=17), "half"),
        (lambda: tracker(pyramid_levels=-1), "levels"),
        (lambda: core.common_ways_px(STAMPS, SAMPLES[:2], STAMPS, SAMPLES), "pixels"),
        (lambda: core.align_patches(*PATCHES, *PATCHES, np.ones((4, 2, 3)), 16, 3.0, 0.8), "half"),
        (lambda: core.align_patches(*PATCHES, *PATCHES, np.ones((3, 2, 3)), 4, 3.0, 0.8), "warps"),
        (lambda: core.align_patches(*PATCHES[:2], OCTAVES[:3], *PATCHES, np.ones((4, 2, 3)), 4, 3.0, 0.8), "octaves"),
        (lambda: core.align_observations(CHOSEN, CHOSEN, np.ones((3, 3)), np.eye(4), 4, 3.0, 0.8), "points_reference"),
        (lambda: core.align_observations(CHOSEN, (*CHOSEN[:4], CHOSEN[4] - 1), np.ones((4, 3)), np.eye(4), 4, 3.0, 0.8), "chosen"),
        (lambda: core.join_tracks(NUMBERS, NUMBERS[:1], NUMBERS), "second"),
        (lambda: core.match_guided(PAIRED, (PLACES, *PAIRED[1:]), np.eye(4), *GUIDANCE, np.ones(2), 3, 0.4), "as many pixels"),
        (lambda: core.match_guided(PAIRED, PAIRED, np.eye(4), *GUIDANCE, np.ones(2), -1, 0.4), "least_inliers"),
        (lambda: core.share_in_view(np.eye(4), SAMPLES, PLACES, np.ones(4), (9.0, 9.0)), "disparities_a"),
        (lambda: core.join_tracks(NUMBERS, NUMBERS - 1, NUMBERS), "first, second"),
        (lambda: core.join_tracks(NUMBERS, NUMBERS, NUMBERS + 3), "keyframes"),
        (lambda: core.imu_intervals(STAMPS, SAMPLES, SAMPLES[:2], 0, 9), "accel_mps2"),
        (lambda: core.drop_spikes(STAMPS, SAMPLES, SAMPLES, 4), "known"),
        (lambda: core.drop_spikes(STAMPS, SAMPLES, SAMPLES[:2], 0), "accel_mps2"),
        (lambda: core.is_steady(SAMPLES, SAMPLES[:2], (1.0,) * 5), "accel_mps2"),
        (lambda: core.latest_steady(STAMPS, SAMPLES, SAMPLES, 0, 9, 3, (1.0,) * 5), "window_ns"),
        (lambda: core.latest_steady(STAMPS, SAMPLES, SAMPLES, 0, 2**40, 9, (1.0,) * 5), "window_ns"),
        (lambda: core.latest_steady(STAMPS, SAMPLES, SAMPLES, 0, 2**62, 9, (1.0,) * 5), "until_ns"),
        (lambda: core.triangulate(POSES, np.arange(3), SAMPLES, np.ones((2, 4)), 1.0, 1.0, ZERO), "views"),
        (lambda: core.triangulate(POSES, np.arange(2), SAMPLES, np.ones((2, 4)), 1.0, 1.0, ZERO), "pixels"),
        (lambda: core.triangulate(POSES, np.arange(2), SAMPLES[:2], np.ones((1, 4)), 1.0, 1.0, ZERO), "lenses"),
        (lambda: core.adjust_window(POSES, 1, SAMPLES, STAMPS, STAMPS, PLACES[:3], np.ones(4), 1.0, 2.5, 8), "starts"),
        (lambda: core.adjust_window(POSES, 1, SAMPLES[:1], np.array([0, 3]), STAMPS, PLACES[:3], np.ones(4), 1.0, 2.5, 8), "views"),
        (lambda: core.adjust_window(POSES, 1, SAMPLES[:1], np.array([0, 3]), ONE, PLACES[:3], np.ones(4), 1.0, 2.5, 8), "pixels"),
        (lambda: FILTER.odom_from_clone(1), "clone_id"),
        (FILTER.begin_frame_anew, "a clone is needed"),
        (lambda: FILTER.observe(0, 0, STAMPS, SAMPLES[:2]), "pixels"),
        (lambda: FILTER.observe(0, 1, STAMPS, SAMPLES), "camera: 1, but the rig has 1"),
        (lambda: FILTER.observe(0, -1, STAMPS, SAMPLES), "camera: -1"),
        (lambda: core.Filter(*NavState().arrays, *[np.eye(15)] * 2, np.ones((1, 4)), POSES, FilterSettings(), 1.0, 9.8), "body_from_cams"),
        (lambda: FILTER.update(STAMPS, UNSET[:2], 1.0), "due"),
        (lambda: FILTER.update(STAMPS, UNSET, 1.0, 0), "iterations"),
        (lambda: core.preintegrate(STAMPS, SAMPLES, SAMPLES, 9, 0, ZERO, ZERO, (1.0, 1.0, 1.0, 1.0)), "end_ns"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call: object, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        call()  # type: ignore[operator]


@pytest.mark.parametrize("strange", [np.nan, np.inf, 1e200, 0.0])
@pytest.mark.parametrize("lens", [np.ones(8), np.ones(4)])
def test_a_depth_image_of_strange_numbers_gives_values(strange: float, lens: Array) -> None:
    points = np.full((4, 3), strange)
    core.register_depth(
        DEPTH * np.float32(strange), points, np.eye(4), np.full(4, strange), lens * strange, strange, 9, 9
    )


# Calls with places (4, 2) of any numbers, at which they read a noisy image; test_core_hostile.py seldom finds images that go together.
HOSTILE = {
    "match_rows": lambda places: core.match_rows(*[NOISE] * 4, places, places[:, 0].copy(), *STEREO_LIMITS),
    "match_rows, without a limit": lambda places: core.match_rows(
        *[NOISE] * 4, places, places[:, 1].copy(), 8.0, -np.inf, np.inf, 7, 7, np.inf
    ),
    "follow_pixels": lambda places: core.follow_pixels(
        NOISE, NOISE[:5, :9].copy(), places, places[::-1].copy(), 3, 9, 3.0, -np.inf
    ),
    "tracker": lambda places: tracked(np.column_stack([places, places[::-1, 0]])),
}
NOISE = np.random.default_rng(1).integers(0, 256, (20, 30), np.uint8)
ANY = st.one_of(st.floats(-9.0, 40.0), st.floats(), st.sampled_from([1e18, -1e18, 1e308, 29.999999999999996, -1e-300]))


@pytest.mark.parametrize("name", HOSTILE)
@given(places=arrays(np.float64, (4, 2), elements=ANY))
@settings(max_examples=200, deadline=None)
def test_no_number_leads_out_of_an_image(name: str, places: Array) -> None:
    HOSTILE[name](places)


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
