"""The map page: versions, coverage, quality, differences between two versions, promote and roll back."""

from collections.abc import Iterable
from typing import Any

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.bow.shipped_vocabulary import shipped_vocabulary
from mapserver.dashboard.data import EVER, SiteHistory, VersionQuality
from mapserver.dashboard.failures import failure_heat
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, load, number, show, version_map
from mapserver.dashboard.map_layers import Layer, box_of, coverage, squares
from mapserver.dashboard.markup import badge, choices, facts, joined, link, share, size, table
from mapserver.dashboard.pages import survey_requests
from mapserver.dashboard.pages.confirm import change_button
from mapserver.dashboard.plan import Plan
from mapserver.floor_plan.areas import Areas
from mapserver.quality.directions import missing_words
from mapserver.releases import Difference
from mapserver.store import CanaryRow, VersionInfo

_REFRESH_S = 5.0
_STATE_WORDS = {"published": "used before"}
_STATE_TONES = {"current": "good", "draft": "warn", "published": "quiet", "retired": "quiet"}
# Figures of a build's report with their labels.
_FIGURES = {
    "path_m": ("Driven", "{:.1f} m"),
    "duration_s": ("Recorded", "{:.0f} s"),
    "keyframes": ("Keyframes", "{:.0f}"),
    "landmarks": ("Landmarks surveyed", "{:.0f}"),
    "ate_rmse_m": ("Error against ground truth", "{:.3f} m"),
    "seconds": ("Time to build", "{:.0f} s"),
}


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/map", title="Map – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def map_page(
        request: Request,
        site: str | None = None,
        version: str | None = None,
        before: str | None = None,
        after: str | None = None,
    ) -> None:
        async def build(context: PageContext) -> None:
            history = await load(services.maps.history, context.site)
            html(Markup("<h1>Map of {}</h1>").format(context.site))
            robots = len((await load(services.robots.look, context.site)).robots)
            _changes(services, context, history, robots)
            shown = number(version, "version") or _default_version(history)
            html(_versions(context, history, shown))
            if shown is not None:
                await _one_version(services, context, shown)
            await _difference(services, context, history, number(before, "version"), number(after, "version"))
            html(await _events(services, context, history))
            _follow(services, context, history)

        await show(services, request, "map", site, build, ("version", "before", "after", "since", "until"))


def _default_version(history: SiteHistory) -> int | None:
    """The version to show where none is named: the current one, else the newest."""
    if history.site.current_version is not None:
        return history.site.current_version
    return history.versions[0].version if history.versions else None


def _trial_words(history: SiteHistory) -> str:
    trial = history.trial
    return "" if trial is None else f" Version {trial.version} is tried by {share(trial.share)} of them."


def _changes(services: Services, context: PageContext, history: SiteHistory, robots: int) -> None:
    """Buttons that change the versions, each with what it does to how many robots."""
    current = history.site.current_version
    used = f"Robots should use version {current}." + _trial_words(history)
    html(Markup("<p>{}</p>").format("No version is published yet." if current is None else used))
    with ui.row().classes("actions"):
        if history.trial is not None:
            _stop_button(services, context, history.trial, robots)
        elif (before := history.before) is not None:
            change_button(
                services,
                f"Roll back to version {history.before}",
                f"All {robots} robots of {context.site} go from version {current} back to version {history.before}. Version {current} "
                "is retired; it can be made current again later.",
                lambda actor: services.maps.roll_back(context.site, before, actor),
                css="back",
            )
        for info in history.versions:
            if info.state != "current":
                _version_buttons(services, context, history, info, robots)


def _stop_button(services: Services, context: PageContext, trial: CanaryRow, robots: int) -> None:
    change_button(
        services,
        f"Stop trying version {trial.version}",
        f"The robots with version {trial.version} ({share(trial.share)} of {robots}) go back to version {trial.base_version}. Version "
        f"{trial.version} is retired; it can be made current again later.",
        lambda actor: services.maps.stop_trial(context.site, trial, actor),
        css="back",
    )


def _version_buttons(
    services: Services, context: PageContext, history: SiteHistory, info: VersionInfo, robots: int
) -> None:
    """Buttons that give a version to all robots, or to some of them first. Older versions are gone back to, newer ones promoted."""
    version, current, share_words = info.version, history.site.current_version, f"{services.maps.trial_share:.0%}"
    through_gate = f"Draft {version} goes through the gate. If the gate accepts it, " if info.state == "draft" else ""
    if info.state == "draft":
        change_button(
            services,
            f"Publish draft {version}",
            f"{through_gate}all {robots} robots of {context.site} get it.",
            lambda actor: services.maps.publish(context.site, version, actor),
            css="forward",
        )
    elif version != history.before or history.trial is not None:
        on_trial = history.trial is not None and history.trial.version == version
        is_back = current is not None and version < current
        words = f"Go back to version {version}" if is_back else f"Promote version {version}"
        ends = " The trial ends." if history.trial is not None else ""
        change_button(
            services,
            f"{words}, ending its trial" if on_trial else words,
            f"All {robots} robots of {context.site} go from version {current} to version {version}.{ends}",
            lambda actor: services.maps.promote(context.site, version, actor),
            css="back" if is_back else "forward",
        )
    if current is not None and history.trial is None and version > current:
        change_button(
            services,
            f"Try version {version} on {share_words} of the robots",
            f"{through_gate}{share_words} of the robots get version {version}. If they fail more often than the others, it is rolled back "
            "automatically; otherwise all robots get it.",
            lambda actor: services.maps.start_trial(context.site, version, actor),
            css="forward",
        )


def _state(history: SiteHistory, info: VersionInfo) -> Markup:
    trial = history.trial
    if trial is not None and trial.version == info.version:
        return badge("warn", f"on trial, {share(trial.share)} of the robots")
    return badge(_STATE_TONES[info.state], _STATE_WORDS.get(info.state, info.state))


def _versions(context: PageContext, history: SiteHistory, shown: int | None) -> Markup:
    rows = [
        (
            link(context.to("map", version=info.version), f"Version {info.version}"),
            joined([_state(history, info), " (shown below)" if info.version == shown else ""]),
            info.parent,
            context.written_moment(info.created),
            context.moment(info.published_ns),
            info.tiles,
            info.landmarks,
            size(info.map_bytes),
        )
        for info in history.versions
    ]
    head = ("Version", "State", "Built on", "Built", "Published", "Tiles", "Landmarks", "Size")
    return Markup("<h2>Versions</h2>{}").format(
        table(head, rows, empty="No version yet; `mapserver build` makes one from a recording.", name="Versions")
    )


async def _one_version(services: Services, context: PageContext, version: int) -> None:
    maps = services.maps
    quality = await load(maps.quality, context.site, version)
    plan, areas = await load(maps.plan, context.site, version), await load(maps.areas, context.site)
    with ui.element("div").classes("pair"):
        with ui.element("div"):
            html(Markup("<h2>Coverage of version {}</h2>").format(version))
            requests = await load(maps.survey_requests, context.site)
            html(Markup('<p class="quiet">Time of the failures on this map (a layer) and of the history below:</p>'))
            html(context.range_form("map", usual="Last 14 days", chosen={"version": context.query.get("version")}))
            failed = await load(failure_heat, services, context, box_of(plan))
            over = [Layer("Tiles", coverage(plan)), failed, *survey_requests.layers(requests)]
            drawn = await version_map(services, context, version, over)
            html(
                Markup(
                    '<p class="quiet">Grey: landmarks. Blue dots: places that robots recognise. Squares: tiles, darker with more '
                    "landmarks. {}</p>"
                ).format(link(context.to("space", version=version), "Walk through it in space"))
            )
        right = Markup("<h2>Quality of version {}</h2>{}{}")
        html(right.format(version, _quality_facts(quality, plan), _verdicts(context, quality)))
    survey_requests.request_form(services, context, requests, drawn)
    html(one_way(plan, areas))


def one_way(plan: Plan, areas: Areas) -> Markup:
    """Tiles in which robots coming from the other side will not localize."""
    rows = [
        (
            areas.tile_words(found.tile, plan.tile_size_m),
            ", ".join(found.seen),
            ", ".join(found.missing),
            missing_words(found),
        )
        for found in plan.directions
        if found.missing
    ]
    head = ("Tile", "Surveyed facing", "Missing", "Details")
    empty = "Every place was surveyed in both directions."
    return Markup("<h2>Surveyed in one direction only</h2>{}").format(
        table(head, rows, empty=empty, name="Surveyed in one direction only")
    )


def _download(info: VersionInfo) -> Markup:
    """What a robot fetches; it has the shipped vocabulary already."""
    has_vocabulary = shipped_vocabulary(info.vocabulary_sha256) is not None
    return Markup("{}{}").format(
        size(info.map_bytes + (0 if has_vocabulary else info.vocabulary_bytes)),
        "; the vocabulary is on every robot" if has_vocabulary else f", {size(info.vocabulary_bytes)} of it vocabulary",
    )


def _quality_facts(quality: VersionQuality, plan: Plan) -> Markup:
    report, info = quality.manifest.report, quality.info
    pairs: list[tuple[str, object]] = [
        (words, pattern.format(report[name]))
        for name, (words, pattern) in _FIGURES.items()
        if isinstance(report.get(name), int | float)
    ]
    area_m2 = len(plan.tiles) * plan.tile_size_m**2
    pairs += [
        ("Landmarks for robots", info.landmarks),
        ("Places for robots", plan.places),
        ("Area with tiles", f"{area_m2:.0f} m²"),
        ("Download for a robot", _download(info)),
    ]
    loops = report.get("loops")
    if isinstance(loops, dict):
        pairs.append(("Loops", f"{loops.get('accepted', 0)} accepted of {loops.get('candidates', 0)} candidates"))
    pairs.append(
        ("Recordings", ", ".join(f"{entry.name} ({entry.frames} frames)" for entry in quality.manifest.recordings))
    )
    pairs += [("Calibration", choice.sentence) for choice in quality.trusted]
    pairs += [(f"Doctor: {name}", "; ".join(words) or "no findings") for name, words in _findings(report)]
    return facts(pairs)


def _findings(report: dict[str, Any]) -> Iterable[tuple[str, list[str]]]:
    found = report.get("findings")
    return found.items() if isinstance(found, dict) else ()


def _verdicts(context: PageContext, quality: VersionQuality) -> Markup:
    """Verdicts of the gate, latest first."""
    if not quality.verdicts:
        return Markup('<p class="quiet">The gate has not judged this version yet; publishing it will.</p>')
    parts = []
    for verdict in reversed(quality.verdicts):
        tone, words = ("good", "accepted") if verdict.accepted else ("bad", "refused")
        if verdict.forced:
            tone, words = "warn", "published by force"
        reasons = joined(Markup("<li>{}</li>").format(reason) for reason in verdict.reasons)
        missing = ", ".join(verdict.report.get("not_judged") or ()).replace("_", " ")
        unjudged = Markup('<p class="quiet">Not judged: {}.</p>').format(missing) if missing else ""
        entry = Markup("<p>Gate, {}: {}</p><ul>{}</ul>{}")
        parts.append(entry.format(context.moment(verdict.stamp_ns), badge(tone, words), reasons, unjudged))
    return joined(parts)


async def _difference(
    services: Services, context: PageContext, history: SiteHistory, before: int | None, after: int | None
) -> None:
    """Two versions to choose, and the differences between them."""
    maps = services.maps
    numbers = [str(info.version) for info in history.versions]
    if len(numbers) < 2:
        return
    if after is None:
        after = _default_version(history) or int(numbers[0])
    if before is None:
        earlier = [int(text) for text in numbers if int(text) < after]
        before = earlier[0] if earlier else int(numbers[0])
    form = Markup(
        '<h2 id="changes">Differences between two versions</h2><form class="ask" method="get" action="{}#changes">'
        '<input type="hidden" name="site" value="{}">{}{}<button type="submit">Compare</button></form>'
    ).format(
        f"{context.root}/map",
        context.site,
        choices("before", "From version", numbers, str(before), any_word=None),
        choices("after", "To version", numbers, str(after), any_word=None),
    )
    html(form)
    found = await load(maps.difference, context.site, before, after)
    kinds = await load(maps.changed_tiles, context.site, before, after)
    plan = await load(maps.plan, context.site, after)
    with ui.element("div").classes("pair"):
        with ui.element("div"):
            await version_map(services, context, after, [Layer("Changed tiles", squares(plan, kinds))])
            html(
                Markup(
                    '<p class="quiet">Tiles <span class="good">added</span> (solid line), <span class="warn">changed</span> (dashed), '
                    '<span class="bad">removed</span> (dotted).</p>'
                )
            )
        html(_difference_facts(found))
    lacks = [await load(maps.lacks_surfels, context.site, version) for version in (before, after)]
    html(_changed_things(context, before, after, next((lack for lack in lacks if lack is not None), None)))


def _changed_things(context: PageContext, before: int, after: int, lack: str | None) -> Markup:
    """The plan of what appeared and vanished; lack: why there is none."""
    if before == after:
        return Markup()
    if lack is not None:
        return Markup('<p class="quiet">No plan of what was moved: {}.</p>').format(lack)
    words = (
        f"What stands otherwise in version {after} than in version {before}: blue appeared, orange vanished, pale was not seen by one of "
        "them, grey is the same."
    )
    return Markup(
        '<figure class="changes"><img src="../v1/sites/{0}/versions/{1}/diff/{2}/changes.png" alt="{3}" loading="lazy">'
        '<figcaption>{3} <a href="../v1/sites/{0}/versions/{1}/diff/{2}/changes.geojson">As GeoJSON</a></figcaption></figure>'
    ).format(context.site, before, after, words)


def _difference_facts(found: Difference) -> Markup:
    moved = "none"
    if found.landmarks_moved and found.moved_median_m is not None and found.moved_max_m is not None:
        moved = f"{found.landmarks_moved}, by {found.moved_median_m:.3f} m (median), at most {found.moved_max_m:.3f} m"
    tiles = f"{found.tiles_added} added, {found.tiles_changed} changed, {found.tiles_removed} removed, {found.tiles_kept} unchanged"
    landmarks = f"{found.landmarks_added} new, {found.landmarks_removed} removed, {found.landmarks_kept} unchanged"
    pairs: list[tuple[str, object]] = [
        ("Tiles", tiles),
        ("Landmarks", landmarks),
        ("Landmarks that moved", moved),
        ("A robot downloads", f"{size(found.fetch_bytes)} of {size(found.full_bytes)}"),
        ("Vocabulary", "changed" if found.vocabulary_changed else "unchanged"),
    ]
    for name, (words, pattern) in _FIGURES.items():
        both = found.quality.get(name)
        if both is not None:
            texts = [pattern.format(v) if isinstance(v, int | float) else "–" for v in (both.before, both.after)]
            pairs.append((words, f"{texts[0]} before, {texts[1]} after"))
    if found.landmarks_kept + found.landmarks_moved + found.landmarks_removed:
        before = found.landmarks_kept + found.landmarks_moved + found.landmarks_removed
        pairs.append(("Landmarks kept", share((before - found.landmarks_removed) / before)))
    return facts(pairs)


async def _events(services: Services, context: PageContext, history: SiteHistory) -> Markup:
    """What happened to the site, in the range of the address or at last."""
    span_ns = context.time_range()
    events = history.events if span_ns == EVER else await load(services.maps.events, context.site, span_ns)
    rows = [
        (
            context.moment(event.stamp_ns),
            event.kind.replace("_", " "),
            event.detail,
            event.actor or "mapserver",
            event.reason,
        )
        for event in events
    ]
    empty = "No events yet." if span_ns == EVER else "Nothing happened in this time."
    return Markup("<h2>History</h2>{}").format(
        table(("When", "What", "Details", "Who", "Why"), rows, empty=empty, name="History")
    )


def _follow(services: Services, context: PageContext, history: SiteHistory) -> None:
    """Reloads the page after a change of versions, unless a dialog is open."""

    async def refresh() -> None:
        if (await load(services.maps.history, context.site)).fingerprint != history.fingerprint:
            ui.run_javascript("if (!document.querySelector('.q-dialog')) location.reload()")

    ui.timer(_REFRESH_S, refresh, immediate=False)
