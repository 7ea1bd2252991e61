"""Entries of acceptance.toml and such files, run."""

import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from support.recordings.realdata import DATA

TESTS = Path(__file__).resolve().parents[1]


def run(entries: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Runs modules with this interpreter in the repository's root; returns the JSON that each wrote, and why others wrote none."""
    found, missing = dict[str, Any](), dict[str, str]()
    for name, entry in entries.items():
        if absent := [needed for needed in entry.get("needs", []) if not (DATA / needed).is_dir()]:
            missing[name] = f"NOT MEASURED, {', '.join(absent)} not found in {DATA}"
            continue
        with tempfile.TemporaryDirectory() as scratch:
            out = Path(scratch) / "figures.json"
            words = [str(out) if word == "{out}" else word for word in shlex.split(entry["command"])]
            if subprocess.run([sys.executable, "-m", *words], cwd=TESTS.parent, check=False).returncode:
                missing[name] = f"{entry['command']} FAILED"
            else:
                found[name] = json.loads(out.read_text("utf-8"))
    return found, missing
