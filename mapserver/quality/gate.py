"""Gate before publishing: reasons against a draft, by itself and compared with the robots' present version. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from fleetmap.config import Section
from fleetmap.encoding import to_plain
from fleetmap.failure_definition import ERROR_LIMIT_M
from fleetmap.mapformat.manifest import Manifest
from mapserver.quality import figures
from mapserver.quality.figures import Aliasing, Comparison, Displacement, Evidence, TrajectoryBreaks

CHECKS = {
    "joining": "recordings that belong to the site",
    "held_out_frames": "frames that the build left out",
    "yesterdays_recordings": "earlier recordings",
    "last_versions_places": "places of the version before",
    "version_before": "recordings where the version before has them",
    "ground_truth": "error against ground truth",
    "aliasing_probes": "places that look alike",
    "calibration": "calibration",
    "motion": "trajectory in one piece",
    "size_against_last_version": "size against the current version",
}
"""Words for the names in a report's `passed` and `not_judged`."""

_JOINED = "joined"  # the verdict of survey.merge.membership on a recording that belongs to the site
Share = Annotated[float, msgspec.Meta(ge=0)]


class GateSettings(Section, frozen=True):
    """Requirements on a draft, and the allowed loss against the current version before an operator must check it."""

    min_landmarks_share: Share = 0.7
    min_coverage_share: Share = 0.8
    max_bytes_share: Share = 3.0
    min_frames: int = 12
    min_localised_share: Share = 0.5
    margin_localised_share: Share = 0.1
    max_wrong_share: Share = 0.05
    max_median_error_m: Share = 0.1
    max_truth_error_m: Share = ERROR_LIMIT_M
    margin_error_m: Share = 0.03
    max_residual_px: Share = 3.0
    min_inliers_share: Share = 0.8
    max_aliased_share: Share = 0.1
    max_breaks: int = 1


@dataclass(frozen=True, slots=True)
class GateVerdict:
    """Result of the gate. reasons: against publishing, empty if accepted; hard ones stand even against --force.

    unjudged: the reasons removed by trust in the calibration. report: the checked figures; under `passed` the names of the
    checks without a reason against the draft, under `not_judged` those without evidence; `unjudged`, too; under `warnings` the
    surveyed views without a fix, which refuse nothing.
    """

    reasons: tuple[str, ...]
    hard_reasons: tuple[str, ...]
    report: dict[str, Any]
    unjudged: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """True if there is no reason against the draft."""
        return not self.reasons and not self.hard_reasons


def judge(
    draft: Manifest, current: Manifest | None, settings: GateSettings, evidence: Evidence | None = None
) -> GateVerdict:
    """Return the verdict on a draft; `current` is None for a site's first version, `evidence` for a draft without examination.

    Figures without frames or without a version to compare with are listed as not judged and refuse nothing, except the calibration of a
    site's first version, which sets the scale of all later ones: it needs a recording that judges it, or an operator's confirmation.
    """
    report: dict[str, Any] = {"landmarks": draft.landmarks, "tiles": len(draft.tiles), "tile_bytes": draft.tile_bytes}
    examined, strangers, shares = evidence or Evidence(), _strangers(draft), _shares(draft, current)
    if current is not None:
        report |= {"compared_with": current.version, **shares}
    doubts, unjudged, unknown = _calibration_reasons(draft, examined, is_first=current is None)
    checked = {  # reasons by what was judged; None for what was not
        "held_out_frames": _frame_reasons("held_out_frames", examined.held_out, settings),
        "yesterdays_recordings": _frame_reasons("yesterdays_recordings", examined.replayed, settings),
        "last_versions_places": _frame_reasons("last_versions_places", examined.last_version, settings),
        "version_before": _displaced_reasons(draft, current, examined.displaced, settings),
        "ground_truth": _truth_reasons(draft.report.get("ate_rmse_m"), settings),
        "aliasing_probes": _aliasing_reasons(examined.aliasing, examined.aliasing_before, settings),
        "calibration": None if unknown and not (doubts or unjudged) else [*doubts, *unjudged],
        "motion": _motion_reasons(examined.motion, settings),
        "size_against_last_version": None if current is None else _size_reasons(shares, current.version, settings),
    }
    judged = {"joining": strangers} | checked
    if examined.views is not None and examined.views.warning:
        report["warnings"] = [examined.views.warning]
    report["evidence"] = to_plain(examined)
    report["passed"] = [name for name, reasons in judged.items() if reasons == []]
    lacking = {name: [name] if reasons is None else [] for name, reasons in judged.items()} | {"calibration": unknown}
    report |= {"not_judged": [words for lacks in lacking.values() for words in lacks], "unjudged": unjudged}
    reasons = tuple(words for found in checked.values() for words in found or ())
    return GateVerdict(reasons, _hard_reasons(draft, strangers), report, tuple(unjudged))


def _displaced_reasons(
    draft: Manifest, current: Manifest | None, recordings: Sequence[Displacement] | None, settings: GateSettings
) -> list[str] | None:
    if recordings is None or current is None:
        return None
    found = [
        f"{one.elsewhere} of {one.frames} frames of {one.recording} agree in that version on a place {one.off_m:.2f} m from the draft's; "
        "build without it"
        for one in recordings
        if one.elsewhere > settings.max_wrong_share * one.frames
    ]
    if draft.parent != current.version:
        found.insert(0, f"compared with version {draft.parent}, and {current.version} is current; build it again")
    return [f"{CHECKS['version_before']}: {words}" for words in found]


def _truth_reasons(error_m: object, settings: GateSettings) -> list[str] | None:
    if not isinstance(error_m, int | float):
        return None
    over = f"{CHECKS['ground_truth']}: {error_m:.3f} m are above the limit ({settings.max_truth_error_m:g})"
    return [over] if error_m > settings.max_truth_error_m else []


def _motion_reasons(motion: TrajectoryBreaks | None, settings: GateSettings) -> list[str] | None:
    if motion is None:
        return None
    torn = f"its trajectory is torn in {motion.breaks} places, by up to {motion.worst_m:.2f} m against odometry; the limit is"
    return [f"{torn} {settings.max_breaks}"] if motion.breaks > settings.max_breaks else []


def _frame_reasons(name: str, compared: Comparison | None, settings: GateSettings) -> list[str] | None:
    """Return reasons from one kind of frames: figures on the wrong side of their limit; the limit itself is allowed."""
    if compared is None or compared.draft.frames < settings.min_frames:
        return None
    draft, before = compared.draft, compared.before
    localised, error = "share of localised frames", "median error in metres"
    least = [(localised, draft.localised_share, settings.min_localised_share, "the limit")]
    most = [
        ("share of frames in a wrong place", draft.wrong_share, settings.max_wrong_share, "the limit"),
        (error, draft.median_error_m, settings.max_median_error_m, "the limit"),
        ("residual in pixels", draft.residual_px, settings.max_residual_px, "the limit"),
    ]
    if before is not None:
        limit = before.localised_share - settings.margin_localised_share
        least.append((localised, draft.localised_share, limit, "the current version's less its margin"))
        if before.median_error_m is not None:
            limit = before.median_error_m + settings.margin_error_m
            most.append((error, draft.median_error_m, limit, "the current version's and its margin"))
    found = [
        f"{figure}, {value:.3f}, is {word} {whose} ({limit:.3f})"
        for sign, word, checks in ((-1, "below", least), (1, "above", most))
        for figure, value, limit, whose in checks
        if value is not None and sign * (value - limit) > 0
    ]
    share, limit = compared.inliers_share, settings.min_inliers_share
    if before is not None and share is not None and share < limit:
        found.append(f"matches per frame, {share:.3f} of the current version's, are below the limit ({limit:.3f})")
    return [f"{CHECKS[name]}: {words}, over {draft.frames} frames" for words in found]


def _aliasing_reasons(aliasing: Aliasing | None, before: Aliasing | None, settings: GateSettings) -> list[str] | None:
    if aliasing is None or aliasing.offered < settings.min_frames:
        return None
    usual = 0.0 if before is None else before.accepted_share
    if aliasing.accepted_share <= max(settings.max_aliased_share, usual):
        return []
    return [
        f"{CHECKS['aliasing_probes']}: {aliasing.accepted_share:.3f} of {aliasing.offered} frames are localised at another, "
        f"similar place, the limit is {settings.max_aliased_share:g}; if the site really looks alike there, raise it"
    ]


def _calibration_reasons(
    draft: Manifest, examined: Evidence, *, is_first: bool
) -> tuple[list[str], list[str], list[str]]:
    """Return doubts, for an operator; parts of a first map never judged, the reference of later ones; other unknown parts."""
    if examined.calibrations is None:
        return [], [], ["calibration"]
    trusted = {choice.rig: choice for choice in figures.trusted_calibrations(draft)}
    doubts, unjudged, unknown = list[str](), list[str](), list[str]()
    for rig in examined.calibrations:
        doubts += [f"calibration {rig.rig}: {subject}: {words}" for subject, words in rig.doubted.items()]
        choice = trusted.get(rig.rig)
        for subject, missing in rig.unknown().items():
            words = f"{subject} of calibration {rig.rig}: {missing}"
            if choice is not None:
                unknown.append(f"{words} ({choice.actor} trusts it: {choice.reason})")
            elif is_first:
                unjudged.append(f"nothing judged the {words}")
            else:
                unknown.append(words)
    return doubts, unjudged, unknown


def _shares(draft: Manifest, current: Manifest | None) -> dict[str, float]:
    """Return by tile its landmarks against before: a tile is covered with at least half as many. Empty for a first version.

    Those that corrections took from the draft, as its report says, do not count.
    """
    if current is None:
        return {}
    found = draft.report.get("removed_landmarks") if draft.parent == current.version else None
    removed = found if isinstance(found, dict) else {}
    before = {(tile.x, tile.y): tile.landmarks - removed.get(f"{tile.x},{tile.y}", 0) for tile in current.tiles}
    after = {(tile.x, tile.y): tile.landmarks for tile in draft.tiles}
    covered = sum(count for cell, count in before.items() if 2 * after.get(cell, 0) >= count)
    return {
        "landmarks_share": round(draft.landmarks / max(1, sum(before.values())), 4),
        "coverage_share": round(covered / max(1, sum(before.values())), 4),
        "bytes_share": round(draft.tile_bytes / max(1, current.tile_bytes), 4),
    }


def _size_reasons(shares: dict[str, float], version: int, settings: GateSettings) -> list[str]:
    return [
        f"{words} is {shares[name]:.2f} of version {version}'s, {side} the limit of {limit:g}"
        for sign, side, name, words, limit in (
            (-1, "below", "landmarks_share", "the number of landmarks", settings.min_landmarks_share),
            (-1, "below", "coverage_share", "the covered area", settings.min_coverage_share),
            (1, "above", "bytes_share", "the size in bytes", settings.max_bytes_share),
        )
        if sign * (shares[name] - limit) > 0
    ]


def _strangers(draft: Manifest) -> list[str] | None:
    """Reasons against recordings that are not shown to belong to the site; None for drafts of older servers, which do not say."""
    joins = draft.report.get("joins")
    if joins is None:
        return None
    verdicts = {entry.name: joins.get(entry.name, "none") for entry in draft.recordings}
    return [
        f"it holds recording {name}, whose join verdict is {verdict!r}: it is not shown to belong to the site; build without it"
        for name, verdict in verdicts.items()
        if verdict != _JOINED
    ]


def _hard_reasons(draft: Manifest, strangers: list[str] | None) -> tuple[str, ...]:
    reasons = []
    if not draft.tiles or draft.landmarks == 0:
        reasons.append(
            f"it has {len(draft.tiles)} tiles and {draft.landmarks} landmarks: no robot could localise in it; see "
            "the build's report and `mapserver doctor` for its recordings"
        )
    reasons += strangers or ()
    if draft.report.get("scale") == "unknown":
        reasons.append(
            "it has a scale of its own: one camera without IMU saw no dock or tag that gives the scale; record with an IMU, a "
            "second camera, or past two docks"
        )
    return tuple(reasons)
