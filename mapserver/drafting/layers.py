"""What a version has beside its landmarks: the grid of planners and the map that renders, where settings ask for them, and which requests
for a survey its recordings covered."""

from collections.abc import Sequence

import numpy as np

from fleetmap.version_grid import GridReport, Tiles, encode_grid, grid_report
from mapserver.drafting.survey_recordings import Surveyed, map_trajectories
from mapserver.floor_plan.survey_requests import SiteFiles, open_requests
from mapserver.grid.survey_grid import GridSession, grow_grid
from mapserver.surfels.surfel_map import SurfelReport, Surfels, encode_surfels, surfel_report
from mapserver.surfels.survey_surfels import grow_surfels
from mapserver.survey.merge.multi_session import MergedMap
from mapserver.survey.settings import SurveySettings


def layer_sessions(taken: Sequence[Surveyed], joined: MergedMap) -> list[GridSession]:
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


_CLOCKS_BEGIN_NS = 946_684_800_000_000_000  # the year 2000: stamps before are no calendar's, but count from a start


def covered_requests(files: SiteFiles, site: str, joined: MergedMap) -> dict[str, float]:
    """By id of each open request the share of its places that these recordings drove past; what is older counts for nothing."""
    places = joined.map.map_from_body[:, :2, 3]
    drives = map_trajectories(joined)
    found = {}
    for request in open_requests(files, site):
        later = [
            drive.positions_m[:, :2]
            for drive in drives
            if len(drive) and not _CLOCKS_BEGIN_NS < int(drive.stamps_ns[-1]) < request.asked_ns
        ]
        found[request.id] = round(request.covered_share(places, np.concatenate([np.zeros((0, 2)), *later])), 3)
    return {name: share for name, share in found.items() if share > 0}
