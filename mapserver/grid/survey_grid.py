"""Dense matching of a build's keyframes at their final poses, and the update of the previous version's grid by it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.version_grid import Counts, Tiles
from mapserver.grid.dense_stereo import dense_disparity, floor_distance_m, nearest_around
from mapserver.grid.site_grid import REACH_PX, SessionViews, updated
from mapserver.survey.bundle.stereo_yaw_check import disparity_shift
from mapserver.survey.stages import Survey
from mapserver.survey.state import Keyframe

_FLOOR_VIEWS = 15


class GridSession(NamedTuple):
    """A recording in the map: its name, its survey, and map_from_body (F, 4, 4) of its frames in the final frame."""

    name: str
    survey: Survey
    map_from_body: Array


@dataclass(frozen=True)
class DepthView:
    """A keyframe with its disparities (H, W), their standard deviation, and its pose (4, 4)."""

    keyframe: Keyframe
    disparity_px: NDArray[np.float32]
    sigma_px: float
    map_from_cam: Array

    @cached_property
    def nearest_px(self) -> NDArray[np.float32]:
        """(H, W) disparities as of `nearest_around`, as far around each pixel as its depth may belong to."""
        return nearest_around(self.disparity_px, REACH_PX)


def measures_depth(survey: Survey) -> bool:
    """True if its pictures contain depth: the camera of a single-camera survey may also have a baseline, set by the adjustment."""
    if not survey.state.camera.baseline_m > 0:
        return False
    frame = survey.odometry.keyframes[0].frame
    return frame.right is not None or frame.disparity_px is not None


def depth_views(session: GridSession, settings: StereoSettings, chosen: slice) -> Iterator[DepthView]:
    """Yield the chosen keyframes of a session, densely matched, in order."""
    survey, camera = session.survey, session.survey.state.camera
    columns = np.arange(camera.width_px, dtype=np.float64)[:, None]
    yaw_px = (survey.stereo_yaw.correction_px * disparity_shift(camera, columns)).astype(np.float32)
    for keyframe in survey.odometry.keyframes[chosen]:
        disparity_px, sigma_px = dense_disparity(keyframe.frame, camera, settings)
        map_from_cam = session.map_from_body[keyframe.frame_index] @ survey.state.body_from_cam
        yield DepthView(keyframe, disparity_px - yaw_px, sigma_px, map_from_cam)


class Grower(Protocol):
    """A product of densely matched keyframes, updated session by session."""

    def begin(self, session: GridSession) -> str | None:
        """Begin a session; return the reason if it adds nothing, None if its views are to be added."""

    def add(self, view: DepthView) -> None:
        """Add a keyframe of the session."""

    def end(self) -> None:
        """Update the product by the session."""


def grow(
    growers: Mapping[str, Grower], sessions: Sequence[GridSession], settings: StereoSettings
) -> dict[str, dict[str, str]]:
    """Match each keyframe of all sessions once for all growers.

    Return for each grower, by the names of recordings that add nothing, the reasons.
    """
    without: dict[str, dict[str, str]] = {name: {} for name in growers}
    for session in sessions:
        wanted = []
        for name, grower in growers.items():
            reason = grower.begin(session)
            if reason is None:
                wanted.append(grower)
            else:
                without[name][session.name] = reason
        for view in depth_views(session, settings, slice(None)) if wanted else ():
            for grower in wanted:
                grower.add(view)
        for grower in wanted:
            grower.end()
    return without


class GridGrower:
    """The tiles of a site's grid."""

    def __init__(self, before: Mapping[tuple[int, int], Counts], settings: StereoSettings) -> None:
        self.tiles: Tiles = dict(before)
        self._settings = settings

    def begin(self, session: GridSession) -> str | None:
        survey, camera = session.survey, session.survey.state.camera
        if not measures_depth(survey):
            return "one camera measures no depth; a grid needs a stereo pair or a depth camera"
        keyframes = survey.odometry.keyframes
        few = slice(None, None, max(1, len(keyframes) // _FLOOR_VIEWS))
        near = depth_views(session, self._settings, few)
        floor_m = floor_distance_m(((view.disparity_px, view.map_from_cam) for view in near), camera)
        if floor_m is None:
            return "no floor at one height below the camera: it is carried by hand, looks past the floor, or its map is not level"
        self._floor_m, self._session, self._views = floor_m, session, SessionViews(self.tiles)
        return None

    def add(self, view: DepthView) -> None:
        camera = self._session.survey.state.camera
        self._views.add((view.disparity_px, view.nearest_px, view.sigma_px), camera, view.map_from_cam, self._floor_m)

    def end(self) -> None:
        survey = self._session.survey
        frames = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
        places = (self._session.map_from_body[frames] @ survey.state.body_from_cam)[:, :3, 3]
        self._views.add_path(places, self._floor_m)
        self.tiles = updated(self._views)
