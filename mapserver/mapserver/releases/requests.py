"""Requests to the signer: what operators ask of a server that cannot sign itself. A request is a job, which the API and the pages show."""

import time
from typing import Literal, TypeAlias

import msgspec

from fleetmap.encoding import to_plain
from fleetmap.errors import StateError
from mapserver.store import Actor, JobInfo, MapStore
from mapserver.store.rows import REQUEST
from mapserver.trust import SignedLists

_ANSWERED_WITHIN_S = 10.0
_LOOK_EVERY_S = 0.1
What: TypeAlias = Literal["publish", "promote", "roll back", "try"]


class Wish(msgspec.Struct, frozen=True, kw_only=True):
    """What is asked for. version: None for a rollback; share: of the robots, for a trial."""

    version: int | None = None
    share: float | None = None
    actor: str = ""
    reason: str = ""


class Desk:
    """Where operators' acts arrive. signer: whether another account signs, so that what its lists do not admit has to be asked for."""

    def __init__(self, store: MapStore, *, signer: bool) -> None:
        self._store, self._signer = store, signer

    def ask(
        self, what: What, site: str, actor: Actor, version: int | None = None, share: float | None = None
    ) -> JobInfo | None:
        """The request, done, or still waiting after ten seconds; None where the server may act itself.

        Raises StateError for a request that was refused, and while another one of the site waits.
        """
        if not self._signer or self._is_admitted(site, self._rollback_target(site) if version is None else version):
            return None
        waiting = [job for job in self._store.running_jobs() if job.site == site and job.kind.startswith(REQUEST)]
        if waiting:
            raise StateError(
                f"job {waiting[0].id}, a {waiting[0].kind}, waits for the signer already; look at it first"
            )
        wish = Wish(version=version, share=share, actor=actor.name, reason=actor.reason)
        words = "waits for the signer; is `mapserver signer` running?"
        return self._answered(self._store.begin_job(site, REQUEST + what, words, to_plain(wish)))

    def _answered(self, number: int) -> JobInfo:
        until_s = time.monotonic() + _ANSWERED_WITHIN_S
        while (job := self._store.job(number)).state == "running" and time.monotonic() < until_s:
            time.sleep(_LOOK_EVERY_S)
        if job.state == "failed":
            raise StateError(job.message)
        return job

    def _rollback_target(self, site: str) -> int | None:
        """None where a trial ends instead, which needs no signature."""
        rows = self._store.releases(site)
        return None if rows.canary is not None else rows.rollback_target

    def _is_admitted(self, site: str, version: int | None) -> bool:
        served = SignedLists(self._store.folder).served(site)
        if version is None:
            return True
        sha256 = self._store.version(site, version).manifest_sha256
        return served is not None and any(
            (entry.about.version, entry.sha256) == (version, sha256) for entry in served.admitted
        )
