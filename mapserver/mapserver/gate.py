"""The gate before publishing: what speaks against a draft, compared with the version that robots use now. Pure."""

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from fleetmap.config import Section
from fleetmap.mapformat import Manifest

Share = Annotated[float, msgspec.Meta(ge=0)]


class GateSettings(Section, frozen=True):
    """How far a draft may differ from the current version before a person must look at it."""

    min_landmarks_share: Share = 0.5
    min_coverage_share: Share = 0.8
    max_bytes_share: Share = 3.0


@dataclass(frozen=True, slots=True)
class Verdict:
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


def judge(draft: Manifest, current: Manifest | None, site_vocabulary: str | None, settings: GateSettings) -> Verdict:
    """The verdict on a draft; `current` is None for a site's first version, where only hard limits refuse."""
    report: dict[str, Any] = {"landmarks": draft.landmarks, "tiles": len(draft.tiles), "tile_bytes": draft.tile_bytes}
    hard = _hard_reasons(draft, site_vocabulary)
    not_judged = ["held_out_frames", "yesterdays_recordings", "aliasing_probes"]
    if current is None:
        return Verdict((), hard, report | {"not_judged": [*not_judged, "size_against_last_version"]})
    shares = _shares(draft, current)
    reasons = []
    for name, limit, is_low in (
        ("landmarks_share", settings.min_landmarks_share, True),
        ("coverage_share", settings.min_coverage_share, True),
        ("bytes_share", settings.max_bytes_share, False),
    ):
        share = shares[name]
        if share < limit if is_low else share > limit:
            word = "below" if is_low else "above"
            reasons.append(f"{name} {share:.2f} of version {current.version} is {word} {limit:g}")
    report |= {"compared_with": current.version, **shares, "not_judged": not_judged}
    return Verdict(tuple(reasons), hard, report)


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
    before = {(tile.x, tile.y) for tile in current.tiles if tile.landmarks}
    after = {(tile.x, tile.y) for tile in draft.tiles if tile.landmarks}
    return {
        "landmarks_share": round(draft.landmarks / max(1, current.landmarks), 4),
        "coverage_share": round(len(before & after) / max(1, len(before)), 4),
        "bytes_share": round(draft.tile_bytes / max(1, current.tile_bytes), 4),
    }
