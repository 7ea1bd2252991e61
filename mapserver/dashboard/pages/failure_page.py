"""The page of one failure: the answer in a sentence, its pictures, the seconds around it, and the robot's whole report."""

from dataclasses import dataclass

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import FleetmapError
from fleetmap.failure_summary import Moment
from fleetmap.messages import Cause, FailureKind, FailureReport
from mapserver.dashboard.failure import story
from mapserver.dashboard.failure.player import LAYER, FailurePlayer, mark_of
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
from mapserver.dashboard.map_layers import Layer, Mark
from mapserver.dashboard.markup import facts, joined, link, table
from mapserver.dashboard.pages.failures_page import tone_of
from mapserver.dashboard.site_map import SiteMap
from mapserver.store import FailureDetail, PictureRow

_DRAWN = "Drawn from the map: what the camera should have seen where the robot believed to be when it began"
_LEFT, _MATCHES = "Left camera image", "The image, and the landmarks expected in it"
_ADVICE = {
    Cause.CARRIED: "The robot was carried: what it sees ended between two images, and its fixes agree on another place.",
    Cause.ALIASED: "Several places of the map look like what the robot sees. Something that differs, a dock or a coarse position tells "
    "them apart.",
    Cause.MAP_CHANGED: "Images and odometry are sound, but far fewer landmarks are there than the map holds: survey this place again.",
    Cause.CALIBRATION: "The cameras do not agree with the map any more: check their mounting, then calibrate the robot.",
    Cause.DARK: "The images are dark: check the light and the lenses.",
    Cause.NO_MATCH: "Nothing in the map agrees: not mapped, or mapped in the other direction only.",
}


@dataclass(frozen=True, slots=True)
class _Shown:
    """A failure with what its recording says: moments and pictures, none without one; clock: for their stamps."""

    context: PageContext
    detail: FailureDetail
    clock: story.FailureClock
    moments: list[Moment]
    pictures: list[PictureRow]

    @property
    def found_ns(self) -> int | None:
        """When the robot had found itself again, None where the recording does not show it."""
        blind = story.blind_time(self.moments, self.clock.began_ns)
        return None if blind is None else blind.found_ns

    def address(self, picture: PictureRow) -> str:
        """Of a picture."""
        return f"{self.context.root}/pictures/{self.detail.failure.number}/{picture.place}.jpg"


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/failures/{failure}", title="Failure – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failure_page(request: Request, failure: str, site: str | None = None) -> None:
        found = await load(_site_of, services, failure, site)

        async def build(context: PageContext) -> None:
            shown = await load(_shown, services, context, number(failure, "failure") or 0)
            html(back_link(context, "failures", "All failures"))
            html(Markup("<h1>Failure {} of {}</h1>").format(shown.detail.failure.number, shown.detail.failure.robot))
            html(_answer(shown))
            html(_pictures(shown))
            html(_expected(shown, await load(services.maps.lacks_view, shown.detail.report)))
            await _seconds(services, shown)
            if shown.moments:
                html(_summary(shown))
            html(_fixes(shown.detail.report))

        await show(services, request, "failures", found, build)


def _shown(services: Services, context: PageContext, failure: int) -> _Shown:
    detail = services.health.failure(failure)
    began_ns = detail.report.stamp_ns
    moments = story.moments_near(services.health.replay(failure), began_ns)
    clock = story.FailureClock(began_ns, detail.failure.happened_ns, context.zone)
    return _Shown(context, detail, clock, moments, story.pictures_near(detail.pictures, began_ns))


def _site_of(services: Services, failure: str, site: str | None) -> str | None:
    """The site of a failure, for the navigation; the named one if there is no such failure."""
    try:
        return services.health.failure(number(failure, "failure") or 0).failure.site
    except FleetmapError:
        return site


def _answer(shown: _Shown) -> Markup:
    """What happened, in a sentence."""
    row = shown.detail.failure
    kind = "suspects a failure" if row.kind == FailureKind.SUSPECTED else "failed"
    where = f" in {row.area}" if row.area else f" in tile {row.tile}" if row.tile else ""
    words = story.answer(shown.detail, shown.moments, shown.clock)
    return notice(tone_of(row), f"{row.robot} {kind} at {shown.context.moment(row.happened_ns)}{where}: {words}.")


def _figure(shown: _Shown, picture: PictureRow, what: str, kind: str = "") -> Markup:
    words = f"{what}: {shown.clock.since(picture.stamp_ns)}"
    return Markup(
        '<figure class="{0}"><img src="{1}" alt="{2}" loading="lazy"><figcaption>{2}</figcaption></figure>'
    ).format(kind, shown.address(picture), words)


def _pictures(shown: _Shown) -> Markup:
    """Before, at and after, from the recording; the report's own where there is none."""
    chosen = story.before_at_after(shown.pictures, shown.clock.began_ns, shown.found_ns)
    if not chosen:
        own = [picture for picture in shown.detail.pictures if picture.kind == "frame"]
        chosen = [(_LEFT, picture) for picture in sorted(own, key=lambda picture: picture.stamp_ns)]
    if not chosen:
        return Markup(
            '<h2>Pictures</h2><p class="quiet">None: the robot sent none, or they were deleted to save space.</p>'
        )
    figures = joined(_figure(shown, picture, title) for title, picture in chosen)
    return Markup('<h2>Pictures</h2><div class="pictures row">{}</div>').format(figures)


def _expected(shown: _Shown, lack: str | None) -> Markup:
    """The picture at the beginning beside the one that the map's surfels make, and the match view. lack: why there is none."""
    parts: list[Markup] = [Markup("<h2>What the map expected</h2>")]
    seen = [picture for picture in shown.detail.pictures if picture.kind != "matches"]
    if lack is None:
        drawn = Markup(
            '<figure><img src="../../v1/failures/{0}/expected.png" alt="{1}"><figcaption>{1}</figcaption></figure>'
        ).format(shown.detail.failure.number, _DRAWN)
        at = min(seen, key=lambda picture: abs(picture.stamp_ns - shown.clock.began_ns), default=None)
        pair = [drawn] if at is None else [_figure(shown, at, _LEFT), drawn]
        parts.append(Markup('<div class="pictures">{}</div>').format(joined(pair)))
    else:
        parts.append(Markup('<p class="quiet">No expected view: {}.</p>').format(lack))
    return joined([*parts, _match_view(shown)])


def _match_view(shown: _Shown) -> Markup:
    views = [
        _figure(shown, picture, _MATCHES, "matches") for picture in shown.detail.pictures if picture.kind == "matches"
    ]
    return Markup('<div class="pictures">{}</div>').format(joined(views)) if views else Markup()


def _summary(shown: _Shown) -> Markup:
    context, row, report = shown.context, shown.detail.failure, shown.detail.report

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
    return Markup("<div><h2>What the robot reported</h2>{}{}{}</div>").format(
        notice("warn", doubt) if suspected else "",
        "" if advice is None else notice("", advice),
        facts(
            [
                ("Began", context.moment(row.happened_ns)),
                ("Duration when reported", f"{row.duration_s:.1f} s"),
                ("Cause", row.cause.replace("_", " ")),
                ("Calibration", report.calibration or "–"),
                ("State of the robot", story.status_words(row.status)),
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


async def _seconds(services: Services, shown: _Shown) -> None:
    """The map around the failure, beside the seconds of its recording or the report's figures."""
    html(Markup("<h2>{}</h2>").format("The seconds around it" if shown.moments else "Where it was"))
    with ui.element("div").classes("pair"):
        with ui.element("div"):
            site_map = await _position(services, shown)
        if not shown.moments:
            html(_summary(shown))
            return
        with ui.element("div"):
            pictures = [(shown.address(picture), shown.clock.at(picture.stamp_ns)) for picture in shown.pictures]
            instants = story.instants(shown.moments, shown.pictures, shown.clock)
            FailurePlayer(instants, pictures, _first(shown), site_map)
            html(_download(shown))


def _first(shown: _Shown) -> int:
    """The moment at which the failure begins."""
    return min(range(len(shown.moments)), key=lambda n: abs(shown.moments[n].stamp_ns - shown.clock.began_ns))


def _download(shown: _Shown) -> Markup:
    """The way to the recording; relative, since whatever stands before the server may add to its addresses."""
    failure = shown.detail.failure.number
    return Markup(
        '<p><a class="plain button" href="../../v1/failures/{0}/replay.mcap" download>Download these seconds (MCAP)</a></p>'
        '<p class="quiet">Foxglove opens it; <code>mapserver fleet replay {0}</code> says what another map version would have done.</p>'
    ).format(failure)


async def _position(services: Services, shown: _Shown) -> SiteMap | None:
    """The map around the failure: what the robot believed in these seconds, and its fixes."""
    context, row = shown.context, shown.detail.failure
    version = row.version or await load(services.maps.current_version, context.site)
    known = {info.version for info in (await load(services.maps.history, context.site)).versions}
    if version is None or version not in known:
        html(notice("warn", "The map version is no longer in the store; the position cannot be shown."))
        return None
    found = [
        Mark(fix.position_map_m[0], fix.position_map_m[1], "accent", "circle", f"fix, {fix.refused or 'used'}")
        for fix in shown.detail.report.fixes
        if fix.position_map_m is not None
    ]
    if row.x_map_m is not None and row.y_map_m is not None:
        found.append(Mark(row.x_map_m, row.y_map_m, tone_of(row), "cross", "believed position"))
    way = story.path(shown.moments, shown.clock)
    instants = story.instants(shown.moments, [], shown.clock)
    layers = [Layer("Failure", found)]
    if instants:
        layers = [Layer("Path", way), *layers, Layer(LAYER, mark_of(instants[_first(shown)]))]
    places_m = [(mark.x, mark.y) for mark in found] + [place for line in way for place in line.points]
    drawn = await version_map(services, context, version, layers, is_small=True, places_m=places_m)
    words = "Cross: where the robot believed to be when it began. Dots: fixes until the report."
    if instants:
        words += " Line: where it believed to be in these seconds, in the colour of its state."
    else:
        words += " There is no recording of the seconds around it: the robot sends none, has not sent it yet, or it went to save space."
    there = Markup("")
    if row.x_map_m is not None and row.y_map_m is not None:
        place = {"x": round(row.x_map_m, 2), "y": round(row.y_map_m, 2)}
        there = link(context.to("space", version=version, **place), "Stand there in space")
    html(Markup('<p class="quiet">{} Map version {}. {}</p>').format(words, version, there))
    return drawn


def _landmarks(report: FailureReport) -> str | None:
    if report.landmarks_expected is None or report.landmarks_seen is None:
        return None
    return f"{report.landmarks_expected} expected, {report.landmarks_seen} seen"


def _fixes(report: FailureReport) -> Markup:
    rows = [
        (
            f"{(fix.stamp_ns - report.stamp_ns) * 1e-9:+.1f} s",
            story.status_words(fix.status),
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
