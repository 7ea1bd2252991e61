"""Queries of a store, and rows that change no version: robots' reports, jobs, events."""

import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, StoreError, UsageError
from fleetmap.mapformat import Manifest, check_name, check_sha256, decode_manifest
from fleetmap.mapformat.building import ALIGNMENT, AREAS, FOR_ROBOTS
from mapserver.floor_plan.alignment import Alignment, decode_alignment
from mapserver.floor_plan.areas import Areas, read_areas
from mapserver.floor_plan.survey_requests import KIND, SurveyRequest, read_request
from mapserver.quality.figures import Evidence, TrustedCalibration, carried_evidence, trusted_calibrations
from mapserver.store.access.chain import AuditLine
from mapserver.store.access.operators import OperatorQueries
from mapserver.store.blobs import BlobFolder
from mapserver.store.database import Transactions
from mapserver.store.fleet_queries import FleetQueries, keep_last_reports
from mapserver.store.rows import (
    NOBODY,
    Actor,
    CanaryRow,
    Event,
    JobInfo,
    LogEntry,
    RobotInfo,
    SiteInfo,
    SiteReleases,
    VerdictRow,
    VersionInfo,
)
from mapserver.store.version_rows import canaries, site_releases

_EVENT = "id, stamp_ns, site, kind, detail, version, actor, reason"
_OF_VERSIONS = ("manifest", "tile", "vocabulary")
_SERVED_KINDS = (*_OF_VERSIONS, "grid", *FOR_ROBOTS)


class StoreQueries:
    """The part of an open store that changes no version."""

    def __init__(self, root: Path, clock_ns: Callable[[], int], *, read_only: bool = False) -> None:
        self._root = root
        self._clock_ns = clock_ns
        self._blobs = BlobFolder(root)
        self._transactions = Transactions(root / "store.sqlite3", clock_ns, read_only=read_only)
        self.fleet = FleetQueries(self._transactions)
        self._areas: dict[str, tuple[tuple[str, ...], Areas]] = {}  # by the addresses of what they were read from
        self.operators = OperatorQueries(self._transactions)

    @property
    def folder(self) -> Path:
        return self._root

    def now_ns(self) -> int:
        return self._clock_ns()

    def robot_names(self) -> set[tuple[str, str]]:
        return {(row["site"], row["robot"]) for row in self._transactions.query("SELECT site, robot FROM robots")}

    def remove_robots(self, site: str, robots: Sequence[str], *, actor: Actor = NOBODY) -> list[str]:
        """Forgets what robots of a site said last, and returns those that were known; their counts and failures stay.

        Raises UsageError for a site that is not known, StoreError where the disk refuses.
        """
        self._check_site(site)
        removed = []
        with self._transactions.write() as connection:
            for robot in robots:
                done = connection.execute("DELETE FROM robots WHERE site = ? AND robot = ?", (site, robot))
                if done.rowcount:
                    removed.append(robot)
                    self._transactions.log(connection, site, LogEntry("robot removed", robot, None, actor))
        return removed

    def sites(self) -> list[SiteInfo]:
        return self._transactions.rows(
            SiteInfo,
            """SELECT s.site, (SELECT version FROM versions v WHERE v.site = s.site AND state = 'current') current_version,
               (SELECT count(*) FROM versions v WHERE v.site = s.site) versions
               FROM sites s ORDER BY s.site""",
        )

    def versions(self, site: str, *, after: int = 0, limit: int = -1) -> list[VersionInfo]:
        """Versions of a site, oldest first, behind number `after`; raises UsageError for a site that is not known."""
        self._check_site(site)
        return self._transactions.rows(
            VersionInfo,
            "SELECT * FROM versions WHERE site = ? AND version > ? ORDER BY version LIMIT ?",
            (site, after, limit),
        )

    def version(self, site: str, version: int) -> VersionInfo:
        """One version; raises UsageError where it does not exist."""
        self._check_site(site)
        found = self._find_version(site, version)
        if found is None:
            raise UsageError(f"site {site} has no version {version}; `mapserver versions --site {site}` lists them")
        return found

    def current(self, site: str) -> VersionInfo | None:
        """The site's current version, None before the first publication; raises UsageError for an unknown site."""
        self._check_site(site)
        return self._current_row(site)

    def releases(self, site: str) -> SiteReleases:
        """What releases of a site are decided by, as it is now; raises UsageError for an unknown site."""
        self._check_site(site)
        return site_releases(self._transactions, site)

    def manifest(self, site: str, version: int) -> Manifest:
        """The manifest of a version; errors as of `version` and `blob`."""
        return decode_manifest(self._blobs.get(self.version(site, version).manifest_sha256))

    def blob(self, sha256: str) -> bytes:
        """The bytes of an address, verified; raises StoreError for missing ones, MapFormatError for damaged ones."""
        return self._blobs.get(check_sha256(sha256))

    def served_kind(self, sha256: str, site: str | None = None) -> str | None:
        """What robots (of a site) may fetch under this address: manifest, tile, vocabulary, grid, or a site's file.

        None for everything else: archives, and what only drafts mention.
        """
        rows = self._transactions.query(
            """SELECT kind FROM version_blobs JOIN versions USING (site, version)
               WHERE sha256 = ?1 AND state <> 'draft' AND (?2 IS NULL OR site = ?2)
               UNION SELECT 'grid' FROM grid_blobs JOIN versions USING (site, version)
               WHERE sha256 = ?1 AND state <> 'draft' AND (?2 IS NULL OR site = ?2)
               UNION SELECT kind FROM site_files WHERE sha256 = ?1 AND (?2 IS NULL OR site = ?2)""",
            (check_sha256(sha256), site),
        )
        kinds = {row["kind"] for row in rows}
        return next((kind for kind in _SERVED_KINDS if kind in kinds), None)

    def archive(self, site: str, version: int) -> bytes | None:
        """The archive of a version, if it has one; errors as of `version` and `blob`."""
        sha256 = self.version(site, version).archive_sha256
        return None if sha256 is None else self._blobs.get(sha256)

    def site_file(self, site: str, kind: str) -> bytes | None:
        """What a site keeps beside its versions under this kind, such as `plan`; None without. Errors as of `blob`."""
        sha256 = self.site_file_sha256(site, kind)
        return None if sha256 is None else self._blobs.get(sha256)

    def survey_requests(self, site: str) -> list[SurveyRequest]:
        """Places that people ask to survey again and that are not done, oldest first; none for an unknown site."""
        query = "SELECT kind, sha256 FROM site_files WHERE site = ? AND kind GLOB ?"
        rows = self._transactions.query(query, (site, f"{KIND}*"))
        found = [read_request(row["kind"], self._blobs.get(row["sha256"])) for row in rows]
        return sorted(found, key=lambda request: (request.asked_ns, request.id))

    def site_file_sha256(self, site: str, kind: str) -> str | None:
        rows = self._transactions.query("SELECT sha256 FROM site_files WHERE site = ? AND kind = ?", (site, kind))
        return rows[0]["sha256"] if rows else None

    def alignment(self, site: str) -> Alignment | None:
        """Where the site's map lies in the drawing of its building; None for a site that was not aligned."""
        data = self.site_file(site, ALIGNMENT)
        return None if data is None else decode_alignment(data)

    def areas(self, site: str) -> Areas:
        """The named areas of a site, in `map` as it is aligned now; none for a site without. UsageError where they need an alignment."""
        query = "SELECT sha256 FROM site_files WHERE site = ? AND kind IN (?, ?) ORDER BY kind"
        key = tuple(row["sha256"] for row in self._transactions.query(query, (site, AREAS, ALIGNMENT)))
        known = self._areas.get(site)
        if known is None or known[0] != key:
            data, alignment = self.site_file(site, AREAS), self.alignment(site)
            frame = None if alignment is None else alignment.frame
            known = self._areas[site] = (key, Areas() if data is None else read_areas(data, frame))
        return known[1]

    def verdicts(self, site: str, version: int) -> list[VerdictRow]:
        """What the gate said about a version, oldest first; raises UsageError where it does not exist."""
        self.version(site, version)
        rows = self._transactions.query(
            """SELECT stamp_ns, accepted, forced, reasons, report FROM verdicts
               WHERE site = ? AND version = ? ORDER BY id""",
            (site, version),
        )
        return [
            msgspec.convert(
                row | {name: json.loads(row[name]) for name in ("reasons", "report")}, VerdictRow, strict=False
            )
            for row in rows
        ]

    def evidence(self, site: str, version: int) -> Evidence | None:
        """What was measured of a version when it was built, None for one that came without; errors as of `manifest`.

        An imported one has what its manifest carries.
        """
        self.version(site, version)
        rows = self._transactions.query("SELECT figures FROM evidence WHERE site = ? AND version = ?", (site, version))
        return (
            msgspec.json.decode(rows[0]["figures"], type=Evidence)
            if rows
            else carried_evidence(self.manifest(site, version))
        )

    def trusted(self, info: VersionInfo) -> list[TrustedCalibration]:
        """The calibrations of a version that a person trusts; none where its manifest is damaged, which `verify` finds."""
        try:
            return trusted_calibrations(self.manifest(info.site, info.version))
        except (StoreError, MapFormatError):
            return []

    def events(
        self, site: str, span_ns: tuple[int | None, int | None] = (None, None), *, after: int = 0, limit: int = -1
    ) -> list[Event]:
        """A site's history, oldest first, behind event `after`; span_ns: from when and until before when, None for ever."""
        return self._transactions.rows(
            Event,
            f"""SELECT {_EVENT} FROM events WHERE site = ?1 AND id > ?2 AND (?3 IS NULL OR stamp_ns >= ?3)
                AND (?4 IS NULL OR stamp_ns < ?4) ORDER BY id LIMIT ?5""",
            (site, after, *span_ns, limit),
        )

    def audit(self, kind: str, detail: str, *, actor: Actor = NOBODY, site: str = "") -> None:
        """One line of the log about something that no other method writes, such as an enrolment, a signature or a refusal."""
        with self._transactions.write() as connection:
            self._transactions.log(connection, site, LogEntry(kind, detail, None, actor))

    def audit_lines(self, last: int | None = None) -> list[AuditLine]:
        """The log of all sites and of the store itself, oldest line first, or the last lines of it."""
        return self._transactions.audit_lines(last)

    def canaries(self, site: str | None = None, *, running: bool = False) -> list[CanaryRow]:
        """Versions that some robots (of a site) tried first, the last one first; those that run alone with `running`."""
        return canaries(self._transactions, site, running=running)

    def last_events(self, site: str, limit: int) -> list[Event]:
        return self._transactions.rows(
            Event, f"SELECT {_EVENT} FROM events WHERE site = ? ORDER BY id DESC LIMIT ?", (site, limit)
        )

    def robots(self, site: str | None = None) -> list[RobotInfo]:
        """What every robot (of a site) said last."""
        rows = self._transactions.query(
            "SELECT * FROM robots WHERE ?1 IS NULL OR site = ?1 ORDER BY site, robot", (site,)
        )
        return [RobotInfo(**row | {"last_report": json.loads(row["last_report"])}) for row in rows]

    def jobs(
        self,
        site: str | None = None,
        span_ns: tuple[int | None, int | None] = (None, None),
        *,
        before: int | None = None,
        limit: int = -1,
    ) -> list[JobInfo]:
        """Jobs (of a site), newest first, older than job `before`; span_ns: begun from when and until before when, by the second."""
        since, until = (None if ns is None else _iso(ns + 999_999_999) for ns in span_ns)
        return self._jobs(
            """WHERE (?1 IS NULL OR site = ?1) AND (?2 IS NULL OR id < ?2) AND (?3 IS NULL OR started >= ?3)
               AND (?4 IS NULL OR started < ?4) ORDER BY id DESC LIMIT ?5""",
            (site, before, since, until, limit),
        )

    def sites_with_jobs(self) -> list[str]:
        """Sites of which there is a job, also those without any version yet."""
        rows = self._transactions.query("SELECT DISTINCT site FROM jobs ORDER BY site")
        return [row["site"] for row in rows]

    def tell_progress(self, job: int, progress: object, key: str = "progress") -> None:
        """Keeps how far a running job is, under a key of its report; nothing for one that has ended. A power cut may take it."""
        with self._transactions.write(durable=False) as connection:
            connection.execute(
                "UPDATE jobs SET report = json_set(report, '$.' || ?, json(?)) WHERE id = ? AND state = 'running'",
                (key, to_json(progress).decode(), job),
            )

    def running_jobs(self) -> list[JobInfo]:
        return self._jobs("WHERE state = 'running' ORDER BY id", ())

    def last_night(self, site: str) -> JobInfo | None:
        """The site's last nightly job that has ended; None before the first."""
        found = self._jobs(
            "WHERE site = ? AND kind = 'nightly' AND state <> 'running' ORDER BY id DESC LIMIT 1", (site,)
        )
        return found[0] if found else None

    def job(self, number: int) -> JobInfo:
        """One job; raises UsageError where it does not exist."""
        found = self._jobs("WHERE id = ?", (number,))
        if not found:
            raise UsageError(f"there is no job {number}; the list of jobs shows those that are kept")
        return found[0]

    def _jobs(self, which: str, values: tuple[object, ...]) -> list[JobInfo]:
        rows = self._transactions.query(f"SELECT * FROM jobs {which}", values)
        return [JobInfo(**row | {"report": json.loads(row["report"])}) for row in rows]

    def record_robot_report(self, site: str, robot: str, report: dict[str, Any], version: int | None = None) -> None:
        """Keeps what a robot said; `version` is what it runs, None where it did not say."""
        check_name(site, "site")
        check_name(robot, "robot")
        with self._transactions.write(durable=False) as connection:
            keep_last_reports(connection, {(site, robot): (version, self._clock_ns(), report)})

    def begin_job(self, site: str, kind: str) -> int:
        with self._transactions.write() as connection:
            done = connection.execute(
                "INSERT INTO jobs (site, kind, state, started, message, report) VALUES (?, ?, 'running', ?, '', '{}')",
                (check_name(site, "site"), kind, _iso(self._clock_ns())),
            )
            return int(done.lastrowid or 0)

    def update_job(self, job: int, state: str, message: str, report: dict[str, Any]) -> None:
        """Keeps how a job goes on, or ended (state done or failed)."""
        with self._transactions.write() as connection:
            connection.execute(
                "UPDATE jobs SET state = ?, finished = ?, message = ?, report = ? WHERE id = ?",
                (state, None if state == "running" else _iso(self._clock_ns()), message, to_json(report).decode(), job),
            )

    def _check_site(self, site: str) -> None:
        check_name(site, "site")
        if not self._transactions.query("SELECT 1 FROM sites WHERE site = ?", (site,)):
            known = ", ".join(info.site for info in self.sites()) or "none"
            raise UsageError(f"the store has no site {site}; it has: {known}")

    def _find_version(self, site: str, version: int) -> VersionInfo | None:
        query = "SELECT * FROM versions WHERE site = ? AND version = ?"
        return self._transactions.first(VersionInfo, query, (site, version))

    def _current_row(self, site: str) -> VersionInfo | None:
        query = "SELECT * FROM versions WHERE site = ? AND state = 'current'"
        return self._transactions.first(VersionInfo, query, (site,))


def _iso(stamp_ns: int) -> str:
    moment = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
    return moment.isoformat(timespec="seconds").replace("+00:00", "Z")
