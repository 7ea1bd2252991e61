"""The fleet's health in the store: sums by the hour, thinned traces, failures with their pictures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from itertools import accumulate
from typing import Any

import msgspec

from fleetmap.encoding import MOST, to_json, to_msgpack
from fleetmap.errors import LinkError, UsageError
from fleetmap.messages import FailureReport, decode_message
from mapserver.fleet_statistics.kpis import COUNTER_COLUMNS, Counters, hour_of
from mapserver.floor_plan.areas import Areas
from mapserver.store.rows import (
    AXES,
    UNLIMITED,
    FailureDetail,
    FailureFilter,
    FailureReplay,
    FailureRow,
    FleetRetention,
    PictureRow,
    TraceRow,
)
from mapserver.store.transactions import Connection, Transactions

CounterKey = tuple[str, str, str, int]
"""Site, axis, key, hour."""

LastReports = dict[tuple[str, str], tuple[int | None, int, dict[str, Any]]]
"""By (site, robot): its version (None if not reported), the time of its last report, and that report."""

_DAY_NS = 86_400_000_000_000
_USUAL_RETENTION = FleetRetention()
_PRUNED_SHARE = 0.95  # of the limit of pictures' bytes: pruning to this share avoids a new sum at each picture
_SHRINK_PAGES = 20_000  # 80 MB, to keep waiting times short
_SUMS = ", ".join(f"sum(t.{name}) {name}" for name in COUNTER_COLUMNS)
_SUMS_OF_WINDOW = _SUMS.replace("sum(t.continued)", "sum(CASE WHEN t.hour = ?4 THEN t.continued ELSE 0 END)")
_COUNTED = """FROM tally_keys k JOIN tallies t ON t.key_id = k.id
    WHERE k.axis = ?1 AND (?2 IS NULL OR k.site = ?2) AND (?3 IS NULL OR k.key = ?3) AND t.hour >= ?4 AND t.hour < ?5"""
_ADD = f"""INSERT INTO tallies (key_id, hour, {", ".join(COUNTER_COLUMNS)})
    VALUES (?, ?, {", ".join("?" * len(COUNTER_COLUMNS))})
    ON CONFLICT (key_id, hour)
    DO UPDATE SET {", ".join(f"{name} = tallies.{name} + excluded.{name}" for name in COUNTER_COLUMNS)}"""
_KEYS_AT_ONCE = 100
_NO_FAILURE = "failure {} does not exist; the list of failures shows the stored ones"
_REPORT_COLUMNS = ("site", "robot", "duration_s", "kind", "cause", "status", "version")
_TRACED = tuple(TraceRow.__dataclass_fields__)[2:]
_TRACE_COLUMNS = ", ".join(_TRACED)
# Earlier versions stored what robots sent: a row with a number that none can mean is shown without it.
_FAILURE_COLUMNS = ", ".join(
    f"CASE WHEN abs({name}) <= {MOST} THEN {name} END {name}" if name in {"x_map_m", "y_map_m"} else name
    for name in FailureRow.__dataclass_fields__
)


@dataclass(slots=True)
class FleetBatch:
    """Data since the last batch."""

    counters: dict[CounterKey, Counters] = field(default_factory=dict)
    traces: list[TraceRow] = field(default_factory=list)
    last_reports: LastReports = field(default_factory=dict)

    def add(self, site: str, axis: str, key: str, hour: int, counts: Counters) -> None:
        self.counters.setdefault((site, axis, key, hour), Counters()).add(counts)


class FleetQueries:
    """The fleet's health in an open store."""

    def __init__(self, transactions: Transactions) -> None:
        self._transactions = transactions
        self._picture_bytes = -(1 << 62)  # looked up at the first failure

    def add(self, batch: FleetBatch) -> None:
        """Store a batch in one transaction. A power cut may lose the last batches, never failures."""
        with self._transactions.write(durable=False) as connection:
            keys = [key[:3] for key in batch.counters] + [(row.site, "robot", row.robot) for row in batch.traces]
            ids = self._ids(connection, keys)
            _add_counters(connection, ids, batch.counters)
            where = [(ids[row.site, "robot", row.robot], row) for row in batch.traces]
            connection.executemany(
                f"""INSERT INTO traces (key_id, {_TRACE_COLUMNS}) VALUES ({", ".join("?" * (1 + len(_TRACED)))})
                    ON CONFLICT DO NOTHING""",
                [(key_id, *astuple(row)[2:]) for key_id, row in where],
            )
            keep_last_reports(connection, batch.last_reports)

    def add_failure(
        self,
        report: FailureReport,
        times_ns: tuple[int, int],
        counters: Mapping[CounterKey, Counters],
        retention: FleetRetention = _USUAL_RETENTION,
        area: str | None = None,
    ) -> bool:
        """Store a failure and its sums durably; False (and no change) for a known one.

        times_ns: time of receipt and of the failure; area: its place. Older failures of the robot, and the oldest
        pictures of all, are deleted above the limits.
        """
        received_ns, happened_ns = times_ns
        x_map_m, y_map_m = (None, None) if report.map_from_base is None else report.map_from_base.position_m[:2]
        row = {
            **{name: getattr(report, name) for name in _REPORT_COLUMNS},
            **{"failure_id": report.id, "received_ns": received_ns, "happened_ns": happened_ns},
            **{"tile": tile_key(report.tile), "x_map_m": x_map_m, "y_map_m": y_map_m, "area": area},
            "report": to_msgpack(msgspec.structs.replace(report, thumbnails=())),
        }
        with self._transactions.write() as connection:
            added = connection.execute(
                f"""INSERT INTO failures ({", ".join(row)}) VALUES ({", ".join(f":{name}" for name in row)})
                    ON CONFLICT DO NOTHING RETURNING number""",
                row,
            ).fetchone()
            if added is None:
                return False
            connection.executemany(
                "INSERT INTO failure_pictures VALUES (?, ?, ?, ?, ?)",
                [(added[0], n, t.kind, t.stamp_ns, t.jpeg) for n, t in enumerate(report.thumbnails)],
            )
            _prune_failures(connection, (report.site, report.robot), retention.failures_per_robot)
            self._picture_bytes += sum(len(thumbnail.jpeg) for thumbnail in report.thumbnails)
            if not 0 <= self._picture_bytes <= retention.picture_bytes:
                _prune_pictures(connection, _PRUNED_SHARE * retention.picture_bytes)
                self._picture_bytes = _sum_of_pictures(connection)
            _add_counters(connection, self._ids(connection, [key[:3] for key in counters]), counters)
        return True

    def counters(
        self, site: str | None, axis: str, *, since_hour: int = 0, until_hour: int = 1 << 60, key: str | None = None
    ) -> dict[tuple[str, str], Counters]:
        """Return sums by (site, key) of an axis over hours from `since_hour` to before `until_hour`."""
        values = (_axis(axis), site, key, since_hour, until_hour)
        query = f"SELECT k.site, k.key, {_SUMS_OF_WINDOW} {_COUNTED} GROUP BY k.id ORDER BY k.site, k.key"
        rows = self._transactions.query(query, values)
        return {(row.pop("site"), row.pop("key")): Counters(**row) for row in rows}

    def hours(
        self, site: str | None, axis: str, *, key: str | None = None, since_hour: int = 0, until_hour: int = 1 << 60
    ) -> dict[int, Counters]:
        """Return sums of an axis (and key) by the hour."""
        values = (_axis(axis), site, key, since_hour, until_hour)
        rows = self._transactions.query(f"SELECT t.hour, {_SUMS} {_COUNTED} GROUP BY t.hour ORDER BY t.hour", values)
        return {row.pop("hour"): Counters(**row) for row in rows}

    def failures(self, wanted: FailureFilter, *, before: int | None = None, limit: int = UNLIMITED) -> list[FailureRow]:
        return self._transactions.rows(
            FailureRow,
            f"""SELECT {_FAILURE_COLUMNS} FROM failures
                WHERE (?1 IS NULL OR site = ?1) AND (?2 IS NULL OR robot = ?2) AND (?3 IS NULL OR version = ?3)
                AND (?4 IS NULL OR tile = ?4) AND (?5 IS NULL OR cause = ?5) AND (?6 IS NULL OR kind = ?6)
                AND (?7 IS NULL OR happened_ns >= ?7) AND (?8 IS NULL OR happened_ns < ?8)
                AND (?9 IS NULL OR area = ?9) AND (?10 IS NULL OR number < ?10) ORDER BY number DESC LIMIT ?11""",
            (*astuple(wanted), before, limit),
        )

    def failure(self, number: int) -> FailureDetail:
        """Return one failure with its context; raises UsageError if it does not exist. An unreadable report has its row's columns only."""
        rows = self._transactions.query(f"SELECT {_FAILURE_COLUMNS}, report FROM failures WHERE number = ?", (number,))
        if not rows:
            raise UsageError(_NO_FAILURE.format(number))
        data = rows[0].pop("report")
        try:
            report = decode_message(data, FailureReport)
        except LinkError as error:
            words = f"the stored report cannot be read; `mapserver fleet remove {number}` removes it ({error})"
            known = {name: rows[0][name] for name in _REPORT_COLUMNS}
            at_ns = rows[0]["happened_ns"]
            report = FailureReport(
                id=rows[0]["failure_id"], stamp_ns=at_ns, wall_ns=at_ns, calibration=words[:2000], **known
            )
        query = "SELECT place, kind, stamp_ns, length(jpeg) bytes FROM failure_pictures WHERE number = ? ORDER BY place"
        pictures = self._transactions.rows(PictureRow, query, (number,))
        return FailureDetail(FailureRow(**rows[0]), report, pictures)

    def remove_failure(self, number: int) -> None:
        """Remove a failure with its pictures and recording; the counts keep it. UsageError if it does not exist."""
        with self._transactions.write() as connection:
            if not connection.execute("DELETE FROM failures WHERE number = ?", (number,)).rowcount:
                raise UsageError(_NO_FAILURE.format(number))

    def picture(self, number: int, place: int) -> bytes:
        """Return the JPEG of a failure; raises UsageError if it does not exist or was deleted."""
        query = "SELECT jpeg FROM failure_pictures WHERE number = ? AND place = ?"
        rows = self._transactions.query(query, (number, place))
        if not rows:
            raise UsageError(f"failure {number} has no picture {place}; old pictures are deleted to save space")
        return bytes(rows[0]["jpeg"])

    def first_pictures(self, numbers: Iterable[int]) -> dict[int, int]:
        """Return by failure the place of its first camera picture, for failures that have one."""
        wanted = tuple(numbers)
        query = f"""SELECT number, min(place) place FROM failure_pictures WHERE kind != 'matches'
                    AND number IN ({", ".join("?" * len(wanted))}) GROUP BY number"""
        return {row["number"]: row["place"] for row in self._transactions.query(query, wanted)} if wanted else {}

    def failure_number(self, site: str, robot: str, failure_id: str) -> int | None:
        """Return the number of a robot's report, None if not stored."""
        query = "SELECT number FROM failures WHERE site = ? AND robot = ? AND failure_id = ?"
        rows = self._transactions.query(query, (site, robot, failure_id))
        return int(rows[0]["number"]) if rows else None

    def add_replay(self, number: int, replay: FailureReplay, keep_bytes: int) -> None:
        """Store a failure's recording, and its pictures with those of the failure; the oldest recordings are deleted, never this one."""
        with self._transactions.write() as connection:
            values = (number, replay.summary, replay.mcap)
            query = "INSERT INTO failure_replays VALUES (?, ?, ?) ON CONFLICT DO NOTHING"
            if not connection.execute(query, values).rowcount:
                return
            query = "SELECT coalesce(max(place) + 1, 0) FROM failure_pictures WHERE number = ?"
            (place,) = connection.execute(query, (number,)).fetchone()
            connection.executemany(
                "INSERT INTO failure_pictures VALUES (?, ?, ?, ?, ?)",
                [(number, place + n, "replay", stamp_ns, jpeg) for n, (stamp_ns, jpeg) in enumerate(replay.pictures)],
            )
            self._picture_bytes += sum(len(jpeg) for _, jpeg in replay.pictures)
            sizes = connection.execute(
                "SELECT number, length(mcap) FROM failure_replays ORDER BY number DESC"
            ).fetchall()
            gone = "DELETE FROM failure_replays WHERE number <= ? AND number <> ?"
            connection.execute(gone, (_newest_beyond(sizes, keep_bytes), number))

    def replay_summary(self, number: int) -> bytes | None:
        """Return the summary of a failure's recording, None if absent or deleted."""
        rows = self._transactions.query("SELECT summary FROM failure_replays WHERE number = ?", (number,))
        return bytes(rows[0]["summary"]) if rows else None

    def replay(self, number: int) -> bytes:
        """Return the MCAP file of a failure's recording; UsageError if absent or deleted."""
        rows = self._transactions.query("SELECT mcap FROM failure_replays WHERE number = ?", (number,))
        if not rows:
            raise UsageError(
                f"failure {number} has no recording: its robot sends none ([run] replays), has not sent it yet, or it was deleted for space"
            )
        return bytes(rows[0]["mcap"])

    def trace(self, site: str, robot: str, *, since_hour: int = 0, until_hour: int = 1 << 60) -> list[TraceRow]:
        """Return a robot's trace, oldest first, hour by hour: in the table, an hour's rows of other robots lie in between."""
        (ends,) = self._transactions.query("SELECT min(hour) first, max(hour) last FROM traces")
        if ends["first"] is None:
            return []
        return self._transactions.rows(
            TraceRow,
            f"""WITH RECURSIVE asked(at) AS (
                    SELECT CAST(? AS BIGINT) UNION ALL SELECT at + 1 FROM asked WHERE at < ?)
               SELECT k.site, k.key robot, {_TRACE_COLUMNS}
               FROM tally_keys k CROSS JOIN asked CROSS JOIN traces t WHERE t.hour = at AND t.key_id = k.id
               AND at < ? AND k.site = ? AND k.axis = 'robot' AND k.key = ? ORDER BY t.hour, t.stamp_ns""",
            (max(since_hour, ends["first"]), min(until_hour - 1, ends["last"]), until_hour, site, robot),
        )

    def prune(self, retention: FleetRetention) -> int:
        """Remove old or excess data; return the number of removed rows."""
        with self._transactions.write(durable=False) as connection:
            gone = 0
            for rows, before in self._expired(retention).values():
                gone += connection.execute(f"DELETE FROM {rows}", (before,)).rowcount
            # Whole hours of traces, the oldest first; the running hour stays
            hours = connection.execute("SELECT hour, count(*) FROM traces GROUP BY hour ORDER BY hour DESC").fetchall()
            last = _newest_beyond(hours[1:], retention.trace_rows - hours[0][1]) if hours else None
            gone += connection.execute("DELETE FROM traces WHERE hour <= ?", (last,)).rowcount
            gone += _prune_pictures(connection, retention.picture_bytes)
            self._picture_bytes = _sum_of_pictures(connection)
        self._transactions.shrink(_SHRINK_PAGES)
        return gone

    def expired(self, retention: FleetRetention) -> dict[str, int]:
        """Return by name how many rows are older than their period."""
        return {
            name: int(self._transactions.query(f"SELECT count(*) n FROM {rows}", (before,))[0]["n"])
            for name, (rows, before) in self._expired(retention).items()
        }

    def _expired(self, retention: FleetRetention) -> dict[str, tuple[str, int]]:
        """Return by name the rows older than their period, as a table with a condition, and the condition's parameter."""
        of_failures = "WHERE number IN (SELECT number FROM failures WHERE happened_ns < ?)"

        def before(days: float) -> int:
            return self._transactions.now_ns() - int(days * _DAY_NS)

        return {
            "figures by the hour": ("tallies WHERE hour < ?", hour_of(before(retention.tally_days))),
            "ways of robots": ("traces WHERE hour < ?", hour_of(before(retention.trace_days))),
            "pictures of failures": (f"failure_pictures {of_failures}", before(retention.picture_days)),
            "recordings of failures": (f"failure_replays {of_failures}", before(retention.replay_days)),
            "failures": ("failures WHERE happened_ns < ?", before(retention.failure_days)),
        }

    def _ids(self, connection: Connection, keys: Iterable[tuple[str, str, str]]) -> dict[tuple[str, str, str], int]:
        """Return the numbers of keys, new ones for unknown keys. They are asked for each time: a database that crashed, or was replaced by
        its replica, may have lost keys that a cache would still know, and counts would go to another one."""
        wanted, found = list(dict.fromkeys(keys)), dict[tuple[str, str, str], int]()
        for first in range(0, len(wanted), _KEYS_AT_ONCE):
            some = wanted[first : first + _KEYS_AT_ONCE]
            found |= _known_ids(connection, some)
            if new := [key for key in some if key not in found]:
                connection.executemany("INSERT INTO tally_keys (site, axis, key) VALUES (?, ?, ?)", new)
                found |= _known_ids(connection, new)
        return found


def _known_ids(connection: Connection, keys: Sequence[tuple[str, str, str]]) -> dict[tuple[str, str, str], int]:
    rows = connection.execute(
        f"SELECT site, axis, key, id FROM tally_keys WHERE (site, axis, key) IN (VALUES {', '.join(['(?, ?, ?)'] * len(keys))})",
        [part for key in keys for part in key],
    )
    return {(site, axis, key): int(number) for site, axis, key, number in rows.fetchall()}


def name_failures(connection: Connection, site: str, areas: Areas) -> None:
    """Set the present areas of a site's failures, within a transaction."""
    query = (
        "SELECT number, x_map_m, y_map_m FROM failures WHERE site = ? AND x_map_m IS NOT NULL AND y_map_m IS NOT NULL"
    )
    placed = connection.execute(query, (site,)).fetchall()
    connection.executemany("UPDATE failures SET area = ? WHERE number = ?", [(areas.at(x, y), n) for n, x, y in placed])


def keep_last_reports(connection: Connection, reports: LastReports) -> None:
    """Store the robots' last reports, within a transaction."""
    connection.executemany(
        """INSERT INTO robots (site, robot, version, last_seen_ns, last_report) VALUES (?, ?, ?, ?, ?)
           ON CONFLICT (site, robot) DO UPDATE SET version = coalesce(excluded.version, robots.version),
           last_seen_ns = excluded.last_seen_ns, last_report = excluded.last_report""",
        [
            (site, robot, version, seen_ns, to_json(report).decode())
            for (site, robot), (version, seen_ns, report) in reports.items()
        ],
    )


def tile_key(tile: tuple[int, int] | None) -> str | None:
    """Return a tile as text for keys and rows: "x,y"."""
    return None if tile is None else f"{tile[0]},{tile[1]}"


def _axis(axis: str) -> str:
    if axis not in AXES:
        raise UsageError(f"unknown axis {axis!r}; choose one of {', '.join(AXES)}")
    return axis


def _add_counters(
    connection: Connection, ids: Mapping[tuple[str, str, str], int], counters: Mapping[CounterKey, Counters]
) -> None:
    ordered = sorted(counters.items(), key=lambda item: item[0])
    connection.executemany(_ADD, [(ids[key[:3]], key[3], *counts.values()) for key, counts in ordered])


def _newest_beyond(rows: Sequence[tuple[int, int]], keep: float) -> int | None:
    """Return the newest number at which the sizes summed from the newest exceed `keep`. rows: number and size, the newest first."""
    sums = accumulate(size for _, size in rows)
    return next((number for (number, _), kept in zip(rows, sums, strict=True) if kept > keep), None)


def _prune_failures(connection: Connection, robot: tuple[str, str], keep: int) -> None:
    """Delete the oldest failures of a robot until `keep` remain; their pictures are deleted with them."""
    (count,) = connection.execute("SELECT count(*) FROM failures WHERE site = ? AND robot = ?", robot).fetchone()
    if count <= keep:
        return
    oldest = "SELECT number FROM failures WHERE site = ? AND robot = ? ORDER BY number LIMIT ?"
    connection.execute(f"DELETE FROM failures WHERE number IN ({oldest})", (*robot, count - keep))


def _sum_of_pictures(connection: Connection) -> int:
    return int(connection.execute("SELECT coalesce(sum(length(jpeg)), 0) FROM failure_pictures").fetchone()[0])


def _prune_pictures(connection: Connection, keep_bytes: float) -> int:
    sizes = connection.execute(
        "SELECT number, sum(length(jpeg)) FROM failure_pictures GROUP BY number ORDER BY number DESC"
    ).fetchall()
    last = _newest_beyond(sizes, keep_bytes)
    return connection.execute("DELETE FROM failure_pictures WHERE number <= ?", (last,)).rowcount
