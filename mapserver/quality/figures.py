"""Figures of the evidence about a draft's tiles; docs/reports.md says what they mean. Light: the store reads them."""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec

from fleetmap.errors import MapFormatError
from fleetmap.mapformat import Manifest

TRUSTED_KEY = "trusted_calibrations"
"""The key of a manifest's configuration that holds the calibrations that a person trusts."""

EVIDENCE_KEY = "evidence"
"""The key of a manifest's report that holds what the gate judges by, so that it goes wherever the version goes."""


class ProbeFigures(msgspec.Struct, frozen=True):
    """Results of frames in one map. Errors and inliers are of the localised ones, None without any."""

    frames: int
    localised_share: float
    wrong_share: float
    median_error_m: float | None
    p95_error_m: float | None
    median_inliers: float | None
    residual_px: float | None


class Compared(msgspec.Struct, frozen=True):
    """The same frames in the draft and in the current version; inliers_share: draft against before, median over frames found in both."""

    draft: ProbeFigures
    before: ProbeFigures | None = None
    inliers_share: float | None = None


class Aliasing(msgspec.Struct, frozen=True):
    """Frames offered with the prior of the place elsewhere that looks most like theirs, and the share that was taken for it."""

    offered: int
    accepted_share: float


class LookAlike(msgspec.Struct, frozen=True):
    """A place, (x, y) in `map`, that is taken for another one once nothing around it is mapped; recall: landmark recall there."""

    place: tuple[float, float]
    taken_for: tuple[float, float]
    recall: float


class Starts(msgspec.Struct, frozen=True):
    """Frames without a prior in the tiles less all around their own place: robots that start where nothing is mapped.

    taken_share: of those that are taken for another place. lookalike_recall: the landmark recall that a start without a prior must
    exceed: an unmapped place like these exceeds it with a probability of at most max_wrong_share. lookalikes: the taken frames.
    """

    frames: int
    taken_share: float
    lookalike_recall: float
    max_wrong_share: float
    lookalikes: list[LookAlike]


class TrajectoryBreaks(msgspec.Struct, frozen=True):
    """Stretches of the survey against odometry: in how many separate places its trajectory is torn, and the worst difference."""

    stretches: int
    breaks: int
    worst_m: float


class TileDirections(msgspec.Struct, frozen=True):
    """Places of a tile by the heading that they look (E along x of `map`, N along y); tile: its x and y.

    seen: places by their heading. missing: headings of which nothing was seen at places that were passed the other way, with how
    many those are; empty where both ways were driven.
    """

    tile: tuple[int, int]
    seen: dict[str, int]
    missing: dict[str, int]


class RigEvidence(msgspec.Struct, frozen=True):
    """What recordings say about one calibration; rig: its fingerprint.

    judged: subjects ("pair geometry", ...) that a recording found right, of this draft or of a version that it was built on. not_judged: by
    subject what this draft's recordings lack. doubted: by subject what speaks against the calibration, without deciding.
    """

    rig: str
    judged: list[str] = []
    not_judged: dict[str, str] = {}
    doubted: dict[str, str] = {}

    def unknown(self) -> dict[str, str]:
        """By subject that nothing ever judged what is missing."""
        return {subject: missing for subject, missing in self.not_judged.items() if subject not in self.judged}


@dataclass(frozen=True, slots=True)
class TrustedCalibration:
    """A person's word that the calibration `rig` (its fingerprint) is right; subjects: those that no recording had judged by then."""

    rig: str
    subjects: list[str]
    actor: str
    reason: str

    @property
    def sentence(self) -> str:
        """It in words."""
        return f"calibration {self.rig} is trusted by {self.actor} ({self.reason}): nothing judged its {', '.join(self.subjects)}"


def trusted_calibrations(manifest: Manifest) -> list[TrustedCalibration]:
    """The calibrations of a version that a person trusts; MapFormatError for a damaged entry."""
    try:
        return msgspec.convert(manifest.configuration.get(TRUSTED_KEY, []), list[TrustedCalibration])
    except msgspec.ValidationError as error:
        raise _damaged(manifest, f"configuration.{TRUSTED_KEY}", error) from error


def merged(rigs: Iterable[RigEvidence]) -> list[RigEvidence]:
    """One for each calibration, in their order: what one recording judged is judged, what one doubts is doubted."""
    found: dict[str, RigEvidence] = {}
    for new in rigs:
        old = found.get(new.rig, RigEvidence(new.rig))
        judged = sorted({*old.judged, *new.judged})
        found[new.rig] = RigEvidence(new.rig, judged, new.not_judged | old.not_judged, new.doubted | old.doubted)
    return list(found.values())


class Evidence(msgspec.Struct, frozen=True):
    """All of it; None where there was nothing to judge by."""

    held_out: Compared | None = None
    replayed: Compared | None = None
    last_version: Compared | None = None
    aliasing: Aliasing | None = None
    aliasing_before: Aliasing | None = None
    starts: Starts | None = None
    motion: TrajectoryBreaks | None = None
    directions: list[TileDirections] | None = None
    calibrations: list[RigEvidence] | None = None


def carried_evidence(manifest: Manifest) -> Evidence | None:
    """The evidence in a manifest, without directions and starts; None for one made without. MapFormatError for a damaged entry."""
    found = manifest.report.get(EVIDENCE_KEY)
    try:
        return None if found is None else msgspec.convert(found, Evidence)
    except msgspec.ValidationError as error:
        raise _damaged(manifest, f"report.{EVIDENCE_KEY}", error) from error


def _damaged(manifest: Manifest, key: str, error: msgspec.ValidationError) -> MapFormatError:
    return MapFormatError(f"manifest of {manifest.site} version {manifest.version}: {key}: {error}; it is damaged")
