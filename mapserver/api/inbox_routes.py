"""Endpoints of inboxes and builds: what waits, uploads, another try for what was left out, a build now, the log of a job."""

import asyncio
import logging
import time
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from starlette.exceptions import HTTPException

from fleetmap.errors import StateError, UsageError
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import By, Sender
from mapserver.drafting.job_lock import log_path
from mapserver.nightly.inbox import Inbox, contents, put_back, sites_of
from mapserver.nightly.upload import Upload
from mapserver.serving.night_runs import SETTLE_S, NightRuns
from mapserver.store import Actor, JobInfo, MapStore

NO_INBOX = "This server has no inbox; `mapserver serve --inbox DIR` gives it one, a folder with a folder for each site."
_MOST_UPLOADS = 4  # at once
_WRITTEN_BYTES = 1 << 20  # at once, by another thread
_LOG_BYTES = 64 << 10
_TEXT = {"content": {"text/plain": {"schema": {"type": "string"}}}}
_log = logging.getLogger(__name__)
router = APIRouter()


def _runs(service: p.Service) -> NightRuns:
    if service.settings.nights is None:
        raise StateError(NO_INBOX)
    return service.settings.nights


Runs = Annotated[NightRuns, Depends(_runs)]


def _logged(store: MapStore, kind: str, words: str, site: str, actor: Actor) -> None:
    store.audit(kind, words, actor=actor, site=site)
    _log.info(
        "site %s: %s: %s, by %s: %s", site, kind.replace("_", " "), words, actor.name, actor.reason or "no reason"
    )


@router.get("/v1/sites/{site}/inbox")
def inbox(runs: Runs, store: p.Store, site: p.Site) -> Inbox:
    """Recordings in the inbox of a site: those that wait, were held or are bad with the reason, and how many are in a version."""
    if site not in {*sites_of(runs.inbox), *store.sites_with_jobs(), *(info.site for info in store.sites())}:
        raise UsageError(f"no inbox of a site {site}; its first upload makes one")
    return contents(runs.inbox / site, SETTLE_S, time.time_ns())


@router.put("/v1/sites/{site}/inbox/{name}", status_code=201, openapi_extra=p.file_body(required=True))
async def upload_recording(
    request: Request, runs: Runs, service: p.Service, site: p.Site, name: p.RecordingName, who: By
) -> views.Uploaded:
    """Upload a recording as the request's body; it is there once all of it is. The first one of a site makes its inbox."""
    folder, uploads = runs.inbox / site, service.uploads
    if folder / name in uploads:
        raise StateError(f"{name} is being uploaded already; wait for its end")
    if len(uploads) >= _MOST_UPLOADS:
        raise HTTPException(429, f"{_MOST_UPLOADS} uploads go on; try again when one has ended", {"Retry-After": "30"})
    uploads.add(folder / name)
    try:
        stated = request.headers.get("content-length")
        part = await asyncio.to_thread(Upload, folder, name, None if stated is None else int(stated))
        try:
            data = bytearray()
            async for chunk in request.stream():
                data += chunk
                if len(data) >= _WRITTEN_BYTES:
                    await asyncio.to_thread(part.write, bytes(data))
                    data.clear()
            await asyncio.to_thread(part.write, bytes(data))
            await asyncio.to_thread(part.end)
        finally:
            await asyncio.to_thread(part.discard)
        words = f"{name}, {part.size_bytes} bytes"
        await asyncio.to_thread(_logged, service.store, "recording_uploaded", words, site, who)
        return views.Uploaded(name=name, size_bytes=part.size_bytes)
    finally:
        uploads.discard(folder / name)


@router.post("/v1/sites/{site}/inbox/{box}/{name}/retry")
def retry_recording(
    runs: Runs, store: p.Store, sender: Sender, site: p.Site, box: p.Box, name: p.RecordingName, act: views.Act
) -> Inbox:
    """Move a held or bad recording back into the inbox, for the next build."""
    who = sender.of(act)
    put_back(runs.inbox / site, box, name)
    _logged(store, "recording_tried_again", f"{name}, which was {box}", site, who)
    return inbox(runs, store, site)


@router.post("/v1/sites/{site}/build", status_code=202)
def build_now(runs: Runs, store: p.Store, sender: Sender, site: p.Site, act: views.Act) -> JobInfo:
    """Build, judge and publish what waits in the inbox of a site, as `mapserver nightly` does; the answer is its job, which goes on."""
    who = sender.of(act)
    if site not in sites_of(runs.inbox):
        raise StateError(f"nothing was ever uploaded for site {site}; upload a recording first")
    return runs.start(site, lambda: _logged(store, "build_started", "of what waits in the inbox", site, who))


@router.get("/v1/jobs")
def jobs(store: p.Store, within: p.TimeRange, page: p.NumberPage, site: p.SiteFilter = None) -> views.Page[JobInfo]:
    """Jobs (of a site) that began within a range of time, newest first."""
    found = store.jobs(site, within, before=page.cursor, limit=page.limit + 1)
    return page.of(found, lambda job: job.id)


@router.get("/v1/jobs/{job}")
def job(store: p.Store, job: p.Number) -> JobInfo:
    """One job."""
    return store.job(job)


@router.get("/v1/jobs/{job}/log", response_class=Response, responses={200: _TEXT})
def job_log(store: p.Store, job: p.Number) -> Response:
    """The last 64 KiB of a job's log, also while it runs."""
    store.job(job)  # raises for an unknown one
    try:
        with log_path(store.folder, job).open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - _LOG_BYTES))
            text = file.read(_LOG_BYTES).decode("utf-8", "replace")
    except FileNotFoundError:
        raise HTTPException(404, f"job {job} has no log: it ran in a terminal, or long ago") from None
    return Response(text, media_type="text/plain", headers={"Cache-Control": "no-store"})
