"""The failure pages: all failures by robot, version, tile and cause; and one with everything that the robot told about it."""

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import FleetmapError
from fleetmap.messages import FailureKind, FailureReport
from mapserver.dashboard import drawing
from mapserver.dashboard.drawing import Mark
from mapserver.dashboard.fleet_health import FAILURES_SHOWN, Choices
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, Rooms, Where, back_link, html, load, notice, number, show
from mapserver.dashboard.live import STATUSES
from mapserver.dashboard.map_page import picture_address
from mapserver.dashboard.markup import badge, choices, facts, joined, link, moment, table
from mapserver.dashboard.plan import Plan
from mapserver.store import FailureDetail, FailureFilter, FailureRow

_LOOK_AGAIN_S = 3.0
_PICTURES = {
    "frame": "What the left camera saw",
    "matches": "Matches: the picture, and the landmarks that the map expects in it",
}


def install(rooms: Rooms) -> None:
    """Adds the pages."""

    @ui.page("/failures", title="Failures – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failures_page(
        request: Request, site: str | None = None, robot: str | None = None, version: str | None = None,
        tile: str | None = None, cause: str | None = None, before: str | None = None,
    ) -> None:  # fmt: skip
        async def build(where: Where) -> None:
            wanted = FailureFilter(
                site=where.site,
                robot=robot or None,
                version=number(version, "version"),
                tile=tile or None,
                cause=cause or None,
            )
            html(Markup("<h1>Failures of {}</h1>").format(where.site))
            html(_filters(where, wanted, await load(rooms.health.choices, where.site)))
            await _list(rooms, where, wanted, number(before, "failure"))

        await show(rooms, request, "failures", site, build)

    @ui.page("/failures/{failure}", title="Failure – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failure_page(request: Request, failure: str, site: str | None = None) -> None:
        found = await load(_site_of, rooms, failure, site)

        async def build(where: Where) -> None:
            detail = await load(rooms.health.failure, number(failure, "failure") or 0)
            html(back_link(where, "failures", "All failures"))
            html(Markup("<h1>Failure {} of {}</h1>").format(detail.failure.number, detail.failure.robot))
            html(
                Markup('<div class="pair">{}{}</div>').format(
                    _context(where, detail), await _place(rooms, where, detail)
                )
            )
            html(_pictures(where, detail))
            html(_fixes(detail.report))

        await show(rooms, request, "failures", found, build)


def _site_of(rooms: Rooms, failure: str, site: str | None) -> str | None:
    """The site of a failure, so that the frame shows it; the named one where there is no such failure."""
    try:
        return rooms.health.failure(number(failure, "failure") or 0).failure.site
    except FleetmapError:
        return site


def _filters(where: Where, wanted: FailureFilter, known: Choices) -> Markup:
    return Markup(
        '<form class="ask" method="get" action="{}"><input type="hidden" name="site" value="{}">{}{}{}{}'
        '<button type="submit">Show</button> <a href="{}">Show all</a></form>'
    ).format(
        f"{where.root}/failures",
        where.site,
        choices("robot", "Robot", known.robots, wanted.robot),
        choices("version", "Map version", known.versions, None if wanted.version is None else str(wanted.version)),
        choices("tile", "Tile", known.tiles, wanted.tile),
        choices("cause", "Cause", known.causes, wanted.cause),
        where.to("failures"),
    )


async def _list(rooms: Rooms, where: Where, wanted: FailureFilter, before: int | None) -> None:
    """The map and the table; the newest page is put anew when failures arrive."""
    shown = await load(rooms.health.failures, wanted, before)
    version = wanted.version or await load(rooms.maps.current_version, where.site)
    over = None if version is None else await _map(rooms, where, version, shown)
    listed = html(_rows(where, wanted, shown))

    async def look() -> None:
        nonlocal shown
        found = await load(rooms.health.failures, wanted, None)
        if found != shown:
            shown = found
            listed.set_content(str(_rows(where, wanted, found)))
            if over is not None:
                over[1].set_content(str(drawing.svg(over[0], "Failures on the map", [_marks(where, over[0], found)])))

    if before is None:
        ui.timer(_LOOK_AGAIN_S, look, immediate=False)


async def _map(rooms: Rooms, where: Where, version: int, shown: list[FailureRow]) -> tuple[Plan, ui.html]:
    plan = await load(rooms.maps.plan, where.site, version)
    ground = drawing.svg(
        plan, f"Map of {where.site}, version {version}",
        [drawing.ground(plan, picture_address(where, version)), drawing.scale_bar(plan)],
    )  # fmt: skip
    with ui.element("div"), ui.element("div").classes("planbox"):
        html(ground)
        layer = html(drawing.svg(plan, "Failures on the map", [_marks(where, plan, shown)]), classes="over")
    return plan, layer


def _marks(where: Where, plan: Plan, shown: list[FailureRow]) -> Markup:
    return drawing.marks(
        plan,
        [
            Mark(
                row.x_map_m, row.y_map_m, _tone(row), "cross", f"failure {row.number}: {row.robot}, {row.cause}",
                where.to(f"failures/{row.number}"),
            )
            for row in reversed(shown)
            if row.x_map_m is not None and row.y_map_m is not None
        ],
    )  # fmt: skip


def _tone(row: FailureRow) -> str:
    return "warn" if row.kind == FailureKind.SUSPECTED else "bad"


def _kind(row: FailureRow) -> Markup:
    return badge(_tone(row), "suspected" if row.kind == FailureKind.SUSPECTED else row.kind)


def _rows(where: Where, wanted: FailureFilter, found: list[FailureRow]) -> Markup:
    shown = found[:FAILURES_SHOWN]
    rows = [
        (
            link(where.to(f"failures/{row.number}"), f"Failure {row.number}"),
            moment(row.happened_ns),
            row.robot,
            row.cause.replace("_", " "),
            _kind(row),
            row.version,
            row.tile,
            f"{row.duration_s:.0f} s",
        )
        for row in shown
    ]
    head = ("Failure", "When", "Robot", "Cause", "Kind", "Map version", "Tile", "Lasted")
    listed = table(head, rows, empty="No failure, as far as these choices go.", name="Failures")
    if len(found) <= FAILURES_SHOWN:
        return listed
    older = where.to(
        "failures",
        robot=wanted.robot,
        version=wanted.version,
        tile=wanted.tile,
        cause=wanted.cause,
        before=shown[-1].number,
    )
    return Markup("{}<p>{}</p>").format(listed, link(older, "Older failures"))


def _context(where: Where, detail: FailureDetail) -> Markup:
    row, report = detail.failure, detail.report

    def figure(value: float | None, unit: str = "") -> str | None:
        return None if value is None else f"{value:.3g}{unit}"

    suspected = row.kind == FailureKind.SUSPECTED
    return Markup("<div><h2>What happened</h2>{}{}</div>").format(
        notice(
            "warn",
            "The robot suspects this failure: its fixes contradict its position. It is an estimate, not a count.",
        )
        if suspected
        else "",
        facts(
            [
                ("Began", moment(row.happened_ns)),
                ("Lasted, when written down", f"{row.duration_s:.1f} s"),
                ("Cause", row.cause.replace("_", " ")),
                ("State of the robot", STATUSES.get(row.status, (row.status,))[0]),
                ("Robot", link(where.to("failures", robot=row.robot), row.robot)),
                (
                    "Map version",
                    None if row.version is None else link(where.to("failures", version=row.version), str(row.version)),
                ),
                ("Tile", None if row.tile is None else link(where.to("failures", tile=row.tile), row.tile)),
                ("Position known within (95 %)", figure(report.radius_95_m, " m")),
                ("Last fix against prediction (squared distance)", figure(report.innovation)),
                ("Matches in the last fix", report.inliers),
                ("Brightness of the picture (0 to 1)", figure(report.exposure)),
                ("Sharpness (1 is usual)", figure(report.sharpness)),
                ("Arrived here", moment(row.received_ns)),
            ]
        ),
    )


async def _place(rooms: Rooms, where: Where, detail: FailureDetail) -> Markup:
    """Where it was, and the fixes before it."""
    row = detail.failure
    version = row.version or await load(rooms.maps.current_version, where.site)
    known = {info.version for info in (await load(rooms.maps.history, where.site)).versions}
    if version is None or version not in known:
        return notice("warn", "The map version is not in the store any more, so that the place cannot be shown.")
    plan = await load(rooms.maps.plan, where.site, version)
    found = [
        Mark(fix.position_map_m[0], fix.position_map_m[1], "accent", "circle", f"fix, {fix.refused or 'used'}")
        for fix in detail.report.fixes
        if fix.position_map_m is not None
    ]
    if row.x_map_m is not None and row.y_map_m is not None:
        found.append(Mark(row.x_map_m, row.y_map_m, _tone(row), "cross", "last estimate"))
    picture = drawing.svg(
        plan, f"Where failure {row.number} was",
        [
            drawing.ground(plan, picture_address(where, version)), drawing.marks(plan, found),
            drawing.scale_bar(plan),
        ],
    )  # fmt: skip
    return Markup(
        '<div><h2>Where</h2><div class="planbox">{}</div><p class="quiet">Cross: the last estimate. Dots: fixes before it. Map '
        "version {}.</p></div>"
    ).format(picture, version)


def _pictures(where: Where, detail: FailureDetail) -> Markup:
    if not detail.pictures:
        return Markup(
            '<h2>Pictures</h2><p class="quiet">None: the robot sent none, or they went because pictures need too much space.</p>'
        )
    shown = joined(
        Markup(
            '<figure><img src="{}" alt="{}" loading="lazy"><figcaption>{}, {:.1f} s {} the beginning</figcaption></figure>'
        ).format(
            f"{where.root}/pictures/{detail.failure.number}/{picture.place}.jpg",
            _PICTURES.get(picture.kind, picture.kind),
            _PICTURES.get(picture.kind, picture.kind),
            abs(picture.stamp_ns - detail.report.stamp_ns) * 1e-9,
            "after" if picture.stamp_ns >= detail.report.stamp_ns else "before",
        )
        for picture in detail.pictures
    )
    return Markup('<h2>Pictures</h2><div class="pictures">{}</div>').format(shown)


def _fixes(report: FailureReport) -> Markup:
    rows = [
        (
            f"{(fix.stamp_ns - report.stamp_ns) * 1e-9:+.1f} s",
            STATUSES.get(fix.status, (fix.status,))[0],
            fix.inliers,
            None if fix.innovation is None else f"{fix.innovation:.3g}",
            None if fix.position_map_m is None else f"{fix.position_map_m[0]:.2f}, {fix.position_map_m[1]:.2f} m",
            fix.refused or "used" if fix.position_map_m is not None else fix.refused,
        )
        for fix in report.fixes
    ]
    head = ("When", "State", "Matches", "Against prediction", "Place (x, y)", "What became of it")
    empty = "The robot told of no looks at the map before."
    return Markup("<h2>Looks at the map before it</h2>{}").format(
        table(head, rows, empty=empty, name="Looks before it")
    )
