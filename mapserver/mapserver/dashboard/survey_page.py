"""The survey page: jobs, what the doctor found in their recordings, loops accepted and refused on the map."""

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from mapserver.dashboard import drawing
from mapserver.dashboard.drawing import Line, Mark
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, Rooms, Where, html, load, number, show
from mapserver.dashboard.map_page import picture_address
from mapserver.dashboard.markup import badge, facts, joined, link, table
from mapserver.store import JobInfo

_LOOK_AGAIN_S = 3.0
_LONG_H = 12.0  # a job that is killed cannot say so
_TONES = {"done": "good", "running": "warn", "failed": "bad"}
_VERDICTS = {"accepted": "good", "rejected": "bad", "ambiguous": "bad", "gated_out": "quiet"}
_REASONS_SHOWN = 40


def install(rooms: Rooms) -> None:
    """Adds the page."""

    @ui.page("/surveys", title="Surveys – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def surveys_page(request: Request, site: str | None = None, job: str | None = None) -> None:
        async def build(where: Where) -> None:
            jobs = await load(rooms.maps.jobs, where.site)
            html(Markup("<h1>Surveys of {}</h1>").format(where.site))
            listed = html(_jobs(where, jobs))

            async def look() -> None:
                nonlocal jobs
                found = await load(rooms.maps.jobs, where.site)
                if found != jobs:
                    jobs = found
                    listed.set_content(str(_jobs(where, found)))

            ui.timer(_LOOK_AGAIN_S, look, immediate=False)
            wanted = number(job, "job")
            chosen = (
                await load(rooms.maps.job, wanted) if wanted is not None else next((j for j in jobs if j.report), None)
            )
            if chosen is not None:
                await _one_job(rooms, where, chosen)

        await show(rooms, request, "surveys", site, build)


def _jobs(where: Where, jobs: list[JobInfo]) -> Markup:
    rows = [
        (
            link(where.to("surveys", job=job.id), f"Job {job.id}"),
            job.kind,
            badge(_TONES.get(job.state, "quiet"), _state(job)),
            _time(job.started),
            _time(job.finished),
            job.message,
        )
        for job in jobs
    ]
    head = ("Job", "Kind", "State", "Started", "Finished", "What came of it")
    empty = "No job yet: `mapserver build` and the nightly job are noted here."
    return Markup("<h2>Jobs, the newest first</h2>{}").format(table(head, rows, empty=empty, name="Jobs"))


def _state(job: JobInfo) -> str:
    if job.state != "running":
        return job.state
    hours = (datetime.now(UTC) - datetime.fromisoformat(job.started)).total_seconds() / 3600
    return "running" if hours < _LONG_H else "running, or was killed"


def _time(text: str | None) -> str | None:
    return None if text is None else text.replace("T", " ").replace("Z", " UTC")


async def _one_job(rooms: Rooms, where: Where, job: JobInfo) -> None:
    html(Markup("<h2>Job {}: {}</h2><p>{}</p>").format(job.id, job.kind, job.message or _state(job)))
    report = _build_of(job.report)
    html(Markup('<div class="pair">{}{}</div>').format(_doctor(report), _recordings(report)))
    await _loops(rooms, where, report)


def _build_of(report: dict[str, Any]) -> dict[str, Any]:
    """The build that a job's report tells of: a night's last one, else the report itself."""
    builds = list(_dicts(report.get("builds")))
    return builds[-1] if builds else report


def _doctor(report: dict[str, Any]) -> Markup:
    """What was found wanting in each recording."""
    found = report.get("findings")
    if not isinstance(found, dict) or not found:
        body = Markup('<p class="quiet">The doctor said nothing about this job\'s recordings.</p>')
    else:
        body = joined(
            Markup("<h3>{}</h3>{}").format(
                name,
                Markup("<ul>{}</ul>").format(joined(Markup("<li>{}</li>").format(words) for words in remarks))
                if remarks
                else Markup("<p>{}</p>").format(badge("good", "nothing wrong")),
            )
            for name, remarks in found.items()
            if isinstance(remarks, list)
        )
    return Markup("<div><h2>What the doctor found</h2>{}</div>").format(body)


def _recordings(report: dict[str, Any]) -> Markup:
    """What became of each recording."""
    rows = [
        (
            session.get("recording"),
            badge("good", "in the map") if session.get("joined") else badge("bad", "left out"),
            session.get("reason"),
        )
        for session in _dicts(report.get("sessions"))
    ]
    listed = table(("Recording", "Result", "Why"), rows, empty="Nothing is noted of recordings.", name="Recordings")
    loops = report.get("loops")
    counted = (
        facts([(name.replace("_", " "), count) for name, count in loops.items()])
        if isinstance(loops, dict)
        else Markup("")
    )
    return Markup("<div><h2>Recordings</h2>{}<h2>Loops, counted</h2>{}</div>").format(listed, counted)


async def _loops(rooms: Rooms, where: Where, report: dict[str, Any]) -> None:
    found = [place for place in _dicts(report.get("loop_places")) if _ends(place) is not None]
    if not found:
        html(Markup('<h2>Loops on the map</h2><p class="quiet">This job noted no loops.</p>'))
        return
    known = {info.version for info in (await load(rooms.maps.history, where.site)).versions}
    version = (
        report.get("version") if report.get("version") in known else await load(rooms.maps.current_version, where.site)
    )
    if version is None:
        html(Markup('<p class="notice">The version that this job made is gone, and none is current.</p>'))
        return
    plan = await load(rooms.maps.plan, where.site, version)
    lines, marks = [], []
    for place in sorted(found, key=lambda p: p.get("verdict") == "accepted"):
        ends, tone = _ends(place), _VERDICTS.get(str(place.get("verdict")), "quiet")
        assert ends is not None
        words = f"{str(place.get('verdict')).replace('_', ' ')}: {place.get('reason') or 'agrees with everything else'}"
        lines.append(Line(*ends, tone, words))
        marks += [Mark(*end, tone, "circle", words) for end in ends if tone == "good"]
    picture = drawing.svg(
        plan, "Loops on the map",
        [drawing.ground(plan, picture_address(where, version)), drawing.lines(lines), drawing.marks(plan, marks), drawing.scale_bar(plan)],
    )  # fmt: skip
    accepted = sum(place.get("verdict") == "accepted" for place in found)
    html(
        Markup(
            '<h2>Loops on the map of version {}</h2><div class="planbox">{}</div><p>Green lines with dots: accepted loops ({}). Dashed red '
            "and thin lines: refused ones, those that looked most alike ({}).</p>{}"
        ).format(version, picture, accepted, len(found) - accepted, _refusals(found))
    )


def _refusals(found: list[dict[str, Any]]) -> Markup:
    refused = [place for place in found if place.get("verdict") != "accepted"][:_REASONS_SHOWN]
    rows = []
    for place in refused:
        ends = _ends(place)
        assert ends is not None
        (x, y), (to_x, to_y) = ends
        verdict = str(place.get("verdict"))
        score = place.get("score")
        rows.append(
            (
                place.get("recording"), badge(_VERDICTS.get(verdict, "quiet"), verdict.replace("_", " ")), place.get("reason"),
                f"{score:.3f}" if isinstance(score, int | float) else None, f"{x:.1f}, {y:.1f} m", f"{to_x:.1f}, {to_y:.1f} m",
            )
        )  # fmt: skip
    head = ("Recording", "Verdict", "Why", "Likeness", "From", "To")
    return table(head, rows, empty="None was refused.", name="Refused loops")


def _ends(place: dict[str, Any]) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Both ends of a loop, None where the report does not tell them as two numbers each."""
    ends = [place.get("from_map_m"), place.get("to_map_m")]
    if not all(
        isinstance(end, list) and len(end) == 2 and all(isinstance(v, int | float) for v in end) for end in ends
    ):
        return None
    (x, y), (to_x, to_y) = ends  # type: ignore[misc]
    return (float(x), float(y)), (float(to_x), float(to_y))


def _dicts(value: object) -> Iterable[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []
