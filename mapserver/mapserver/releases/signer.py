"""The signer's work, on the builder's account: answers operators' requests, and signs what releases admit."""

import logging

import msgspec

from fleetmap.errors import FleetmapError, StateError
from fleetmap.log_lines import LogLimit
from mapserver.quality.gate import GateSettings
from mapserver.releases import release
from mapserver.releases.requests import Wish
from mapserver.store import Actor, JobInfo, MapStore, VersionInfo
from mapserver.store.rows import REQUEST
from mapserver.trust.builder_folder import BuilderFolder
from mapserver.trust.signing import sign_as_builder

_log = logging.getLogger(__name__)


class Signer:
    """One builder's account at work on one store. Never publishes by force: that is for a person of this account."""

    def __init__(self, store: MapStore, builder: BuilderFolder, gate: GateSettings) -> None:
        self._store, self._builder, self._gate = store, builder, gate
        self._faults = LogLimit(_log)

    def run_once(self) -> None:
        """Answers what waits and signs what is due; what is in the way of one site does not stop another."""
        for job in self._store.running_jobs():
            if job.kind.startswith(REQUEST):
                self._answer(job)
        for info in self._store.sites():
            try:
                if sign_as_builder(self._store, self._builder, info.site):
                    _log.info("the list of site %s is signed", info.site)
            except FleetmapError as error:
                self._faults.warning(info.site, "nothing is signed for site %s: %s", info.site, error)

    def _answer(self, job: JobInfo) -> None:
        try:
            words = self._act(job.site, job.kind.removeprefix(REQUEST), msgspec.convert(job.report, Wish))
            sign_as_builder(self._store, self._builder, job.site)
            state = "done"
        except (FleetmapError, msgspec.MsgspecError) as error:
            words, state = f"the signer refused: {error}", "failed"
        _log.info("job %d, site %s, %s: %s", job.id, job.site, job.kind, words)
        self._store.update_job(job.id, state, words, job.report)

    def _act(self, site: str, what: str, wish: Wish) -> str:
        actor = Actor(wish.actor, wish.reason)
        if what == "roll back":
            rows = self._store.releases(site)
            if rows.rollback_target is not None:
                self._builder.check(rows.versions[rows.rollback_target], to_release=True)
            return f"version {release.roll_back(self._store, site, actor=actor)} is current"
        info = self._store.version(site, wish.version or 0)
        self._builder.check(info, to_release=True)
        if what == "publish":
            release.publish(self._store, site, info.version, actor=actor, gate=self._gate)
        elif what == "promote":
            release.promote(self._store, site, info.version, actor=actor)
        elif what == "try" and wish.share is not None:
            release.start_canary(self._store, site, info.version, wish.share, actor=actor, gate=self._gate)
            return f"version {info.version} is tried"
        else:
            raise StateError(f"a request to {what[:40]!r} is none that the signer knows; look at who sends it")
        return f"version {info.version} is current"


def note_verdict(store: MapStore, builder: BuilderFolder, draft: VersionInfo, gate: GateSettings) -> None:
    """Notes whether a draft passes the gate, right after it was built: who asks for it later cannot change that."""
    if release.judge_draft(store, draft, gate).accepted:
        builder.note_passed(draft.site, draft.version)
