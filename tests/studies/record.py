"""The record of a release: what was measured, with what, and hashes of inputs and outputs, so that anybody can get the same again.

`PYTHONPATH=tests python -m studies.record [NAME...] [--out FILE.json]`: runs acceptance.toml's entries without `long` and those of
record.toml, or some of them, and writes docs/record.json and the page beside it. But for `measured` (times, memory, map sizes) its bytes
are the same whenever it is made of the same commit on the same machine; `sha256` is of figures, hashes and poses alone.

`--check` repeats what record.toml calls `repeated` and compares: exit status 1 where a pose is more than 0.1 mm, or 0.1 mm/m, away from the
record's, or another figure came out.
"""

import argparse
import hashlib
import json
import re
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from acceptance import compared
from fleetmap.recordings.tum import parse_tum
from studies.study import Column, about, between_marks, table
from support.programs import TESTS, run

RECORD = TESTS.parent / "docs" / "record.json"
MOST_MM = 0.1  # of a pose's origin, and of points 1 m from it by its rotation
# In names of what no run repeats. The bytes of a map are some more or less, since its manifest says how long the build took, and the index
# of its pictures says when it kept them.
_MEASURED = re.compile(r"cpu|rss|seconds|_ms(?![a-z])|map_bytes|pictures/sha256")
_SHA256 = re.compile(r"[0-9a-f]{64}")

Record = dict[str, Any]


def entries_of(commit: str) -> tuple[dict[str, Any], dict[str, str]]:
    """What is to be measured, each seed an entry, and why programs are left out."""
    listed, more = (tomllib.loads((TESTS / f"{name}.toml").read_text("utf-8")) for name in ("acceptance", "record"))
    also, seeds = more.pop("also"), more.pop("seeds")
    programs = {name: entry["command"].split()[0] for name, entry in listed.items()}
    missing = {program: "no entry of acceptance.toml runs it" for program in also if program not in programs.values()}
    taken = {name: entry for name, entry in listed.items() if not entry.get("long") or programs[name] in also}
    for name, entry in more.items():
        numbers = [int(sha256([commit, n])[:7], 16) for n in range(seeds)] if "{seed}" in entry["command"] else [None]
        for seed in numbers:
            command = entry["command"].replace("{seed}", str(seed))
            taken[name if seed is None else f"{name} {seed}"] = entry | {"command": command}
    return taken, missing


def sha256(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def leaves(values: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Every value of JSON that is no table or list, with its path."""
    if not isinstance(values, dict | list):
        yield path, values
        return
    for key, value in values.items() if isinstance(values, dict) else enumerate(values):
        yield from leaves(value, f"{path}/{key}")


def record(entries: dict[str, Any], found: dict[str, Any]) -> Record:
    """Of what entries found: figures, hashes and poses, which anybody gets again, their hash, and figures which nobody does."""
    made: Record = {"figures": {}, "hashes": {}, "poses": {}, "measured": {}}
    for name, values in found.items():
        for figure, *what in compared(entries[name], values):
            part = "measured" if _MEASURED.search(figure) else "figures"
            made[part][f"{name}/{figure}"] = dict(zip(("value", "limit", "holds"), what, strict=True))
        for path, leaf in leaves(values, name):
            if path.endswith(".tum") and entries[name].get("repeated"):
                made["poses"][path] = leaf
            elif path.endswith(".tum"):
                made["hashes"][path] = sha256(leaf)
            elif isinstance(leaf, str) and _SHA256.fullmatch(leaf) and not _MEASURED.search(path):
                made["hashes"][path] = leaf
    return made | {"sha256": sha256([made[part] for part in ("figures", "hashes", "poses")])}


def page(made: Record) -> str:
    """What the record says, as tables."""
    columns = [Column(key, key) for key in ("figure", "value", "limit", "holds")]
    figures, measured = (
        table([{"figure": name} | of for name, of in made[part].items()], columns) for part in ("figures", "measured")
    )
    made_with = [f"* {what}: {value}" for what, value in made["about"].items()]
    missing = [f"* {name}: {why}" for name, why in made["missing"].items()]
    hashes = f"SHA-256 of all figures, poses and {len(made['hashes'])} hashes: `{made['sha256']}`"
    tables = [figures, "## Times, memory, bytes of maps", measured, "## Not measured", "\n".join(missing)]
    return "\n\n".join([hashes, "\n".join(made_with), *tables])


def differences(kept: Record, now: Record) -> tuple[list[str], list[str]]:
    """What came out otherwise, in words: what may pass, and what may not."""
    passed = [f"{path}: other bytes" for path, sha in kept["hashes"].items() if now["hashes"].get(path) != sha]
    values = {path: (now["figures"].get(path, {}).get("value"), of["value"]) for path, of in kept["figures"].items()}
    beyond = [f"{path}: {mine}, in the record {theirs}" for path, (mine, theirs) in values.items() if mine != theirs]
    for path, text in kept["poses"].items():
        mine, theirs = parse_tum(now["poses"].get(path, "")), parse_tum(text)
        if not np.array_equal(mine.stamps_ns, theirs.stamps_ns):
            beyond.append(f"{path}: {len(mine)} poses, in the record {len(theirs)}, or other stamps")
        elif now["poses"][path] != text:  # of the poses' axes, 1 m long, and origins
            apart = 1e3 * np.linalg.norm((mine.frame_from_body - theirs.frame_from_body)[:, :3], axis=1).max(axis=0)
            words = f"{path}: up to {apart[3]:.2g} mm apart, and turned by {apart[:3].max():.2g} mm/m"
            (passed if apart.max() <= MOST_MM else beyond).append(words)
    return passed, beyond


def check(kept: Record) -> int:
    """Repeats what is `repeated`, says how it compares with the record, and returns the exit status."""
    here, entries = about(), {name: entry for name, entry in entries_of("")[0].items() if entry.get("repeated")}
    print("\n".join(f"{what}: {here[what]} here, {kept['about'].get(what)} in the record" for what in here))
    found, missing = run(entries)
    for part in ("figures", "hashes", "poses"):
        kept[part] = {path: value for path, value in kept[part].items() if path.partition("/")[0] in found}
    passed, beyond = differences(kept, record(entries, found))
    print("\n".join([*passed, *beyond, *(f"{name}: {why}" for name, why in missing.items())]))
    verdict = "DIFFERS" if beyond else f"at most {MOST_MM} mm apart" if passed else "equal"
    print(f"{len(kept['hashes'])} hashes and {len(kept['poses'])} trajectories of {', '.join(found)}: {verdict}")
    return 1 if beyond or not kept["poses"] or any("FAILED" in why for why in missing.values()) else 0


def main() -> None:
    """The command."""
    here, begun_s = about(), time.monotonic()
    entries, missing = entries_of(here["commit"].split()[0])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *{name.split()[0]: None for name in entries}])
    parser.add_argument("--check", action="store_true", help="repeat a part and compare it with the record")
    parser.add_argument("--out", type=Path, default=RECORD)
    given = parser.parse_args()
    if given.check:
        sys.exit(check(json.loads(given.out.read_text("utf-8"))))
    asked = {name: entry for name, entry in entries.items() if not given.names or name.split()[0] in given.names}
    found, failed = run(asked)
    missing |= {name: "not asked for" for name in entries if name not in asked} | failed
    made = {"about": here, "missing": missing} | record(asked, found)
    made["measured"]["minutes in all"] = {"value": round((time.monotonic() - begun_s) / 60), "limit": "", "holds": True}
    given.out.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    text = between_marks(RECORD.with_suffix(".md").read_text("utf-8"), page(made), RECORD)
    given.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(page(made))
    holds = all(of["holds"] for part in ("figures", "measured") for of in made[part].values())
    sys.exit(0 if holds and not failed else 1)


if __name__ == "__main__":
    main()
