"""Where the loops of a build lie in its map, for people to look at. Pure."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fleetmap.geometry import Array
from mapserver.survey.loops.loops import LoopRecord, LoopVerdict
from mapserver.survey.merge.multi_session import Joined
from mapserver.survey.pipeline import Survey

MAX_REFUSED = 300  # of a build, the most alike first: they are what could have made a wrong map


def loop_places(names: Sequence[str], surveys: Sequence[Survey], joined: Joined) -> list[dict[str, Any]]:
    """Accepted loops and the refused ones that looked most alike: recording, both ends (x, y) in `map`, verdict, reason, score.

    names and surveys: of the recordings that are in the map, in their order.
    """
    ends = np.cumsum([len(trajectory) for trajectory in joined.trajectories])
    parts = np.split(joined.map.trajectory.frame_from_body, ends[:-1])
    accepted: list[dict[str, Any]] = []
    refused: list[dict[str, Any]] = []
    for name, survey, map_from_body in zip(names, surveys, parts, strict=True):
        frames = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
        # Records keep the numbers that keyframes had before parts of the survey were left out: then no places are known.
        for record in survey.loops.records if all(part.kept for part in survey.components) else ():
            place = _place(name, record, map_from_body[:, :2, 3], frames)
            (accepted if record.verdict is LoopVerdict.ACCEPTED else refused).append(place)
    refused.sort(key=lambda place: (-place["score"], place["recording"], place["from_map_m"], place["to_map_m"]))
    return accepted + refused[:MAX_REFUSED]


def _place(name: str, record: LoopRecord, places_map: Array, frames: list[int]) -> dict[str, Any]:
    start_m, end_m = (
        [round(float(value), 3) for value in places_map[frames[number]]] for number in (record.i, record.j)
    )
    return {
        "recording": name,
        "from_map_m": start_m,
        "to_map_m": end_m,
        "verdict": record.verdict.value,
        "reason": record.reason,
        "score": round(record.score, 4),
    }
