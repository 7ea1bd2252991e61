"""Verdict on a site: its figures beside their limits, what to survey again, and the comparison with an earlier report. Pure."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from mapserver.plugins.acceptance import figures
from mapserver.plugins.acceptance.ladders import BLUR_PX, STOPS
from mapserver.quality.directions import missing_words
from mapserver.quality.figures import Evidence, TileDirections, first_of
from mapserver.quality.gate import GateSettings

ONE_WAY = "robots drive every aisle as it was surveyed"
KNOWN_STARTS = "robots always start where they are told their place"
_LEVEL = 0.05  # of all comparisons together
_NAMED = 3
_QUIET_H = 48.0  # 3.0 robot-days, the rule of three: so much driving without an incident shows at most one a day


class Reason(NamedTuple):
    """A reason against a site, and the survey that would end it, empty for none."""

    words: str
    again: str = ""


class Row(NamedTuple):
    """A figure of the site, of its weakest area or drive, its limit, empty for none, and the reasons if it is beyond.

    reasons: None without a limit, and if too little was tried to say.
    """

    name: str
    site: str
    weakest: str = ""
    limit: str = ""
    reasons: Sequence[Reason] | None = None


Part = tuple[float, str, str]
"""How bad a figure of an area or drive is, its name, and the figure."""
Found = tuple[str, str, Reason]
"""The area, drive or rig where something was found that must not be, what, and the reason."""


def judged(
    report: figures.Report, settings: GateSettings, evidence: Evidence | None, fleet: Sequence[str]
) -> figures.Report:
    """Return the report with verdict, reasons, table, what was not judged and what to survey again.

    A share counts against a limit if its 95 % interval lies below it. evidence: of the version's build. fleet: tiles that the robots'
    failures put on the list, as text.
    """
    rows = [*_of_frames(report, settings), *_of_robots(report, settings), *_of_site(report, settings)]
    found = [reason for row in rows for reason in row.reasons or ()]
    reasons, again = [reason.words for reason in found], [reason.again for reason in found if reason.again]
    if evidence is not None and evidence.views is not None and evidence.views.warning:
        again.append(evidence.views.warning)
    site = f"{report.site}, version {report.version}"
    promised = f", if {' and '.join(report.promises)}" if report.promises else ""
    judged_ones = " that could be judged" if any(row.limit and row.reasons is None for row in rows) else ""
    accepted = f"ACCEPTED{promised}: {site}: every figure{judged_ones} is within its limit."
    return msgspec.structs.replace(
        report,
        verdict=f"NOT ACCEPTED: {site}: {first_of(reasons, 1)}." if reasons else accepted,
        is_accepted=not reasons,
        reasons=reasons,
        figures=[figures.Figure(*row[:4], None if row.reasons is None else not row.reasons) for row in rows],
        survey_again=list(dict.fromkeys([*again, *fleet])),
        not_judged=list(_not_judged(report)),
    )


def _of_frames(report: figures.Report, settings: GateSettings) -> Iterator[Row]:
    whole, tries = report.whole, report.whole.frames.tries

    def unlocalized(area: figures.AreaFigures) -> Reason:
        is_dark = report.darkest_grey is not None and area.grey is not None and area.grey <= report.darkest_grey
        why = f"too dark (grey level {area.grey:.0f} of 255)" if is_dark else "not localized"
        words = f"{area.name} is {why}: {area.frames.text} frames get a fix"
        return Reason(words, f"{area.name}: survey it{' with more light' if is_dark else ''}")

    def half(area: figures.AreaFigures) -> figures.Count:
        return figures.Count() if _is_below(area.frames, settings) else area.darkness.get("1", figures.Count())

    def dim(area: figures.AreaFigures) -> Reason:
        words = f"{area.name} is nearly too dark: with half its light {half(area).text} frames get a fix"
        return Reason(words, f"{area.name}: survey it with more light")

    few = f"only {tries} frames at a known place judge it, {settings.min_frames} are needed: record a longer drive"
    reasons = [Reason(few)] if tries < settings.min_frames else []
    yield Row("Frames at a known place", str(tries), "", f"at least {settings.min_frames}", reasons)
    yield _share("Frames localized, each by itself", report, settings, lambda area: area.frames, unlocalized)
    yield _share("Frames localized with half the light", report, settings, half, dim)
    for words, levels, ladder in (
        (f"with 1/{', 1/'.join(str(2**stop) for stop in STOPS[1:])} of the light", STOPS[1:], whole.darkness),
        (f"with a blur of {', '.join(map(str, BLUR_PX))} px", BLUR_PX, whole.blur),
    ):
        yield Row(f"the same {words}", ", ".join(ladder.get(str(level), figures.Count()).text for level in levels))
    wrong = [(area.wrong / area.frames.tries, area.name, str(area.wrong)) for area in report.areas if area.frames.tries]
    words = f"{whole.wrong} of {tries} frames are localized at a wrong place"
    over = [Reason(words)] if whole.wrong > settings.max_wrong_share * tries else [] if tries else None
    limit = f"at most {100 * settings.max_wrong_share:g} %"
    yield Row("Frames localized at a wrong place", f"{whole.wrong} of {tries}", _worst(wrong), limit, over)
    limit_mm, median_mm = 1e3 * settings.max_median_error_m, float(np.median(whole.errors_mm or [0.0]))
    words = f"the median error is {median_mm:.0f} mm, the limit is {limit_mm:.0f} mm"
    is_known = figures.quantile(whole.errors_mm, 0.5) is not None
    over = [Reason(words)] if median_mm > limit_mm else [] if is_known else None
    medians = _worst(_errors((area.name, figures.quantile(area.errors_mm, 0.5)) for area in report.areas))
    yield Row(
        "Error of these frames, median", _mm(whole.errors_mm, "median"), medians, f"at most {limit_mm:g} mm", over
    )
    yield Row("Error of these frames, 95 %", _mm(whole.errors_mm, "p95"))


def _of_robots(report: figures.Report, settings: GateSettings) -> Iterator[Row]:
    whole, drives, least = report.whole.starts, report.drives, settings.min_localised_share

    def unfound(area: figures.AreaFigures) -> Reason:
        starts, tries = area.starts, area.starts.found_of_all.tries
        if starts.ambiguous > starts.lost:
            alike = ", ".join([alike.other for alike in report.similar if alike.area == area.name][:_NAMED])
            stay = f"{starts.ambiguous} of {tries} starts stay AMBIGUOUS"
            return Reason(f"{area.name} looks like {alike or 'another place'}: {stay}")
        words = f"{area.name}: {starts.lost} of {tries} starts without a guess stay lost"
        return Reason(words, f"{area.name}: survey it")

    name = "Starts without a guess that find their place"
    row = _share(name, report, settings, lambda area: area.starts.found_of_all, unfound)
    if not whole.found_of_all.tries:
        row = row._replace(reasons=[Reason("no start without a guess was tried: record a longer drive")])
    yield row._replace(limit="", reasons=None) if KNOWN_STARTS in report.promises else row
    yield Row("Starts that stay AMBIGUOUS, or lost", f"{whole.ambiguous}, {whole.lost}")
    silent = [(area.name, area.starts.silent) for area in report.areas if area.starts.silent]
    wrong = [(area, f"{n}", Reason(f"{area}: {n} starts without a guess are silently wrong")) for area, n in silent]
    yield _none("Starts that are silently wrong", wrong, whole.silent, is_tried=whole.found_of_all.tries > 0)
    frames = sum(drive.frames for drive in drives)
    hits = sum(drive.localised_share * drive.frames for drive in drives)
    shares = [(-drive.localised_share, drive.name, f"{100 * drive.localised_share:.1f} %") for drive in drives]
    words = [Reason(f"{text} of drive {name} is localized") for share, name, text in shares if -share < least]
    localized = f"{100 * hits / max(1, frames):.1f} % of {frames}"
    yield Row("Frames localized while driving", localized, _worst(shares), f"at least {100 * least:g} %", words)
    for name, share in (("median", "median"), ("p99", "99 %")):
        known = _errors((drive.name, (drive.errors_mm or {}).get(name)) for drive in drives)
        error = max(known)[2] if known else "not known"
        yield Row(f"Error while driving, {share}, of the worst drive", error, _worst(known))
    silent = [(drive.name, drive.silent) for drive in drives if drive.silent]
    wrong = [(drive, f"{n}", Reason(f"{drive}: {n} silent failures while driving")) for drive, n in silent]
    # Against a drive's own replay nothing is silently wrong.
    is_tried = any(drive.errors_mm for drive in drives)
    yield _none("Silent failures while driving", wrong, sum(drive.silent for drive in drives), is_tried=is_tried)
    failures = [(drive.failures, drive.name, str(drive.failures)) for drive in drives]
    yield Row("Position failures while driving", str(sum(drive.failures for drive in drives)), _worst(failures))
    docks_mm = [off_mm for drive in drives for off_mm in drive.docks_mm]
    furthest = f"{max(docks_mm):.0f} mm, of {len(docks_mm)}" if docks_mm else "none"
    yield Row("Largest distance at a dock passed", furthest)


def _of_site(report: figures.Report, settings: GateSettings) -> Iterator[Row]:
    strays, one_way, doubted = list[Found](), list[Found](), list[Found]()
    for area in report.areas:
        if area.name != figures.UNKNOWN_PLACE and not area.places and not _is_below(area.frames, settings):
            words = f"{area.name} was driven through, and is not in the map"
            strays.append((area.name, "no place", Reason(words, f"{area.name}: survey it")))
        if area.missing:
            ways, counts = ", ".join(area.missing), missing_words(TileDirections((0, 0), area.seen, area.missing))
            words = f"{area.name} was surveyed in one direction only, nobody drove it facing {ways}"
            one_way.append((area.name, ways, Reason(words, f"{area.name}: drive it facing {ways} ({counts})")))
    yield _none("Areas driven through, and not in the map", strays)
    row = _none("Areas surveyed in one direction only", one_way)
    yield row._replace(limit="", reasons=None) if ONE_WAY in report.promises else row
    alike = [f"{one.area}: {one.frames} like {one.other}" for one in report.similar]
    yield Row(f"Areas that look alike, by {report.similar_of} frames", str(len(alike)), first_of(alike, 1))
    for rig in report.calibrations:
        for subject, words in rig.doubted.items():
            doubted.append((rig.rig, subject, Reason(f"the calibration {rig.rig} is in doubt: {subject}: {words}")))
    yield _none("Calibrations in doubt", doubted, is_tried=any(rig.judged for rig in report.calibrations))
    yield Row("Failures a robot-day that the fleet reported", report.fleet or "too little driving")


def _share(
    name: str,
    report: figures.Report,
    settings: GateSettings,
    of: Callable[[figures.AreaFigures], figures.Count],
    reason: Callable[[figures.AreaFigures], Reason],
) -> Row:
    """Return a share's row; of areas with few tries each, which judge none of them, all together may be below the limit.

    A share that is below, as chance may have it, is neither within its limit nor a reason.
    """
    count = sum(map(of, report.areas), figures.Count())
    areas = [area for area in report.areas if area.name != figures.UNKNOWN_PLACE and of(area).tries]
    reasons = [reason(area) for area in areas if _is_below(of(area), settings)]
    if not reasons and _is_below(count, settings):
        reasons = [Reason(f"{name}: only {count.text}", "all areas: survey them")]
    low, high, least = count.share.low, count.share.high, settings.min_localised_share
    between = "" if low is None or high is None else f" ({100 * low:.0f} to {100 * high:.0f} % with 95 %)"
    parts = [(-of(area).hits / of(area).tries, area.name, of(area).text) for area in areas]
    is_met = count.tries > 0 and count.hits >= least * count.tries
    judged_by = reasons if reasons or is_met else None
    return Row(name, count.text + between, _worst(parts), f"at least {100 * least:g} %", judged_by)


def _none(name: str, found: Sequence[Found], number: int | None = None, *, is_tried: bool = True) -> Row:
    """Return the row of what must not be. number: default that of the places where it was found."""
    named = first_of([f"{where}: {words}" for where, words, _ in found], 1)
    reasons = [reason for _, _, reason in found] if found or is_tried else None
    return Row(name, str(len(found) if number is None else number), named, "none", reasons)


def _is_below(count: figures.Count, settings: GateSettings) -> bool:
    high = count.share.high
    return high is not None and high < settings.min_localised_share


def _errors(named_mm: Iterable[tuple[str, float | None]]) -> list[Part]:
    return [(error_mm, name, f"{error_mm:.1f} mm") for name, error_mm in named_mm if error_mm is not None]


def _mm(values: Sequence[float], name: str) -> str:
    """Return a quantile as text, or that there are too few values for it."""
    found, least = figures.quantile(values, figures.QUANTILES[name]), figures.fewest(figures.QUANTILES[name])
    return f"too few: {len(values)} of {least}" if found is None else f"{found:.1f} mm"


def _worst(parts: Sequence[Part]) -> str:
    """Return the worst part as text; empty if all are alike."""
    worst = max(parts, default=(0.0, "", ""))
    return f"{worst[1]}: {worst[2]}" if any(part[0] < worst[0] for part in parts) else ""


def _not_judged(report: figures.Report) -> Iterator[str]:
    hours = sum(drive.hours for drive in report.drives)
    for drive in report.drives:
        if drive.is_surveyed:
            yield f"{drive.name} is a recording of the map: another day, with other stock and light, was not judged by it"
        if drive.reference == "its own replay":
            yield f"{drive.name} has no ground truth in the map's frame: its errors are against its own replay; docks alone judge them"
        if not drive.docks_mm:
            yield f"{drive.name} passed no dock: nothing beside the map judges its position"
    for area in report.areas:
        if area.name == figures.UNKNOWN_PLACE:
            yield f"{area.starts.found_of_all.tries} starts were at a place that is not known"
        elif area.places and not area.frames.tries:
            yield f"{area.name}: no drive was there"
    for rig in report.calibrations:
        for subject, missing in rig.unknown().items():
            yield f"{subject} of calibration {rig.rig}: {missing}"
    if hours < _QUIET_H:
        quiet = f"{_QUIET_H:g} h without one show that there is at most one a robot-day"
        yield f"the rate of incidents, by {hours:.2f} h of driving: {quiet}"


def compared(report: figures.Report, before: figures.Report) -> figures.Report:
    """Return the report with what is better and worse than before, beyond chance: Fisher's exact test of counts, Mann and Whitney's test
    of errors, both at a level of 5 % for all comparisons together (Bonferroni)."""
    then = {area.name: area for area in before.areas} | {figures.ALL: before.whole}
    pairs = [(area, then[area.name]) for area in (report.whole, *report.areas) if area.name in then]
    tests = [(words, p, is_better) for now, old in pairs for words, p, is_better in _tests(now, old)]
    sure = [(words, is_better) for words, p, is_better in tests if p * len(tests) < _LEVEL]
    better, worse = [w for w, good in sure if good], [w for w, good in sure if not good]
    for now, old in pairs[1:]:
        gone, new = sorted({*old.missing} - {*now.missing}), sorted({*now.missing} - {*old.missing})
        better += [f"{now.name}: surveyed facing {', '.join(gone)}"] if gone else []
        worse += [f"{now.name}: no longer surveyed facing {', '.join(new)}"] if new else []
    names = {area.name for area in report.areas}
    worse += [f"{old.name}: no longer in the map" for old in before.areas if old.places and old.name not in names]
    better += [f"{now.name}: new in the map" for now in report.areas if now.places and now.name not in then]
    worse += [f"new reason: {reason}" for reason in report.reasons if reason not in before.reasons]
    better += [f"no longer: {reason}" for reason in before.reasons if reason not in report.reasons]
    name = f"version {before.version} of {before.site}"
    return msgspec.structs.replace(report, compared_with=name, better=better, worse=worse)


def _tests(now: figures.AreaFigures, old: figures.AreaFigures) -> Iterator[tuple[str, float, bool]]:
    """Yield each figure of an area as text with the probability that chance changed it as much, and if it is better now."""
    counts = {"frames localized": (now.frames, old.frames)}
    counts["starts found"] = now.starts.found_of_all, old.starts.found_of_all
    for words, ladder, before in (
        ("{} stops less light", now.darkness, old.darkness),
        ("a blur of {} px", now.blur, old.blur),
    ):
        counts |= {f"frames localized with {words.format(n)}": (ladder[n], before[n]) for n in ladder if n in before}
    for name, (mine, other) in counts.items():
        if mine.tries and other.tries:
            table = np.array([[count.hits, count.tries - count.hits] for count in (mine, other)])
            p = float(scipy.stats.fisher_exact(table).pvalue)
            is_better = mine.hits * other.tries > other.hits * mine.tries
            yield f"{now.name}: {mine.text} {name}, {other.text} before", p, is_better
    medians = figures.quantile(now.errors_mm, 0.5), figures.quantile(old.errors_mm, 0.5)
    if medians[0] is not None and medians[1] is not None:
        p = float(scipy.stats.mannwhitneyu(now.errors_mm, old.errors_mm).pvalue)
        yield f"{now.name}: median error {medians[0]:.1f} mm, {medians[1]:.1f} mm before", p, medians[0] < medians[1]
