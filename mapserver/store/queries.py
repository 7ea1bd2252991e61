"""Queries of a store, and writes that change no version: robots' reports, jobs, the log."""

import json
import threading
from collections.abc import Callable, Sequence, Set
from contextlib import closing
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, StateError, StoreError, UsageError
from fleetmap.mapformat.building import ALIGNMENT, AREAS, FLOORS, FOR_ROBOTS, Building, read_building
from fleetmap.mapformat.manifest import Manifest, decode_manifest
from fleetmap.mapformat.names import check_name, check_sha256, sha256_hex
from mapserver.floor_plan.alignment import Alignment, decode_alignment
from mapserver.floor_plan.areas import Areas, read_areas
from mapserver.floor_plan.survey_requests import KIND, SurveyRequest, read_request
from mapserver.quality.figures import Evidence, TrustedCalibration, carried_evidence, trusted_calibrations
from mapserver.store import rows as records
from mapserver.store.blobs import Blobs
from mapserver.store.database import Database, SqliteDatabase, Transaction, matching
from mapserver.store.fleet_queries import FleetQueries, keep_last_reports
from mapserver.store.operators import OperatorQueries
from mapserver.store.places import open_database, open_objects, read_places
from mapserver.store.survey_pictures import SurveyPicture, pictures_of
from mapserver.store.usage import DiskMeter, DiskSpace, StoreUsage, UsageMeter

EXTRA_TABLES = {"grid": "grid_blobs", "surfel": "surfel_blobs"}
"""By kind: table of the bytes of a version not needed by its robots; pictures of surveys are among the surfels."""
_OF_VERSIONS = ("manifest", "tile", "vocabulary")
_RESTORED = "restored"
_REQUESTS_KEPT = 4096
Span = tuple[int | None, int | None]
"""From when and until before when, nanoseconds since 1970; None: without an end."""
EVER: Span = (None, None)


class StoreQueries:
    """Methods of an open store that change no version. Those with a site raise UsageError for an unknown one, all StoreError."""

    def __init__(
        self, root: Path, clock_ns: Callable[[], int], *, create: bool = False, read_only: bool = False
    ) -> None:
        places = read_places(root)
        self.folder, self.now_ns = root, clock_ns
        self._blobs = Blobs(open_objects(places.content or root))
        self._database = open_database(root, places, clock_ns, create=create, read_only=read_only)
        self.fleet, self.operators = FleetQueries(self._database), OperatorQueries(self._database)
        self.files = self._database.files(root)
        self.locked, self.leads, self.is_shared = self._database.locked, self._database.leads, self._database.is_shared
        self.blob_size, self.blob_chunks, self.is_whole = self._blobs.size, self._blobs.chunks, self._blobs.is_whole
        self.disk_space: Callable[[], DiskSpace] = DiskMeter(root, clock_ns).look
        self.usage: Callable[[], StoreUsage | None] = UsageMeter(root, self._database, self._blobs).look
        self._areas: dict[str, tuple[list[str], Areas]] = {}  # by the addresses of their source files
        self._acts, self._acts_read, self._acts_lock = dict[str, list[records.Event]](), 0, threading.Lock()
        # Every robot asks for requests every few seconds, and an object store answers slowly.
        self._request = lru_cache(_REQUESTS_KEPT)(lambda kind, sha256: read_request(kind, self._blobs.get(sha256)))

    def now(self) -> datetime:
        """Return the time in UTC, by the store's clock."""
        return datetime.fromtimestamp(self.now_ns() / 1e9, UTC)

    # ---------------------------------------------------------------------------------------------- sites and versions

    def sites(self) -> list[records.SiteInfo]:
        return self._database.rows(
            records.SiteInfo,
            """SELECT s.site, (SELECT version FROM versions v WHERE v.site = s.site AND state = 'current') current_version,
               (SELECT count(*) FROM versions v WHERE v.site = s.site) versions FROM sites s ORDER BY s.site""",
        )

    def versions(self, site: str, *, after: int = 0, limit: int | None = None) -> list[records.VersionInfo]:
        """Return versions of a site, oldest first, after number `after`."""
        self._check_site(site)
        return self._database.select(
            records.VersionInfo, "versions", {"site": site, "version >": after}, "version", limit
        )

    def version(self, site: str, version: int) -> records.VersionInfo:
        """Return one version; UsageError if it does not exist."""
        self._check_site(site)
        if (found := self._version(site, version=version)) is None:
            raise UsageError(f"site {site} has no version {version}; `mapserver versions --site {site}` lists them")
        return found

    def current(self, site: str) -> records.VersionInfo | None:
        """Return the site's current version, None before the first publication."""
        if (found := self._version(site, state="current")) is None:
            self._check_site(site)
        return found

    def releases(self, site: str) -> records.SiteReleases:
        """Return the present state of a site's releases, for decisions."""
        self._check_site(site)
        return site_releases(self._database, site)

    def canaries(self, site: str | None = None, *, running: bool = False) -> list[records.CanaryRow]:
        """Return canaries (of a site), latest first; with `running` only running ones."""
        wanted = {"site": site, "state": "running" if running else None}
        return self._database.select(records.CanaryRow, "canaries", wanted, "id DESC")

    def verdicts(self, site: str, version: int) -> list[records.VerdictRow]:
        """Return the gate's verdicts on a version, oldest first; UsageError if it does not exist."""
        self.version(site, version)
        return [verdict for _, verdict in self._verdicts("site = ? AND version = ?", site, version)]

    def last_verdicts(self, site: str) -> dict[int, records.VerdictRow]:
        """Return the gate's last verdict on each version of a site that it judged."""
        return dict(self._verdicts("id IN (SELECT max(id) FROM verdicts WHERE site = ? GROUP BY version)", site))

    def _verdicts(self, condition: str, *values: object) -> list[tuple[int, records.VerdictRow]]:
        """Return version and verdict, oldest first."""
        columns = "version, stamp_ns, accepted, forced, reasons, report"
        rows: list[dict[str, Any]] = self._database.rows(
            dict, f"SELECT {columns} FROM verdicts WHERE {condition} ORDER BY id", values
        )
        return [(row["version"], msgspec.convert(row, records.VerdictRow, strict=False)) for row in rows]

    def evidence(self, site: str, version: int) -> Evidence | None:
        """Return the measurements of a version from its build, None if absent; errors as of `manifest`.

        For an imported one those in its manifest.
        """
        self.version(site, version)
        query = "SELECT figures FROM evidence WHERE site = ? AND version = ?"
        if (figures := self._database.value(query, (site, version))) is None:
            return carried_evidence(self.manifest(site, version))
        return msgspec.json.decode(figures, type=Evidence)

    def trusted(self, info: records.VersionInfo) -> list[TrustedCalibration]:
        """Return the calibrations of a version trusted by an operator; empty for a damaged manifest, which `verify` reports."""
        try:
            return trusted_calibrations(self.manifest(info.site, info.version))
        except (StoreError, MapFormatError):
            return []

    # --------------------------------------------------------------------------------------------------------- content

    def manifest(self, site: str, version: int) -> Manifest:
        """Return the manifest of a version; errors as of `version` and `blob`."""
        return decode_manifest(self._blobs.get(self.version(site, version).manifest_sha256))

    def archive(self, site: str, version: int) -> bytes | None:
        """Return the archive of a version, if it has one; errors as of `version` and `blob`."""
        sha256 = self.version(site, version).archive_sha256
        return None if sha256 is None else self._blobs.get(sha256)

    def blob(self, sha256: str) -> bytes:
        """Return the bytes of an address, verified; StoreError for missing ones, MapFormatError for damaged ones."""
        return self._blobs.get(check_sha256(sha256))

    def named_blobs(self) -> set[str]:
        """Return the addresses of all blobs that the database names."""
        return mentioned(self._database)

    def served_kind(self, sha256: str, site: str | None = None) -> str | None:
        """Return the kind that robots (of a site) may fetch under this address: manifest, tile, vocabulary, grid, or a site's file.

        None for all others: archives, and bytes referenced only by drafts.
        """
        words, values = matching({"sha256": check_sha256(sha256), "site": site})
        of_versions = f"JOIN versions USING (site, version) WHERE state <> 'draft' AND {words}"
        kinds = self._database.column(
            f"""SELECT kind FROM version_blobs {of_versions} UNION SELECT 'grid' kind FROM grid_blobs {of_versions}
                UNION SELECT kind FROM site_files WHERE {words}""",
            values * 3,
        )
        return next((kind for kind in (*_OF_VERSIONS, "grid", *FOR_ROBOTS) if kind in kinds), None)

    def survey_pictures(self, site: str, version: int) -> tuple[SurveyPicture, ...]:
        """Return the surveys' pictures of a version that are still kept; errors as of `manifest` and `pictures_of`."""
        query = "SELECT sha256 FROM surfel_blobs WHERE site = ? AND version = ?"
        kept = set(self._database.column(query, (site, version)))
        found = tuple(p for p in pictures_of(self.manifest(site, version), self._blobs.get) if p.sha256 in kept)
        if not found:
            raise StateError(
                f"the surveys' pictures of version {version} of site {site} were removed after their period"
            )
        return found

    def copy_database(self, path: Path) -> tuple[set[str], int]:
        """Copy the database into a new file, as of one moment; return the blobs that the copy names, and its number of versions."""
        self._database.copy_to(path)
        with closing(SqliteDatabase(path, self.now_ns, read_only=True)) as copy:
            return mentioned(copy), copy.value("SELECT count(*) FROM versions")

    # -------------------------------------------------------------------------------------------------- files of a site

    def site_file_sha256(self, site: str, kind: str) -> str | None:
        query = "SELECT sha256 FROM site_files WHERE site = ? AND kind = ?"
        found: str | None = self._database.value(query, (site, kind))
        return found

    def site_file(self, site: str, kind: str) -> bytes | None:
        """Return a site's file of this kind, such as `plan`; None if absent. Errors as of `blob`."""
        sha256 = self.site_file_sha256(site, kind)
        return None if sha256 is None else self._blobs.get(sha256)

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
        source = self._area_files(site)
        if site not in self._areas or self._areas[site][0] != source:
            data, alignment = self.site_file(site, AREAS), self.alignment(site)
            areas = Areas() if data is None else read_areas(data, None if alignment is None else alignment.frame)
            self._areas[site] = source, areas
        return self._areas[site][1]

    def areas_tag(self, site: str) -> str:
        """Return a hash that changes with the areas of a site and with their place in `map`."""
        return sha256_hex(" ".join(self._area_files(site)).encode())

    def _area_files(self, site: str) -> list[str]:
        query = "SELECT sha256 FROM site_files WHERE site = ? AND kind IN (?, ?) ORDER BY kind"
        return self._database.column(query, (site, AREAS, ALIGNMENT))

    def survey_requests(self, site: str) -> list[SurveyRequest]:
        """Return the open survey requests, oldest first; empty for an unknown site."""
        query = "SELECT kind, sha256 FROM site_files WHERE site = ? AND substr(kind, 1, ?) = ?"
        rows = self._database.query(query, (site, len(KIND), KIND))
        found = [self._request(row["kind"], row["sha256"]) for row in rows]
        return sorted(found, key=lambda request: (request.asked_ns, request.id))

    # ---------------------------------------------------------------------------------------------------------- the log

    def audit(self, kind: str, detail: str, *, actor: records.Actor = records.NOBODY, site: str = "") -> None:
        """Log an event that no other method writes, such as an enrolment, a signature or a refusal."""
        with self._database.write() as change:
            change.log(site, kind, detail, actor=actor)

    def events(
        self, site: str, span_ns: Span = EVER, *, after: int = 0, limit: int | None = None
    ) -> list[records.Event]:
        """Return a site's history, oldest first, after event `after`; span_ns: start and end, None for open."""
        wanted = {"site": site, "id >": after, "stamp_ns >=": span_ns[0], "stamp_ns <": span_ns[1]}
        return self._database.select(records.Event, "events", wanted, "id", limit)

    def last_events(self, site: str, limit: int) -> list[records.Event]:
        """Return the last events of a site, the newest first, without what people did about incidents."""
        return self._database.select(
            records.Event, "events", {"site": site, "kind <>": records.INCIDENT}, "id DESC", limit
        )

    def incident_acts(self) -> dict[str, list[records.Event]]:
        """Return what people did about each incident, by its id, oldest first. Only new lines are read: the log goes back for ever."""
        with self._acts_lock:
            last = self._database.value("SELECT max(id) FROM events") or 0
            wanted = {"id >": self._acts_read, "id <=": last, "kind": records.INCIDENT}
            for act in self._database.select(records.Event, "events", wanted, "id"):
                self._acts.setdefault(act.detail.partition(": ")[2], []).append(act)
            self._acts_read = last
            return dict(self._acts)

    def log(
        self,
        *,
        site: str | None = None,
        person: str | None = None,
        kind: str | None = None,
        of_people: bool = False,
        span_ns: Span = EVER,
        before: int | None = None,
        limit: int | None = None,
    ) -> list[records.AuditLine]:
        """Return lines of the log, the last first. kind: its beginning; of_people: not what the server did; before: a line."""
        by, start_ns, end_ns = "" if of_people else None, *span_ns
        wanted = {"site": site, "actor": person, "actor <>": by, "stamp_ns >=": start_ns, "stamp_ns <": end_ns}
        wanted |= {"kind LIKE": None if kind is None else f"{kind}%", "id <": before}
        return self._database.select(records.AuditLine, "events", wanted, "id DESC", limit)

    def log_values(self, column: Literal["actor", "site", "kind"]) -> list[str]:
        """Return what lines of people have in a column of the log."""
        return self._database.column(
            f"SELECT DISTINCT {column} FROM events WHERE actor <> '' AND {column} <> '' ORDER BY {column}"
        )

    def note_restored(self, detail: str, ahead: int, actor: records.Actor) -> None:
        """Log the restoration of this store, and let its sites' versions go on `ahead` numbers later: the lost store gave the next ones."""
        with self._database.write() as change:
            change.execute("UPDATE sites SET last_version = last_version + ?", (ahead,))
            change.log("", _RESTORED, detail, actor=actor)

    def restored_ns(self) -> int:
        """Return when the store was last restored from a backup, 0 if never."""
        return self._database.value("SELECT max(stamp_ns) FROM events WHERE kind = ?", (_RESTORED,)) or 0

    # ----------------------------------------------------------------------------------------------------------- robots

    def robots(self, site: str | None = None) -> list[records.RobotInfo]:
        """Return the last report of every robot (of a site)."""
        return self._database.select(records.RobotInfo, "robots", {"site": site}, "site, robot")

    def robot_names(self) -> set[tuple[str, str]]:
        return {(row["site"], row["robot"]) for row in self._database.query("SELECT site, robot FROM robots")}

    def record_robot_report(self, site: str, robot: str, report: dict[str, Any], version: int | None = None) -> None:
        """Store a robot's report; `version` is its running version, None if not reported."""
        check_name(site, "site")
        check_name(robot, "robot")
        with self._database.write(durable=False) as change:
            keep_last_reports(change, {(site, robot): (version, self.now_ns(), report)})

    def remove_robots(self, site: str, robots: Sequence[str], *, actor: records.Actor = records.NOBODY) -> list[str]:
        """Remove the last reports of a site's robots, and return the known ones; their counts and failures stay."""
        self._check_site(site)
        removed = []
        with self._database.write() as change:
            for robot in robots:
                if change.execute("DELETE FROM robots WHERE site = ? AND robot = ?", (site, robot)).rowcount:
                    removed.append(robot)
                    change.log(site, "robot removed", robot, actor=actor)
        return removed

    # ------------------------------------------------------------------------------------------------------------- jobs

    def jobs(
        self, site: str | None = None, span_ns: Span = EVER, *, before: int | None = None, limit: int | None = None
    ) -> list[records.JobInfo]:
        """Return jobs (of a site), newest first, older than job `before`; span_ns: range of their start, by the second."""
        since, until = (None if ns is None else _iso(ns + 999_999_999) for ns in span_ns)
        wanted = {"site": site, "id <": before, "started >=": since, "started <": until}
        return self._database.select(records.JobInfo, "jobs", wanted, "id DESC", limit)

    def job(self, number: int) -> records.JobInfo:
        """Return one job; UsageError if it does not exist."""
        if found := self._database.select(records.JobInfo, "jobs", {"id": number}, "id"):
            return found[0]
        raise UsageError(f"job {number} does not exist; the list of jobs shows the stored ones")

    def running_jobs(self) -> list[records.JobInfo]:
        return self._database.select(records.JobInfo, "jobs", {"state": "running"}, "id")

    def last_night(self, site: str) -> records.JobInfo | None:
        """Return the site's last ended nightly job; None before the first."""
        wanted = {"site": site, "kind": "nightly", "state <>": "running"}
        return next(iter(self._database.select(records.JobInfo, "jobs", wanted, "id DESC", 1)), None)

    def sites_with_jobs(self) -> list[str]:
        """Return the sites with a job, also those without a version."""
        return self._database.column("SELECT DISTINCT site FROM jobs ORDER BY site")

    def begin_job(self, site: str, kind: str) -> int:
        row = {"site": check_name(site, "site"), "kind": kind, "state": "running", "started": _iso(self.now_ns())}
        with self._database.write() as change:
            done = change.insert("jobs", [row | {"message": "", "report": "{}"}], "RETURNING id")
            return int(done.fetchone()[0])

    def update_job(self, job: int, state: str, message: str, report: dict[str, Any]) -> None:
        """Store the state of a job: running, or ended (done or failed)."""
        finished = None if state == "running" else _iso(self.now_ns())
        with self._database.write() as change:
            query = "UPDATE jobs SET state = ?, finished = ?, message = ?, report = ? WHERE id = ?"
            change.execute(query, (state, finished, message, to_json(report).decode(), job))

    def tell_progress(self, job: int, progress: object, key: str = "progress") -> None:
        """Store the progress of a running job under a key of its report; ignored for an ended one. A power cut may lose it."""
        with self._database.write(durable=False) as change:
            found = change.execute("SELECT report FROM jobs WHERE id = ? AND state = 'running'", (job,)).fetchone()
            if found is not None:
                report = to_json(json.loads(found[0]) | {key: progress}).decode()
                change.execute("UPDATE jobs SET report = ? WHERE id = ?", (report, job))

    def _check_site(self, site: str) -> None:
        check_name(site, "site")
        if self._database.value("SELECT 1 FROM sites WHERE site = ?", (site,)) is None:
            known = ", ".join(info.site for info in self.sites()) or "none"
            raise UsageError(f"the store has no site {site}; it has: {known}")

    def _version(self, site: str, **wanted: object) -> records.VersionInfo | None:
        return next(
            iter(self._database.select(records.VersionInfo, "versions", {"site": site, **wanted}, "version")), None
        )


def site_releases(database: Database, site: str) -> records.SiteReleases:
    """Return the state of a site's releases; empty for an unknown site."""
    versions = database.select(records.VersionInfo, "versions", {"site": site}, "version")
    running = database.select(records.CanaryRow, "canaries", {"site": site, "state": "running"}, "id DESC")
    current = next((info.version for info in versions if info.state == "current"), None)
    query = "SELECT version FROM currents WHERE site = ? AND version <> ? ORDER BY id DESC LIMIT 1"
    files = database.query("SELECT kind, sha256 FROM site_files WHERE site = ? ORDER BY kind", (site,))
    return records.SiteReleases(
        site=site,
        versions={info.version: info for info in versions},
        rollback_target=None if current is None else database.value(query, (site, current)),
        canary=running[0] if running else None,
        files={row["kind"]: row["sha256"] for row in files if row["kind"] in FOR_ROBOTS},
    )


class Release:
    """Changes of one site's releases, in the transaction that reads their state; `mapserver.releases` decides them. rows: before them."""

    def __init__(self, database: Database, change: Transaction, site: str) -> None:
        self._change, self._site, self._now_ns = change, site, database.now_ns()
        self.rows = site_releases(database, site)
        self.has_new_current = False

    def set_state(self, version: int, state: str) -> None:
        """Set a version published, current or retired, with the time of the first and of the last."""
        self.has_new_current |= state == "current"
        self._change.execute(
            """UPDATE versions SET state = ?, published_ns = coalesce(published_ns, ?), retired_ns = ?
               WHERE site = ? AND version = ?""",
            (state, self._now_ns, self._now_ns if state == "retired" else None, self._site, version),
        )

    def make_current(self, version: int) -> None:
        """Make a version current instead of the present one, which stays published."""
        if self.rows.current is not None:
            self.set_state(self.rows.current.version, "published")
        self.set_state(version, "current")
        self._change.insert("currents", [{"site": self._site, "version": version, "since_ns": self._now_ns}])

    def roll_back(self, version: int) -> None:
        """Make the rollback target current again; the present version retires, and leaves the history of current ones."""
        if self.rows.current is not None:
            self.set_state(self.rows.current.version, "retired")
        self.set_state(version, "current")
        self._change.execute(
            """DELETE FROM currents WHERE site = ? AND id > (SELECT max(id) FROM currents WHERE site = ? AND version = ?)""",
            (self._site, self._site, version),
        )

    def begin_canary(
        self, version: int, base_version: int, share: float, threshold: float, actor: records.Actor
    ) -> None:
        """Begin a canary; its version, perhaps a draft, is published."""
        self.set_state(version, "published")
        row = {"site": self._site, "version": version, "base_version": base_version, "share": share}
        row |= {"threshold": threshold, "state": "running", "started_ns": self._now_ns, "outcome": ""}
        self._change.insert("canaries", [row | {"actor": actor.name, "reason": actor.reason}])

    def end_canary(self, state: str, outcome: str) -> None:
        """End the running canary: promoted, rolled_back or stopped, and the reason."""
        query = "UPDATE canaries SET state = ?, ended_ns = ?, outcome = ? WHERE site = ? AND state = 'running'"
        self._change.execute(query, (state, self._now_ns, outcome, self._site))

    def log(self, kind: str, detail: str, version: int, actor: records.Actor) -> None:
        self._change.log(self._site, kind, detail, version, actor)


def mentioned(database: Database, leaving: Set[tuple[str, int]] = frozenset()) -> set[str]:
    """Return the addresses that the database names, but for versions that leave."""
    tables = ("version_blobs", *EXTRA_TABLES.values())
    rows = [row for table in tables for row in database.query(f"SELECT site, version, sha256 FROM {table}")]
    kept = {row["sha256"] for row in rows if (row["site"], row["version"]) not in leaving}
    return kept | set(database.column("SELECT sha256 FROM site_files"))


def _iso(stamp_ns: int) -> str:
    return f"{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}"
