"""The fleet's health in the store: sums by the hour, thinned traces, failures with their pictures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import accumulate
from typing import Any

import msgspec

from fleetmap.encoding import to_json, to_msgpack
from fleetmap.errors import LinkError, UsageError
from fleetmap.messages import FailureReport, decode_message
from mapserver.fleet_statistics.kpis import COUNTER_COLUMNS, Counters, hour_of
from mapserver.floor_plan.areas import Areas
from mapserver.store import rows as records
from mapserver.store.database import Database, Transaction, matching
from mapserver.store.schema import names

Key = tuple[str, str, str]
"""Site, axis, key."""
CounterKey = tuple[str, str, str, int]
"""Site, axis, key, hour."""
LastReport = tuple[int | None, int, dict[str, Any]]
"""Of a robot: its version (None if not reported), the time of its last report, and that report."""
LastReports = dict[tuple[str, str], LastReport]
"""By (site, robot)."""

_DAY_NS = 86_400_000_000_000
_USUAL_RETENTION = records.FleetRetention()
_PRUNED_SHARE = 0.95  # of the limit of pictures' bytes: pruning to this share avoids a new sum at each picture
_SHRINK_PAGES = 20_000  # 80 MB, to keep waiting times short
_SUMS = ", ".join(f"sum(t.{name}) {name}" for name in COUNTER_COLUMNS)
_ADD = ", ".join(f"{name} = tallies.{name} + excluded.{name}" for name in COUNTER_COLUMNS)
_KEYS_AT_ONCE = 100
_TRACED = names(records.TraceRow).removeprefix("site, robot, ")
_REPORT_COLUMNS = ("site", "robot", "duration_s", "kind", "cause", "status", "version")
_NO_FAILURE = "failure {} does not exist; the list of failures shows the stored ones"


class FleetBatch(msgspec.Struct):
    """Data since the last batch."""

    counters: dict[CounterKey, Counters] = {}
    traces: list[records.TraceRow] = []
    last_reports: LastReports = {}

    def add(self, site: str, axis: str, key: str, hour: int, counts: Counters) -> None:
        self.counters.setdefault((site, axis, key, hour), Counters()).add(counts)


class FleetQueries:
    """The fleet's health in an open store."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._picture_bytes = -(1 << 62)  # looked up at the first failure

    def add(self, batch: FleetBatch) -> None:
        """Store a batch in one transaction. A power cut may lose the last batches, never failures."""
        with self._database.write(durable=False) as change:
            traced: list[Key] = [(row.site, "robot", row.robot) for row in batch.traces]
            ids = _ids(change, [*(key[:3] for key in batch.counters), *traced])
            _add_counters(change, ids, batch.counters)
            columns = _TRACED.split(", ")
            traces = zip(traced, batch.traces, strict=True)
            rows = [{"key_id": ids[key]} | {name: getattr(row, name) for name in columns} for key, row in traces]
            change.insert("traces", rows, "ON CONFLICT DO NOTHING")
            keep_last_reports(change, batch.last_reports)

    def add_failure(
        self,
        report: FailureReport,
        times_ns: tuple[int, int],
        counters: Mapping[CounterKey, Counters],
        retention: records.FleetRetention = _USUAL_RETENTION,
        area: str | None = None,
    ) -> bool:
        """Store a failure and its sums durably; False (and no change) for a known one.

        times_ns: time of receipt and of the failure; area: its place. Older failures of the robot, and the oldest
        pictures of all, are deleted above the limits.
        """
        x_map_m, y_map_m = (None, None) if report.map_from_base is None else report.map_from_base.position_m[:2]
        row = {name: getattr(report, name) for name in _REPORT_COLUMNS}
        row |= {"failure_id": report.id, "received_ns": times_ns[0], "happened_ns": times_ns[1]}
        row |= {"tile": tile_key(report.tile), "x_map_m": x_map_m, "y_map_m": y_map_m, "area": area}
        row |= {"report": to_msgpack(msgspec.structs.replace(report, thumbnails=()))}
        pictures = [(picture.kind, picture.stamp_ns, picture.jpeg) for picture in report.thumbnails]
        with self._database.write() as change:
            added = change.insert("failures", [row], "ON CONFLICT DO NOTHING RETURNING number").fetchone()
            if added is None:
                return False
            self._add_pictures(change, added[0], 0, pictures)
            change.execute(
                """DELETE FROM failures WHERE number IN (
                   SELECT number FROM failures WHERE site = ? AND robot = ? ORDER BY number DESC LIMIT ? OFFSET ?)""",
                (report.site, report.robot, 1 << 62, retention.failures_per_robot),
            )
            if not 0 <= self._picture_bytes <= retention.picture_bytes:
                _prune_pictures(change, _PRUNED_SHARE * retention.picture_bytes)
                self._picture_bytes = _sum_of_pictures(change)
            _add_counters(change, _ids(change, [key[:3] for key in counters]), counters)
        return True

    def _add_pictures(
        self, change: Transaction, number: int, place: int, pictures: Sequence[tuple[str, int, bytes]]
    ) -> None:
        """Add pictures (kind, stamp, JPEG) to a failure, from a place on."""
        rows = [
            {"number": number, "place": place + n, "kind": kind, "stamp_ns": stamp_ns, "jpeg": jpeg}
            for n, (kind, stamp_ns, jpeg) in enumerate(pictures)
        ]
        change.insert("failure_pictures", rows)
        self._picture_bytes += sum(len(jpeg) for _, _, jpeg in pictures)

    def counters(
        self, site: str | None, axis: str, *, since_hour: int = 0, until_hour: int = 1 << 60, key: str | None = None
    ) -> dict[tuple[str, str], Counters]:
        """Return sums by (site, key) of an axis over hours from `since_hour` to before `until_hour`."""
        begun = f"sum(CASE WHEN t.hour = {since_hour:d} THEN t.continued ELSE 0 END)"
        sums = f"k.site, k.key, {_SUMS.replace('sum(t.continued)', begun)}"
        rows = self._sums(sums, "k.id, k.site, k.key", "k.site, k.key", site, axis, key, since_hour, until_hour)
        return {(row.pop("site"), row.pop("key")): Counters(**row) for row in rows}

    def counters_of(self, site: str, axis: str, since_hour: int, until_hour: int = 1 << 60) -> dict[str, Counters]:
        """Return the sums of one site by key."""
        found = self.counters(site, axis, since_hour=since_hour, until_hour=until_hour)
        return {key: counts for (_, key), counts in found.items()}

    def hours(
        self, site: str | None, axis: str, *, key: str | None = None, since_hour: int = 0, until_hour: int = 1 << 60
    ) -> dict[int, Counters]:
        """Return sums of an axis (and key) by the hour."""
        rows = self._sums(f"t.hour, {_SUMS}", "t.hour", "t.hour", site, axis, key, since_hour, until_hour)
        return {row.pop("hour"): Counters(**row) for row in rows}

    def _sums(
        self, sums: str, by: str, order: str, site: str | None, axis: str, key: str | None, since: int, until: int
    ) -> list[dict[str, Any]]:
        if axis not in records.AXES:
            raise UsageError(f"unknown axis {axis!r}; choose one of {', '.join(records.AXES)}")
        wanted = {"k.axis": axis, "k.site": site, "k.key": key, "t.hour >=": since, "t.hour <": until}
        words, values = matching(wanted)
        tables = "tally_keys k JOIN tallies t ON t.key_id = k.id"
        return self._database.query(f"SELECT {sums} FROM {tables} WHERE {words} GROUP BY {by} ORDER BY {order}", values)

    def failures(
        self, wanted: records.FailureFilter, *, before: int | None = None, limit: int | None = None
    ) -> list[records.FailureRow]:
        columns = asdict(wanted) | {"number <": before}
        columns |= {"happened_ns >=": columns.pop("since_ns"), "happened_ns <": columns.pop("until_ns")}
        return self._database.select(records.FailureRow, "failures", columns, "number DESC", limit)

    def failure(self, number: int) -> records.FailureDetail:
        """Return one failure with its context; raises UsageError if it does not exist. An unreadable report has its row's columns only."""
        rows = self._database.select(records.FailureRow, "failures", {"number": number}, "number")
        if not rows:
            raise UsageError(_NO_FAILURE.format(number))
        data = self._database.value("SELECT report FROM failures WHERE number = ?", (number,))
        try:
            report = decode_message(data, FailureReport)
        except LinkError as error:
            words = f"the stored report cannot be read; `mapserver fleet remove {number}` removes it ({error})"
            known = {name: getattr(rows[0], name) for name in _REPORT_COLUMNS}
            at_ns = rows[0].happened_ns
            report = FailureReport(
                id=rows[0].failure_id, stamp_ns=at_ns, wall_ns=at_ns, calibration=words[:2000], **known
            )
        query = "SELECT place, kind, stamp_ns, length(jpeg) bytes FROM failure_pictures WHERE number = ? ORDER BY place"
        return records.FailureDetail(rows[0], report, self._database.rows(records.PictureRow, query, (number,)))

    def failure_number(self, site: str, robot: str, failure_id: str) -> int | None:
        """Return the number of a robot's report, None if not stored."""
        query = "SELECT number FROM failures WHERE site = ? AND robot = ? AND failure_id = ?"
        found: int | None = self._database.value(query, (site, robot, failure_id))
        return found

    def remove_failure(self, number: int) -> None:
        """Remove a failure with its pictures and recording; the counts keep it. UsageError if it does not exist."""
        with self._database.write() as change:
            if not change.execute("DELETE FROM failures WHERE number = ?", (number,)).rowcount:
                raise UsageError(_NO_FAILURE.format(number))

    def picture(self, number: int, place: int) -> bytes:
        """Return the JPEG of a failure; raises UsageError if it does not exist or was deleted."""
        query = "SELECT jpeg FROM failure_pictures WHERE number = ? AND place = ?"
        if (jpeg := self._database.value(query, (number, place))) is None:
            raise UsageError(f"failure {number} has no picture {place}; old pictures are deleted to save space")
        return bytes(jpeg)

    def first_pictures(self, numbers: Iterable[int]) -> dict[int, int]:
        """Return by failure the place of its first camera picture, for failures that have one."""
        wanted = tuple(numbers)
        query = f"""SELECT number, min(place) place FROM failure_pictures WHERE kind != 'matches'
                    AND number IN ({", ".join("?" * len(wanted))}) GROUP BY number"""
        return {row["number"]: row["place"] for row in self._database.query(query, wanted)} if wanted else {}

    def add_replay(self, number: int, replay: records.FailureReplay, keep_bytes: int) -> None:
        """Store a failure's recording, and its pictures with those of the failure; the oldest recordings are deleted, never this one."""
        row = {"number": number, "summary": replay.summary, "mcap": replay.mcap}
        with self._database.write() as change:
            if not change.insert("failure_replays", [row], "ON CONFLICT DO NOTHING").rowcount:
                return
            query = "SELECT coalesce(max(place) + 1, 0) FROM failure_pictures WHERE number = ?"
            place = change.execute(query, (number,)).fetchone()[0]
            self._add_pictures(change, number, place, [("replay", *picture) for picture in replay.pictures])
            query = "SELECT number, length(mcap) FROM failure_replays ORDER BY number DESC"
            last = _newest_beyond(change.execute(query).fetchall(), keep_bytes)
            change.execute("DELETE FROM failure_replays WHERE number <= ? AND number <> ?", (last, number))

    def replay_summary(self, number: int) -> bytes | None:
        """Return the summary of a failure's recording, None if absent or deleted."""
        summary = self._database.value("SELECT summary FROM failure_replays WHERE number = ?", (number,))
        return None if summary is None else bytes(summary)

    def replay(self, number: int) -> bytes:
        """Return the MCAP file of a failure's recording; UsageError if absent or deleted."""
        if (mcap := self._database.value("SELECT mcap FROM failure_replays WHERE number = ?", (number,))) is None:
            raise UsageError(
                f"failure {number} has no recording: its robot sends none ([run] replays), has not sent it yet, or it was deleted for space"
            )
        return bytes(mcap)

    def trace(self, site: str, robot: str, *, since_hour: int = 0, until_hour: int = 1 << 60) -> list[records.TraceRow]:
        """Return a robot's trace, oldest first, hour by hour: in the table, an hour's rows of other robots lie in between."""
        (ends,) = self._database.query("SELECT min(hour) first, max(hour) last FROM traces")
        if ends["first"] is None:
            return []
        return self._database.rows(
            records.TraceRow,
            f"""WITH RECURSIVE asked(at) AS (
                    SELECT CAST(? AS BIGINT) UNION ALL SELECT at + 1 FROM asked WHERE at < ?)
               SELECT k.site, k.key robot, {_TRACED}
               FROM tally_keys k CROSS JOIN asked CROSS JOIN traces t WHERE t.hour = at AND t.key_id = k.id
               AND at < ? AND k.site = ? AND k.axis = 'robot' AND k.key = ? ORDER BY t.hour, t.stamp_ns""",
            (max(since_hour, ends["first"]), min(until_hour - 1, ends["last"]), until_hour, site, robot),
        )

    def prune(self, retention: records.FleetRetention) -> int:
        """Remove old or excess data; return the number of removed rows."""
        with self._database.write(durable=False) as change:
            gone = 0
            for rows, before in self._expired(retention).values():
                gone += change.execute(f"DELETE FROM {rows}", (before,)).rowcount
            # Whole hours of traces, the oldest first; the running hour stays
            hours = change.execute("SELECT hour, count(*) FROM traces GROUP BY hour ORDER BY hour DESC").fetchall()
            last = _newest_beyond(hours[1:], retention.trace_rows - hours[0][1]) if hours else None
            gone += change.execute("DELETE FROM traces WHERE hour <= ?", (last,)).rowcount
            gone += _prune_pictures(change, retention.picture_bytes)
            self._picture_bytes = _sum_of_pictures(change)
        self._database.shrink(_SHRINK_PAGES)
        return int(gone)

    def expired(self, retention: records.FleetRetention) -> dict[str, int]:
        """Return by name how many rows are older than their period."""
        rows = self._expired(retention).items()
        return {name: int(self._database.value(f"SELECT count(*) FROM {old}", (ns,))) for name, (old, ns) in rows}

    def _expired(self, retention: records.FleetRetention) -> dict[str, tuple[str, int]]:
        """Return by name the rows older than their period, as a table with a condition, and the condition's parameter."""
        of_failures = "WHERE number IN (SELECT number FROM failures WHERE happened_ns < ?)"

        def before(days: float) -> int:
            return self._database.now_ns() - int(days * _DAY_NS)

        return {
            "figures by the hour": ("tallies WHERE hour < ?", hour_of(before(retention.tally_days))),
            "ways of robots": ("traces WHERE hour < ?", hour_of(before(retention.trace_days))),
            "pictures of failures": (f"failure_pictures {of_failures}", before(retention.picture_days)),
            "recordings of failures": (f"failure_replays {of_failures}", before(retention.replay_days)),
            "failures": ("failures WHERE happened_ns < ?", before(retention.failure_days)),
        }


def name_failures(change: Transaction, site: str, areas: Areas) -> None:
    """Set the present areas of a site's failures."""
    query = "SELECT number, x_map_m, y_map_m FROM failures WHERE site = ? AND x_map_m + y_map_m IS NOT NULL"
    for number, x_m, y_m in change.execute(query, (site,)).fetchall():
        change.execute("UPDATE failures SET area = ? WHERE number = ?", (areas.at(x_m, y_m), number))


def keep_last_reports(change: Transaction, reports: LastReports) -> None:
    """Store the robots' last reports."""
    rows = [
        {"site": site, "robot": robot, "version": version, "last_seen_ns": ns, "last_report": to_json(report).decode()}
        for (site, robot), (version, ns, report) in reports.items()
    ]
    otherwise = """ON CONFLICT (site, robot) DO UPDATE SET version = coalesce(excluded.version, robots.version),
                   last_seen_ns = excluded.last_seen_ns, last_report = excluded.last_report"""
    change.insert("robots", rows, otherwise)


def tile_key(tile: tuple[int, int] | None) -> str | None:
    """Return a tile as text for keys and rows: "x,y"."""
    return None if tile is None else f"{tile[0]},{tile[1]}"


def _ids(change: Transaction, keys: Iterable[Key]) -> dict[Key, int]:
    """Return the numbers of keys, new ones for unknown keys. They are asked for each time: a database that crashed, or was replaced by
    its replica, may have lost keys that a cache would still know, and counts would go to another one."""
    wanted, found = list(dict.fromkeys(keys)), dict[Key, int]()
    for first in range(0, len(wanted), _KEYS_AT_ONCE):
        some = wanted[first : first + _KEYS_AT_ONCE]
        found |= _known_ids(change, some)
        if new := [key for key in some if key not in found]:
            change.insert("tally_keys", [dict(zip(("site", "axis", "key"), key, strict=True)) for key in new])
            found |= _known_ids(change, new)
    return found


def _known_ids(change: Transaction, keys: Sequence[Key]) -> dict[Key, int]:
    groups = ", ".join(["(?, ?, ?)"] * len(keys))
    query = f"SELECT site, axis, key, id FROM tally_keys WHERE (site, axis, key) IN (VALUES {groups})"
    rows = change.execute(query, [part for key in keys for part in key]).fetchall()
    return {(site, axis, key): int(number) for site, axis, key, number in rows}


def _add_counters(change: Transaction, ids: Mapping[Key, int], counters: Mapping[CounterKey, Counters]) -> None:
    rows = [
        {"key_id": ids[key[:3]], "hour": key[3]} | {name: getattr(counters[key], name) for name in COUNTER_COLUMNS}
        for key in sorted(counters)
    ]
    change.insert("tallies", rows, f"ON CONFLICT (key_id, hour) DO UPDATE SET {_ADD}")


def _newest_beyond(rows: Sequence[tuple[int, int]], keep: float) -> int | None:
    """Return the newest number at which the sizes summed from the newest exceed `keep`. rows: number and size, the newest first."""
    sums = accumulate(size for _, size in rows)
    return next((number for (number, _), kept in zip(rows, sums, strict=True) if kept > keep), None)


def _prune_pictures(change: Transaction, keep_bytes: float) -> int:
    query = "SELECT number, sum(length(jpeg)) FROM failure_pictures GROUP BY number ORDER BY number DESC"
    last = _newest_beyond(change.execute(query).fetchall(), keep_bytes)
    return int(change.execute("DELETE FROM failure_pictures WHERE number <= ?", (last,)).rowcount)


def _sum_of_pictures(change: Transaction) -> int:
    return int(change.execute("SELECT coalesce(sum(length(jpeg)), 0) FROM failure_pictures").fetchone()[0])
