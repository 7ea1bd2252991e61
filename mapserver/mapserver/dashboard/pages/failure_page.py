"""The failure pages: the list by robot, version, tile and cause, and one failure with its whole report."""

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import FleetmapError
from fleetmap.messages import Cause, FailureKind, FailureReport
from mapserver.dashboard.fleet_health import FAILURES_SHOWN, FilterChoices
from mapserver.dashboard.layout import (
    RESPONSE_TIMEOUT_S,
    PageContext,
    Services,
    back_link,
    html,
    load,
    notice,
    number,
    show,
    version_map,
)
from mapserver.dashboard.live import STATUSES
from mapserver.dashboard.map_layers import Layer, Mark, box_of, heat
from mapserver.dashboard.markup import badge, choices, facts, joined, link, table
from mapserver.store import FailureDetail, FailureFilter, FailureRow

_REFRESH_S = 3.0
_KNOWN = ("robot", "version", "area", "tile", "cause", "since", "until", "before")
_PICTURES = {"frame": "Left camera image", "matches": "Matches: the image and the landmarks expected in it"}
_KINDS = {FailureKind.NOT_FOUND: "does not find itself"}
_ADVICE = {
    Cause.CARRIED: "The robot was carried: what it sees ended between two images, and its fixes agree on another place.",
    Cause.ALIASED: "Several places of the map look like what the robot sees. Something that differs, a dock or a coarse position tells "
    "them apart.",
    Cause.MAP_CHANGED: "Images and odometry are sound, but far fewer landmarks are there than the map holds: survey this place again.",
    Cause.CALIBRATION: "The cameras do not agree with the map any more: check their mounting, then calibrate the robot.",
    Cause.DARK: "The images are dark: check the light and the lenses.",
    Cause.NO_MATCH: "Nothing in the map agrees: not mapped, or mapped in the other direction only.",
}


def install(services: Services) -> None:
    """Adds the pages."""

    @ui.page("/failures", title="Failures – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failures_page(request: Request, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            query = request.query_params
            since_ns, until_ns = context.time_range()
            wanted = FailureFilter(
                site=context.site,
                robot=query.get("robot") or None,
                version=number(query.get("version"), "version"),
                tile=query.get("tile") or None,
                cause=query.get("cause") or None,
                area=query.get("area") or None,
                since_ns=since_ns,
                until_ns=until_ns,
            )
            html(Markup("<h1>Failures of {}</h1>").format(context.site))
            html(_filters(context, wanted, await load(services.health.choices, context.site)))
            await _list(services, context, wanted, number(query.get("before"), "failure"))

        await show(services, request, "failures", site, build, _KNOWN)

    @ui.page("/failures/{failure}", title="Failure – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failure_page(request: Request, failure: str, site: str | None = None) -> None:
        found = await load(_site_of, services, failure, site)

        async def build(context: PageContext) -> None:
            detail = await load(services.health.failure, number(failure, "failure") or 0)
            html(back_link(context, "failures", "All failures"))
            html(Markup("<h1>Failure {} of {}</h1>").format(detail.failure.number, detail.failure.robot))
            html(_answer(context, detail))
            with ui.element("div").classes("pair"):
                html(_summary(context, detail))
                with ui.element("div"):
                    await _position(services, context, detail)
            html(_pictures(context, detail))
            html(_fixes(detail.report))

        await show(services, request, "failures", found, build)


def _site_of(services: Services, failure: str, site: str | None) -> str | None:
    """The site of a failure, for the navigation; the named one if there is no such failure."""
    try:
        return services.health.failure(number(failure, "failure") or 0).failure.site
    except FleetmapError:
        return site


def _filters(context: PageContext, wanted: FailureFilter, known: FilterChoices) -> Markup:
    return Markup(
        '<form class="ask" method="get" action="{}"><input type="hidden" name="site" value="{}">{}{}{}{}{}{}'
        '<button type="submit">Show</button> <a href="{}">Show all</a></form>'
    ).format(
        f"{context.root}/failures",
        context.site,
        choices("robot", "Robot", known.robots, wanted.robot),
        choices("version", "Map version", known.versions, None if wanted.version is None else str(wanted.version)),
        choices("area", "Area", known.areas, wanted.area) if known.areas or wanted.area else "",
        choices("tile", "Tile", known.tiles, wanted.tile),
        choices("cause", "Cause", known.causes, wanted.cause),
        context.range_fields(),
        context.to("failures"),
    )


async def _list(services: Services, context: PageContext, wanted: FailureFilter, before: int | None) -> None:
    """The map and the table; the newest page is refreshed when failures arrive."""
    shown = await load(services.health.failures, wanted, before)
    version = wanted.version or await load(services.maps.current_version, context.site)
    shown_map = None
    if version is not None:
        box = box_of(await load(services.maps.plan, context.site, version))
        layers = [
            Layer("Density", heat(_places(shown), box), shown=False),
            Layer("Failures", failure_marks(context, shown)),
        ]
        shown_map = await version_map(services, context, version, layers)
    listed = html(_rows(context, shown))

    async def refresh() -> None:
        nonlocal shown
        found = await load(services.health.failures, wanted, None)
        if found != shown:
            shown = found
            listed.set_content(str(_rows(context, found)))
            if shown_map is not None:
                shown_map.show("Failures", failure_marks(context, found))
                shown_map.show("Density", heat(_places(found), box))

    if before is None:
        ui.timer(_REFRESH_S, refresh, immediate=False)


def _places(shown: list[FailureRow]) -> list[tuple[float, float]]:
    return [(row.x_map_m, row.y_map_m) for row in shown if row.x_map_m is not None and row.y_map_m is not None]


def failure_marks(context: PageContext, shown: list[FailureRow]) -> list[Mark]:
    """Crosses at the failures that have a position."""
    found = []
    for row in reversed(shown):
        if row.x_map_m is not None and row.y_map_m is not None:
            words, to_failure = f"failure {row.number}: {row.robot}, {row.cause}", context.to(f"failures/{row.number}")
            found.append(Mark(row.x_map_m, row.y_map_m, _tone(row), "cross", words, to_failure))
    return found


def _tone(row: FailureRow) -> str:
    return "warn" if row.kind == FailureKind.SUSPECTED else "bad"


def _kind(row: FailureRow) -> Markup:
    return badge(_tone(row), _KINDS.get(FailureKind(row.kind), row.kind) if row.kind in set(FailureKind) else row.kind)


def _rows(context: PageContext, found: list[FailureRow]) -> Markup:
    shown = found[:FAILURES_SHOWN]
    listed = failure_table(context, shown, "No failures match these filters.")
    if len(found) <= FAILURES_SHOWN:
        return listed
    filters = {name: context.query.get(name) for name in _KNOWN}
    older = context.to("failures", **(filters | {"before": shown[-1].number}))
    return Markup("{}<p>{}</p>").format(listed, link(older, "Older failures"))


def failure_table(context: PageContext, shown: list[FailureRow], empty: str) -> Markup:
    """Failures as a table; empty: the sentence where there are none."""
    rows = [
        (
            link(context.to(f"failures/{row.number}"), f"Failure {row.number}"),
            context.moment(row.happened_ns),
            link(context.to(f"robots/{row.robot}"), row.robot),
            row.cause.replace("_", " "),
            _kind(row),
            row.version,
            row.where,
            f"{row.duration_s:.0f} s",
        )
        for row in shown
    ]
    head = ("Failure", "When", "Robot", "Cause", "Kind", "Map version", "Where", "Duration")
    return table(head, rows, empty=empty, name="Failures")


def _answer(context: PageContext, detail: FailureDetail) -> Markup:
    """What happened, in a sentence."""
    row, report = detail.failure, detail.report
    kind = "suspects a failure" if row.kind == FailureKind.SUSPECTED else "failed"
    where = f" in {row.area}" if row.area else f" in tile {row.tile}" if row.tile else ""
    state = STATUSES.get(row.status, (row.status.lower(),))[0]
    off = f", and was {report.wrong_by_m:.1f} m from where it believed to be" if report.wrong_by_m is not None else ""
    lasted = f"{state} for {row.duration_s:.1f} s when it reported"
    words = (
        f"{row.robot} {kind} at {context.moment(row.happened_ns)}{where}: {row.cause.replace('_', ' ')}, {lasted}{off}."
    )
    return notice(_tone(row), words)


def _summary(context: PageContext, detail: FailureDetail) -> Markup:
    row, report = detail.failure, detail.report

    def figure(value: float | None, unit: str = "") -> str | None:
        if value is None:
            return None
        return f"{value:.0f}{unit}" if abs(value) >= 100 else f"{value:.3g}{unit}"

    def same(name: str, value: object) -> Markup | None:
        return None if value is None else link(context.to("failures", **{name: value}), value)

    suspected = row.kind == FailureKind.SUSPECTED
    advice = _ADVICE.get(Cause(row.cause)) if row.cause in set(Cause) else None
    doubt = (
        "The robot suspects a failure because its fixes contradict its position. Suspected failures are an estimate."
    )
    return Markup("<div><h2>What happened</h2>{}{}{}</div>").format(
        notice("warn", doubt) if suspected else "",
        "" if advice is None else notice("", advice),
        facts(
            [
                ("Began", context.moment(row.happened_ns)),
                ("Duration when reported", f"{row.duration_s:.1f} s"),
                ("Cause", row.cause.replace("_", " ")),
                ("Calibration", report.calibration or "–"),
                ("State of the robot", STATUSES.get(row.status, (row.status,))[0]),
                ("Robot", link(context.to(f"robots/{row.robot}"), row.robot)),
                ("Map version", same("version", row.version)),
                ("Area", same("area", row.area) or "–"),
                ("Tile", same("tile", row.tile)),
                ("Believed uncertainty when it began (95 % radius)", figure(report.radius_95_m, " m")),
                ("Believed position was wrong by", figure(report.wrong_by_m, " m")),
                ("Landmarks expected and seen", _landmarks(report)),
                ("Last fix against prediction (squared Mahalanobis distance)", figure(report.innovation)),
                ("Matches in the last fix", report.inliers),
                ("Brightness of the image (0 to 1)", figure(report.exposure)),
                ("Sharpness (1 is usual)", figure(report.sharpness)),
                ("Received", context.moment(row.received_ns)),
            ]
        ),
    )


async def _position(services: Services, context: PageContext, detail: FailureDetail) -> None:
    """The position on the map, and the fixes before the failure."""
    row = detail.failure
    version = row.version or await load(services.maps.current_version, context.site)
    known = {info.version for info in (await load(services.maps.history, context.site)).versions}
    if version is None or version not in known:
        html(notice("warn", "The map version is no longer in the store; the position cannot be shown."))
        return
    found = [
        Mark(fix.position_map_m[0], fix.position_map_m[1], "accent", "circle", f"fix, {fix.refused or 'used'}")
        for fix in detail.report.fixes
        if fix.position_map_m is not None
    ]
    if row.x_map_m is not None and row.y_map_m is not None:
        found.append(Mark(row.x_map_m, row.y_map_m, _tone(row), "cross", "believed position"))
    html(Markup("<h2>Position</h2>"))
    await version_map(services, context, version, [Layer("Failure", found)], is_small=True)
    html(
        Markup(
            '<p class="quiet">Cross: where the robot believed to be when it began. Dots: fixes until the report. Map version {}.</p>'
        ).format(version)
    )


def _landmarks(report: FailureReport) -> str | None:
    if report.landmarks_expected is None or report.landmarks_seen is None:
        return None
    return f"{report.landmarks_expected} expected, {report.landmarks_seen} seen"


def _pictures(context: PageContext, detail: FailureDetail) -> Markup:
    # Those of the seconds around it are many: they are in the recording.
    pictures = [picture for picture in detail.pictures if picture.kind != "replay"]
    if not pictures:
        return Markup(
            '<h2>Pictures</h2><p class="quiet">None: the robot sent none, or they were deleted to save space.</p>'
        )
    shown = joined(
        Markup(
            '<figure class="{}"><img src="{}" alt="{}" loading="lazy"><figcaption>{}, {:.1f} s {} the beginning</figcaption></figure>'
        ).format(
            picture.kind if picture.kind in _PICTURES else "",
            f"{context.root}/pictures/{detail.failure.number}/{picture.place}.jpg",
            _PICTURES.get(picture.kind, picture.kind),
            _PICTURES.get(picture.kind, picture.kind),
            abs(picture.stamp_ns - detail.report.stamp_ns) * 1e-9,
            "after" if picture.stamp_ns >= detail.report.stamp_ns else "before",
        )
        for picture in sorted(pictures, key=lambda picture: (picture.kind != "matches", picture.stamp_ns))
    )
    return Markup('<h2>Pictures</h2><div class="pictures">{}</div>').format(shown)


def _fixes(report: FailureReport) -> Markup:
    rows = [
        (
            f"{(fix.stamp_ns - report.stamp_ns) * 1e-9:+.1f} s",
            STATUSES.get(fix.status, (fix.status,))[0],
            fix.inliers,
            None
            if fix.innovation is None
            else f"{fix.innovation:.0f}"
            if fix.innovation >= 100
            else f"{fix.innovation:.3g}",
            None if fix.position_map_m is None else f"{fix.position_map_m[0]:.2f}, {fix.position_map_m[1]:.2f} m",
            fix.refused or "used" if fix.position_map_m is not None else fix.refused,
        )
        for fix in report.fixes
    ]
    head = ("When", "State", "Matches", "Against prediction", "Position (x, y)", "Result")
    empty = "The report contains no fixes."
    return Markup("<h2>Fixes before the failure</h2>{}").format(
        table(head, rows, empty=empty, name="Fixes before the failure")
    )
