"""Measures the figures of acceptance.toml and compares them with their limits: `make acceptance`, before and after a large change.

`PYTHONPATH=tests python tests/acceptance.py [NAME...] [--all] [--out FILE.json]`: without names the entries that are not marked `long`.
Each entry is a module with its options, which writes JSON to the path in place of `{out}`, and limits of figures in it: keys joined by
`/`, `*` for every entry of a list or table. Times are CPU times at the yardstick's reference. Entries whose recordings are missing are
reported as not measured. Exit status 1 on any miss; a command that fails is one.
"""

import argparse
import json
import operator
import shlex
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from support.recordings.realdata import DATA

TESTS = Path(__file__).resolve().parent
COMPARISONS = {"at_most": operator.le, "at_least": operator.ge, "equals": operator.eq}


def measured(command: str, folder: Path) -> Any:
    """Runs a module with this interpreter in the repository's root; returns the JSON that it wrote, None if it failed."""
    out = folder / "figures.json"
    out.unlink(missing_ok=True)
    words = [str(out) if word == "{out}" else word for word in shlex.split(command)]
    done = subprocess.run([sys.executable, "-m", *words], cwd=TESTS.parent, check=False)
    return None if done.returncode else json.loads(out.read_text("utf-8"))


def figures_at(values: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Every figure that a path of keys names, with its full path; KeyError if the path names none."""
    first, _, rest = path.partition("/")
    keys = range(len(values)) if isinstance(values, list) else list(values)
    for key in keys if first == "*" else [int(first) if isinstance(values, list) else first]:
        if not rest:
            yield str(key), values[key]
            continue
        for name, value in figures_at(values[key], rest):
            yield f"{key}/{name}", value


def compared(entry: dict[str, Any], values: Any) -> Iterator[tuple[str, Any, str, bool]]:
    """Figure, value, limit and whether it holds."""
    for how, holds in COMPARISONS.items():
        for path, limit in entry.get(how, {}).items():
            for name, value in figures_at(values, path):
                yield name, value, f"{how} {limit}", value is not None and holds(value, limit)


def main() -> None:
    """The command."""
    entries: dict[str, Any] = tomllib.loads((TESTS / "acceptance.toml").read_text("utf-8"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *entries])
    parser.add_argument("--all", action="store_true", help="also the entries that take hours")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    kept: dict[str, Any] = {}
    lines, missed = [], 0
    with tempfile.TemporaryDirectory() as scratch:
        for name in given.names or [name for name, entry in entries.items() if given.all or not entry.get("long")]:
            entry = entries[name]
            if absent := [needed for needed in entry.get("needs", []) if not (DATA / needed).is_dir()]:
                lines.append(f"{name}: NOT MEASURED, {', '.join(absent)} not found in {DATA}")
                continue
            kept[name] = measured(entry["command"], Path(scratch))
            if kept[name] is None:
                lines.append(f"{name}: {entry['command']} FAILED")
                missed += 1
                continue
            for figure, value, limit, holds in compared(entry, kept[name]):
                shown = f"{value:.4g}" if isinstance(value, float) else value
                lines.append(f"{name}: {figure} = {shown}, {limit}{'' if holds else '  MISSED'}")
                missed += not holds
    print("\n".join(lines))
    if given.out is not None:
        given.out.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
