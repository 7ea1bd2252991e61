"""Tiles for robots, checked by frames of the surveys: a view without a fix, or with a weak one, gets more landmarks."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.failure_definition import is_wrong
from fleetmap.geometry import rotation_angle_rad, se3_inverse
from fleetmap.mapformat.tile import Tile
from fleetmap.mapformat.tile_codec import decode_tile, encode_tile
from fleetmap.relocalization.landmark_visibility import places_around
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import Fix, is_reliable
from fleetmap.relocalization.settings import FixSettings
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.quality.figures import BlindView, SurveyedViews
from mapserver.quality.probes import PRIOR_RADIUS_M, SAME_WAY_COSINE, Probe, place_xy, relocalized
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.survey_map import SurveyMap
from mapserver.tiles.tiling import Sighting, choose_landmarks, tiles_from_survey


class AskedView(NamedTuple):
    """A frame to be localized, and the path driven up to it in its recording."""

    probe: Probe
    path_m: float


def asked_views(sessions: Sequence[MappedSession]) -> list[AskedView]:
    """Return held-out frames of all recordings that judge no draft, and both ends of every recording."""
    found = []
    for session in sessions:
        map_from_body, positions_m = session.trajectory.frame_from_body, session.trajectory.positions_m
        path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1))])
        frames = list({(frame.number, frame.view): frame for frame in session.asked(len(sessions))}.values())
        found += [AskedView(frame.probe(map_from_body), float(path_m[frame.number])) for frame in frames]
    return found


class TileChooser(NamedTuple):
    """A map, its budget for robots, and what their tiles need.

    published: landmarks with priority, None in a first version. frozen (N,): those that are chosen only if published.
    """

    survey_map: SurveyMap
    settings: BudgetSettings
    published: NDArray[np.uint32] | None
    vocabulary: Vocabulary
    frozen: NDArray[np.bool_] | None = None

    def choose(self, views: Sequence[AskedView]) -> tuple[list[Tile], SurveyedViews]:
        """Return the tiles, and which views give no fix in them.

        The budget is chosen for what keyframes observed. A view between them or beyond the last one may match few of those
        landmarks: those that it matches among all landmarks then count as its observations, and the budget is chosen again. What one view
        gets others lose: the second choice is taken if fewer views are without a fix in it, or as many and fewer are weak.
        """
        tiles = self._tiles(())
        fixes = self._fixes(tiles, views)
        weak = [view for view, fix in zip(views, fixes, strict=True) if fix is None or not _is_sure(fix)]
        sightings = [found for view in weak if (found := self._sighting(view.probe)) is not None]
        given_more = 0
        if sightings:
            again = self._tiles(sightings)
            fixes_again = self._fixes(again, views)
            if _lacking(fixes_again) < _lacking(fixes):
                tiles, fixes, given_more = again, fixes_again, len(sightings)
        missed = [view for view, fix in zip(views, fixes, strict=True) if fix is None]
        places = [BlindView(place_xy(view.probe.map_from_cam), round(view.path_m, 1)) for view in missed]
        return tiles, SurveyedViews(len(views), given_more, places)

    def _tiles(self, sightings: Sequence[Sighting]) -> list[Tile]:
        chosen = choose_landmarks(self.survey_map, self.settings, self.published, sightings)
        if self.frozen is not None and self.published is not None:
            chosen = np.where(self.frozen, np.isin(self.survey_map.landmark_ids, self.published), chosen)
        return tiles_from_survey(self.survey_map, chosen=chosen)

    def _view(self, tiles: Sequence[Tile]) -> MapView:
        stored = [decode_tile(encode_tile(tile)) for tile in tiles]
        return MapView(stored, self.vocabulary, self.survey_map.camera.focal_px)

    def _fixes(self, tiles: Sequence[Tile], views: Sequence[AskedView]) -> list[Fix | None]:
        view = self._view(tiles)
        return [relocalized(view, each.probe, each.probe.map_from_cam) for each in views]

    def _sighting(self, probe: Probe) -> Sighting | None:
        """Return the matches of a probe among all landmarks that were observed around it; None without a fix at its place."""
        survey = self.survey_map
        map_from_cam = survey.map_from_body @ survey.body_from_cam
        near = places_around(map_from_cam, probe.map_from_cam, PRIOR_RADIUS_M, SAME_WAY_COSINE)
        around = np.zeros(len(survey.landmark_ids), bool)
        around[survey.obs_landmark[near[survey.obs_keyframe]]] = True
        view = self._view(tiles_from_survey(survey, chosen=around))
        fix = relocalized(view, probe, probe.map_from_cam)
        if fix is None or fix.matches is None:
            return None
        off = se3_inverse(probe.map_from_cam) @ fix.map_from_cam
        if is_wrong(float(np.linalg.norm(off[:3, 3])), rotation_angle_rad(off[:3, :3])):
            return None
        features, rows = fix.matches.T
        order = np.argsort(survey.landmark_ids, kind="stable")
        landmarks = order[np.searchsorted(survey.landmark_ids, view.landmark_ids[rows], sorter=order)]
        return Sighting(fix.map_from_cam, landmarks, probe.features.pixels[features])


def _lacking(fixes: Sequence[Fix | None]) -> tuple[int, int]:
    """Return the numbers of views without a fix, and of those without a sure one."""
    return fixes.count(None), sum(fix is None or not _is_sure(fix) for fix in fixes)


def _is_sure(fix: Fix) -> bool:
    """True if 95 % of other looks from there are reliable, too: the numbers that they find are distributed as Poisson's."""
    inliers, seen = (count - 1.645 * np.sqrt(count) for count in (fix.inliers, fix.seen))
    recall = seen / fix.expected if fix.expected else fix.landmark_recall
    return is_reliable(replace(fix, inliers=int(inliers), landmark_recall=recall), FixSettings())
