"""Gate before publishing: reasons against a draft, by itself and beside the version that robots use now. Pure."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, NamedTuple

import msgspec

from fleetmap.config import Section
from fleetmap.encoding import to_plain
from fleetmap.mapformat import Manifest
from mapserver.quality.figures import Aliasing, Compared, Evidence, trusted_calibrations

_JOINED = "joined"  # the verdict of survey.merge.membership on a recording that belongs to the site
Share = Annotated[float, msgspec.Meta(ge=0)]


class GateSettings(Section, frozen=True):
    """What a draft must be able to do, and how far it may fall behind the current version before a person must look at it."""

    min_landmarks_share: Share = 0.7
    min_coverage_share: Share = 0.8
    max_bytes_share: Share = 3.0
    min_frames: int = 12
    min_localised_share: Share = 0.5
    margin_localised_share: Share = 0.1
    max_wrong_share: Share = 0.05
    max_median_error_m: Share = 0.1
    margin_error_m: Share = 0.03
    max_residual_px: Share = 3.0
    min_inliers_share: Share = 0.8
    max_aliased_share: Share = 0.1
    max_breaks: int = 1


@dataclass(frozen=True, slots=True)
class GateVerdict:
    """The gate's answer. reasons: against publishing, none if accepted; hard ones stand even against --force.

    unjudged: the reasons that a person's trust in the calibration takes away.
    report: the figures that were looked at, and under `not_judged` those for which evidence is missing.
    """

    reasons: tuple[str, ...]
    hard_reasons: tuple[str, ...]
    report: dict[str, Any]
    unjudged: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether there is no reason against the draft."""
        return not self.reasons and not self.hard_reasons


def judge(
    draft: Manifest,
    current: Manifest | None,
    settings: GateSettings,
    evidence: Evidence | None = None,
) -> GateVerdict:
    """The verdict on a draft; `current` is None for a site's first version, `evidence` for a draft that nobody examined.

    What cannot be judged, for want of frames or of a version to compare with, is named and refuses nothing; but for the calibration of a
    site's first version, whose metres all later ones keep: nobody trusts that before a recording has judged it, or a person says so.
    """
    report: dict[str, Any] = {"landmarks": draft.landmarks, "tiles": len(draft.tiles), "tile_bytes": draft.tile_bytes}
    examined = evidence or Evidence()
    found = _Findings([], [] if "joins" in draft.report else ["joining"], [])
    for name, compared in (
        ("held_out_frames", examined.held_out),
        ("yesterdays_recordings", examined.replayed),
        ("last_versions_places", examined.last_version),
    ):
        _compare(name, compared, settings, found)
    _judge_aliasing(examined.aliasing, examined.aliasing_before, settings, found)
    _judge_calibrations(draft, examined, found, is_first=current is None)
    if examined.motion is None:
        found.not_judged.append("motion")
    elif examined.motion.breaks > settings.max_breaks:
        found.reasons.append(
            f"its trajectory is torn in {examined.motion.breaks} places, by up to {examined.motion.worst_m:.2f} m against "
            f"odometry; max_breaks is {settings.max_breaks}"
        )
    if current is None:
        found.not_judged.append("size_against_last_version")
    else:
        shares = _shares(draft, current)
        report |= {"compared_with": current.version, **shares}
        found.reasons.extend(_size_reasons(shares, current.version, settings))
    report |= {"evidence": to_plain(examined), "not_judged": found.not_judged}
    return GateVerdict(tuple(found.reasons), _hard_reasons(draft), report, tuple(found.unjudged))


@dataclass(frozen=True, slots=True)
class _Findings:
    """Reasons against a draft so far, what could not be judged, and which of the reasons are about that."""

    reasons: list[str]
    not_judged: list[str]
    unjudged: list[str]


class _Bound(StrEnum):
    """A limit's kind, as the word for a figure that breaks it."""

    MIN = "below"
    MAX = "above"

    def is_broken(self, value: float, limit: float) -> bool:
        """Whether the value lies on the wrong side; the limit itself is allowed."""
        return value < limit if self is _Bound.MIN else value > limit


class _Check(NamedTuple):
    """A figure, None where unknown, and its limit with the name that people read."""

    figure: str
    value: float | None
    bound: _Bound
    limit: float
    limit_name: str
    relative_to: str = ""


def _compare(name: str, compared: Compared | None, settings: GateSettings, found: _Findings) -> None:
    """The reasons of one kind of frames."""
    if compared is None or compared.draft.frames < settings.min_frames:
        found.not_judged.append(name)
        return
    for check in _checks(compared, settings):
        if check.value is not None and check.bound.is_broken(check.value, check.limit):
            words = f"{check.relative_to}{check.bound} {check.limit_name} ({check.limit:.3f})"
            over = f"over {compared.draft.frames} frames"
            found.reasons.append(f"{name}: {check.figure} {check.value:.3f} is {words}, {over}")


def _checks(compared: Compared, settings: GateSettings) -> list[_Check]:
    draft, before = compared.draft, compared.before
    absolute = (
        ("localised_share", _Bound.MIN, "min_localised_share"),
        ("wrong_share", _Bound.MAX, "max_wrong_share"),
        ("median_error_m", _Bound.MAX, "max_median_error_m"),
        ("residual_px", _Bound.MAX, "max_residual_px"),
    )
    checks = [_Check(name, getattr(draft, name), kind, getattr(settings, key), key) for name, kind, key in absolute]
    if before is None:
        return checks
    least = before.localised_share - settings.margin_localised_share
    limit_name = "the current version's less its margin"
    checks.append(_Check("localised_share", draft.localised_share, _Bound.MIN, least, limit_name))
    if before.median_error_m is not None:
        most, limit_name = before.median_error_m + settings.margin_error_m, "the current version's and its margin"
        checks.append(_Check("median_error_m", draft.median_error_m, _Bound.MAX, most, limit_name))
    limit = (_Bound.MIN, settings.min_inliers_share, "min_inliers_share")
    return [*checks, _Check("inliers_share", compared.inliers_share, *limit, relative_to="of the current version ")]


def _judge_aliasing(
    aliasing: Aliasing | None, before: Aliasing | None, settings: GateSettings, found: _Findings
) -> None:
    if aliasing is None or aliasing.offered < settings.min_frames:
        found.not_judged.append("aliasing_probes")
        return
    usual = 0.0 if before is None else before.accepted_share
    if aliasing.accepted_share > max(settings.max_aliased_share, usual):
        found.reasons.append(
            f"aliasing_probes: {aliasing.accepted_share:.3f} of {aliasing.offered} frames are taken for another place that looks "
            f"like theirs, max_aliased_share is {settings.max_aliased_share:g}; if the site really looks alike there, raise it"
        )


def _judge_calibrations(draft: Manifest, examined: Evidence, found: _Findings, *, is_first: bool) -> None:
    """Doubts are for a person. So is what nothing judged of a site's first map, with which later ones are compared."""
    if examined.calibrations is None:
        found.not_judged.append("calibration")
        return
    trusted = {choice.rig: choice for choice in trusted_calibrations(draft)}
    for rig in examined.calibrations:
        found.reasons.extend([f"calibration {rig.rig}: {subject}: {words}" for subject, words in rig.doubted.items()])
        choice = trusted.get(rig.rig)
        for subject, missing in rig.unknown().items():
            words = f"{subject} of calibration {rig.rig}: {missing}"
            if choice is not None:
                found.not_judged.append(f"{words} ({choice.actor} trusts it: {choice.reason})")
            elif is_first:
                found.unjudged.append(f"nothing judged the {words}")
            else:
                found.not_judged.append(words)
    found.reasons.extend(found.unjudged)


def _size_reasons(shares: dict[str, float], version: int, settings: GateSettings) -> list[str]:
    limits = (
        ("landmarks_share", _Bound.MIN, settings.min_landmarks_share),
        ("coverage_share", _Bound.MIN, settings.min_coverage_share),
        ("bytes_share", _Bound.MAX, settings.max_bytes_share),
    )
    return [
        f"{name} {shares[name]:.2f} of version {version} is {bound} {limit:g}"
        for name, bound, limit in limits
        if bound.is_broken(shares[name], limit)
    ]


def _hard_reasons(draft: Manifest) -> tuple[str, ...]:
    reasons = []
    if not draft.tiles or draft.landmarks == 0:
        reasons.append(
            f"it has {len(draft.tiles)} tiles and {draft.landmarks} landmarks: no robot could localise in it; look at "
            "the build's report and at `mapserver doctor` for its recordings"
        )
    joins = draft.report.get("joins")  # drafts of older servers do not say
    verdicts = {} if joins is None else {entry.name: joins.get(entry.name, "none") for entry in draft.recordings}
    reasons += [
        f"it holds recording {name}, whose join verdict is {verdict!r}: it is not shown to belong to the site; build without it"
        for name, verdict in verdicts.items()
        if verdict != _JOINED
    ]
    if draft.report.get("scale") == "unknown":
        reasons.append(
            "it has a scale of its own: one camera without IMU saw no dock or tag that could tell the metres; record with an IMU, a "
            "second camera, or past two docks"
        )
    return tuple(reasons)


def _shares(draft: Manifest, current: Manifest) -> dict[str, float]:
    """A tile is covered where it has at least half as many landmarks as before."""
    before = {(tile.x, tile.y): tile.landmarks for tile in current.tiles if tile.landmarks}
    after = {(tile.x, tile.y): tile.landmarks for tile in draft.tiles}
    covered = sum(count for cell, count in before.items() if 2 * after.get(cell, 0) >= count)
    return {
        "landmarks_share": round(draft.landmarks / max(1, current.landmarks), 4),
        "coverage_share": round(covered / max(1, sum(before.values())), 4),
        "bytes_share": round(draft.tile_bytes / max(1, current.tile_bytes), 4),
    }
