"""Dense matching of a build's keyframes at their final poses, and the update of the previous version's grid by it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, Array32
from fleetmap.version_grid import Counts, Tiles
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps.dense_stereo import STEP_PX, dense_disparity, floor_distance_m, nearest_around
from mapserver.plugins.dense_maps.site_grid import FREE, REACH_PX, SessionViews, updated
from mapserver.survey.bundle.stereo_yaw_check import disparity_shift
from mapserver.survey.stages import Survey
from mapserver.survey.state import Keyframe

_FLOOR_VIEWS = 15
# Later images from the same place take an earlier one's part once they are as many as free a voxel for sure: what they disagree on has
# changed meanwhile. Keyframes of one drive are further apart; ten degrees are an eighth of a usual lens's view.
_ALIKE_M, _ALIKE_COSINE, _ENOUGH = 0.5, math.cos(math.radians(10.0)), FREE
_NO_DEPTH = "one camera measures no depth; that needs a stereo pair or a depth camera"


@dataclass(frozen=True)
class DepthView:
    """A keyframe with its disparities as of `dense_disparity`, their standard deviation, and its pose (4, 4)."""

    keyframe: Keyframe
    disparity_px: Array32
    sigma_px: float
    map_from_cam: Array

    @cached_property
    def nearest_px(self) -> Array32:
        """Disparities as of `nearest_around`, as far around each pixel as its depth may belong to."""
        return nearest_around(self.disparity_px, REACH_PX)


def measures_depth(survey: Survey) -> bool:
    """True if its pictures contain depth: the camera of a single-camera survey may also have a baseline, set by the adjustment."""
    if not survey.state.rig.camera.baseline_m > 0:
        return False
    frame = survey.odometry.keyframes[0].frame
    return frame.right is not None or frame.disparity_px is not None


def adding_keyframes(session: MappedSession) -> list[Keyframe]:
    """Return the keyframes of a session, in order, but those from whose place enough later ones look the same way."""
    survey, kept = session.survey, list[Keyframe]()
    places, axes = np.zeros((0, 3)), np.zeros((0, 3))
    for keyframe in reversed(survey.odometry.keyframes):
        map_from_cam = session.map_from_body[keyframe.frame_index] @ survey.state.rig.body_from_cam[0]
        place, axis = map_from_cam[:3, 3], map_from_cam[:3, 2]
        alike = (np.linalg.norm(places - place, axis=1) < _ALIKE_M) & (axes @ axis > _ALIKE_COSINE)
        if alike.sum() < _ENOUGH:
            kept.append(keyframe)
            places, axes = np.vstack([places, place]), np.vstack([axes, axis])
    return kept[::-1]


def depth_view(session: MappedSession, settings: StereoSettings, keyframe: Keyframe) -> DepthView:
    """Return a keyframe of a session, densely matched."""
    survey, camera = session.survey, session.survey.state.rig.camera
    columns = np.arange(0, camera.width_px, STEP_PX, dtype=np.float64)[:, None]
    yaw_px = (survey.stereo_yaws[0].correction_px * disparity_shift(camera, columns)).astype(np.float32)
    disparity_px, sigma_px = dense_disparity(keyframe.frame, camera, settings)
    map_from_cam = session.map_from_body[keyframe.frame_index] @ survey.state.rig.body_from_cam[0]
    return DepthView(keyframe, disparity_px - yaw_px, sigma_px, map_from_cam)


class Grower(Protocol):
    """A product of densely matched keyframes, updated session by session."""

    def begin(self, session: MappedSession, some: Sequence[DepthView]) -> str | None:
        """Begin a session, of which `some` images are spread over it; return the reason if it adds nothing, None if it adds its images."""

    def add(self, view: DepthView) -> None:
        """Add a keyframe of the session."""

    def end(self) -> None:
        """Update the product by the session."""


def grow(
    growers: Mapping[str, Grower], sessions: Sequence[MappedSession], settings: StereoSettings
) -> dict[str, dict[str, str]]:
    """Match each keyframe that adds something, of all sessions, once for all growers.

    Return for each grower, by the names of recordings that add nothing, the reasons.
    """
    without: dict[str, dict[str, str]] = {name: {} for name in growers}
    for session in sessions if growers else ():
        if not measures_depth(session.survey):
            for said in without.values():
                said[session.name] = _NO_DEPTH
            continue
        keyframes = adding_keyframes(session)
        some = [depth_view(session, settings, each) for each in keyframes[:: max(1, len(keyframes) // _FLOOR_VIEWS)]]
        matched = {view.keyframe.frame_index: view for view in some}
        wanted = []
        for name, grower in growers.items():
            reason = grower.begin(session, some)
            if reason is None:
                wanted.append(grower)
            else:
                without[name][session.name] = reason
        del some
        for keyframe in keyframes if wanted else ():
            view = matched.pop(keyframe.frame_index, None) or depth_view(session, settings, keyframe)
            for grower in wanted:
                grower.add(view)
        for grower in wanted:
            grower.end()
    return without


class GridGrower:
    """The tiles of a site's grid."""

    def __init__(self, before: Mapping[tuple[int, int], Counts]) -> None:
        self.tiles: Tiles = dict(before)

    def begin(self, session: MappedSession, some: Sequence[DepthView]) -> str | None:
        camera = session.survey.state.rig.camera
        floor_m = floor_distance_m(((view.disparity_px, view.map_from_cam) for view in some), camera)
        if floor_m is None:
            return "no floor at one height below the camera: it is carried by hand, looks past the floor, or its map is not level"
        self._floor_m, self._session, self._views = floor_m, session, SessionViews(self.tiles)
        return None

    def add(self, view: DepthView) -> None:
        camera = self._session.survey.state.rig.camera
        self._views.add((view.disparity_px, view.nearest_px, view.sigma_px), camera, view.map_from_cam, self._floor_m)

    def end(self) -> None:
        survey = self._session.survey
        frames = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
        places = (self._session.map_from_body[frames] @ survey.state.rig.body_from_cam[0])[:, :3, 3]
        self._views.add_path(places, self._floor_m)
        self.tiles = updated(self._views)
