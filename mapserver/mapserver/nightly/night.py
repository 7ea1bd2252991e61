"""One night of one site, from the inbox to a current version. Whatever ends it, the next one goes on from there.

What was done is read from the store: a version says which recordings it was made of, the log which job saved a draft. So nothing is
built twice and nothing is lost, wherever a night was killed: before the draft is whole there is none, after that the next night takes
it to the gate, and recordings that a version holds are only put away.
"""

import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from fleetmap.errors import FleetmapError, GateRefusedError, RecordingError, StoreError, SurveyError
from mapserver import releases
from mapserver.build.build import BuildOptions, BuildRequest, build_draft
from mapserver.build.job_lock import INTERRUPTED, end_interrupted, held
from mapserver.nightly import inbox as boxes
from mapserver.nightly.lock import only_one
from mapserver.nightly.recorded import Recorded, identify
from mapserver.quality.gate import GateSettings
from mapserver.store import Actor, MapStore, VersionInfo
from mapserver.survey.settings import SurveySettings

JOB = "nightly"


@dataclass(frozen=True, slots=True)
class NightRequest:
    """What `mapserver nightly` was asked for. now_ns: the moment by which recordings have been quiet for `settle_s`, or not."""

    site: str
    inbox: Path
    store: Path
    now_ns: int
    settle_s: float = 300.0
    frames: str = "::"
    calibration: Path | None = None
    zones: Path | None = None
    threads: int | None = None
    scheduler: str | None = None


@dataclass
class Night:
    """What happened. version: what is current in the end; fates: by recording, where it went and why."""

    job: int
    version: int | None = None
    published: list[int] = field(default_factory=list)
    fates: list[dict[str, Any]] = field(default_factory=list)
    resumes: list[int] = field(default_factory=list)
    waiting: list[dict[str, str]] = field(default_factory=list)
    builds: list[dict[str, Any]] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """As JSON; docs/reports.md says what the keys mean."""
        return {
            "job": self.job,
            "resumes": self.resumes,
            "version": self.version,
            "published": self.published,
            "recordings": self.fates,
            "waiting": self.waiting,
            "builds": self.builds,
        }


def run_night(order: NightRequest, survey: SurveySettings, gate: GateSettings, console: Console) -> str:
    """Does it; the sentence says how it ended.

    Raises BusyError where another night of the site runs, GateRefusedError for a refused draft, and other FleetmapErrors; the job
    in the store says the same. The current version is the last good one in any case.
    """
    with MapStore.open(order.store, create=True) as maps, only_one(order.store, order.site):
        night = Night(maps.begin_job(order.site, JOB))
        _take_over(maps, order.site, night)
        end_interrupted(maps, time.time_ns())
        try:
            with held(order.store, night.job):
                sentence = _Conductor(order, survey, gate, console, maps, night).run()
        except FleetmapError as error:
            with suppress(StoreError):  # a full disk: then the next night finds this one's job running, and ends it
                night.version = _current(maps, order.site)
                maps.update_job(night.job, "failed", f"{error}{_still(night.version)}", night.report())
            raise
        night.version = _current(maps, order.site)
        maps.update_job(night.job, "done", sentence, night.report())
        return sentence


def last_report(store: Path, site: str) -> dict[str, Any] | None:
    """What the last night of a site reports, its state and message with it; None where there was none."""
    with MapStore.open(store) as maps:
        last = next((job for job in maps.jobs(site) if job.kind == JOB), None)
    return None if last is None else {"state": last.state, "message": last.message, **last.report}


def _still(version: int | None) -> str:
    return "" if version is None else f"; version {version} stays current"


def _current(maps: MapStore, site: str) -> int | None:
    info = maps.current(site) if site in {known.site for known in maps.sites()} else None
    return None if info is None else info.version


def _take_over(maps: MapStore, site: str, night: Night) -> None:
    """Ends the jobs of nights that were killed: the lock says that none of them runs."""
    for job in maps.jobs(site):
        if job.kind != JOB or job.id == night.job or not (job.state == "running" or INTERRUPTED in job.report):
            continue
        night.resumes += [job.id, *job.report.get("resumes", [])]
    maps.update_job(night.job, "running", "", night.report())
    for number in night.resumes:
        job = maps.job(number)
        if job.state == "running" or INTERRUPTED in job.report:
            report = {key: value for key, value in job.report.items() if key != INTERRUPTED}
            maps.update_job(number, "failed", f"was interrupted; job {night.job} goes on with it", report)


class _Conductor:
    """The steps of a night."""

    def __init__(
        self, order: NightRequest, survey: SurveySettings, gate: GateSettings, console: Console, maps: MapStore, night: Night
    ) -> None:  # fmt: skip
        self._order, self._survey, self._gate = order, survey, gate
        self._console, self._maps, self._night = console, maps, night

    def run(self) -> str:
        here = boxes.arrivals(self._order.inbox, self._order.settle_s, self._order.now_ns)
        for path, reason in here.waiting:
            self._say(f"not yet: {path.name}: {reason}")
            self._night.waiting.append({"name": path.name, "reason": reason})
        recordings = self._identified(here.complete)
        left = self._left_draft()
        if left is not None:
            recordings = self._publish(left, recordings)
        fresh = self._unknown(recordings)
        if fresh:
            self._build(fresh)
        if not self._night.published:
            return f"site {self._order.site}: nothing new"
        versions = ", ".join(str(version) for version in self._night.published)
        return f"site {self._order.site}: version {versions} published, {self._counts()}"

    def _identified(self, paths: tuple[Path, ...]) -> list[Recorded]:
        """Those that can be read, each once."""
        found: dict[str, Recorded] = {}
        for path in paths:
            self._say(f"reading {path.name}")
            recorded = identify(path, self._order.calibration)
            if isinstance(recorded, str):
                self._put_away(path, boxes.BAD, None, recorded)
            elif recorded.sha256 in found:
                same = found[recorded.sha256].path.name
                self._put_away(path, boxes.DONE, recorded.sha256, f"the same as {same}")
            else:
                found[recorded.sha256] = recorded
        return list(found.values())

    def _left_draft(self) -> VersionInfo | None:
        """The draft that a killed night saved and that still fits: nobody published anything since."""
        site = self._order.site
        if site not in {known.site for known in self._maps.sites()}:
            return None
        parent, resumed = _current(self._maps, site), set(self._night.resumes)
        drafts = [info for info in self._maps.versions(site) if info.state == "draft" and info.job in resumed]
        return next((info for info in reversed(drafts) if info.parent == parent), None)

    def _unknown(self, recordings: list[Recorded]) -> list[Recorded]:
        """Those that no version was made of; the others are put away."""
        site = self._order.site
        known: dict[str, int] = {}
        if site in {info.site for info in self._maps.sites()}:
            for info in self._maps.versions(site):
                if info.state != "draft":
                    entries = self._maps.manifest(site, info.version).recordings
                    known |= {entry.sha256: info.version for entry in entries}
        for recorded in recordings:
            if recorded.sha256 in known:
                self._put_away(recorded.path, boxes.DONE, recorded.sha256, f"in version {known[recorded.sha256]}")
        return [recorded for recorded in recordings if recorded.sha256 not in known]

    def _build(self, recordings: list[Recorded]) -> None:
        order = self._order
        by_hash = {recorded.sha256: recorded for recorded in recordings}
        unusable: dict[Path, str] = {}
        options = BuildOptions(
            frames=order.frames,
            calibration=order.calibration,
            zones=order.zones,
            replay=tuple(self._replayed()),
            actor=Actor(JOB, _reason(self._night.job)),
            threads=order.threads,
            scheduler=order.scheduler,
            job=self._night.job,
        )
        build = BuildRequest(tuple(r.path for r in recordings), order.site, order.store, options)
        try:
            draft, _ = build_draft(build, self._survey, unusable)
        except (RecordingError, SurveyError) as error:
            self._put_all_away(recordings, unusable, str(error))
            raise
        self._night.builds.append({"version": draft.version, **draft.report})
        self._say(draft.sentence)
        for sha256, reason in draft.left_out.items():
            self._put_away(by_hash.pop(sha256).path, boxes.HELD, sha256, reason)
        for recorded in [r for r in by_hash.values() if r.path in unusable]:
            self._put_away(recorded.path, boxes.BAD, recorded.sha256, unusable[recorded.path])
        rest = [recorded for recorded in by_hash.values() if recorded.path not in unusable]
        self._publish(self._maps.version(order.site, draft.version), rest)

    def _put_all_away(self, recordings: list[Recorded], unusable: dict[Path, str], reason: str) -> None:
        for recorded in recordings:
            where = boxes.BAD if recorded.path in unusable else boxes.HELD
            self._put_away(recorded.path, where, recorded.sha256, unusable.get(recorded.path, reason))

    def _replayed(self) -> list[Path]:
        """Recordings of the current version that the inbox still has."""
        current = _current(self._maps, self._order.site)
        if current is None:
            return []
        entries = self._maps.manifest(self._order.site, current).recordings
        return boxes.kept(self._order.inbox, [entry.sha256 for entry in entries])

    def _publish(self, draft: VersionInfo, recordings: list[Recorded]) -> list[Recorded]:
        """Takes a draft through the gate and puts away what it was made of; the others are returned."""
        site, version = self._order.site, draft.version
        taken = {entry.sha256 for entry in self._maps.manifest(site, version).recordings}
        own = [recorded for recorded in recordings if recorded.sha256 in taken]
        try:
            releases.publish(self._maps, site, version, actor=Actor(JOB, _reason(self._night.job)), gate=self._gate)
        except GateRefusedError as error:
            for recorded in own:
                self._put_away(recorded.path, boxes.HELD, recorded.sha256, str(error))
            raise
        self._night.published.append(version)
        self._say(f"site {site}: version {version} is current")
        for recorded in own:
            self._put_away(recorded.path, boxes.DONE, recorded.sha256, f"in version {version}")
        return [recorded for recorded in recordings if recorded.sha256 not in taken]

    def _put_away(self, path: Path, where: str, sha256: str | None, reason: str) -> None:
        self._say(f"{where}: {path.name}: {reason}")
        boxes.put_away(path, where, sha256, None if where == boxes.DONE else reason)
        self._night.fates.append({"name": path.name, "sha256": sha256, "fate": where, "reason": reason})

    def _counts(self) -> str:
        fates = [fate["fate"] for fate in self._night.fates]
        return ", ".join(f"{fates.count(where)} {where}" for where in (boxes.DONE, boxes.HELD, boxes.BAD))

    def _say(self, words: str) -> None:
        self._console.print(words, markup=False, highlight=False)


def _reason(job: int) -> str:
    return f"nightly job {job}"
