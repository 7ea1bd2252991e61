"""The page of maps: what runs where (versions with state, the gate's word and robots), and what another version would change."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

from fleetmap.bow.vocabulary import shipped_vocabulary
from fleetmap.errors import FleetmapError
from mapserver.api.incidents import of_drafts
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.data import MapData
from mapserver.dashboard.map_layers import Layer, Outline, Picture, square
from mapserver.dashboard.plan import Plan
from mapserver.dashboard.rendering import begun, share, size
from mapserver.fleet.alerts import with_acts
from mapserver.fleet.resurvey_list import courses_of
from mapserver.floor_plan.alignment import Alignment
from mapserver.floor_plan.areas import Area, Areas, due_corrections
from mapserver.quality.directions import missing_words
from mapserver.quality.figures import trusted_calibrations
from mapserver.quality.gate import CHECKS
from mapserver.releases.version_diff import Difference
from mapserver.store import EVER, Event, SiteReleases, VerdictRow, VersionInfo

_EVENTS_SHOWN = 50
_STATES = {
    "current": ("good", "current"),
    "draft": ("warn", "draft"),
    "published": ("quiet", "used before"),
    "retired": ("quiet", "retired"),
}
# What was done to a version, by the kind of an event.
_DONE = {
    "published": "published",
    "promoted": "promoted",
    "rolled_back": "gone back to",
    "canary_started": "tried",
    "canary_promoted": "promoted after its trial",
    "canary_rolled_back": "taken back",
    "canary_stopped": "trial ended",
}
# Figures of a build's report with their labels.
_FIGURES = {
    "path_m": ("Driven", "{:.1f} m"),
    "duration_s": ("Recorded", "{:.0f} s"),
    "keyframes": ("Keyframes", "{:.0f}"),
    "landmarks": ("Landmarks surveyed", "{:.0f}"),
    "ate_rmse_m": ("Error against ground truth", "{:.3f} m"),
    "seconds": ("Time to build", "{:.0f} s"),
}
# Why the gate does not judge something.
_UNKNOWN = {
    "joining": "the build does not say how they were joined",
    "held_out_frames": "too few of them",
    "yesterdays_recordings": "too few frames of them were played against it",
    "last_versions_places": "too few of them could be tried",
    "version_before": "there was none",
    "ground_truth": "the recordings have none",
    "aliasing_probes": "too few frames could be tried",
    "calibration": "no recording was examined for it",
    "motion": "nothing to compare it with",
    "size_against_last_version": "there was none",
}
_CORRECTED = {"forget": "forgotten and learned anew", "never-use": "never used", "freeze": "frozen"}
_FRAMES = {"held_out_frames": "held_out", "yesterdays_recordings": "replayed", "last_versions_places": "last_version"}


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    maps, site, span_ns = services.maps, context.site, context.time_range()
    if not maps.is_mapped(site):
        return {"shown": None}
    rows, events = maps.store.releases(site), maps.store.last_events(site, _EVENTS_SHOWN)
    verdicts = maps.store.last_verdicts(site)
    refused = {one.about: one for one in with_acts(maps.store, of_drafts(maps.store, site))}
    robots = [robot.status.version for robot in services.robots.look(site)]
    asked, before, after = (number(context.query.get(name), name) for name in ("version", "before", "after"))
    known = (asked, after, maps.current_version(site), max(rows.versions, default=None))
    shown = next((number for number in known if number is not None), None)
    if shown is None:
        return {"shown": None}
    info, plan, requests = maps.store.version(site, shown), maps.plan(site, shown), maps.store.survey_requests(site)
    changes, compares = _changes(maps, context, rows, before, after or shown), "after" in context.query
    forgets, now_ns = _waiting(maps, site), time.time_ns()
    # Areas that wait are requests of their own, which hide nothing.
    drawn = [ring.round(2).tolist() for area in forgets for ring in area.outlines]
    others = [one for one in requests if one.corners_map_m not in drawn]
    asked_for = [Outline([[(x, y) for x, y in one.corners_map_m]], f"survey {one.id}") for one in others]
    failed = {"Failures": services.health.places(site, *span_ns)}
    tiles = [square(plan, place, kind, kind) for place, kind in sorted(changes["tiles"].items())]
    over = [
        Layer("Changed tiles", tiles, shown=compares),
        Layer("Requested surveys", asked_for),
        Layer("Outline that you draw"),
    ]
    return {
        "used": _used(services, rows),
        "building": maps.store.building(site),
        "versions": [
            _card(maps, rows, events, verdicts.get(info.version), info, robots, shown)
            | {"incident": refused.get(str(info.version))}
            for info in reversed(rows.versions.values())
        ],
        "shown": shown,
        "scene": scene_of(services, context, shown, over, dense_m=failed, shows_coverage=not compares),
        "gate": _gate(maps, info, verdicts.get(shown)),
        "version_facts": _facts(maps, info, plan),
        "one_way": one_way(plan, maps.store.areas(site)),
        "changes": changes,
        "moved": services.shown("changes", context, changes["before"], changes["after"]),
        "links": services.shown("version", context, shown),
        "alignment": _aligned(maps.store.alignment(site)),
        "corrected": _CORRECTED,
        "waiting": [area.name for area in forgets],
        "areas": sorted(maps.store.areas(site).areas, key=lambda area: area.name),
        "requests": requests,
        "courses": courses_of(maps.store, site, services.settings.config.resurvey, now_ns),
        "events": events if span_ns == EVER else maps.store.events(site, span_ns)[::-1][:_EVENTS_SHOWN],
        "no_events": "No events yet." if span_ns == EVER else "Nothing happened in this time.",
    }


def _waiting(maps: MapData, site: str) -> Sequence[Area]:
    """The areas to be learned anew that the current version has not forgotten yet."""
    current = maps.current_version(site)
    return [] if current is None else due_corrections(maps.store.areas(site), maps.store.manifest(site, current))


def _used(services: Services, rows: SiteReleases) -> str:
    if rows.current is None:
        return "No version is published yet."
    used = f"Robots should use version {rows.current.version}."
    if rows.canary is None:
        return used
    reasons = {trial.id: found.reason for trial, found in services.health.site(rows.site).trials}
    said = f": {reasons[rows.canary.id]}" if rows.canary.id in reasons else ""
    return f"{used} Version {rows.canary.version} is tried by {share(rows.canary.share)} of them{said}."


def _card(
    maps: MapData,
    rows: SiteReleases,
    events: list[Event],
    verdict: VerdictRow | None,
    info: VersionInfo,
    robots: list[int | None],
    shown: int,
) -> dict[str, object]:
    """A version in the list. Acts on old ones are there once they are chosen: the list stays short."""
    version, trial = info.version, rows.canary
    on_trial = trial is not None and trial.version == version
    tone, state = _STATES[info.state]
    if trial is not None and on_trial:
        tone, state = "warn", f"on trial, {share(trial.share)} of the robots"
    event = next((e for e in events if e.version == version and e.kind in _DONE), None)
    stamp_ns = event.stamp_ns if event else info.published_ns or info.saved_ns
    done = _DONE[event.kind] if event else "published" if info.published_ns else "built"
    by = f" by {event.actor or 'the server'}" if event else ""
    runs = robots.count(version)
    is_old = rows.current is not None and version < rows.current.version and not on_trial
    # A difference decodes the tiles of both versions: not for every draft of the list.
    gets = _gets(maps, rows, version) if version in (shown, max(rows.versions)) else ""
    return {
        "version": version,
        "tone": tone,
        "state": state,
        "gate": verdict_words(verdict, info.state == "draft"),
        "done": f"{begun(done)}{by}",
        "stamp_ns": stamp_ns,
        "why": event.reason if event else "",
        "robots": f"{runs} of {len(robots)} robots" if runs else "",
        "acts": [] if is_old and version != shown else list(_acts(maps, rows, info, verdict, len(robots), gets)),
    }


def _acts(
    maps: MapData, rows: SiteReleases, info: VersionInfo, verdict: VerdictRow | None, robots: int, gets: str
) -> Iterator[tuple[object, ...]]:
    """What can be done to a version, as the macro `act` takes it: give it to all robots, to some of them first, or take it back.

    gets: what it changes for them.
    """
    site, version, trial, before = info.site, info.version, rows.canary, rows.rollback_target
    current = None if rows.current is None else rows.current.version
    to, back = f"sites/{site}/versions/{version}", f"sites/{site}/rollback"
    everybody = f"all {robots} robots of {site}" if robots != 1 else f"the robot of {site}"
    retires = f"Version {version} is retired; it can be made current again later."
    gets += f" The trial of version {trial.version} ends." if trial is not None else ""
    if trial is not None and trial.version == version:
        told = f"The robots with version {version} ({share(trial.share)} of all) go back to version {trial.base_version}. {retires}"
        yield f"Stop trying version {version}", back, told, {"canary": trial.id}, "back", True
    if info.state == "current":
        if trial is None and before is not None:
            told = f"{begun(everybody)} go from version {version} back to version {before}. {retires}"
            yield f"Roll back to version {before}", back, told, {"to": before}, "back", True
        return
    through = f"Draft {version} goes through the gate. If the gate accepts it, " if info.state == "draft" else ""
    if info.state == "draft":
        told = f"{begun(f'{through}{everybody}')} get it.{gets}"
        yield f"Publish draft {version}", f"{to}/publish", told, {}, "forward", False
        if verdict is not None and verdict.reasons and set(verdict.reasons) <= set(verdict.report.get("unjudged", ())):
            told = (
                f"You say that the calibration of draft {version} is right although no recording judged it: all later versions keep "
                f"its metres. {begun(everybody)} get it.{gets}"
            )
            trusts = {"trust_calibration": True}
            yield f"Trust its calibration, publish draft {version}", f"{to}/publish", told, trusts, "back", True
        elif verdict is not None and verdict.reasons:
            told = f"The gate refused draft {version}. {begun(everybody)} get it all the same, if they could use it at all.{gets}"
            yield f"Publish draft {version} by force", f"{to}/publish", told, {"force": True}, "back", True
    elif version != before or trial is not None:
        is_back = current is not None and version < current
        ends = ", ending its trial" if trial is not None and trial.version == version else ""
        told = f"{begun(everybody)} go from version {current} to version {version}.{gets}"
        words = f"{'Go back to' if is_back else 'Promote'} version {version}{ends}"
        yield words, f"{to}/promote", told, {}, "back" if is_back else "forward", is_back
    if current is not None and trial is None and version > current:
        some = f"{maps.trial_share:.0%} of the robots"
        told = (
            f"{through}{some} get version {version}. If they fail more often than the others, it is rolled back automatically; "
            f"otherwise all robots get it.{gets}"
        )
        yield f"Try version {version} on {some}", f"{to}/canary", told, {}, "forward", False


def _aligned(found: Alignment | None) -> str:
    """What the map is aligned with and how well; empty without an alignment."""
    if found is None:
        return ""
    plan = f"with {found.plan} " if found.plan else ""
    left = f", at most {max(found.off_m.values()):.2f} m left at one" if found.off_m else ""
    return f"The map is aligned {plan}by {len(found.off_m)} points{left}."


def _gets(maps: MapData, rows: SiteReleases, version: int) -> str:
    """What a version changes for robots that have the current one, in a sentence that follows another; empty if it changes none."""
    if rows.current is None or rows.current.version == version:
        return ""
    try:
        found = maps.difference(rows.site, rows.current.version, version)
        tile_size_m = maps.store.manifest(rows.site, version).tile_size_m
    except FleetmapError as error:  # a lost tile must not take the other versions' acts with it
        return f" What it changes is not known: {error}."
    tiles = found.tiles_added + found.tiles_changed + found.tiles_removed
    if not tiles:
        return " The map is the same."
    of_tiles = f"{tiles} tiles of {tiles + found.tiles_kept}, {tiles * tile_size_m**2:.0f} m²"
    landmarks = (
        f"{found.landmarks_added} new and {found.landmarks_removed} removed landmarks, {found.landmarks_moved} moved"
    )
    return f" It changes {of_tiles}: {landmarks}. Each robot downloads {size(found.fetch_bytes)}."


def verdict_words(verdict: VerdictRow | None, is_draft: bool) -> tuple[str, str]:
    """Tone and sentence of what the gate said last about a version."""
    if verdict is None:
        return "quiet", "The gate judges it when it is published." if is_draft else "The gate never judged it."
    if verdict.accepted:
        return "good", "The gate accepted it."
    tone, said = ("warn", "Published by force, although") if verdict.forced else ("bad", "The gate refused it")
    more = f", and {len(verdict.reasons) - 1} more" if len(verdict.reasons) > 1 else ""
    return tone, f"{said}: {verdict.reasons[0]}{more}."


def _gate(maps: MapData, info: VersionInfo, verdict: VerdictRow | None) -> dict[str, object] | None:
    """What the gate found, or would find in a draft; None where it never looked."""
    answers = ("accepted", "refused")
    if verdict is None and info.state == "draft":
        answers, verdict = ("would accept", "would refuse"), maps.foretold(info)
    if verdict is None:
        return None
    report, evidence = verdict.report, verdict.report.get("evidence") or {}
    passed = []
    for name in report.get("passed", ()):
        tried = (evidence.get(_FRAMES.get(name)) or {}).get("draft")
        told = f": {tried['localised_share']:.0%} of {tried['frames']} localised" if tried else ""
        passed.append(f"{begun(CHECKS[name])}{told}")
    not_judged = report.get("not_judged", ())
    unknown = [f"{begun(CHECKS[name])}: {_UNKNOWN[name]}" if name in CHECKS else name for name in not_judged]
    return {
        "tone": "good" if verdict.accepted else "bad",
        "words": f"The gate {answers[not verdict.accepted]} it.",
        "failed": [begun(reason) for reason in verdict.reasons],
        "passed": passed,
        "warned": [begun(warning) for warning in report.get("warnings", ())],
        "not_judged": unknown,
    }


def _facts(maps: MapData, info: VersionInfo, plan: Plan) -> list[tuple[str, object]]:
    manifest = maps.store.manifest(info.site, info.version)
    report = manifest.report
    pairs: list[tuple[str, object]] = [
        (words, pattern.format(report[name]))
        for name, (words, pattern) in _FIGURES.items()
        if isinstance(report.get(name), int | float)
    ]
    is_shipped = shipped_vocabulary(info.vocabulary_sha256) is not None  # then every robot has it
    recordings = ", ".join(f"{entry.name} ({entry.frames} frames)" for entry in manifest.recordings)
    pairs += [
        ("Built on", f"version {info.parent}" if info.parent else "nothing: it is the first"),
        ("For robots", f"{info.landmarks} landmarks and {plan.places} places"),
        ("Area with tiles", f"{len(plan.tiles) * plan.tile_size_m**2:.0f} m² in {info.tiles} tiles"),
        ("Download for a robot", size(info.map_bytes + (0 if is_shipped else info.vocabulary_bytes))),
        ("Recordings", recordings),
        *(("Calibration", choice.sentence) for choice in trusted_calibrations(manifest)),
    ]
    findings = report.get("findings")
    said = findings if isinstance(findings, dict) else {}
    return pairs + [(f"Doctor: {name}", "; ".join(words) or "no findings") for name, words in said.items()]


def one_way(plan: Plan, areas: Areas) -> list[str]:
    """Tiles in which robots coming from the other side will not localize."""
    return [
        f"{areas.tile_words(found.tile, plan.tile_size_m)}, surveyed facing {', '.join(found.seen)}: {missing_words(found)}"
        for found in plan.directions
        if found.missing
    ]


def _changes(maps: MapData, context: PageContext, rows: SiteReleases, before: int | None, after: int) -> dict[str, Any]:
    """What version `after` changes; without `before`, from the current version, or from the one before where it is that."""
    site, current = rows.site, rows.current
    if before is None:
        earlier = max((version for version in rows.versions if version < after), default=after)
        before = current.version if current and current.version != after else rows.rollback_target or earlier
    tiles, swipe = maps.changed_tiles(site, before, after), None
    try:
        facts = _changed(maps.difference(site, before, after))
        swipe = None if before == after else _swipe(maps, context, before, after)
    except FleetmapError as error:
        facts = [("Not known", str(error))]
    return {"before": before, "after": after, "tiles": tiles, "facts": facts, "swipe": swipe}


def _swipe(maps: MapData, context: PageContext, before: int, after: int) -> dict[str, object]:
    """The pictures of two versions, and the box of them all."""

    def pictures(version: int) -> list[Picture]:
        layers = maps.underlays(context.site, version, context.root)
        below = [item for layer in layers for item in layer.items if isinstance(item, Picture)]
        return [*below, Picture(context.plan_picture(version), maps.plan(context.site, version).box)]

    left, right = pictures(before), pictures(after)
    x0, y0, x1, y1 = zip(*(picture.box for picture in (*left, *right)), strict=True)
    return {"before": left, "after": right, "box": (min(x0), min(y0), max(x1), max(y1))}


def _changed(found: Difference) -> list[tuple[str, object]]:
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
    ]
    for name, (words, pattern) in _FIGURES.items():
        both = found.quality.get(name)
        if both is not None:
            texts = [pattern.format(v) if isinstance(v, int | float) else "unknown" for v in (both.before, both.after)]
            pairs.append((words, f"{texts[0]} before, {texts[1]} after"))
    return pairs
