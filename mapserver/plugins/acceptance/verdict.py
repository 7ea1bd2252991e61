"""Verdict on a site, the list to survey again, and the comparison with an earlier report, from the figures of a report. Pure."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from mapserver.plugins.acceptance.figures import ALL, UNKNOWN_PLACE, AreaFigures, Count, Report, percentile
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


def judged(report: Report, settings: GateSettings, evidence: Evidence | None, fleet: Sequence[str]) -> Report:
    """Return the report with verdict, reasons, what was not judged and what to survey again.

    A share counts against a limit if its 95 % interval lies below it. evidence: of the version's build. fleet: tiles that the robots'
    failures put on the list, as text.
    """
    found = [*_of_areas(report, settings), *_of_site(report, settings)]
    reasons, again = [reason.words for reason in found], [reason.again for reason in found if reason.again]
    if evidence is not None and evidence.views is not None and evidence.views.warning:
        again.append(evidence.views.warning)
    whole, sentence = report.whole, f"{report.site}, version {report.version}"
    if reasons:
        verdict = f"NOT ACCEPTED: {sentence}: {first_of(reasons)}."
    else:
        median, p99 = percentile(whole.errors_mm, 50), percentile(whole.errors_mm, 99)
        promised = f", if {' and '.join(report.promises)}" if report.promises else ""
        verdict = (
            f"ACCEPTED{promised}: {sentence}: {whole.starts.found_of_all.text} starts without a guess found their place and none "
            f"was silently wrong, {whole.frames.text} frames are localized, median error {median:.0f} mm, p99 {p99:.0f} mm."
        )
    return msgspec.structs.replace(
        report,
        verdict=verdict,
        is_accepted=not reasons,
        reasons=reasons,
        survey_again=list(dict.fromkeys([*again, *fleet])),
        not_judged=list(_not_judged(report)),
    )


def _of_areas(report: Report, settings: GateSettings) -> Iterator[Reason]:
    for area in report.areas:
        if area.starts.silent:
            yield Reason(f"{area.name}: {area.starts.silent} starts without a guess are silently wrong")
        if area.name == UNKNOWN_PLACE:
            continue
        dark = report.darkest_grey is not None and area.grey is not None and area.grey <= report.darkest_grey
        if _is_below(area.frames, settings):
            why = f"too dark (grey level {area.grey:.0f} of 255)" if dark else "not localized"
            light = " with more light" if dark else ""
            yield Reason(f"{area.name} is {why}: {area.frames.text} frames get a fix", f"{area.name}: survey it{light}")
        elif _is_below(area.darkness.get("1", Count()), settings):
            half = f"with half its light {area.darkness['1'].text} frames get a fix"
            yield Reason(f"{area.name} is nearly too dark: {half}", f"{area.name}: survey it with more light")
        if not area.places and not _is_below(area.frames, settings):
            yield Reason(f"{area.name} was driven through, and is not in the map", f"{area.name}: survey it")
        if area.missing and ONE_WAY not in report.promises:
            ways = ", ".join(area.missing)
            words = missing_words(TileDirections((0, 0), area.seen, area.missing))
            one_way = f"{area.name} was surveyed in one direction only, nobody drove it facing {ways}"
            yield Reason(one_way, f"{area.name}: drive it facing {ways} ({words})")
        starts = area.starts.found_of_all
        if KNOWN_STARTS not in report.promises and _is_below(starts, settings):
            alike = ", ".join([alike.other for alike in report.similar if alike.area == area.name][:_NAMED])
            if area.starts.ambiguous > area.starts.lost:
                stay = f"{area.starts.ambiguous} of {starts.tries} starts stay AMBIGUOUS"
                yield Reason(f"{area.name} looks like {alike or 'another place'}: {stay}")
            else:
                stay = f"{area.starts.lost} of {starts.tries} starts without a guess stay lost"
                yield Reason(f"{area.name}: {stay}", f"{area.name}: survey it")


def _of_site(report: Report, settings: GateSettings) -> Iterator[Reason]:
    whole = report.whole
    median = percentile(whole.errors_mm, 50)
    if silent := sum(drive.silent for drive in report.drives):
        yield Reason(f"{silent} silent failures while driving")
    # Of areas with few tries each, which judge none of them, all together may be below.
    if _is_below(whole.frames, settings) and not any(_is_below(area.frames, settings) for area in report.areas):
        yield Reason(f"only {whole.frames.text} frames get a fix", "all areas: survey them")
    if KNOWN_STARTS not in report.promises:
        starts = whole.starts.found_of_all
        if not starts.tries:
            yield Reason("no start without a guess was tried: record a longer drive")
        elif _is_below(starts, settings) and not any(_is_below(a.starts.found_of_all, settings) for a in report.areas):
            yield Reason(f"only {starts.text} starts without a guess found their place", "all areas: survey them")
    if whole.frames.tries and whole.wrong / whole.frames.tries > settings.max_wrong_share:
        yield Reason(f"{whole.wrong} of {whole.frames.tries} frames are localized at a wrong place")
    if median is not None and median > 1e3 * settings.max_median_error_m:
        yield Reason(f"the median error is {median:.0f} mm, the limit is {1e3 * settings.max_median_error_m:.0f} mm")
    for drive in report.drives:
        if drive.localised_share < settings.min_localised_share:
            yield Reason(f"{100 * drive.localised_share:.0f} % of drive {drive.name} is localized")
    for rig in report.calibrations:
        for subject, words in rig.doubted.items():
            yield Reason(f"the calibration {rig.rig} is in doubt: {subject}: {words}")
    if whole.frames.tries < settings.min_frames:
        needed = f"{settings.min_frames} are needed: record a longer drive"
        yield Reason(f"only {whole.frames.tries} frames at a known place judge it, {needed}")


def _is_below(count: Count, settings: GateSettings) -> bool:
    high = count.share.high
    return high is not None and high < settings.min_localised_share


def _not_judged(report: Report) -> Iterator[str]:
    hours = sum(drive.hours for drive in report.drives)
    for drive in report.drives:
        if drive.is_surveyed:
            yield f"{drive.name} is a recording of the map: another day, with other stock and light, was not judged by it"
        if drive.reference == "its own replay":
            yield f"{drive.name} has no ground truth in the map's frame: its errors are against its own replay; docks alone judge them"
        if not drive.docks_mm:
            yield f"{drive.name} passed no dock: nothing beside the map judges its position"
    for area in report.areas:
        if area.name == UNKNOWN_PLACE:
            yield f"{area.starts.found_of_all.tries} starts were at a place that is not known"
        elif area.places and not area.frames.tries:
            yield f"{area.name}: no drive was there"
    for rig in report.calibrations:
        for subject, missing in rig.unknown().items():
            yield f"{subject} of calibration {rig.rig}: {missing}"
    if hours < _QUIET_H:
        quiet = f"{_QUIET_H:g} h without one show that there is at most one a robot-day"
        yield f"the rate of incidents, by {hours:.2f} h of driving: {quiet}"


def compared(report: Report, before: Report) -> Report:
    """Return the report with what is better and worse than before, beyond chance: Fisher's exact test of counts, Mann and Whitney's test
    of errors, both at a level of 5 % for all comparisons together (Bonferroni)."""
    then = {area.name: area for area in before.areas} | {ALL: before.whole}
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


def _tests(now: AreaFigures, old: AreaFigures) -> Iterator[tuple[str, float, bool]]:
    """Yield each figure of an area as text with the probability that chance changed it as much, and if it is better now."""
    counts = {"frames localized": (now.frames, old.frames)}
    counts["starts found"] = now.starts.found_of_all, old.starts.found_of_all
    counts |= {f"frames localized with {n} stops less light": pair for n, pair in _both(now.darkness, old.darkness)}
    counts |= {f"frames localized with a blur of {n} px": pair for n, pair in _both(now.blur, old.blur)}
    for name, (mine, other) in counts.items():
        if mine.tries and other.tries:
            table = np.array([[count.hits, count.tries - count.hits] for count in (mine, other)])
            p = float(scipy.stats.fisher_exact(table).pvalue)
            is_better = mine.hits * other.tries > other.hits * mine.tries
            yield f"{now.name}: {mine.text} {name}, {other.text} before", p, is_better
    medians = percentile(now.errors_mm, 50), percentile(old.errors_mm, 50)
    if medians[0] is not None and medians[1] is not None:
        p = float(scipy.stats.mannwhitneyu(now.errors_mm, old.errors_mm).pvalue)
        yield f"{now.name}: median error {medians[0]:.1f} mm, {medians[1]:.1f} mm before", p, medians[0] < medians[1]


def _both(now: Mapping[str, Count], old: Mapping[str, Count]) -> list[tuple[str, tuple[Count, Count]]]:
    return [(level, (count, old[level])) for level, count in now.items() if level in old]
