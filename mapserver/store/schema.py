"""The tables of the database, most with a column for each field of a record in `rows`.

A change is a further migration, known by its name; a released one is never changed.
"""

from collections.abc import Callable
from dataclasses import fields
from types import NoneType
from typing import TYPE_CHECKING, get_args

from mapserver.fleet_statistics.kpis import Counters
from mapserver.store import rows

if TYPE_CHECKING:
    from sqlite_utils import Database

_OF_VERSION = "FOREIGN KEY (site, version) REFERENCES versions(site, version)"
_TYPES = {int: "INTEGER", bool: "INTEGER", str: "TEXT", float: "REAL", bytes: "BLOB"}


def _columns(record: type, *without: str) -> str:
    """Return the columns of a record; its `id` or `number` is that of the row. What is no number, text or bytes is JSON."""
    found = []
    for each in (each for each in fields(record) if each.name not in without):
        kinds = get_args(each.type) or (each.type,)
        words = "" if NoneType in kinds else " NOT NULL"
        words = " PRIMARY KEY" if each.name in ("id", "number") else words
        found.append(f"{each.name} {_TYPES.get(kinds[0], 'TEXT')}{words}")
    return ", ".join(found)


def _one_of(column: str, *values: str) -> str:
    return f"CHECK ({column} IN ({', '.join(repr(value) for value in values)}))"


def _blobs_of_version(more: str = "") -> str:
    key = f"site, version, {'kind, ' if more else ''}sha256"
    return (
        f"site TEXT NOT NULL, version INTEGER NOT NULL, {more}sha256 TEXT NOT NULL, PRIMARY KEY ({key}), {_OF_VERSION}"
    )


_COMPACT = {"version_blobs", "grid_blobs", "surfel_blobs", "site_files", "evidence", "operators", "sessions", "tokens"}
_COMPACT |= {"robots", "tallies", "traces"}
"""Tables that lie in their key: small rows, always found by it."""

TABLES = {
    "sites": "site TEXT PRIMARY KEY, last_version INTEGER NOT NULL DEFAULT 0",
    "versions": f"""{_columns(rows.VersionInfo)}, PRIMARY KEY (site, version), FOREIGN KEY (site) REFERENCES sites(site),
        CHECK (version >= 1), {_one_of("state", "draft", "published", "current", "retired")}""",
    "version_blobs": _blobs_of_version(
        "kind TEXT NOT NULL CHECK (kind IN ('manifest', 'tile', 'vocabulary', 'archive')), "
    ),
    # What no robot fetches: the grid of planners, and the surfels with the pictures of surveys, each an index and tiles or pictures
    "grid_blobs": _blobs_of_version(),
    "surfel_blobs": _blobs_of_version(),
    # What belongs to a site and to no version, such as the drawing of its building
    "site_files": """site TEXT NOT NULL REFERENCES sites(site), kind TEXT NOT NULL, sha256 TEXT NOT NULL,
        PRIMARY KEY (site, kind)""",
    # What was current, in that order: rolling back takes the last row away
    "currents": f"""id INTEGER PRIMARY KEY, site TEXT NOT NULL, version INTEGER NOT NULL, since_ns INTEGER NOT NULL,
        {_OF_VERSION}""",
    # What was measured of a draft when it was built; the gate judges by it later
    "evidence": f"""site TEXT NOT NULL, version INTEGER NOT NULL, figures TEXT NOT NULL, PRIMARY KEY (site, version),
        {_OF_VERSION}""",
    "verdicts": f"""id INTEGER PRIMARY KEY, site TEXT NOT NULL, version INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
        accepted INTEGER NOT NULL, forced INTEGER NOT NULL, reasons TEXT NOT NULL, report TEXT NOT NULL,
        CHECK (accepted IN (0, 1) AND forced IN (0, 1)), {_OF_VERSION}""",
    "canaries": f"{_columns(rows.CanaryRow)}, {_one_of('state', 'running', 'promoted', 'rolled_back', 'stopped')}",
    "jobs": f"{_columns(rows.JobInfo)}, {_one_of('state', 'running', 'done', 'failed')}",
    "events": _columns(rows.AuditLine).replace("TEXT NOT NULL", "TEXT NOT NULL DEFAULT ''"),  # the log
    "operators": f"""{_columns(rows.OperatorRow, "tokens", "sessions")}, PRIMARY KEY (name), CHECK (is_disabled IN (0, 1)),
        {_one_of("role", "viewer", "operator", "admin", "program")}""",
    "sessions": """sha256 TEXT PRIMARY KEY, name TEXT NOT NULL REFERENCES operators(name), begun_ns INTEGER NOT NULL,
        used_ns INTEGER NOT NULL""",
    "tokens": """sha256 TEXT PRIMARY KEY, name TEXT NOT NULL REFERENCES operators(name), scopes TEXT NOT NULL,
        ends_ns INTEGER NOT NULL""",
    "robots": f"{_columns(rows.RobotInfo)}, PRIMARY KEY (site, robot)",
    # What is counted by: an axis of `AXES` and a key of it
    "tally_keys": """id INTEGER PRIMARY KEY, site TEXT NOT NULL, axis TEXT NOT NULL, key TEXT NOT NULL,
        UNIQUE (site, axis, key)""",
    "tallies": f"key_id INTEGER NOT NULL, hour INTEGER NOT NULL, {_columns(Counters)}, PRIMARY KEY (key_id, hour)",
    "traces": f"key_id INTEGER NOT NULL, {_columns(rows.TraceRow, 'site', 'robot')}, PRIMARY KEY (hour, key_id, stamp_ns)",
    "failures": f"{_columns(rows.FailureRow)}, report BLOB NOT NULL, UNIQUE (site, robot, failure_id)",
    "failure_pictures": """number INTEGER NOT NULL REFERENCES failures(number) ON DELETE CASCADE, place INTEGER NOT NULL,
        kind TEXT NOT NULL, stamp_ns INTEGER NOT NULL, jpeg BLOB NOT NULL, PRIMARY KEY (number, place)""",
    # The recording of the seconds around a failure, and its summary
    "failure_replays": """number INTEGER PRIMARY KEY REFERENCES failures(number) ON DELETE CASCADE, summary BLOB NOT NULL,
        mcap BLOB NOT NULL""",
}
"""Columns and constraints by name, each table after those that it refers to."""

INDEXES = [
    "CREATE UNIQUE INDEX one_current_per_site ON versions(site) WHERE state = 'current'",
    "CREATE UNIQUE INDEX one_canary_per_site ON canaries(site) WHERE state = 'running'",
    "CREATE INDEX version_blobs_by_address ON version_blobs(sha256)",
    "CREATE INDEX verdicts_by_version ON verdicts(site, version)",
    "CREATE INDEX jobs_by_site ON jobs(site)",
    "CREATE INDEX events_by_site ON events(site)",
    "CREATE INDEX failures_by_time ON failures(site, happened_ns)",
]


def statements(compact: str = " WITHOUT ROWID") -> list[str]:
    """Return the statements that make all tables, without triggers."""
    made = [f"CREATE TABLE {name} ({text}){compact if name in _COMPACT else ''}" for name, text in TABLES.items()]
    return made + INDEXES


def tables(database: "Database") -> None:
    """Create the first schema."""
    for statement in statements():
        database.execute(statement)
    for name, change, words in (
        ("events_are_kept", "DELETE", "shortened"),
        ("events_stay_as_they_are", "UPDATE", "changed"),
    ):
        database.execute(
            f"""CREATE TRIGGER {name} BEFORE {change} ON events
                BEGIN SELECT RAISE(ABORT, 'the log of events is never {words}'); END"""
        )


MIGRATIONS: list[Callable[["Database"], None]] = [tables]
FORMAT = 12 + len(MIGRATIONS)  # there were 12 before migrations had names
"""SQLite's user_version of a database with all migrations: reveals an older database by its header, and is newer for older programs."""


def names(record: type) -> str:
    """Return the columns of a record for a SELECT."""
    return ", ".join(each.name for each in fields(record))
