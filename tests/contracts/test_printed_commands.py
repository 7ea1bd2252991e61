"""Commands that messages print as the next step run as they are printed: they have every option and argument that they need."""

import ast
import shlex
from collections.abc import Iterator

from fleetmap.cli_exit import PRINTED, runnable
from support.fleet.contracts_documents import REPOSITORY, click_command

PACKAGES = ("mapserver", "locclient", "shared/fleetmap")
GIVEN = ["mapserver", "any", "--store", "maps", "--site", "hall"]  # what somebody typed who reads the message
# Named as what they are, not as a step to take
NAMED = {"mapserver build", "mapserver calibrate", "mapserver doctor", "mapserver nightly"}


def _texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of what a module may print: no docstrings and no help of options."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in {"Option", "Argument"}:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = (str(part.value) if isinstance(part, ast.Constant) else "1" for part in node.values)
            yield node.lineno, "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        else:
            yield from _texts(node)


def _printed() -> dict[str, str]:
    """Commands by the place that prints them."""
    found = {}
    for path in (path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))):
        source = path.read_text("utf-8")
        for line, text in _texts(ast.parse(source)) if "`mapserver " in source else ():
            for command in PRINTED.findall(text):
                if command not in NAMED:
                    found[f"{path.relative_to(REPOSITORY)}:{line}: {command}"] = command
    return found


def test_printed_commands_run_as_printed() -> None:
    printed = _printed()
    assert len(printed) > 50
    for where, command in printed.items():
        words = shlex.split(runnable(f"`{command}`", GIVEN).strip("`"))
        found = click_command("mapserver")
        while words[1:] and (inner := getattr(found, "commands", {}).get(words[1])):
            found, words = inner, words[1:]
        options = {name: p for p in found.params if p.param_type_name == "option" for name in p.opts}
        arguments, given, rest = [], set(), iter(words[1:])
        for word in rest:
            if not word.startswith("-"):
                arguments.append(word)
            elif given.add(word) or not getattr(options[word], "is_flag", False):
                next(rest)
        assert {p.opts[0] for p in options.values() if p.required} <= given, where
        assert len(arguments) >= sum(p.required for p in found.params if p.param_type_name == "argument"), where
