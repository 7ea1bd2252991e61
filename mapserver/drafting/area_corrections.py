"""Corrections that operators drew as areas, applied to a build: at the landmarks, the tiles, and what plug-ins make.

A point belongs to an area by its position in `map`, at any height. `forget` waits for a recording made after it that covers what is
there: its landmarks of the version before then go, once; recordings older than it add no landmarks there.
`never use` removes them from every build, `freeze` keeps those of the version before.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fleetmap.geometry import AnyArray, Array, Mask, Rings, inside_any
from fleetmap.mapformat.manifest import Manifest
from mapserver.drafting.draft_evidence import Before
from mapserver.drafting.survey_recordings import RecordingSurvey, map_trajectories
from mapserver.floor_plan.areas import CORRECTIONS_KEY, Area, Areas, CorrectionKind, due_corrections
from mapserver.floor_plan.survey_requests import COVERED_SHARE, near_drives
from mapserver.survey.merge.changes import SurveyLimits, is_before
from mapserver.survey.merge.merge import kept
from mapserver.survey.merge.multi_session import MapMerger, MergedMap, Session
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap


def _of(areas: Iterable[Area], kind: CorrectionKind) -> list[Area]:
    return [area for area in areas if area.correction is not None and area.correction.kind is kind]


def _polygons(areas: Iterable[Area]) -> tuple[Rings, ...]:
    return tuple(polygon for area in areas for polygon in area.polygons)


@dataclass(frozen=True)
class AreaCorrections:
    """The corrections of a site for one build. due: those to forget that the version before does not have yet."""

    areas: Sequence[Area] = ()
    due: Sequence[Area] = ()

    @classmethod
    def of(cls, areas: Areas, manifest: Manifest) -> "AreaCorrections":
        """Return the corrections of a site's areas for a build on a version."""
        return cls(areas.corrections, due_corrections(areas, manifest))

    def joined(
        self, base: SurveyMap | None, surveyed: Sequence[RecordingSurvey], settings: SurveySettings
    ) -> tuple[MergedMap, "AreaCorrections"]:
        """Join recordings to a map; return the result, and the corrections that it has.

        Joined once more if no recording covers one that is due: its landmarks must still be there.
        """
        frozen, unused, forget = (
            _of(self.areas, kind) for kind in (CorrectionKind.FREEZE, CorrectionKind.NEVER_USE, CorrectionKind.FORGET)
        )
        since = [(p, area.correction.since_ns or 0) for area in forget if area.correction for p in area.polygons]
        start = base
        if base is not None and (gone := self._is_gone(base.points_map)).any():
            start = kept(base, ~gone)
        merger = MapMerger(start, settings, SurveyLimits(_polygons(frozen), _polygons(unused), tuple(since)))
        for done in surveyed:
            merger.add(Session(done.survey, done.map_from_survey))
        found = merger.finish()
        left = [] if base is None else [area for area in self.due if not _is_covered(area, base, found)]
        if not left:
            return found, self
        areas, due = ([area for area in these if area not in left] for these in (self.areas, self.due))
        return AreaCorrections(areas, due).joined(base, surveyed, settings)

    def applied(self, before: Before) -> Before:
        """Return the version before as a draft is compared with it: without what is due to be forgotten, and with its removed landmarks.

        Landmarks that are never used stay in it: a draft that loses places with them is refused.
        """
        survey = before.survey
        removed = survey.landmark_ids[self._is_gone(survey.points_map)]
        is_due = self.is_due(survey.points_map)
        survey = kept(survey, ~is_due) if is_due.any() else survey
        return replace(before, survey=survey, removed_ids=removed if len(removed) else None)

    def frozen(self, points_map: AnyArray) -> Mask:
        """Return (N,) which points (N, 2) or (N, 3) are kept as in the version before."""
        return inside_any(points_map, _polygons(_of(self.areas, CorrectionKind.FREEZE)))

    @property
    def freezes(self) -> bool:
        """True if an area is kept as in the version before."""
        return bool(_of(self.areas, CorrectionKind.FREEZE))

    def configuration(self, site: str) -> dict[str, Any]:
        """Return the entry of the manifest."""
        return {CORRECTIONS_KEY: Areas.of(self.areas).geojson(site)} if self.areas else {}

    def is_due(self, points_map: AnyArray) -> Mask:
        """Return (N,) which points are forgotten now."""
        return inside_any(points_map, _polygons(self.due))

    def _is_gone(self, points_map: AnyArray) -> Mask:
        return self.is_due(points_map) | self.is_unused(points_map)

    def is_unused(self, points_map: AnyArray) -> Mask:
        """Return (N,) which points are never used."""
        return inside_any(points_map, _polygons(_of(self.areas, CorrectionKind.NEVER_USE)))


def driven_since(found: MergedMap, since_ns: int) -> Array:
    """Return the positions (F, 2) in `map` of the recordings that are not older than a moment."""
    drives = [drive for drive in map_trajectories(found) if len(drive)] if found.trajectories else []
    later = [d.positions_m[:, :2] for d in drives if not is_before(int(d.stamps_ns[-1]), since_ns)]
    return np.concatenate([np.zeros((0, 2)), *later])


def _is_covered(area: Area, base: SurveyMap, found: MergedMap) -> bool:
    """True if recordings later than the correction passed a place of most of its landmarks, or it has none."""
    inside = inside_any(base.points_map, area.polygons)
    since_ns = area.correction.since_ns or 0 if area.correction else 0
    passed = near_drives(base.map_from_body[:, :2, 3], driven_since(found, since_ns))
    seen = np.bincount(base.obs_landmark[passed[base.obs_keyframe]], minlength=len(inside)) > 0
    return not inside.any() or float(seen[inside].mean()) >= COVERED_SHARE
