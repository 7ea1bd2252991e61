"""Figures of the evidence about a draft's tiles; see docs/reports.md. Light imports: the store reads them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec

from fleetmap.mapformat.manifest import Manifest, manifest_entry

TRUSTED_KEY = "trusted_calibrations"
"""Key of a manifest's configuration with the calibrations trusted by an operator."""

EVIDENCE_KEY = "evidence"
"""Key of a manifest's report with the gate's evidence, which therefore stays with the version."""


def first_of(words: Sequence[str], most: int = 3) -> str:
    """Return the first ones as one text, with the number of the others."""
    more = [f"and {len(words) - most} more"] if len(words) > most else []
    return "; ".join([*words[:most], *more])


class ProbeFigures(msgspec.Struct, frozen=True):
    """Results of frames in one map. Errors and inliers are of the localised ones, None without any."""

    frames: int
    localised_share: float
    wrong_share: float
    median_error_m: float | None
    p95_error_m: float | None
    median_inliers: float | None
    residual_px: float | None


class Comparison(msgspec.Struct, frozen=True):
    """The same frames in the draft and in the current version; inliers_share: draft against before, median over frames found in both."""

    draft: ProbeFigures
    before: ProbeFigures | None = None
    inliers_share: float | None = None


class Aliasing(msgspec.Struct, frozen=True):
    """Frames offered with the prior of the most similar other place, and the share wrongly localised there."""

    offered: int
    accepted_share: float


class Displacement(msgspec.Struct, frozen=True):
    """Frames of one recording localized anywhere in the version before: their number, and how many of them agree on one other place.

    off_m: median distance of these from where the draft has them.
    """

    recording: str
    frames: int
    elsewhere: int
    off_m: float


class LookAlike(msgspec.Struct, frozen=True):
    """A place, (x, y) in `map`, mistaken for another one if its surroundings are unmapped; recall: landmark recall there."""

    place: tuple[float, float]
    taken_for: tuple[float, float]
    recall: float


class Starts(msgspec.Struct, frozen=True):
    """Frames without a prior in the tiles without those around their own place: robots that start at an unmapped place.

    taken_share: share localised at another place. lookalike_recall: landmark recall that a start without a prior must
    exceed: an unmapped place like these exceeds it with a probability of at most max_wrong_share; or lookalike_inliers, with the same
    probability. lookalikes: the wrongly localised frames.
    """

    frames: int
    taken_share: float
    lookalike_recall: float
    max_wrong_share: float
    lookalikes: list[LookAlike]
    lookalike_inliers: int | None = None


class Repetition(msgspec.Struct, frozen=True):
    """Frames asked for every place of the draft that they show: smallest distance from one to another place that robots accept.

    step_m: None if no frame shows another place.
    """

    frames: int
    step_m: float | None


class BlindView(msgspec.Struct, frozen=True):
    """A view of a survey without a fix in the draft: (x, y) in `map`, and the path driven up to it in its recording."""

    place: tuple[float, float]
    path_m: float


class SurveyedViews(msgspec.Struct, frozen=True):
    """Held-out frames and both ends of every recording, localized in the tiles from a prior at their own place.

    frames: their number. given_more: number of those for which the budget was chosen again, since their fix was none or weak.
    without_fix: those that have none yet.
    """

    frames: int
    given_more: int
    without_fix: list[BlindView]

    @property
    def warning(self) -> str:
        """The views without a fix, as text; empty if there are none."""
        if not self.without_fix:
            return ""
        named = [f"({v.place[0]:g}, {v.place[1]:g}), {v.path_m:g} m into its recording" for v in self.without_fix]
        return f"{len(named)} of {self.frames} frames of the surveys get no fix in the map ({first_of(named)})"


class TrajectoryBreaks(msgspec.Struct, frozen=True):
    """Stretches of the survey against odometry: number of separate breaks of its trajectory, and the worst difference."""

    stretches: int
    breaks: int
    worst_m: float


class TileDirections(msgspec.Struct, frozen=True):
    """Places of a tile by heading (E along x of `map`, N along y); tile: its x and y.

    seen: places by their heading. missing: unseen headings of places passed the other way, with their
    number; empty if both ways were driven.
    """

    tile: tuple[int, int]
    seen: dict[str, int]
    missing: dict[str, int]


class RigEvidence(msgspec.Struct, frozen=True):
    """Evidence of recordings on one calibration; rig: its fingerprint.

    judged: subjects ("pair geometry", ...) found right by a recording, of this draft or of a version that it was built on. not_judged: by
    subject the data missing in this draft's recordings. doubted: by subject the undecided evidence against the calibration.
    pair_yaw: radians and sigma by which the right camera is turned against it, the surest of surveys that judged the pair.
    """

    rig: str
    judged: list[str] = []
    not_judged: dict[str, str] = {}
    doubted: dict[str, str] = {}
    pair_yaw: tuple[float, float] | None = None

    def unknown(self) -> dict[str, str]:
        """The missing data by subject never judged."""
        return {subject: missing for subject, missing in self.not_judged.items() if subject not in self.judged}


@dataclass(frozen=True, slots=True)
class TrustedCalibration:
    """An operator's confirmation that the calibration `rig` (fingerprint) is right; subjects: those not judged by then."""

    rig: str
    subjects: list[str]
    actor: str
    reason: str

    @property
    def sentence(self) -> str:
        """It as text."""
        return f"calibration {self.rig} is trusted by {self.actor} ({self.reason}): nothing judged its {', '.join(self.subjects)}"


def trusted_calibrations(manifest: Manifest) -> list[TrustedCalibration]:
    """Return the calibrations of a version trusted by an operator; MapFormatError for a damaged entry."""
    return manifest_entry(manifest, "configuration", TRUSTED_KEY, list[TrustedCalibration]) or []


def merged(rigs: Iterable[RigEvidence]) -> list[RigEvidence]:
    """Merge the evidence per calibration, in order: judged if one recording judged it, doubted if one doubts it."""
    found: dict[str, RigEvidence] = {}
    for new in rigs:
        old = found.get(new.rig, RigEvidence(new.rig))
        judged = sorted({*old.judged, *new.judged})
        yaws = [each.pair_yaw for each in (new, old) if each.pair_yaw is not None]
        best = min(yaws, key=lambda yaw: yaw[1], default=None)
        found[new.rig] = RigEvidence(new.rig, judged, new.not_judged | old.not_judged, new.doubted | old.doubted, best)
    return list(found.values())


class Evidence(msgspec.Struct, frozen=True):
    """All evidence; None for a part without data."""

    held_out: Comparison | None = None
    replayed: Comparison | None = None
    last_version: Comparison | None = None
    displaced: list[Displacement] | None = None
    aliasing: Aliasing | None = None
    aliasing_before: Aliasing | None = None
    starts: Starts | None = None
    repetition: Repetition | None = None
    views: SurveyedViews | None = None
    motion: TrajectoryBreaks | None = None
    directions: list[TileDirections] | None = None
    calibrations: list[RigEvidence] | None = None


def pair_yaws(known: Iterable[Evidence | None], least_sigmas: float) -> dict[str, tuple[float, float]]:
    """Return by calibration the surest `pair_yaw` of versions, of those that are beyond so many of their sigmas."""
    yaws = {rig.rig: rig.pair_yaw for rig in merged(r for each in known if each for r in each.calibrations or ())}
    return {rig: yaw for rig, yaw in yaws.items() if yaw is not None and abs(yaw[0]) > least_sigmas * yaw[1]}


def carried_evidence(manifest: Manifest) -> Evidence | None:
    """Return the evidence in a manifest, without directions, starts and views; None if absent. MapFormatError for a damaged entry."""
    return manifest_entry(manifest, "report", EVIDENCE_KEY, Evidence)
