"""The chain of the log: the hash of a line covers the line and the hash of the line before it. Pure."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import astuple

from mapserver.store.rows import AuditLine


def line_sha256(before: str, values: Sequence[object]) -> str:
    """Return the hash of a line with these columns, all but the hash, after a line of hash `before` (empty for the first)."""
    return hashlib.sha256(json.dumps([before, *values], separators=(",", ":")).encode()).hexdigest()


def chain_faults(lines: Iterable[AuditLine]) -> list[str]:
    """Return changed or missing lines, oldest first. A log rewritten completely from some line on shows no fault."""
    faults: list[str] = []
    before, number = "", 0
    for line in lines:
        if line.id != number + 1:
            faults.append(f"lines {number + 1} to {line.id - 1} are missing")
        if line.sha256 != line_sha256(before, astuple(line)[:-1]):
            faults.append(f"line {line.id} was changed, or follows a removed one")
        before, number = line.sha256, line.id
    return faults
