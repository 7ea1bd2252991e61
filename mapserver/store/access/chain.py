"""The chain of the log: the hash of a line covers the line and the hash of the line before it. Pure."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass

COLUMNS = "id, stamp_ns, site, kind, detail, version, actor, reason, operator, address, sha256"


@dataclass(frozen=True, slots=True)
class AuditLine:
    """One line of the log. operator: the authenticated name, empty if none; address: of the request."""

    id: int
    stamp_ns: int
    site: str
    kind: str
    detail: str
    version: int | None
    actor: str
    reason: str
    operator: str
    address: str
    sha256: str


def line_sha256(before: str, values: Sequence[object]) -> str:
    """Return the hash of a line with these columns, all but the hash, after a line of hash `before` (empty for the first)."""
    return hashlib.sha256(json.dumps([before, *values], separators=(",", ":")).encode()).hexdigest()


def chain_head(lines: Iterable[AuditLine]) -> str:
    """Return the hash to which the line after these, oldest first, is chained."""
    before = ""
    for line in lines:
        before = line.sha256 or line_sha256(before, astuple(line)[:-1])
    return before


def chain_faults(lines: Iterable[AuditLine]) -> list[str]:
    """Return changed or missing lines, oldest first. A log rewritten completely from some line on shows no fault."""
    faults: list[str] = []
    before, number, is_chained = "", 0, False
    for line in lines:
        if line.id != number + 1:
            faults.append(f"lines {number + 1} to {line.id - 1} are missing")
        values = astuple(line)[:-1]
        expected = line_sha256(before, values)
        # The first lines of a store from before the chain have no hash. The first chained line covers them all; in some stores it was
        # written as if it were the very first, and covers none of them.
        right = {expected} if is_chained else {expected, line_sha256("", values), ""}
        if line.sha256 not in right:
            faults.append(f"line {line.id} was changed, or follows a removed one")
        is_chained |= bool(line.sha256)
        before, number = line.sha256 or expected, line.id
    return faults
