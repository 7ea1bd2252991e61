"""Rigid transforms are named target_from_source, and the names meet where transforms are multiplied."""

import ast
import re
from collections.abc import Iterator

from support.fleet.contracts_documents import REPOSITORY

ROOTS = ("shared", "mapserver", "locclient", "tests", "deploy")
# Names of values that say neither target nor source, alone or as the last word; and T as in papers.
VAGUE = re.compile(r"^(.*_)?(poses?|transforms?|extrinsics?)$|^T$|^T_|_T$")
# Functions act on poses and messages of that name; only one that is nothing but the word returns a matrix.
VAGUE_FUNCTION = re.compile(r"^_?(poses?|transforms?|extrinsics?|T)$")
ALLOWED = {"mapserver/fleet/fleet.py": {"last_pose"}}  # the last PoseMessage as plain values, not a matrix
# Products are checked where both names say one of the project's own frames; others may be the same by another name.
KNOWN = {"map", "survey", "odom", "body", "base", "cam"}
FRAMES = re.compile(r"^_?([a-z0-9_]+?)_from_([a-z0-9_]+)$")
# A module without such a word has no name to complain of.
ANY = re.compile(r"(poses?|transforms?|extrinsics?)\b|\bT\b|\bT_|_T\b|_from_")
INVERSES = {"se3_inverse", "inverse_se3", "inv"}

Offence = tuple[int, str]


def offences(source: str, allowed: frozenset[str] = frozenset()) -> list[Offence]:
    """Line and complaint for each offence in a module's text."""
    nodes = list(ast.walk(ast.parse(source)))
    found = [(line, f"{name}: name it target_from_source") for line, name in _vague(nodes) if name not in allowed]
    return sorted(found + list(_mismatches(nodes)))


def _vague(nodes: list[ast.AST]) -> Iterator[Offence]:
    other = {target for target, value in _assigned(nodes) if _is_no_matrix(value)}
    for node in nodes:
        match node:
            case ast.Name(id=name, ctx=ast.Store()) if node not in other:
                pass
            case ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                pass
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                if VAGUE_FUNCTION.search(name):
                    yield node.lineno, name
                continue
            case _:
                continue
        if VAGUE.search(name):
            yield node.lineno, name


def _assigned(nodes: list[ast.AST]) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Targets with their values, those of tuples one by one."""
    for node in nodes:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    yield from zip(target.elts, node.value.elts, strict=False)
                else:
                    yield target, node.value


def _is_no_matrix(value: ast.expr) -> bool:
    """A type variable, or a constant of a class such as Status.TRACKING."""
    match value:
        case ast.Call(func=ast.Name(id="TypeVar" | "ParamSpec")):
            return True
        case ast.Attribute(attr=name):
            return name.isupper()
    return False


def _mismatches(nodes: list[ast.AST]) -> Iterator[Offence]:
    for node in nodes:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            left, right = _frames(node.left), _frames(node.right)
            if left and right and not _same(left[1], right[0]):
                yield node.lineno, f"{ast.unparse(node)}: {left[1]} meets {right[0]}"
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            wanted, built = _frames(node.targets[0]), _frames(node.value)
            # A plain copy may declare two origins to be one: map_from_body = odom_from_body, at the start.
            is_copy = not isinstance(node.value, ast.BinOp | ast.Call)
            if wanted and built and not ((is_copy or _same(wanted[0], built[0])) and _same(wanted[1], built[1])):
                yield node.lineno, f"{ast.unparse(node)}: that is {built[0]}_from_{built[1]}"


def _frames(node: ast.expr) -> tuple[str, str] | None:
    """Target and source of what an expression is by its name; None where names do not say."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            found = FRAMES.match(name)
            return (found[1], found[2]) if found else None
        case ast.Subscript(value=value):
            return _frames(value)
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[only]) if name in INVERSES:
            inner = _frames(only)
            return (inner[1], inner[0]) if inner else None
        case ast.BinOp(op=ast.MatMult(), left=left, right=right):
            first, last = _frames(left), _frames(right)
            return (first[0], last[1]) if first and last else None
    return None


def _same(one: str, other: str) -> bool:
    """Whether two names may be one frame: body and body_a, cam0 and cam; or one of them is not a known frame."""
    known = [KNOWN & {word.rstrip("0123456789") for word in name.split("_")} for name in (one, other)]
    return not (known[0] and known[1]) or bool(known[0] & known[1])


def test_frames() -> None:
    paths = sorted(path for root in ROOTS for path in (REPOSITORY / root).rglob("*.py"))
    sources = {str(path.relative_to(REPOSITORY)): path.read_text("utf-8") for path in paths}
    found = [
        f"{module}:{line}: {what}"
        for module, source in sources.items()
        if ANY.search(source)
        for line, what in offences(source, frozenset(ALLOWED.get(module, ())))
    ]
    assert not found, "\n".join(found)


def test_offenders_are_caught_and_good_names_pass() -> None:
    bad = """
        pose = f()
        def f(T): ...
        T, R = frame.map_from_body, x
        self.camera_pose = x
        T_cam_imu: object = 1
        def transform(): ...
        a = map_from_body @ map_from_cam
        a = se3_inverse(map_from_body) @ body_from_cam
        map_from_cam = state.map_from_body[k]
        map_from_cam = odom_from_body @ body_from_cam
        cam_from_map = se3_inverse(cam_from_map)
        a = map_from_odom @ odom_from_body @ cam_from_body
    """
    good = """
        T = TypeVar("T", bound=int)
        T, L = Status.TRACKING, Status.LOST
        pose_graph = 1
        rotation = x.T
        map_from_body = map_from_odom @ odom_from_body
        map_from_cam = map_from_body[3] @ self.body_from_cam
        cam_from_map = se3_inverse(map_from_cam)
        error = se3_inverse(true_frame_from_body) @ frame_from_body
        points = map_from_cam[:3, :3] @ points_cam
        a_from_b = se3_inverse(map_from_body[a]) @ map_from_body[b]
        def publish_pose(): ...
    """
    lines = [(line.strip(), text is bad) for text in (bad, good) for line in text.strip().splitlines()]
    assert [(line, bool(offences(line))) for line, _ in lines] == lines
