"""One nightly run of one site, from the inbox to a current version; an interrupted run is continued by the next one.

The state of the work is read from the store: a version lists its recordings and the job that saved it. So nothing is built twice
or lost whenever a run is killed: an incomplete draft is not stored; a stored draft is taken to the gate by the next run;
recordings already in a version are only moved.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

from msgspec import Struct, structs
from rich.console import Console

from fleetmap.errors import FleetmapError, GateRefusedError, RecordingError, StoreError, SurveyError
from fleetmap.log_lines import printable
from fleetmap.recordings import file_suffixes
from mapserver import releases
from mapserver.drafting.draft import BuildOptions, BuildRequest, build_draft
from mapserver.drafting.job_lock import INTERRUPTED, end_interrupted, held, logged, only_one
from mapserver.library import settings_for
from mapserver.nightly import inbox as boxes
from mapserver.nightly.inbox import apply_retention
from mapserver.plugins.nightly_builds.recordings import InboxRecording, identify, kept
from mapserver.quality.gate import GateSettings
from mapserver.store import Actor, FleetRetention, MapStore, VersionInfo

_log = logging.getLogger(__name__)
JOB = "nightly"
_MOST_A_NIGHT = 1000  # recordings, and lines on entries left in place
_MOST_ENDED = 2
# Of a night that ended with several recordings in work, for each: after two such nights each is built alone, and judged by itself.
_ENDED_TOGETHER, _ALONE_ABOVE = 0.75, 1.0
_ENDED = (
    "{nights} nights ended while this was read or built: killed, out of memory or time, or by a bug; "
    "try `mapserver doctor` on it, and move it back, alone, to try again"
)


class NightRequest(NamedTuple):
    """Options of `mapserver nightly`. now_ns: for `settle_s`; retention: applied before the work; trial_share: of the robots, which try
    each version first, None: versions become current at once."""

    site: str
    inbox: Path
    store: Path
    now_ns: int
    settle_s: float = 300.0
    options: BuildOptions = BuildOptions()
    retention: FleetRetention = FleetRetention()
    trial_share: float | None = None


class NightReport(Struct):
    """The report of a night, with the keys of docs/reports.md. version: the current one at the end.

    expired: by kind, how much was removed after its period. looking_at: names of the recordings being read or built.
    ended: by name, number of nights that ended during its processing; one that ended with several in work counts less.
    """

    job: int
    resumes: list[int] = []
    version: int | None = None
    published: list[int] = []
    recordings: list[dict[str, Any]] = []
    waiting: list[dict[str, str]] = []
    expired: dict[str, int] = {}
    builds: list[dict[str, Any]] = []
    looking_at: list[str] = []
    ended: dict[str, float] = {}


def run_night(request: NightRequest, gate: GateSettings, console: Console) -> str:
    """Run the night and return a sentence on its result.

    Raises BusyError if another night of the site runs, GateRefusedError for a refused draft, and other FleetmapErrors; the job
    in the store holds the same message. The current version is the last good one in any case.
    """
    site = request.site
    with MapStore.open(request.store, create=True) as maps, only_one(maps, site):
        report = NightReport(maps.begin_job(site, JOB))
        # End the jobs of killed nights: the lock shows that none of them runs. Count their recordings in work.
        nights = [job for job in maps.jobs(site) if job.kind == JOB and job.id != report.job]
        killed = [job for job in nights if job.state == "running" or INTERRUPTED in job.report]
        report.ended = dict(nights[0].report.get("ended", {})) if nights else {}
        for job in killed:
            for name in job.report.get("looking_at", []):
                share = 1.0 if len(job.report["looking_at"]) == 1 else _ENDED_TOGETHER
                report.ended[name] = report.ended.get(name, 0) + share
            report.resumes += [job.id, *job.report.get("resumes", [])]
        maps.update_job(report.job, "running", "", structs.asdict(report))
        for job in killed:
            left = {key: value for key, value in job.report.items() if key != INTERRUPTED}
            maps.update_job(job.id, "failed", f"was interrupted; job {report.job} goes on with it", left)
        end_interrupted(maps, time.time_ns())
        try:
            with held(maps, report.job), logged(request.store, report.job):
                removed = apply_retention(maps, request.retention, [request.inbox])
                report.expired = {name: count for name, count in removed.items() if count}
                sentence = _Night(request, gate, console, maps, report).run()
        except KeyboardInterrupt:  # ended by a user, not by a recording
            maps.tell_progress(report.job, [], "looking_at")
            raise
        except FleetmapError as error:
            report.looking_at = []
            with suppress(StoreError):  # disk full: the next night finds this job running, and ends it
                report.version = _current(maps, site)
                kept = "" if report.version is None else f"; version {report.version} stays current"
                maps.update_job(report.job, "failed", f"{error}{kept}", structs.asdict(report))
            raise
        report.version = _current(maps, site)
        maps.update_job(report.job, "done", sentence, structs.asdict(report))
        return sentence


def last_report(store: Path, site: str) -> dict[str, Any] | None:
    """Return the last report of a site's nightly run, with its state and message; None if absent."""
    with MapStore.open(store) as maps:
        last = next((job for job in maps.jobs(site) if job.kind == JOB), None)
    return None if last is None else {"state": last.state, "message": last.message, **last.report}


def _versions(maps: MapStore, site: str) -> list[VersionInfo]:
    return maps.versions(site) if any(info.site == site for info in maps.sites()) else []


def _like(names: Sequence[object]) -> str:
    return f", like {len(names) - 1} more" if len(names) > 1 else ""


def _current(maps: MapStore, site: str) -> int | None:
    return next((info.current_version for info in maps.sites() if info.site == site), None)


@dataclass(frozen=True, slots=True)
class _Night:
    """The steps of a night."""

    _request: NightRequest
    _gate: GateSettings
    _console: Console
    _maps: MapStore
    _report: NightReport

    def run(self) -> str:
        here = boxes.arrivals(self._request.inbox, self._request.settle_s, self._request.now_ns)
        for path, reason in here.bad[:_MOST_A_NIGHT]:
            self._put_away(path, boxes.BAD, None, reason)
        recordings = self._identified(here.complete[:_MOST_A_NIGHT])
        for path, reason in here.waiting:
            self._wait(path.name, f"not yet: {reason}")
        left = [*here.complete[_MOST_A_NIGHT:], *(path for path, _ in here.bad[_MOST_A_NIGHT:])]
        if left:
            self._wait(left[0].name, f"not yet{_like(left)}: a night takes {_MOST_A_NIGHT} recordings")
        if here.others:
            known = ", ".join(file_suffixes())
            words = f"no recording{_like(here.others)}; a recording is a folder, or a file that ends in {known}"
            self._wait(here.others[0], words)
        # The draft that a killed night saved, if still based on the current version
        parent, resumed = _current(self._maps, self._request.site), set(self._report.resumes)
        saved = [v for v in _versions(self._maps, self._request.site) if v.state == "draft" and v.job in resumed]
        draft = next((info for info in reversed(saved) if info.parent == parent), None)
        refused = None
        if draft is not None:
            try:
                self._publish(draft, recordings)
            except GateRefusedError as error:
                refused = error
            recordings = [recorded for recorded in recordings if recorded.path.exists()]
        version_of = {
            entry.sha256: info.version
            for info in _versions(self._maps, self._request.site)
            if info.state != "draft"
            for entry in self._maps.manifest(self._request.site, info.version).recordings
        }
        for recorded in recordings:
            if recorded.sha256 in version_of:
                self._put_away(recorded.path, boxes.DONE, recorded.sha256, f"in version {version_of[recorded.sha256]}")
        self._build_all([recorded for recorded in recordings if recorded.sha256 not in version_of])
        if not self._report.published:
            if refused is not None:
                raise refused
            return f"site {self._request.site}: nothing new"
        versions = ", ".join(str(version) for version in self._report.published)
        fates = [recording["fate"] for recording in self._report.recordings]
        counts = ", ".join(f"{fates.count(where)} {where}" for where in (boxes.DONE, boxes.HELD, boxes.BAD))
        return f"site {self._request.site}: version {versions} published, {counts}"

    def _identified(self, paths: tuple[Path, ...]) -> list[InboxRecording]:
        """Return the readable ones, each once."""
        found: dict[str, InboxRecording] = {}
        for path in paths:
            name = path.name
            self._say(f"reading {name}")
            if not boxes.is_safe_name(name):
                self._put_away(path, boxes.BAD, None, f"its name {name} is invalid; rename it")
                continue
            if self._report.ended.get(name, 0) >= _MOST_ENDED:
                self._put_away(path, boxes.BAD, None, _ENDED.format(nights=ceil(self._report.ended[name])))
                continue
            self._look_at([path])
            recorded = identify(path, self._request.options.opening)
            if recorded is None:
                self._wait(name, "incomplete: it changed while it was read")
            elif isinstance(recorded, str):
                self._put_away(path, boxes.BAD, None, recorded)
            elif recorded.sha256 in found:
                same = found[recorded.sha256].path.name
                self._put_away(path, boxes.DONE, recorded.sha256, f"the same as {same}")
            else:
                found[recorded.sha256] = recorded
        self._look_at([])
        return list(found.values())

    def _build_all(self, recordings: list[InboxRecording]) -> None:
        """Build recordings together. Those in work when nights ended are built alone, and where a fault ends a build or the gate refuses
        it all are: only the one at fault is blamed.
        """
        alone = [[r] for r in recordings if self._report.ended.get(r.path.name, 0) > _ALONE_ABOVE]
        groups = [[r for r in recordings if [r] not in alone], *alone]
        failed, published = None, len(self._report.published)
        for group in filter(None, groups):
            if self._request.trial_share and (trials := self._maps.canaries(self._request.site, running=True)):
                for recorded in group:
                    self._wait(recorded.path.name, f"not yet: version {trials[0].version} is on trial")
                continue
            try:
                self._build(group)
            except (RecordingError, SurveyError, GateRefusedError) as error:
                failed = error
                if len(group) > 1:
                    groups += [[r] for r in group if r.path.exists()]  # in the inbox still
            except (FleetmapError, OSError, MemoryError):
                raise
            except Exception as error:
                _log.exception("%s", ", ".join(r.path.name for r in group))
                if len(group) > 1:
                    groups += [[r] for r in group]
                    continue
                words = f"{type(error).__name__}: {str(error)[:200]}; a bug; report it with the log"
                self._put_aside(group, {group[0].path: words}, {})
                failed = RecordingError(f"{group[0].path}: {words}")
        if failed is not None and len(self._report.published) == published:
            raise failed

    def _build(self, recordings: list[InboxRecording]) -> None:
        request = self._request
        unusable: dict[Path, str] = {}
        current = _current(self._maps, request.site)
        entries = () if current is None else self._maps.manifest(request.site, current).recordings
        options = replace(
            request.options,
            replay=tuple(kept(request.inbox, [entry.sha256 for entry in entries])),
            actor=self._actor(),
            job=self._report.job,
            look_at=self._look_at,
        )
        paths = tuple(recorded.path for recorded in recordings)
        build = BuildRequest(paths, request.site, request.store, options)
        try:
            draft, _ = build_draft(build, settings_for(build), unusable)
        except (RecordingError, SurveyError) as error:
            self._put_aside(recordings, unusable, dict.fromkeys((r.sha256 for r in recordings), str(error)))
            raise
        self._look_at([])
        self._report.builds.append({"version": draft.version, **draft.report})
        self._say(draft.sentence)
        self._put_aside(recordings, {}, draft.left_out)
        self._put_aside(recordings, unusable, {})
        self._publish(self._maps.version(request.site, draft.version), recordings)

    def _put_aside(
        self, recordings: list[InboxRecording], unusable: dict[Path, str], left_out: Mapping[str, str]
    ) -> None:
        """Put away those that are in no draft, by the reasons: unusable ones by path, valid ones by hash."""
        for recorded in recordings:
            if (reason := unusable.get(recorded.path, left_out.get(recorded.sha256))) is not None:
                where = boxes.BAD if recorded.path in unusable else boxes.HELD
                self._put_away(recorded.path, where, recorded.sha256, recorded.why(reason))

    def _publish(self, draft: VersionInfo, recordings: list[InboxRecording]) -> None:
        """Take a draft through the gate and move its recordings; of several in a refused one each must be tried alone."""
        site, version = self._request.site, draft.version
        taken = {entry.sha256 for entry in self._maps.manifest(site, version).recordings}
        own = [recorded for recorded in recordings if recorded.sha256 in taken]
        try:
            share, gate = self._request.trial_share, self._gate
            state = releases.publish_or_try(self._maps, site, version, share, actor=self._actor(), gate=gate)
        except GateRefusedError as error:
            if len(own) == 1:
                self._put_away(own[0].path, boxes.HELD, own[0].sha256, str(error))
            raise
        self._report.published.append(version)
        self._say(f"site {site}: version {version} is {state}")
        for recorded in own:
            self._put_away(recorded.path, boxes.DONE, recorded.sha256, f"in version {version}")

    def _put_away(self, path: Path, where: str, sha256: str | None, reason: str) -> None:
        reason = " ".join(reason.split())  # a refusal has several lines
        self._say(f"{where}: {path.name}: {reason}")
        try:
            boxes.put_away(path, where, sha256, None if where == boxes.DONE else reason)
        except StoreError as error:
            self._wait(path.name, f"{error}; {where}: {reason}")
            return
        self._report.ended.pop(path.name, None)  # a new attempt, or another recording of this name, starts at zero
        told = {"name": printable(path.name), "reason": printable(reason)}
        self._report.recordings.append({**told, "sha256": sha256, "fate": where})

    def _wait(self, name: str, reason: str) -> None:
        self._say(f"{name}: {reason}")
        if len(self._report.waiting) < _MOST_A_NIGHT:
            self._report.waiting.append({"name": printable(name), "reason": printable(reason)})

    def _look_at(self, paths: Sequence[Path]) -> None:
        """Record the recordings in work, so that the next nights know them if this one is killed."""
        self._report.looking_at = [path.name for path in paths]
        self._maps.tell_progress(self._report.job, self._report.looking_at, "looking_at")

    def _say(self, words: str) -> None:
        self._console.print(printable(words), markup=False, highlight=False)

    def _actor(self) -> Actor:
        return Actor(JOB, f"nightly job {self._report.job}")
