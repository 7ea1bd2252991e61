"""What a version has beside its landmarks, where settings ask for it: the grid of planners and the map that renders."""

from collections.abc import Sequence

from fleetmap.version_grid import GridReport, Tiles, encode_grid, grid_report
from mapserver.build.survey_recordings import Surveyed, map_trajectories
from mapserver.grid.survey_grid import GridSession, grow_grid
from mapserver.surfels.surfel_map import SurfelReport, Surfels, encode_surfels, surfel_report
from mapserver.surfels.survey_surfels import grow_surfels
from mapserver.survey.merge.multi_session import Joined
from mapserver.survey.settings import SurveySettings


def layer_sessions(taken: Sequence[Surveyed], joined: Joined) -> list[GridSession]:
    """The recordings that are in the map, where their frames are in its final frame."""
    places = [trajectory.frame_from_body for trajectory in map_trajectories(joined)]
    return [GridSession(s.entry.name, s.survey, place) for s, place in zip(taken, places, strict=True)]


def grid_layer(
    settings: SurveySettings, sessions: Sequence[GridSession], before: Tiles
) -> tuple[list[bytes], GridReport | None]:
    """The grid of the version before, with what the recordings saw if that is wanted; its bytes, and words about it."""
    tiles, without = grow_grid(before, sessions if settings.occupancy_grid else [], settings.stereo)
    blobs = encode_grid(tiles)
    return blobs, grid_report(blobs, without) if blobs or without else None


def surfel_layer(
    settings: SurveySettings, sessions: Sequence[GridSession], before: Surfels
) -> tuple[list[bytes], SurfelReport | None]:
    """The surfels of the version before with what the recordings saw, if they are wanted; their bytes, and words about them."""
    if not settings.surfel_map:
        return [], None
    surfels, without = grow_surfels(before, sessions, settings.stereo)
    blobs = encode_surfels(surfels)
    return blobs, surfel_report(blobs, len(surfels), without)
