"""Queries of a store, and writes that change no version: robots' reports, jobs, events."""

import json
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, StateError, StoreError, UsageError
from fleetmap.mapformat import Manifest, check_name, check_sha256, decode_manifest, sha256_hex
from fleetmap.mapformat.building import ALIGNMENT, AREAS, FLOORS, FOR_ROBOTS
from fleetmap.mapformat.floors import Building, read_building
from mapserver.floor_plan.alignment import Alignment, decode_alignment
from mapserver.floor_plan.areas import Areas, read_areas
from mapserver.floor_plan.survey_requests import KIND, SurveyRequest, read_request
from mapserver.quality.figures import Evidence, TrustedCalibration, carried_evidence, trusted_calibrations
from mapserver.store.access.chain import AuditLine
from mapserver.store.access.operators import OperatorQueries
from mapserver.store.database import SqliteTransactions
from mapserver.store.fleet_queries import FleetQueries, keep_last_reports
from mapserver.store.places import open_blobs, open_database, read_places
from mapserver.store.rows import (
    NOBODY,
    UNLIMITED,
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
from mapserver.store.shared_files import SharedFiles
from mapserver.store.usage import DiskMeter, DiskSpace, StoreUsage, UsageMeter
from mapserver.store.version_rows import canaries, mentioned, site_releases

if TYPE_CHECKING:
    from mapserver.surfels.survey_pictures import SurveyPicture

_EVENT = "id, stamp_ns, site, kind, detail, version, actor, reason"
_OF_VERSIONS = ("manifest", "tile", "vocabulary")
_RESTORED = "restored"
_SERVED_KINDS = (*_OF_VERSIONS, "grid", *FOR_ROBOTS)


class DatabaseCopy(NamedTuple):
    """Content of a copied database: addresses of the blobs that it names, number of versions."""

    blobs: set[str]
    versions: int


class StoreQueries:
    """Methods of an open store that change no version."""

    def __init__(
        self, root: Path, clock_ns: Callable[[], int], *, create: bool = False, read_only: bool = False
    ) -> None:
        self._root = root
        self._clock_ns = clock_ns
        places = read_places(root)
        self._blobs = open_blobs(root, places)
        self._transactions = open_database(root, places, clock_ns, create=create, read_only=read_only)
        self.fleet = FleetQueries(self._transactions)
        self._areas: dict[str, tuple[tuple[str, ...], Areas]] = {}  # by the addresses of their source files
        self._requests: dict[str, dict[tuple[str, str], SurveyRequest]] = {}
        self.operators = OperatorQueries(self._transactions)
        self.files = SharedFiles(root, self._transactions)
        self.locked, self.leads = self._transactions.locked, self._transactions.leads
        self.is_shared = self._transactions.is_shared
        self._disk = DiskMeter(root, self._transactions.now_ns)
        self._usage = UsageMeter(root, self._transactions, self._blobs)

    @property
    def folder(self) -> Path:
        return self._root

    def disk_space(self) -> DiskSpace:
        return self._disk.look()

    def usage(self) -> StoreUsage | None:
        """Return the size of the store, at most ten minutes old; None while it is measured for the first time."""
        return self._usage.look()

    def now_ns(self) -> int:
        return self._clock_ns()

    def robot_names(self) -> set[tuple[str, str]]:
        return {(row["site"], row["robot"]) for row in self._transactions.query("SELECT site, robot FROM robots")}

    def remove_robots(self, site: str, robots: Sequence[str], *, actor: Actor = NOBODY) -> list[str]:
        """Remove the last reports of a site's robots, and return the known ones; their counts and failures stay.

        Raises UsageError for an unknown site, StoreError on a disk error.
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

    def named_blobs(self) -> set[str]:
        """Return the addresses of all blobs that the database names."""
        return mentioned(self._transactions)

    def blob_size(self, sha256: str) -> int | None:
        """Return the size of a blob in bytes, None if it is missing; StoreError behind a symbolic link."""
        return self._blobs.size(sha256)

    def blob_chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the bytes of a blob in pieces, unverified; raises StoreError for a missing one."""
        return self._blobs.chunks(sha256)

    def is_whole(self, sha256: str) -> bool:
        """True if a blob exists and matches its address; reads it in pieces."""
        return self._blobs.is_whole(sha256)

    def copy_database(self, path: Path) -> DatabaseCopy:
        """Copy the database into a new file, as of one moment, and return what the copy names. Raises StoreError on a disk error."""
        self._transactions.copy_to(path)
        copy = SqliteTransactions(path, self._clock_ns, read_only=True)
        try:
            versions = copy.query("SELECT count(*) n FROM versions")[0]["n"]
            return DatabaseCopy(mentioned(copy), versions)
        finally:
            copy.close()

    def log_event(self, site: str, kind: str, detail: str, *, actor: Actor = NOBODY) -> None:
        """Write a line into a site's log."""
        with self._transactions.write() as connection:
            self._transactions.log(connection, site, LogEntry(kind, detail, None, actor))

    def note_restored(self, detail: str, ahead: int, actor: Actor) -> None:
        """Log the restoration of this store, and let its sites' versions go on `ahead` numbers later: the lost store gave the next ones."""
        with self._transactions.write() as connection:
            connection.execute("UPDATE sites SET last_version = last_version + ?", (ahead,))
            self._transactions.log(connection, "", LogEntry(_RESTORED, detail, None, actor))

    def sites(self) -> list[SiteInfo]:
        return self._transactions.rows(
            SiteInfo,
            """SELECT s.site, (SELECT version FROM versions v WHERE v.site = s.site AND state = 'current') current_version,
               (SELECT count(*) FROM versions v WHERE v.site = s.site) versions
               FROM sites s ORDER BY s.site""",
        )

    def versions(self, site: str, *, after: int = 0, limit: int = UNLIMITED) -> list[VersionInfo]:
        """Return versions of a site, oldest first, after number `after`; raises UsageError for an unknown site."""
        self._check_site(site)
        return self._transactions.rows(
            VersionInfo,
            "SELECT * FROM versions WHERE site = ? AND version > ? ORDER BY version LIMIT ?",
            (site, after, limit),
        )

    def version(self, site: str, version: int) -> VersionInfo:
        """Return one version; raises UsageError if it does not exist."""
        self._check_site(site)
        found = self._find_version(site, version)
        if found is None:
            raise UsageError(f"site {site} has no version {version}; `mapserver versions --site {site}` lists them")
        return found

    def current(self, site: str) -> VersionInfo | None:
        """Return the site's current version, None before the first publication; raises UsageError for an unknown site."""
        row = self._current_row(site)
        if row is None:
            self._check_site(site)
        return row

    def releases(self, site: str) -> SiteReleases:
        """Return the present state of a site's releases, for decisions; raises UsageError for an unknown site."""
        self._check_site(site)
        return site_releases(self._transactions, site)

    def manifest(self, site: str, version: int) -> Manifest:
        """Return the manifest of a version; errors as of `version` and `blob`."""
        return decode_manifest(self._blobs.get(self.version(site, version).manifest_sha256))

    def blob(self, sha256: str) -> bytes:
        """Return the bytes of an address, verified; raises StoreError for missing ones, MapFormatError for damaged ones."""
        return self._blobs.get(check_sha256(sha256))

    def served_kind(self, sha256: str, site: str | None = None) -> str | None:
        """Return the kind that robots (of a site) may fetch under this address: manifest, tile, vocabulary, grid, or a site's file.

        None for all others: archives, and bytes referenced only by drafts.
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
        """Return the archive of a version, if it has one; errors as of `version` and `blob`."""
        sha256 = self.version(site, version).archive_sha256
        return None if sha256 is None else self._blobs.get(sha256)

    def survey_pictures(self, site: str, version: int) -> "tuple[SurveyPicture, ...]":
        """Return the surveys' pictures of a version that are still kept; errors as of `manifest` and `pictures_of`."""
        from mapserver.surfels.survey_pictures import pictures_of  # loads OpenCV, which few commands need

        query = "SELECT sha256 FROM surfel_blobs WHERE site = ? AND version = ?"
        known = {row["sha256"] for row in self._transactions.query(query, (site, version))}
        pictures = pictures_of(self.manifest(site, version), self._blobs.get)
        found = tuple(one for one in pictures if one.sha256 in known)
        if not found:
            raise StateError(
                f"the surveys' pictures of version {version} of site {site} were removed after their period"
            )
        return found

    def site_file(self, site: str, kind: str) -> bytes | None:
        """Return a site's file of this kind, such as `plan`; None if absent. Errors as of `blob`."""
        sha256 = self.site_file_sha256(site, kind)
        return None if sha256 is None else self._blobs.get(sha256)

    def survey_requests(self, site: str) -> list[SurveyRequest]:
        """Return the open survey requests, oldest first; empty for an unknown site."""
        query = "SELECT kind, sha256 FROM site_files WHERE site = ? AND substr(kind, 1, ?) = ?"
        rows = self._transactions.query(query, (site, len(KIND), KIND))
        known = self._requests.get(site, {})  # every robot asks every few seconds, and an object store answers slowly
        found = {
            key: known.get(key) or read_request(row["kind"], self._blobs.get(row["sha256"]))
            for row in rows
            for key in [(row["kind"], row["sha256"])]
        }
        self._requests[site] = found
        return sorted(found.values(), key=lambda request: (request.asked_ns, request.id))

    def site_file_sha256(self, site: str, kind: str) -> str | None:
        rows = self._transactions.query("SELECT sha256 FROM site_files WHERE site = ? AND kind = ?", (site, kind))
        return rows[0]["sha256"] if rows else None

    def alignment(self, site: str) -> Alignment | None:
        """Return the pose of the site's map in the drawing of its building; None if not aligned."""
        data = self.site_file(site, ALIGNMENT)
        return None if data is None else decode_alignment(data)

    def building(self, site: str) -> Building | None:
        """Return the building of which a site is a floor; None without one. Errors as of `blob`."""
        data = self.site_file(site, FLOORS)
        return None if data is None else read_building(data)

    def areas(self, site: str) -> Areas:
        """Return the named areas of a site, in `map` by the present alignment; empty if absent. UsageError if an alignment is missing."""
        key, known = self._area_files(site), self._areas.get(site)
        if known is None or known[0] != key:
            data, alignment = self.site_file(site, AREAS), self.alignment(site)
            frame = None if alignment is None else alignment.frame
            known = self._areas[site] = (key, Areas() if data is None else read_areas(data, frame))
        return known[1]

    def areas_tag(self, site: str) -> str:
        """Return a hash that changes with the areas of a site and with their place in `map`."""
        return sha256_hex(" ".join(self._area_files(site)).encode())

    def _area_files(self, site: str) -> tuple[str, ...]:
        query = "SELECT sha256 FROM site_files WHERE site = ? AND kind IN (?, ?) ORDER BY kind"
        return tuple(row["sha256"] for row in self._transactions.query(query, (site, AREAS, ALIGNMENT)))

    def verdicts(self, site: str, version: int) -> list[VerdictRow]:
        """Return the gate's verdicts on a version, oldest first; raises UsageError if it does not exist."""
        self.version(site, version)
        return [verdict for _, verdict in self._verdicts("site = ? AND version = ?", site, version)]

    def last_verdicts(self, site: str) -> dict[int, VerdictRow]:
        """Return the gate's last verdict on each version of a site that it judged."""
        return dict(self._verdicts("id IN (SELECT max(id) FROM verdicts WHERE site = ? GROUP BY version)", site))

    def _verdicts(self, condition: str, *values: object) -> list[tuple[int, VerdictRow]]:
        """Return version and verdict, oldest first."""
        rows = self._transactions.query(
            f"SELECT version, stamp_ns, accepted, forced, reasons, report FROM verdicts WHERE {condition} ORDER BY id",
            values,
        )
        parsed = (row | {name: json.loads(row[name]) for name in ("reasons", "report")} for row in rows)
        return [(row["version"], msgspec.convert(row, VerdictRow, strict=False)) for row in parsed]

    def evidence(self, site: str, version: int) -> Evidence | None:
        """Return the measurements of a version from its build, None if absent; errors as of `manifest`.

        For an imported one those in its manifest.
        """
        self.version(site, version)
        rows = self._transactions.query("SELECT figures FROM evidence WHERE site = ? AND version = ?", (site, version))
        return (
            msgspec.json.decode(rows[0]["figures"], type=Evidence)
            if rows
            else carried_evidence(self.manifest(site, version))
        )

    def trusted(self, info: VersionInfo) -> list[TrustedCalibration]:
        """Return the calibrations of a version trusted by an operator; empty for a damaged manifest, which `verify` reports."""
        try:
            return trusted_calibrations(self.manifest(info.site, info.version))
        except (StoreError, MapFormatError):
            return []

    def events(
        self,
        site: str,
        span_ns: tuple[int | None, int | None] = (None, None),
        *,
        after: int = 0,
        limit: int = UNLIMITED,
    ) -> list[Event]:
        """Return a site's history, oldest first, after event `after`; span_ns: start and end, None for open."""
        return self._transactions.rows(
            Event,
            f"""SELECT {_EVENT} FROM events WHERE site = ?1 AND id > ?2 AND (?3 IS NULL OR stamp_ns >= ?3)
                AND (?4 IS NULL OR stamp_ns < ?4) ORDER BY id LIMIT ?5""",
            (site, after, *span_ns, limit),
        )

    def audit(self, kind: str, detail: str, *, actor: Actor = NOBODY, site: str = "") -> None:
        """Log an event that no other method writes, such as an enrolment, a signature or a refusal."""
        with self._transactions.write() as connection:
            self._transactions.log(connection, site, LogEntry(kind, detail, None, actor))

    def restored_ns(self) -> int:
        """Return when the store was last restored from a backup, 0 if never."""
        rows = self._transactions.query("SELECT max(stamp_ns) stamp_ns FROM events WHERE kind = ?", (_RESTORED,))
        return int(rows[0]["stamp_ns"] or 0)

    def audit_lines(self, last: int | None = None) -> list[AuditLine]:
        """Return the log of all sites and of the store itself, oldest line first, or its last lines."""
        return self._transactions.audit_lines(last)

    def canaries(self, site: str | None = None, *, running: bool = False) -> list[CanaryRow]:
        """Return canaries (of a site), latest first; with `running` only running ones."""
        return canaries(self._transactions, site, running=running)

    def last_events(self, site: str, limit: int) -> list[Event]:
        return self._transactions.rows(
            Event, f"SELECT {_EVENT} FROM events WHERE site = ? ORDER BY id DESC LIMIT ?", (site, limit)
        )

    def robots(self, site: str | None = None) -> list[RobotInfo]:
        """Return the last report of every robot (of a site)."""
        rows = self._transactions.query(
            "SELECT * FROM robots WHERE (?1 IS NULL OR site = ?1) ORDER BY site, robot", (site,)
        )
        return [RobotInfo(**row | {"last_report": json.loads(row["last_report"])}) for row in rows]

    def jobs(
        self,
        site: str | None = None,
        span_ns: tuple[int | None, int | None] = (None, None),
        *,
        before: int | None = None,
        limit: int = UNLIMITED,
    ) -> list[JobInfo]:
        """Return jobs (of a site), newest first, older than job `before`; span_ns: range of their start, by the second."""
        since, until = (None if ns is None else _iso(ns + 999_999_999) for ns in span_ns)
        return self._jobs(
            """WHERE (?1 IS NULL OR site = ?1) AND (?2 IS NULL OR id < ?2) AND (?3 IS NULL OR started >= ?3)
               AND (?4 IS NULL OR started < ?4) ORDER BY id DESC LIMIT ?5""",
            (site, before, since, until, limit),
        )

    def sites_with_jobs(self) -> list[str]:
        """Return the sites with a job, also those without a version."""
        rows = self._transactions.query("SELECT DISTINCT site FROM jobs ORDER BY site")
        return [row["site"] for row in rows]

    def tell_progress(self, job: int, progress: object, key: str = "progress") -> None:
        """Store the progress of a running job under a key of its report; ignored for an ended one. A power cut may lose it."""
        with self._transactions.write(durable=False) as connection:
            found = connection.execute("SELECT report FROM jobs WHERE id = ? AND state = 'running'", (job,)).fetchone()
            if found is not None:
                report = to_json(json.loads(found[0]) | {key: progress}).decode()
                connection.execute("UPDATE jobs SET report = ? WHERE id = ?", (report, job))

    def running_jobs(self) -> list[JobInfo]:
        return self._jobs("WHERE state = 'running' ORDER BY id", ())

    def last_night(self, site: str) -> JobInfo | None:
        """Return the site's last ended nightly job; None before the first."""
        found = self._jobs(
            "WHERE site = ? AND kind = 'nightly' AND state <> 'running' ORDER BY id DESC LIMIT 1", (site,)
        )
        return found[0] if found else None

    def job(self, number: int) -> JobInfo:
        """Return one job; raises UsageError if it does not exist."""
        found = self._jobs("WHERE id = ?", (number,))
        if not found:
            raise UsageError(f"job {number} does not exist; the list of jobs shows the stored ones")
        return found[0]

    def _jobs(self, which: str, values: tuple[object, ...]) -> list[JobInfo]:
        rows = self._transactions.query(f"SELECT * FROM jobs {which}", values)
        return [JobInfo(**row | {"report": json.loads(row["report"])}) for row in rows]

    def record_robot_report(self, site: str, robot: str, report: dict[str, Any], version: int | None = None) -> None:
        """Store a robot's report; `version` is its running version, None if not reported."""
        check_name(site, "site")
        check_name(robot, "robot")
        with self._transactions.write(durable=False) as connection:
            keep_last_reports(connection, {(site, robot): (version, self._clock_ns(), report)})

    def begin_job(self, site: str, kind: str) -> int:
        with self._transactions.write() as connection:
            done = connection.execute(
                """INSERT INTO jobs (site, kind, state, started, message, report) VALUES (?, ?, 'running', ?, '', '{}')
                   RETURNING id""",
                (check_name(site, "site"), kind, _iso(self._clock_ns())),
            )
            return int(done.fetchone()[0])

    def update_job(self, job: int, state: str, message: str, report: dict[str, Any]) -> None:
        """Store the state of a job: running, or ended (done or failed)."""
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
