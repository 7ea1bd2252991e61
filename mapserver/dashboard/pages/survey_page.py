"""The survey page: jobs, the doctor's findings in their recordings, accepted and refused loops on the map."""

from collections import Counter
from datetime import UTC, datetime
from typing import Any

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, load, number, show, version_map
from mapserver.dashboard.map_layers import Item, Layer, Line, Mark
from mapserver.dashboard.markup import age, badge, facts, joined, link, table
from mapserver.dashboard.space.loops import builds_of, dicts, ends_of
from mapserver.store import JobInfo

_REFRESH_S = 3.0
_TELLING_S = 4.0  # of a stage, before what is left of it can be said
_LONG_H = 12.0  # a job that is killed cannot say so
_TONES = {"done": "good", "running": "warn", "failed": "bad"}
_VERDICTS = {"accepted": "good", "rejected": "bad", "ambiguous": "bad", "gated_out": "quiet"}
_LEFT_OUT = {"foreign": "another place", "undecided": "held"}
_REASONS_SHOWN = 40


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/surveys", title="Surveys – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def surveys_page(request: Request, site: str | None = None, job: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            span_ns = context.time_range()
            jobs = await load(services.maps.jobs, context.site, span_ns)
            html(Markup("<h1>Surveys of {}</h1>").format(context.site))
            html(context.range_form("surveys", usual="All jobs"))
            listed = html(_jobs(context, jobs))

            async def refresh() -> None:
                nonlocal jobs
                found = await load(services.maps.jobs, context.site, span_ns)
                if found != jobs:
                    jobs = found
                    listed.set_content(str(_jobs(context, found)))

            ui.timer(_REFRESH_S, refresh, immediate=False)
            wanted = number(job, "job")
            newest = next((j for j in jobs if j.report and j.state != "running"), None)
            chosen = newest if wanted is None else await load(services.maps.job, wanted)
            if chosen is not None:
                await _one_job(services, context, chosen)

        await show(services, request, "surveys", site, build, ("job", "since", "until"))


def _jobs(context: PageContext, jobs: list[JobInfo]) -> Markup:
    span = {name: context.query.get(name) for name in ("since", "until")}
    rows = [
        (
            link(context.to("surveys", **span | {"job": job.id}), f"Job {job.id}"),
            job.kind,
            badge(_TONES.get(job.state, "quiet"), _state(job)),
            context.written_moment(job.started),
            context.written_moment(job.finished),
            job.message or _progress(job),
        )
        for job in jobs
    ]
    head = ("Job", "Kind", "State", "Started", "Finished", "Result")
    empty = "No jobs yet: `mapserver build` and `mapserver nightly` record theirs here."
    if any(span.values()):
        empty = "No job began in this time."
    return Markup("<h2>Jobs, newest first</h2>{}").format(table(head, rows, empty=empty, name="Jobs"))


def _progress(job: JobInfo) -> Markup | None:
    """Stage of a running job, how far it is, and how long that stage takes still."""
    told = job.report.get("progress")
    if job.state != "running" or not isinstance(told, dict):
        return None
    stage: Any = told.get("stage")
    done, total, stage_s = (float(told.get(name) or 0) for name in ("done", "total", "stage_s"))
    if total < 2:
        return Markup("{}").format(stage)
    bar = Markup('<progress max="{}" value="{}" aria-label="{}"></progress>').format(total, done, stage)
    left = f", about {age(stage_s * (total - done) / done)} more" if done > 0 and stage_s >= _TELLING_S else ""
    return Markup("{} {}: {:.0f} of {:.0f}{}").format(bar, stage, done, total, left)


def _state(job: JobInfo) -> str:
    if job.state != "running":
        return job.state
    hours = (datetime.now(UTC) - datetime.fromisoformat(job.started)).total_seconds() / 3600
    return "running" if hours < _LONG_H else "running or killed"


async def _one_job(services: Services, context: PageContext, job: JobInfo) -> None:
    html(Markup("<h2>Job {}: {}</h2><p>{}</p>").format(job.id, job.kind, job.message or _state(job)))
    report = builds_of(job.report)[-1]
    html(Markup("{}{}").format(_doctor(report), _recordings(report)))
    await _loops(services, context, report)


def _doctor(report: dict[str, Any]) -> Markup:
    """The doctor's findings for each recording."""
    found = report.get("findings")
    if not isinstance(found, dict) or not found:
        body = Markup('<p class="quiet">The job\'s report has no findings of the doctor.</p>')
    else:
        body = joined(
            Markup("<h3>{}</h3>{}").format(
                name,
                Markup("<ul>{}</ul>").format(joined(map(_remark, remarks)))
                if remarks
                else Markup("<p>{}</p>").format(badge("good", "no findings")),
            )
            for name, remarks in found.items()
            if isinstance(remarks, list)
        )
    return Markup("<div><h2>Findings of the doctor</h2>{}</div>").format(body)


def _remark(words: str) -> Markup:
    """A finding; one that could not be judged is no fault, and no "ok" either."""
    name, unjudged, missing = words.partition(": not judged: ")
    if not unjudged:
        return Markup("<li>{}</li>").format(words)
    return Markup("<li>{} {}: {}</li>").format(badge("quiet", "not judged"), name, missing)


def _recordings(report: dict[str, Any]) -> Markup:
    """Result of each recording."""
    rows = [
        (
            session.get("recording"),
            badge("good", "in the map")
            if session.get("joined")
            else badge("bad", _LEFT_OUT.get(str(session.get("verdict")), "left out")),
            session.get("reason"),
            *_join_figures(session.get("evidence")),
        )
        for session in dicts(report.get("sessions"))
    ]
    listed = table(
        ("Recording", "Result", "Why", "Fixes that agree", "Seen of the map"),
        rows,
        empty="The report names no recordings.",
        name="Recordings",
    )
    loops = report.get("loops")
    counts = loops.items() if isinstance(loops, dict) else None
    counted = Markup("") if counts is None else facts([(name.replace("_", " "), count) for name, count in counts])
    return Markup("<div><h2>Recordings</h2>{}<h2>Loop counts</h2>{}</div>").format(listed, counted)


def _join_figures(evidence: Any) -> tuple[str, str]:
    """Fixes and places, and the seen share with its bounds; dashes for the recording that began a map and for old reports."""
    if not isinstance(evidence, dict) or not evidence.get("fixes"):
        return "-", "-"
    fixes = f"{evidence['fixes']} at {evidence['places']} places"
    if not evidence.get("cells_expected"):
        return fixes, "-"
    low, share, high = (round(100 * evidence[name]) for name in ("share_low", "seen_share", "share_high"))
    return fixes, f"{share} % of {evidence['cells_expected']} parts ({low} to {high} %)"


async def _loops(services: Services, context: PageContext, report: dict[str, Any]) -> None:
    found = [place for place in dicts(report.get("loop_places")) if ends_of(place) is not None]
    if not found:
        html(Markup('<h2>Loops on the map</h2><p class="quiet">The report contains no loops.</p>'))
        return
    known = {info.version for info in (await load(services.maps.history, context.site)).versions}
    version = report.get("version")
    if version not in known:
        version = await load(services.maps.current_version, context.site)
    if version is None:
        html(Markup('<p class="notice">The version of this job was removed, and no version is current.</p>'))
        return
    lines: list[Item] = []
    for place in sorted(found, key=lambda p: p.get("verdict") == "accepted"):
        ends, tone = ends_of(place), _VERDICTS.get(str(place.get("verdict")), "quiet")
        assert ends is not None
        words = f"{str(place.get('verdict')).replace('_', ' ')}: {place.get('reason') or 'consistent'}"
        lines.append(Line(list(ends), tone, words))
        if tone == "good":
            lines += [Mark(*end, tone, "circle", words) for end in ends]
    html(Markup("<h2>Loops on the map of version {}</h2>").format(version))
    await version_map(services, context, version, [Layer("Loops", lines)])
    accepted = sum(place.get("verdict") == "accepted" for place in found)
    html(
        Markup(
            "<p>Green lines with dots: accepted loops ({}). Dashed red and thin lines: the most similar refused ones ({}).</p>{}"
        ).format(accepted, len(found) - accepted, _refusals(found))
    )


def _refusals(found: list[dict[str, Any]]) -> Markup:
    refused = [place for place in found if place.get("verdict") != "accepted"]
    if not refused:
        return Markup('<p class="quiet">No loops were refused.</p>')
    reasons = Counter(str(place.get("reason") or place.get("verdict")).replace("_", " ") for place in refused)
    rows = []
    for place in refused[:_REASONS_SHOWN]:
        ends = ends_of(place)
        assert ends is not None
        (x, y), (to_x, to_y) = ends
        verdict, score = str(place.get("verdict")), place.get("score")
        shown = badge(_VERDICTS.get(verdict, "quiet"), verdict.replace("_", " "))
        similarity = f"{score:.3f}" if isinstance(score, int | float) else None
        positions = f"{x:.1f}, {y:.1f} m", f"{to_x:.1f}, {to_y:.1f} m"
        rows.append((place.get("recording"), shown, place.get("reason"), similarity, *positions))
    head = ("Recording", "Verdict", "Why", "Similarity", "From", "To")
    why = "; ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
    listed = table(head, rows, empty="", name="Refused loops")
    return Markup("<details><summary>Why {} candidates were refused: {}</summary>{}</details>").format(
        len(refused), why, listed
    )
