"""The gate before publishing: what speaks against a draft, compared with the version that robots use now. Pure."""

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from fleetmap.config import Section
from fleetmap.mapformat import Manifest
from mapserver.quality.figures import Aliasing, Compared, Evidence

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
    """What the gate says. reasons: against publishing, none if accepted; hard ones stand even against --force.

    report: the figures that were looked at, and under `not_judged` those for which evidence is missing.
    """

    reasons: tuple[str, ...]
    hard_reasons: tuple[str, ...]
    report: dict[str, Any]

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against the draft."""
        return not self.reasons and not self.hard_reasons


def judge(
    draft: Manifest, current: Manifest | None, site_vocabulary: str | None, settings: GateSettings,
    evidence: Evidence | None = None,
) -> GateVerdict:  # fmt: skip
    """The verdict on a draft; `current` is None for a site's first version, `evidence` for a draft that nobody examined.

    What cannot be judged, for want of frames or of a version to compare with, is named and refuses nothing.
    """
    report: dict[str, Any] = {"landmarks": draft.landmarks, "tiles": len(draft.tiles), "tile_bytes": draft.tile_bytes}
    examined = evidence or Evidence()
    found = _Findings([], [])
    for name, compared in (
        ("held_out_frames", examined.held_out),
        ("yesterdays_recordings", examined.replayed),
        ("last_versions_places", examined.last_version),
    ):
        _compare(name, compared, settings, found)
    _judge_aliasing(examined.aliasing, examined.aliasing_before, settings, found)
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
    report |= {"evidence": msgspec.to_builtins(examined), "not_judged": found.not_judged}
    return GateVerdict(tuple(found.reasons), _hard_reasons(draft, site_vocabulary), report)


@dataclass(frozen=True, slots=True)
class _Findings:
    """What speaks against a draft so far, and what could not be judged."""

    reasons: list[str]
    not_judged: list[str]


def _compare(name: str, compared: Compared | None, settings: GateSettings, found: _Findings) -> None:
    """The reasons of one kind of frames."""
    if compared is None or compared.draft.frames < settings.min_frames:
        found.not_judged.append(name)
        return
    draft, before = compared.draft, compared.before
    checks = [
        ("localised_share", draft.localised_share, settings.min_localised_share, "below min_localised_share"),
        ("wrong_share", draft.wrong_share, settings.max_wrong_share, "above max_wrong_share"),
        ("median_error_m", draft.median_error_m, settings.max_median_error_m, "above max_median_error_m"),
        ("residual_px", draft.residual_px, settings.max_residual_px, "above max_residual_px"),
    ]
    if before is not None:
        least = before.localised_share - settings.margin_localised_share
        checks.append(("localised_share", draft.localised_share, least, "below the current version's less its margin"))
        if before.median_error_m is not None:
            most = before.median_error_m + settings.margin_error_m
            checks.append(("median_error_m", draft.median_error_m, most, "above the current version's and its margin"))
        shares = (compared.inliers_share, settings.min_inliers_share)
        checks.append(("inliers_share", *shares, "of the current version below min_inliers_share"))
    for figure, value, limit, words in checks:
        if value is not None and (value < limit if "below" in words else value > limit):
            found.reasons.append(f"{name}: {figure} {value:.3f} is {words} ({limit:.3f}), over {draft.frames} frames")


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


def _size_reasons(shares: dict[str, float], version: int, settings: GateSettings) -> list[str]:
    reasons = []
    for name, limit, is_low in (
        ("landmarks_share", settings.min_landmarks_share, True),
        ("coverage_share", settings.min_coverage_share, True),
        ("bytes_share", settings.max_bytes_share, False),
    ):
        share = shares[name]
        if share < limit if is_low else share > limit:
            word = "below" if is_low else "above"
            reasons.append(f"{name} {share:.2f} of version {version} is {word} {limit:g}")
    return reasons


def _hard_reasons(draft: Manifest, site_vocabulary: str | None) -> tuple[str, ...]:
    reasons = []
    if not draft.tiles or draft.landmarks == 0:
        reasons.append(
            f"it has {len(draft.tiles)} tiles and {draft.landmarks} landmarks: no robot could localise in it; look at "
            "the build's report and at `mapserver doctor` for its recordings"
        )
    if site_vocabulary is not None and site_vocabulary != draft.vocabulary.sha256:
        reasons.append(
            f"it uses vocabulary {draft.vocabulary.sha256}, site {draft.site} keeps {site_vocabulary}; build it again "
            "so that it takes the site's"
        )
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
