"""The page of surveys: what was built, what failed? Inbox, jobs with progress and log, what became of every recording, loops on the map."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import PurePath
from typing import Any, NamedTuple

import msgspec

from fleetmap.recordings import file_suffixes
from mapserver.api.inbox_routes import NO_INBOX
from mapserver.api.incidents import of_inbox
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.data import JOBS_SHOWN
from mapserver.dashboard.map_layers import Item, Layer, Line, Mark
from mapserver.fleet.alerts import with_acts
from mapserver.nightly.inbox import contents
from mapserver.serving.night_runs import SETTLE_S
from mapserver.store import JobInfo

_TELLING_S = 4.0  # of a stage, before what is left of it can be said
_LEFT_OUT = {"foreign": "another place", "undecided": "held", "bad": "refused"}
_WAITS = "waits"
MOST_LOOPS = 3000
VERDICTS = {
    "accepted": ("good", "accepted"),
    "ambiguous": ("warn", "refused as several places fit"),
    "rejected": ("bad", "refused by what is seen"),
    "gated_out": ("quiet", "refused by position"),
}
"""Tone and words of what becomes of a revisit."""


class Loop(msgspec.Struct, frozen=True):
    """A revisit of a recording between two places, x and y in `map`, what became of it and why, and how alike they look."""

    start_map_m: tuple[float, float] = msgspec.field(name="from_map_m")
    end_map_m: tuple[float, float] = msgspec.field(name="to_map_m")
    verdict: str
    reason: str = ""
    recording: str = ""
    score: float | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether the map is held together by it."""
        return self.verdict == "accepted"


def builds_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The builds in a job's report: those of a night, else the report itself."""
    return dicts(report.get("builds")) or [report]


def loops_of_version(reports: Iterable[dict[str, Any]], version: int) -> list[Loop]:
    """Loops of the build that made a version, by the first of these reports of jobs that tells them; none where none does."""
    builds = (build for report in reports for build in builds_of(report) if build.get("version") == version)
    return loops_of(next(builds, {}))


def loops_of(build: dict[str, Any]) -> list[Loop]:
    """Loops of a build, accepted ones first, without those that have no two numbers for each end."""
    found = []
    for place in dicts(build.get("loop_places")):
        with suppress(msgspec.ValidationError):
            found.append(msgspec.convert(place, Loop))
    return sorted(found, key=lambda loop: not loop.is_accepted)[:MOST_LOOPS]


def dicts(value: object) -> list[dict[str, Any]]:
    """The objects of a list; none of what is no list."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


class _Recording(NamedTuple):
    """A recording of a job. checks: the doctor in one line; found: what was wanting; unjudged: by what they lack, checks not judged."""

    name: str
    tone: str
    result: str
    reason: str | None
    checks: str | None = None
    figures: str = ""
    found: Sequence[str] = ()
    unjudged: Mapping[str, Sequence[str]] = {}


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    wanted = number(context.query.get("job"), "job")
    chosen = None if wanted is None else services.maps.store.job(wanted)
    if chosen is not None:
        context = context._replace(site=chosen.site)  # whatever site the address names, or none
    jobs = services.maps.store.jobs(context.site, context.time_range(), limit=JOBS_SHOWN)
    if chosen is None:  # the last in which a recording was built or refused: a night in which all of them wait was none
        ended = (job for job in jobs if job.state != "running")
        chosen = next((job for job in ended if any(row.result != _WAITS for row in _recordings(job))), None)
    folder, now_ns = services.maps.inbox, services.maps.store.now_ns()
    inbox = None if folder is None else contents(folder / context.site, SETTLE_S, now_ns)
    held = () if inbox is None else with_acts(services.maps.store, of_inbox(inbox))
    shown: dict[str, object] = {
        "context": context,
        "site": context.site,
        "jobs": [(job, _progress(job)) for job in jobs],
        "chosen": chosen,
        "inbox": inbox,
        "held": {one.about: one for one in held},
        "no_inbox": NO_INBOX,
        "suffixes": file_suffixes(),
    }
    if chosen is None:
        return shown
    return shown | _loops(services, context, builds_of(chosen.report)[-1]) | {"recordings": _recordings(chosen)}


def _progress(job: JobInfo) -> dict[str, object] | None:
    """The stage of a running job, how far it is, and how many seconds that stage takes still; before the first stage, what it reads."""
    if job.state != "running":
        return None
    told, reads = job.report.get("progress") or {}, job.report.get("looking_at") or ()
    done, total, stage_s = (float(told.get(name) or 0) for name in ("done", "total", "stage_s"))
    left_s = stage_s * (total - done) / done if done > 0 and stage_s >= _TELLING_S else None
    stage = told.get("stage") or (f"reading {reads[0]}" if reads else "starting")
    return {"stage": stage, "done": done, "total": total, "left_s": left_s}


def _recordings(job: JobInfo) -> list[_Recording]:
    """What became of every recording, those that are left out first; a later build of a night has the last word."""
    rows: dict[str, _Recording] = {}
    for build in builds_of(job.report):
        for session in dicts(build.get("sessions")):
            name, left = str(session.get("recording")), _LEFT_OUT.get(str(session.get("verdict")), "left out")
            tone, result = ("good", "in the map") if session.get("joined") else ("bad", left)
            found, checks = ((build.get(key) or {}).get(name) for key in ("findings", "checks"))
            said = checks, _figures(session.get("evidence")), *_remarks(found or ())
            rows[name] = _Recording(name, tone, result, session.get("reason"), *said)
    waiting = [entry | {"fate": _WAITS} for entry in dicts(job.report.get("waiting"))]
    for entry in [*dicts(job.report.get("recordings")), *waiting]:
        name, fate = str(entry.get("name")), str(entry.get("fate"))
        if fate != "done":
            tone = "quiet" if fate == _WAITS else "bad"
            rows.setdefault(PurePath(name).stem, _Recording(name, tone, _LEFT_OUT.get(fate, fate), entry.get("reason")))
    return sorted(rows.values(), key=lambda row: row.tone != "bad")


def _remarks(words: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Remarks of the doctor, and by what they lack the checks that could not be judged."""
    found: list[str] = []
    unjudged: dict[str, list[str]] = {}
    for remark in words:
        name, is_unjudged, missing = remark.partition(": not judged: ")
        (unjudged.setdefault(missing, []) if is_unjudged else found).append(name)
    return found, unjudged


def _figures(evidence: Any) -> str:
    """By what it was joined; empty for the recording that began a map and for old reports."""
    if not isinstance(evidence, dict) or not evidence.get("fixes"):
        return ""
    words = f"{evidence['fixes']} fixes agree, at {evidence['places']} places"
    if not evidence.get("cells_expected"):
        return words
    low, share, high = (round(100 * evidence[name]) for name in ("share_low", "seen_share", "share_high"))
    return f"{words}; it sees {share} % ({low} to {high} %) of {evidence['cells_expected']} parts of the map"


def _loops(services: Services, context: PageContext, build: dict[str, Any]) -> dict[str, object]:
    """Loops of a build on the map that it made, on the current one where that was removed."""
    found: list[Loop] = loops_of(build)
    version: Any = build.get("version")
    if found and not services.maps.has_version(context.site, version):
        version = services.maps.current_version(context.site)
    items: dict[bool, list[Item]] = {False: [], True: []}
    for loop in found:
        tone, words = _told(loop)
        ends = [loop.start_map_m, loop.end_map_m]
        marks = [Mark(*end, tone, "circle", words) for end in ends if loop.is_accepted]
        items[loop.is_accepted] += [Line(ends, tone, words), *marks]
    layers = [Layer("Refused loops", items[False], shown=False), Layer("Accepted loops", items[True])]
    refused = [(loop, *_told(loop)) for loop in found if not loop.is_accepted]
    reasons = (
        re.sub(r"\d+(\.\d+)?", "…", loop.reason or words) for loop, _, words in refused
    )  # the same but for figures
    return {
        "scene": scene_of(services, context, version, layers) if found else None,
        "version": version,
        "counts": build.get("loops"),
        "loops": found,
        "refused": refused,
        "reasons": Counter(reasons).most_common(),
    }


def _told(loop: Loop) -> tuple[str, str]:
    """Tone and words of what became of a loop."""
    tone, words = VERDICTS.get(loop.verdict, ("quiet", loop.verdict))
    return tone, f"{words}: {loop.reason}" if loop.reason else words
