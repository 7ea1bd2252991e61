"""What all studies share: results that are kept as they come, and the page that shows them.

A study is a module of this folder with a `main`; `make study NAME=square` runs it. Its rows are kept in docs/studies/NAME.json after each
case, so that one that was stopped goes on where it was; `make study NAME=square FRESH=1` begins anew. JOBS=2 makes two cases at a time,
each in a process of its own.
Its page is docs/studies/NAME.md: prose by hand, and between two marks the tables of the last run.
"""

import importlib.metadata
import io
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import starmap
from multiprocessing import get_context
from pathlib import Path
from shutil import which
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_info

PAGES = Path(__file__).parents[2] / "docs" / "studies"
_BEGIN, _END = "<!-- begin of results -->", "<!-- end of results -->"
_VERSIONS = "numpy", "scipy", "gtsam", "opencv-python-headless"

Row = dict[str, Any]


class Column(NamedTuple):
    """A column of a table: the row's key, what stands above it, and how a value is written."""

    key: str
    title: str
    form: str = "{}"


def study(main: Callable[[], None]) -> Callable[[], None]:
    """Runs a function where its file is the program."""
    if main.__module__ == "__main__":
        main()
    return main


def results(name: str, cases: Mapping[str, Callable[[], Row]], seeds: Sequence[int] = ()) -> list[Row]:
    """A row for each case: those in the kept file, the others made now and kept one by one. `seeds` are kept beside them."""
    path = PAGES / f"{name}.json"
    kept = json.loads(path.read_text()) if path.exists() and not os.environ.get("FRESH") else {}
    rows = {row["case"]: row for row in kept.get("rows", []) if row["case"] in cases}
    missing = {case: make for case, make in cases.items() if case not in rows}
    made = _made(missing, int(os.environ.get("JOBS") or 1))
    for row in track(made, name, len(missing), console=Console(stderr=True), disable=len(cases) < 2):
        rows[row["case"]] = row
        path.parent.mkdir(parents=True, exist_ok=True)
        known = {"about": about(), "seeds": list(seeds), "rows": [rows[c] for c in cases if c in rows]}
        beside = path.with_suffix(".part")
        beside.write_text(json.dumps(known, indent=1) + "\n")
        beside.replace(path)
    return [rows[case] for case in cases if case in rows]


def about() -> Row:
    """The commit, the machine and the libraries, in words."""
    root, git = PAGES.parents[1], which("git") or "false"
    head, changed = (
        subprocess.run([git, *words], cwd=root, capture_output=True, text=True, check=False).stdout.split()
        for words in (["rev-parse", "HEAD"], ["diff", "--name-only", "HEAD", "--", ".", ":!docs"])
    )
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", cpuinfo.read_text() if cpuinfo.exists() else "")
    kernels = {f"{of['internal_api']} {of['version']} {of.get('architecture')}" for of in threadpool_info()}
    return {
        "commit": " ".join([*(head or ["unknown"]), *(["and changes of", *changed] if changed else [])]),
        "machine": f"{platform.machine()}, {model[1] if model else 'unknown processor'}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "linear algebra": ", ".join(sorted(kernels)),
    } | {package: importlib.metadata.version(package) for package in _VERSIONS}


def _made(cases: Mapping[str, Callable[[], Row]], jobs: int) -> Iterator[Row]:
    """The rows as they are ready, begun in the order of the cases; with several jobs each has a process."""
    if jobs == 1:
        yield from starmap(_timed, cases.items())
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_timed, *case) for case in cases.items()]):
            yield done.result()


def _timed(case: str, make: Callable[[], Row]) -> Row:
    """The row of a case, with its name and what it took."""
    begin_s = sum(os.times()[:4])  # of this process and of those that it waited for
    return {"case": case, **make(), "cpu_s": round(sum(os.times()[:4]) - begin_s, 2)}


def environment(name: str, *wheels: str) -> Path:
    """The folder of an environment of these wheels alone, made where it is not there yet; RuntimeError where they cannot be had."""
    folder = Path(sys.prefix) / name
    install = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", *wheels]
    for command in () if (folder / "complete").exists() else ([sys.executable, "-m", "venv", folder], install):
        if subprocess.run(command, check=False).returncode:
            raise RuntimeError(f"{' '.join(wheels)} IS MISSING, without it this study shows nothing")
    (folder / "complete").touch()
    return folder


def table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Markdown; a value that a row lacks is left open."""
    lines = ["| " + " | ".join(c.title for c in columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        cells = ["" if row.get(c.key) is None else c.form.format(row[c.key]) for c in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def between_marks(text: str, content: str, path: Path) -> str:
    """The text of a page with this between its two marks; ValueError where it has none."""
    before, _, rest = text.partition(_BEGIN)
    if _END not in rest:
        raise ValueError(f"{path} lacks the lines {_BEGIN} and {_END}; add them where the tables belong")
    return "\n\n".join([before + _BEGIN, content, _END + rest.partition(_END)[2]])


def publish(name: str, tables: Sequence[str], figure: Figure | None) -> None:
    """Writes the tables between the marks of the study's page and the picture beside it, and prints the tables."""
    page = PAGES / f"{name}.md"
    about = json.loads((PAGES / f"{name}.json").read_text())
    hours = sum(row["cpu_s"] for row in about["rows"]) / 3600
    made = ", ".join(f"{what} {value}" for what, value in about["about"].items())
    seeds = f"Seeds {', '.join(map(str, about['seeds']))}. " if about["seeds"] else ""
    note = f"{seeds}{hours:.2g} CPU hours. {made}."
    page.write_text(between_marks(page.read_text(), "\n\n".join([*tables, note]), page))
    print("\n\n".join([*tables, note]))
    if figure is not None:
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110, facecolor="white", metadata={"Software": None})
        (PAGES / f"{name}.png").write_bytes(buffer.getvalue())


def rms(errors: np.ndarray[Any, Any]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))
