"""Prints the lines of every room beside its budget: `python tests/budgets.py`, after tests/budgets.toml."""

import subprocess
import tomllib
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
CODE = {".py", ".cpp", ".hpp", ".h", ".js", ".css", ".html", ".sh"}


class Room(NamedTuple):
    """Lines of a room, and the most that it may have."""

    part: str
    name: str
    lines: int
    limit: int


def lines_by_file() -> dict[str, int]:
    """Physical lines of every tracked file with code, but for libraries of others."""
    listed = subprocess.check_output(["git", "ls-files", ":!:*/vendor/*"], cwd=REPOSITORY, text=True)
    files = [name for name in listed.split("\n") if Path(name).suffix in CODE and (REPOSITORY / name).is_file()]
    return {name: len((REPOSITORY / name).read_bytes().splitlines()) for name in files}


def is_in(file: str, path: str) -> bool:
    """True if it is the file, if the file lies in the folder, or directly beside a pattern's other files."""
    if "*" not in path:
        return file == path or file.startswith(f"{path}/")
    return fnmatchcase(file, path) and file.count("/") == path.count("/")


def rooms(budgets: dict[str, Any], lines: dict[str, int]) -> list[Room]:
    """Every room with its lines; a file lies in the room with the longest path to it. AssertionError if it lies in none."""
    paths = {
        path: (part, name)
        for part, entries in budgets.items()
        for name, e in entries.items()
        for path in e.get("paths", ())
    }
    counts, homeless, top = Counter[tuple[str, str]](), list[str](), {path.split("/")[0] for path in paths}
    for file, count in lines.items():
        path = max((path for path in paths if is_in(file, path)), key=len, default=None)
        if path is not None:
            counts[paths[path]] += count
        elif file.split("/")[0] in top:
            homeless.append(file)
    assert not homeless, f"in no room: {homeless}"
    found = []
    for part, entries in budgets.items():
        for name, entry in entries.items():
            count = sum(n for (p, _), n in counts.items() if p == part) if name == "total" else counts[part, name]
            found.append(Room(part, name, count, entry["limit"]))
    return found


def measured() -> list[Room]:
    """The rooms of this checkout."""
    return rooms(tomllib.loads((REPOSITORY / "tests" / "budgets.toml").read_text("utf-8")), lines_by_file())


if __name__ == "__main__":
    print(f"{'room':40} {'lines':>7} {'budget':>7}")
    for room in measured():
        print(f"{room.name:40} {room.lines:7} {room.limit:7}")
