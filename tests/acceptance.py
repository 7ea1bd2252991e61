"""Measures the figures of acceptance.toml and compares them with their limits: `make acceptance`, before and after a large change.

`PYTHONPATH=tests python tests/acceptance.py [NAME...] [--all] [--out FILE.json]`: without names the entries that are not marked `long`.
Each entry is a module with its options, which writes JSON to the path in place of `{out}`, and limits of figures in it: keys or numbers
joined by `/`, with `*` as in names of files. Times are CPU times at the yardstick's reference. Entries whose recordings are missing are
reported as not measured. Exit status 1 on any miss; a command that fails is one. Figures under `shown` have no limit.
"""

import argparse
import json
import operator
import sys
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from support.programs import TESTS, run

COMPARISONS = {"at_most": operator.le, "at_least": operator.ge, "equals": operator.eq, "shown": lambda *_: True}


def figures_at(values: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Every figure that a path of keys names, with its full path."""
    first, _, rest = path.partition("/")
    for key, value in values.items() if isinstance(values, dict) else enumerate(values):
        if not fnmatchcase(str(key), first):
            continue
        for name, figure in figures_at(value, rest) if rest else [("", value)]:
            yield f"{key}/{name}".rstrip("/"), figure


def compared(entry: dict[str, Any], values: Any) -> Iterator[tuple[str, Any, str, bool]]:
    """Figure, value, limit and whether it holds, which no limit does whose path names no figure."""
    for how, holds in COMPARISONS.items():
        for path, limit in entry.get(how, {}).items():
            for name, value in list(figures_at(values, path)) or [(path, None)]:
                yield name, value, f"{how} {limit}", value is not None and holds(value, limit)


def main() -> None:
    """The command."""
    entries: dict[str, Any] = tomllib.loads((TESTS / "acceptance.toml").read_text("utf-8"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *entries])
    parser.add_argument("--all", action="store_true", help="also the entries that take hours")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    names = given.names or [name for name, entry in entries.items() if given.all or not entry.get("long")]
    found, missing = run({name: entries[name] for name in names})
    lines = [f"{name}: {why}" for name, why in missing.items()]
    missed = sum("FAILED" in line for line in lines)
    for name, values in found.items():
        for figure, value, limit, holds in compared(entries[name], values):
            shown = f"{value:.4g}" if isinstance(value, float) else value
            lines.append(f"{name}: {figure} = {shown}, {limit}{'' if holds else '  MISSED'}")
            missed += not holds
    print("\n".join(lines))
    if given.out is not None:
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
